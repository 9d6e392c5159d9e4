"""Gymnasium's own environments and the worlds compiled from their tables are the same."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from gridworld import InputError, compile_env, compile_mdp
from gridworld.world.evaluation import Evaluator
from gridworld.world.solver import value_iteration
from gridworld.world.sources.environment import compile_id
from gridworld.world.sources.gymnasium_table import has_table

EVERY = {
    "frozen_lake": ("FrozenLake-v1", {"is_slippery": False}, 100),
    "cliff_walking": ("CliffWalking-v1", {}, None),
    "taxi": ("Taxi-v4", {}, 200),
    "slippery_lake": ("FrozenLake-v1", {}, 100),
    "large_lake": ("FrozenLake8x8-v1", {}, 200),
    "slippery_cliff": ("CliffWalkingSlippery-v1", {}, None),
    "rainy_taxi": ("Taxi-v4", {"is_rainy": True}, 200),
}


@pytest.fixture(scope="module")
def world():
    """{name: (its world, the real environment)}, made once."""
    made = {}

    def of(name):
        if name not in made:
            env_id, kwargs, _ = EVERY[name]
            real = gym.make(env_id, disable_env_checker=True, **kwargs)
            made[name] = compile_id(env_id, kwargs), real
        return made[name]

    return of


@pytest.mark.parametrize("name", EVERY)
def test_every_row_is_that_of_the_table_and_the_step_limit_that_of_the_id(world, name):
    mdp, env = world(name)
    env_id, _, limit = EVERY[name]
    assert (mdp.name, mdp.max_episode_steps, gym.spec(env_id).max_episode_steps) == (env_id, limit, limit)
    real = env.unwrapped
    assert (mdp.num_numbers, mdp.num_actions) == (env.observation_space.n, env.action_space.n)
    assert np.array_equal(mdp.start[: mdp.num_numbers], real.initial_state_distrib)
    for state in np.flatnonzero(~mdp.terminal).tolist():
        for action in range(mdp.num_actions):
            targets = mdp.next_state[state, action]
            found = (mdp.probability[state, action], mdp.number[targets], mdp.reward[state, action])
            ours = np.stack([*found, mdp.terminal[targets]]).T
            ours = [tuple(row) for row in ours.tolist() if row[0] > 0]
            theirs = [row for row in real.P[state][action] if row[0] > 0]
            if not mdp.reachable[state]:  # a step that nobody takes needs no end of its own
                ours, theirs = ([row[:3] for row in rows] for rows in (ours, theirs))
            assert ours == theirs


def outcomes(mdp):
    """{(number, action): {(number that follows, reward, whether it is over): probability}}."""
    found = {}
    for state in np.flatnonzero(mdp.acting).tolist():
        for action in range(mdp.num_actions):
            row = found[int(mdp.number[state]), action] = {}
            each = (table[state, action] for table in (mdp.next_state, mdp.reward, mdp.probability))
            for following, reward, chance in zip(*each, strict=True):
                if chance > 0:
                    key = int(mdp.number[following]), float(reward), bool(mdp.terminal[following])
                    row[key] = row.get(key, 0.0) + float(chance)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frozen_lake", "slippery_lake", "cliff_walking", "slippery_cliff", "taxi"])
def test_the_table_is_what_a_search_finds(world, name):
    env_id, kwargs, _ = EVERY[name]
    table, searched = outcomes(world(name)[0]), outcomes(compile_id(env_id, kwargs, by_table=False))
    assert (
        table.keys() <= searched.keys()
    )  # where the starts of Taxi sum to less than 1, it starts in state 0
    for key, row in table.items():
        assert row == pytest.approx(searched[key], abs=1e-14)


def test_a_step_limit_may_be_given():
    assert compile_id("FrozenLake-v1", {"max_episode_steps": 7}).max_episode_steps == 7


def naive_value(real, gamma, sweeps):
    values = [0.0] * len(real.P)
    for _ in range(sweeps):
        values = [
            max(
                sum(p * (r + gamma * (0.0 if ended else values[n])) for p, n, r, ended in row)
                for row in real.P[state].values()
            )
            for state in range(len(values))
        ]
    return float(real.initial_state_distrib @ values)


@pytest.mark.parametrize(
    ("name", "gamma", "sweeps", "known"),
    [
        ("frozen_lake", 0.99, 20, 0.99**5),
        ("slippery_lake", 0.99, 1000, 0.5420),
        ("cliff_walking", 1.0, 30, -13.0),
        ("taxi", 1.0, 30, 7.93),
    ],
)
def test_the_optimum_is_that_of_a_naive_solver(world, name, gamma, sweeps, known):
    mdp, env = world(name)
    value = float(mdp.start @ np.where(mdp.start > 0, value_iteration(mdp, gamma).v, 0.0))
    assert value == pytest.approx(naive_value(env.unwrapped, gamma, sweeps), abs=1e-3)
    assert value == pytest.approx(known, abs=0.005)


def test_names_and_places(world):
    assert world("slippery_lake")[0].action_names == ("left", "down", "right", "up")
    assert world("cliff_walking")[0].action_names == ("up", "right", "down", "left")
    assert world("taxi")[0].action_names == ("south", "north", "east", "west", "pickup", "dropoff")
    assert world("cliff_walking")[0].places[25].tolist() == [0, 2, 1]
    assert world("large_lake")[0].places[-1].tolist() == [0, 7, 7]
    taxi, env = world("taxi")
    for state in (0, 123, 499):
        row, col, passenger, destination = env.unwrapped.decode(state)
        assert taxi.places[state].tolist() == [passenger * 4 + destination, row, col]


class TableEnv(gym.Env):
    """Two states: action 1 in the second one ends with 1; a subclass does it otherwise."""

    def __init__(self):
        self.observation_space, self.action_space = spaces.Discrete(2), spaces.Discrete(2)
        self.initial_state_distrib = [1.0, 0.0]
        self.P = {s: {0: [(1.0, 0, 0.0, False)], 1: [(1.0, 1, float(s), s == 1)]} for s in (0, 1)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.s = 0
        return self.s, {}

    def step(self, action):
        _, self.s, reward, terminated = self.P[self.s][action][0]
        return self.s, reward, terminated, False, {}


def test_an_environment_of_ones_own_will_do():
    env = TableEnv()
    mdp = compile_env(env)
    assert (mdp.name, mdp.action_names, mdp.max_episode_steps) == ("TableEnv", ("0", "1"), None)
    assert mdp.truth == "enumerated, 3 states"  # with that in which it is over
    assert mdp.places is None
    assert mdp.number.tolist() == [0, 1, 1]
    by_table = compile_mdp(env.P, env.initial_state_distrib)
    assert by_table.digest() == compile_mdp(env.P, start=0).digest()
    for name in ("next_state", "probability", "reward", "terminal", "start", "number"):
        assert np.array_equal(getattr(by_table, name), getattr(mdp, name)), name
    assert value_iteration(mdp, 0.9).v.tolist() == pytest.approx([0.9, 1.0, 0.0])


def redrawn(self, **kwargs):
    self.P = {**self.P, 1: {**self.P[1], 0: [(1.0, 0, self.P[1][0][0][2] + 1.0, False)]}}
    return TableEnv.reset(self, **kwargs)


@pytest.mark.parametrize(
    ("method", "other", "told"),
    [
        ("reset", redrawn, "a reset does not always lead to the same state"),
        ("step", lambda self, action: 1 / 0, "a step with action 0 fails: ZeroDivisionError: division"),
        ("reset", lambda self, **_: (None, {}), "an observation is None, which is not in its space"),
    ],
)
def test_an_environment_with_a_table_that_is_no_world_is_refused(method, other, told):
    with pytest.raises(InputError, match=told):
        compile_env(type("Odd", (TableEnv,), {method: other})())


def test_steps_count_and_not_a_table_that_they_do_not_follow():
    def later(self, **kwargs):
        TableEnv.reset(self, **kwargs)
        self.s = 1
        return 1, {}

    assert compile_env(type("Later", (TableEnv,), {"reset": later})()).start.tolist() == [0.0, 1.0, 0.0]
    env = TableEnv()
    env.step = lambda action: (0, 1.0, False, False, {})
    assert compile_env(env).reward.tolist() == [[[1.0], [1.0]], [[0.0], [0.0]]]
    lake = gym.make("FrozenLake-v1").unwrapped
    other = type("Other", (type(lake),), {"step": lambda self, action: type(lake).step(self, 3 - action)})()
    assert compile_env(other).truth.startswith("enumerated")


def test_the_wrappers_of_an_id_belong_to_its_world():
    wraps = gym.wrappers
    changing = {
        "rewards": (lambda env: wraps.TransformReward(env, lambda r: -r), -1.0, 2),
        "actions": (lambda env: wraps.TransformAction(env, lambda a: 1 - a, env.action_space), 1.0, 2),
        "observations": (
            lambda env: wraps.TransformObservation(env, lambda s: 1 - s, env.observation_space),
            1.0,
            2,
        ),
        "steps": (lambda env: wraps.MaxAndSkipObservation(env, 2), 1.0, 1),
    }
    for wrapper, reward, steps in changing.values():
        gym.register("Wrapped-v0", lambda wrapper=wrapper, **_: wrapper(TableEnv()), max_episode_steps=20)
        mdp = compile_id("Wrapped-v0")
        del gym.registry["Wrapped-v0"]
        assert mdp.max_episode_steps == 20
        assert mdp.reward.sum() == reward
        judge = Evaluator(mdp, 0.9, 20)
        assert judge.optimal_value == pytest.approx(0.9 ** (steps - 1) if reward > 0 else 0.0)


ROW = [(1.0, 0, 0.0, False)]


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"P": {0: {0: ROW, 1: ROW}, 2: {0: ROW, 1: ROW}}}, "P must have for each of 2 states and 2 actions"),
        ({"P": [[ROW, ROW], [ROW]]}, "P must have"),
        ({"P": [[ROW, ROW], [ROW, []]]}, "P must have"),
        ({"P": [[ROW, ROW], [ROW, [(1.0, 0, 0.0)]]]}, "P must have"),
        ({"P": [[ROW, ROW], [ROW, 3]]}, "P must have"),
        ({"P": [[ROW, ROW], [ROW, [(1.0, 2, 0.0, False)]]]}, "next state from 0 to 1"),
        ({"P": [[ROW, ROW], [ROW, [(1.0, 0, 0.0, None)]]]}, "P must have"),
        ({"P": [[ROW, ROW], [ROW, [(0.5, 0, 0.0, False)]]]}, "probability of state 1, action 1"),
        ({"P": [[ROW, ROW], [ROW, [(1.0, 0, float("nan"), False)]]]}, "reward of state 1, action 1"),
        ({"start": [1.0]}, "start must be the 2 probabilities"),
        ({"start": None}, "start must be the 2 probabilities"),
        ({"start": 2}, "start must be the 2 probabilities"),
        ({"P": {}}, "start must be the 0 probabilities"),
        ({"P": [[ROW]] * 1_100_000}, "1,100,000 states and 1 actions are too many"),
    ],
)
def test_a_table_that_is_none_is_refused(changed, told):
    given = {"P": TableEnv().P, "start": [1.0, 0.0]} | changed
    with pytest.raises(InputError, match=f"^P: .*{told}"):
        compile_mdp(given["P"], given["start"])


@pytest.mark.parametrize(
    ("env_id", "kwargs", "told"),
    [
        (
            "FrozenLak-v1",
            {},
            "env.id=FrozenLak-v1: is not registered with Gymnasium .*Did you mean: `FrozenLake`",
        ),
        ("FrozenLake-v9", {}, "env.id=FrozenLake-v9: .*`v1`"),
        ("no such id", {}, "env.id=no such id: "),
        (3, {}, "env.id=3: "),
        ("no_module.here:Any-v0", {}, "env.id=no_module.here:Any-v0: no module no_module; install"),
        (":Any-v0", {}, "env.id=:Any-v0: is not registered with Gymnasium"),
        ("gymnasium:Lake-v1", {}, "the module gymnasium has no Lake-v1, nor is it registered with"),
        ("CartPole-v1", {}, r"its states are continuous: .*cartpole.py"),
        ("FrozenLake-v1", {"is_slipery": True}, "env.kwargs={is_slipery: True}: .*argument 'is_slipery'"),
        ("FrozenLake-v1", {"map_name": "9x9"}, "env.kwargs={map_name: 9x9}: FrozenLake-v1 cannot be made"),
        ("FrozenLake-v1", {"map_name": None}, "a different table each time it is made"),
        ("FrozenLake-v1", {"desc": ["FF", "FG"]}, "start is .*must be probabilities"),
        ("Taxi-v4", {"render_mode": "human"}, "env.kwargs: render_mode=human is not part"),
    ],
)
def test_an_id_that_makes_no_world_is_refused(env_id, kwargs, told):
    with pytest.raises(InputError, match=told.replace("{", r"\{").replace("}", r"\}")) as refused:
        compile_id(env_id, kwargs)
    assert "\n" not in str(refused.value)


def test_an_id_may_name_the_module_that_registers_it(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    lines = 'import gymnasium\ngymnasium.register("Lake-v7", "gymnasium.envs.toy_text:FrozenLakeEnv")\n'
    (tmp_path / "lake_registry.py").write_text(lines)
    (tmp_path / "lake_mistake.py").write_text("import sys\nsys.exit('no lake')\n")
    with pytest.raises(InputError, match=r"lake_mistake cannot be imported .SystemExit: no lake"):
        compile_id("lake_mistake:Lake-v7")
    mdp = compile_id("lake_registry:Lake-v7", {"is_slippery": False})
    assert (mdp.name, mdp.max_episode_steps) == ("lake_registry:Lake-v7", None)
    del gym.registry["Lake-v7"]


def test_a_table_that_lacks_something_is_left_out():
    assert [
        has_table(gym.make("Taxi-v4", fickle_passenger=fickle).unwrapped) for fickle in (False, True)
    ] == [True, False]


def test_the_environment_is_left_as_it_is():
    env = gym.make("Taxi-v4", render_mode="ansi")
    env.reset(seed=5)
    before = env.unwrapped.s, env.unwrapped.np_random.bit_generator.state, env.render()
    compile_env(env)
    assert before == (env.unwrapped.s, env.unwrapped.np_random.bit_generator.state, env.render())
