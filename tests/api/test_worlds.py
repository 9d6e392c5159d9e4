"""What `evaluate` takes: a world by name, as a map, an environment, a batch or a run; tables and models."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import FlattenObservation, TimeLimit
from helpers.support import ROOT, SHORT
from sb3_contrib import QRDQN, TRPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

import gridworld
from gridworld import GridWorldEnv, InputError, Mdp, compile_mdp, load

RAW, LAKE = "GridWorld-v0", "FrozenLake-v1"
NEED_MORE = {"arrays", "built", "enumerated", "gymnasium"}  # env.path, env.builder, env.id
LIKE_TAXI = {"cliff_walking_v1", "frozen_lake_v1", "frozen_lake_v1_dry", "frozen_lake_8x8_v1"}  # Gymnasium's
NAMES = sorted({path.stem for path in (ROOT / "conf" / "env").glob("*.yaml")} - NEED_MORE - LIKE_TAXI)


def same(first: Mdp, second: Mdp) -> bool:
    arrays = ("next_state", "probability", "reward", "terminal", "start")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in arrays)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_the_world_of_the_command_line(name: str) -> None:
    env = gridworld.compose(f"env={name}").env
    wanted = env.compile()
    limit = env.step_limit(wanted)
    world, batch = gridworld.compile_env(name), gridworld.make_vec_env(name, n_envs=2, observation="none")
    assert same(world, wanted)
    assert same(batch.envs.mdp, wanted)
    assert (world.max_episode_steps, batch.envs.max_episode_steps) == (limit, limit)
    if name not in ("cliff", "river_swim", "taxi_v4"):
        return  # the others are no others for whoever takes a name
    actions = np.zeros(wanted.num_states, dtype=int)
    exact = gridworld.evaluate(actions, wanted, max_episode_steps=limit)
    assert gridworld.evaluate(actions, name) == exact
    evaluator = gridworld.ExactEvalCallback(name).evaluator
    assert evaluator is not None
    assert same(evaluator.mdp, wanted)
    assert evaluator.max_episode_steps == limit


@pytest.mark.parametrize(
    ("name", "limit", "places"),
    [
        (
            "classic",
            100,
            [
                *(gym.make(RAW), gridworld.OneHotObservation(gym.make(RAW)), GridWorldEnv(), load("classic")),
                *(gym.make_vec(RAW, num_envs=3), gridworld.make_vec_env("classic", n_envs=2)),
                *(DummyVecEnv([lambda: gym.make(RAW)]), compile_mdp(load("classic"))),
            ],
        ),
        (
            "classic",
            5,
            [
                gym.make(RAW, max_episode_steps=5),
                gym.make_vec(RAW, num_envs=2, max_episode_steps=5),
                gridworld.make_vec_env(max_episode_steps=5),
                DummyVecEnv([lambda: TimeLimit(GridWorldEnv(), 5)]),
            ],
        ),
        (
            "frozen_lake_v1",
            100,
            [
                *(LAKE, gym.make(LAKE), make_vec_env(LAKE, 2)),
                gym.make_vec(LAKE, 2, vectorization_mode="sync"),
            ],
        ),
        ("frozen_lake_v1", 7, [TimeLimit(gym.make(LAKE).unwrapped, 7)]),
    ],
    ids=lambda value: None if isinstance(value, list) else str(value),
)
def test_whatever_holds_a_world_is_that_world(name: str, limit: int, places: list[Any]) -> None:
    world = gridworld.compile_env(name)
    down = np.ones(world.num_states, dtype=int)
    wanted = gridworld.evaluate(down, world, max_episode_steps=limit)
    for place in places:
        assert gridworld.evaluate(down, place) == wanted


def test_tables_and_step_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lake, grid = gym.make(LAKE), gym.make(RAW)
    assert repr(gridworld.compile_env(lake)) == "<Mdp FrozenLake-v1: 16 states, 4 actions>"
    assert gridworld.compile_env(lake.unwrapped).max_episode_steps is None
    assert gridworld.compile_env(grid) is grid.unwrapped.mdp  # type: ignore[attr-defined]
    monkeypatch.chdir(tmp_path)
    Path("mine.txt").write_text("S.G\n")
    assert gridworld.compile_env("mine.txt").num_states == 3
    bare, cliff = gridworld.make_vec_env(layout="cliff", n_envs=1).envs.mdp, compile_mdp(load("cliff"))
    assert same(bare, cliff)
    assert not same(bare, gridworld.compile_env("cliff"))
    slippery = gridworld.make_vec_env("cliff", n_envs=1, slip=0.1, max_episode_steps=7).envs
    assert slippery.max_episode_steps == 7
    assert same(slippery.mdp, gridworld.compose("env=cliff", "env.slip=0.1").env.compile())
    for batch in (
        gridworld.make_vec_env(cliff),
        gridworld.make_vec_env(mdp=cliff),
        gridworld.make_vec(cliff),
    ):
        assert getattr(batch, "envs", batch).max_episode_steps == 100
    shorter = gridworld.make_vec(gridworld.compile_env("cliff_walking"), max_episode_steps=100)
    assert gridworld.compile_env(shorter).max_episode_steps == 100
    assert gridworld.make_vec(gridworld.compile_env(gym.make("CliffWalking-v1"))).max_episode_steps is None
    taxi = gridworld.compile_env(gym.make("Taxi-v4"))
    batch = gridworld.make_vec(taxi, 50)
    assert (batch.num_envs, batch.max_episode_steps, batch.single_action_space.n) == (50, 200, 6)
    states, _ = batch.reset(seed=0)
    assert (taxi.start[states] > 0).all()
    assert batch.step(np.zeros(50, dtype=int))[1].tolist() == [-1.0] * 50
    model = PPO("MlpPolicy", gridworld.make_vec_env("river_swim", n_envs=2), n_steps=8, batch_size=16)
    assert gridworld.evaluate(model).outcome == gridworld.evaluate(model, "river_swim").outcome


def test_a_run_is_scored_on_its_own_world() -> None:
    run = gridworld.train(
        "agent=q_learning", "env=cliff_walking", "evaluation.gamma=0.9", total_timesteps=500, progress=False
    )
    score = gridworld.evaluate(run.policy.greedy, run)
    assert score.value == run.summary["value"]
    assert score.outcome.timeout == pytest.approx(run.summary["timeout_probability"])
    assert gridworld.evaluate(run.policy.greedy, "cliff_walking", gamma=0.9) == score
    assert gridworld.evaluate(q=run.model, env=run) == score
    assert gridworld.evaluate(run.policy.sampled, run).value == run.summary["sampled"]["value"]


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (
            lambda: gridworld.evaluate([1], "clif"),
            "env=clif: no such choice; choose from .*; did you mean cliff",
        ),
        (lambda: gridworld.evaluate([1], "Nowhere-v1"), "env.id=Nowhere-v1: "),
        (lambda: gridworld.evaluate([1], "arrays"), "env.path: has no value"),
        (lambda: gridworld.compile_env("nowhere"), "env=nowhere: .* choose from aima_4x3, "),
        (lambda: gridworld.compile_env(gym.make("CartPole-v1")), "its states are continuous"),
        (lambda: gridworld.compile_env(make_vec_env("CartPole-v1", 1)), "its states are continuous"),
        (lambda: gridworld.compile_env(3), "env: int is not an environment"),
        (lambda: gridworld.compile_mdp("classic"), "layout='classic': must be a Layout; load"),  # type: ignore[arg-type]
        (lambda: gridworld.make_vec("FrozenLake"), "mdp=FrozenLake: must be a compiled world"),
        (
            lambda: gridworld.make_vec_env("cliff", slop=1),
            "slop: is not a setting of env=cliff; did you mean sl",
        ),
        (lambda: gridworld.make_vec_env("river_swim", source="deep_sea"), "source: is not a setting of"),
        (lambda: gridworld.make_vec_env("taxi_v4", slip=0.1), "slip: is not a setting of env=taxi_v4"),
        (
            lambda: gridworld.make_vec_env("cliff", layout="four_rooms"),
            "env=cliff, layout=four_rooms: are 2 w",
        ),
        (lambda: gridworld.make_vec_env(slip=2), "slip=2: must be from 0 to 1"),
        (lambda: gridworld.make_vec_env(layout="nowhere"), "neither a shipped layout"),
        (lambda: gridworld.make_vec_env(observation="pixels"), "observation kind 'pixels': must be one_hot"),
        (lambda: gridworld.make_vec_env(n_envs=0), "num_envs"),
    ],
)
def test_what_is_no_world_is_refused(call: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        call()


def by_hand(env, policy, steps):
    """(probability of the goal, expected length) of an episode on a lake, from P alone."""
    at, goal, length = env.unwrapped.initial_state_distrib.copy(), 0.0, 0.0
    for _ in range(steps):
        length += at.sum()
        following = np.zeros_like(at)
        for state in np.flatnonzero(at):
            for action, chosen in enumerate(policy[state]):
                for p, target, reward, ended in env.unwrapped.P[int(state)][action]:
                    goal += at[state] * chosen * p * (reward if ended else 0.0)
                    following[target] += 0.0 if ended else at[state] * chosen * p
        at = following
    return goal, length


@pytest.mark.parametrize("seen_as", [lambda env: env, FlattenObservation])
def test_a_model_that_saw_the_environment_itself_is_scored_exactly(seen_as):
    env = gym.make("FrozenLake-v1", max_episode_steps=30)
    model = PPO("MlpPolicy", seen_as(env), n_steps=8, batch_size=8, seed=0, device="cpu")
    observations = np.arange(16) if seen_as is not FlattenObservation else np.eye(16, dtype=np.int64)
    with torch.no_grad():
        tensor = model.policy.obs_to_tensor(observations)[0]
        policy = model.policy.get_distribution(tensor).distribution.probs.double().numpy()
    for place in (seen_as(env), None):
        found = gridworld.evaluate(model, place, deterministic=False).outcome
        assert (found.goal, found.expected_length) == pytest.approx(by_hand(env, policy, 30), rel=1e-5)
    assert gridworld.evaluate(policy, env).outcome.goal == pytest.approx(found.goal, rel=1e-5)


# ---- scores of tables and of models of plain SB3 code, against asking their `predict` ----------------------


WORLD = compile_mdp(load("aima_4x3"), slip=0.2, step_reward=-0.04)
SMALL: dict[type, dict[str, Any]] = {
    DQN: {"buffer_size": 500, "learning_starts": 20},
    QRDQN: {"buffer_size": 500, "learning_starts": 20},
    PPO: {"n_steps": 64},
    TRPO: {"n_steps": 128},
    A2C: {},
}
WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "none": lambda env: env,
    "one_hot": gridworld.OneHotObservation,
    "coordinates": gridworld.CoordinateObservation,
    "image": gridworld.ImageObservation,
}


def expected(policy: Any, **others: Any) -> gridworld.Score:
    return gridworld.Evaluator(WORLD, others.get("gamma", 0.99), others.get("limit", 100)).score(policy)


def trained(algorithm: Any, env: Any, policy: str = "MlpPolicy", **settings: Any) -> Any:
    return algorithm(policy, env, seed=0, **SMALL[algorithm], **settings).learn(200)


def by_predict(model: Any, observations: Any) -> list[int]:
    return [int(model.predict(each, deterministic=True)[0]) for each in observations]


def test_tables() -> None:
    actions = np.arange(12) % 4
    table = np.eye(4)[actions]
    assert gridworld.evaluate(actions, WORLD) == expected(table)
    assert gridworld.evaluate(actions.tolist(), WORLD, gamma=0.9) == expected(table, gamma=0.9)
    uniform = np.full((12, 4), 0.25)
    assert gridworld.evaluate(uniform, WORLD, max_episode_steps=7) == expected(uniform, limit=7)
    best = gridworld.Evaluator(WORLD, 0.99, 100).solution.q
    assert gridworld.evaluate(q=best, env=WORLD).certified
    assert gridworld.evaluate(q=table, env=WORLD) == expected(table)


@pytest.mark.parametrize(
    ("algorithm", "kind"),
    [
        *[(PPO, kind) for kind in ("none", "one_hot", "coordinates")],
        *[(DQN, "none"), (QRDQN, "one_hot"), (TRPO, "coordinates"), (A2C, "image")],
    ],
)
def test_models_of_plain_sb3(algorithm: Any, kind: str) -> None:
    env = WRAPPERS[kind](gym.make(RAW, mdp=WORLD))
    model = trained(algorithm, env)
    rows = gridworld.make_vec_env(observation=kind, mdp=WORLD).observation.table()
    score = gridworld.evaluate(by_predict(model, rows), WORLD)
    assert gridworld.evaluate(model) == gridworld.evaluate(model, env) == score
    assert gridworld.evaluate(model, WORLD) == gridworld.evaluate(model.policy, WORLD) == score
    random = gridworld.evaluate(model, deterministic=False)
    assert random != score
    assert 0 < random.outcome.goal < 1


@pytest.mark.parametrize("agent", ["dqn", "ppo"])
def test_a_run_scores_as_its_own_summary(agent: str) -> None:
    run = gridworld.train(*SHORT[agent], progress=False)
    for deterministic, summary in ((True, run.summary), (False, run.summary["sampled"])):
        score = gridworld.evaluate(run.model, deterministic=deterministic)
        assert score.value == pytest.approx(summary["value"], abs=1e-6)
        assert score.outcome.goal == pytest.approx(summary["goal_probability"], abs=1e-6)
    assert gridworld.evaluate(run.policy.sampled, "classic").value == run.summary["sampled"]["value"]


def refused(*given: Any, **named: Any) -> str:
    with pytest.raises(InputError) as told:
        gridworld.evaluate(*given, **named)
    assert "\n" not in str(told.value)
    return str(told.value)


@pytest.mark.parametrize(
    ("given", "named", "sentence"),
    [
        (([1] * 29, "classic"), {}, "has shape (29,); classic has 30 states and 4 actions"),
        (([4] * 30, "classic"), {}, "state 0 has the action 4; must be 0 (up)"),
        (([0.5] * 30, "classic"), {}, "state 0 has the action 0.5"),
        ((np.ones((30, 4)), "classic"), {}, "not probability distributions; give Q values as q="),
        (
            (),
            {"q": [1] * 30, "env": "classic"},
            "q: has shape (30,); classic has 30 states and 4 actions, so it must be (30, 4)",
        ),
        ((), {"q": np.full((30, 4), np.nan), "env": "classic"}, "q: contains NaN"),
        ((), {"env": "classic"}, "give either a model or table"),
        (("abc", "classic"), {}, "str is neither a model, an opened run nor a table of numbers"),
        (([1] * 30,), {}, "env: is required"),
        (([1] * 30, "classic"), {"gamma": "x"}, "gamma=x: must be a number"),
        (("runs/a",), {}, r"runs/a is a path; open the run with open_run"),
        (([1] * 30, "nope"), {}, "env=nope: no such choice"),
        (([1] * 30, 3), {}, "env: int is not an environment"),
        (([1] * 30, "classic"), {"gamma": 2}, "gamma=2: must be from 0 to 1"),
        (([1] * 30, "classic"), {"max_episode_steps": 0}, "max_episode_steps"),
    ],
)
def test_refused_tables(given: tuple[Any, ...], named: dict[str, Any], sentence: str) -> None:
    assert re.search(re.escape(sentence), refused(*given, **named))


@pytest.mark.slow
def test_refused_models() -> None:
    one_hot = gridworld.OneHotObservation(gym.make(RAW))
    model = PPO("MlpPolicy", one_hot, n_steps=64)
    assert "which no observation of this world (121 states) has" in refused(model, "four_rooms")
    assert "its states are continuous" in refused(model, gym.make("CartPole-v1"))
    other = PPO("MlpPolicy", "CartPole-v1", n_steps=64)
    assert "acts in Discrete(2)" in refused(other, "classic")
    assert "its states are continuous" in refused(other)
    memory = RecurrentPPO("MlpLstmPolicy", one_hot, n_steps=128)
    assert "keeps memory between steps" in refused(memory)
    for stateful in (
        gym.wrappers.TimeAwareObservation(one_hot),
        gym.wrappers.FrameStackObservation(one_hot, 2),
        gym.wrappers.NormalizeObservation(one_hot),
    ):
        assert refused(model, stateful).startswith(("the model expects Box", "env: a reset does not always"))
    stacked = VecFrameStack(DummyVecEnv([lambda: gridworld.CoordinateObservation(gym.make(RAW))]), 3)
    assert "VecFrameStack makes observations that depend on more" in refused(
        PPO("MlpPolicy", stacked, n_steps=64)
    )
