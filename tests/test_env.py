"""Every shipped layout under every observation keeps the contract, and the walk follows the rules."""

import pickle
import random
import subprocess
import sys
import warnings
from collections import Counter

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import World, worlds

import gridworld
from gridworld import GridWorldEnv, InputError
from gridworld.layout import load, parse
from gridworld.observations import make_observation

LAYOUTS = gridworld.shipped_layouts()
WRAPPERS = {
    "none": (lambda env: env, lambda env: env),
    "one_hot": (gridworld.OneHotObservation, gridworld.VectorOneHotObservation),
    "coordinates": (gridworld.CoordinateObservation, gridworld.VectorCoordinateObservation),
    "image": (gridworld.ImageObservation, gridworld.VectorImageObservation),
}


@pytest.fixture(params=[0.0, 0.2], ids=["", "slip"])
def slip(request):
    return request.param


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_raw_env_passes_gymnasiums_checks(layout, slip):
    env = gym.make("GridWorld-v0", layout=layout, slip=slip).unwrapped
    check_env(env, skip_render_check=layout != "classic")


@pytest.mark.parametrize("kind", WRAPPERS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_one_env(layout, kind, slip):
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    env = WRAPPERS[kind][0](gym.make("GridWorld-v0", layout=layout, slip=slip))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_for_sb3(env)
    table = make_observation(env.unwrapped.mdp, kind).table()
    assert len(table) == env.unwrapped.mdp.num_states
    observation, _ = env.reset(seed=1)
    for action in np.random.default_rng(1).integers(4, size=60):
        row = table[env.unwrapped.state]
        assert observation in env.observation_space
        assert np.array_equal(observation, row)
        assert np.asarray(observation).dtype == table.dtype == env.observation_space.dtype
        observation, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            observation, _ = env.reset()


@pytest.mark.parametrize("kind", WRAPPERS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_batch_of_envs(layout, kind, slip):
    envs = WRAPPERS[kind][1](gym.make_vec("GridWorld-v0", num_envs=3, layout=layout, slip=slip))
    table = make_observation(envs.unwrapped.mdp, kind).table()
    assert envs.observation_space.shape == (3, *envs.single_observation_space.shape)
    observations, _ = envs.reset(seed=1)
    for actions in np.random.default_rng(1).integers(4, size=(60, 3)):
        assert observations in envs.observation_space
        assert np.array_equal(observations, table[envs.unwrapped.states])
        assert observations.dtype == table.dtype == envs.single_observation_space.dtype
        assert all(row in envs.single_observation_space for row in observations)
        observations, *_ = envs.step(actions)


def test_what_the_observations_show():
    mdp = GridWorldEnv(4, 5).mdp
    rows, cols = np.divmod(np.arange(20), 5)
    assert np.array_equal(make_observation(mdp, "none").table(), np.arange(20))
    assert np.array_equal(make_observation(mdp, "one_hot").table(), np.eye(20))
    assert make_observation(mdp, "coordinates").table() == pytest.approx(
        np.stack([rows / 3, cols / 4], axis=1)
    )
    pictures = make_observation(mdp, "image", cell_size=8).table()
    env = GridWorldEnv(4, 5, render_mode="rgb_array", cell_size=8)
    for state in range(20):
        env.state = state
        assert np.array_equal(pictures[state].transpose(1, 2, 0), env.render())
    line = GridWorldEnv(layout=parse("S.G", "line")).mdp
    assert make_observation(line, "coordinates").table().tolist() == [[0, 0], [0, 0.5], [0, 1]]


@pytest.mark.parametrize("kind", WRAPPERS)
def test_observations_are_fresh(kind):
    env = WRAPPERS[kind][0](GridWorldEnv())
    table = make_observation(env.unwrapped.mdp, kind)
    before, first = table.table(), env.reset()[0]
    if kind != "none":
        first[...] = 7
        table.rows(np.arange(3))[...] = 7
    assert np.array_equal(table.table(), before)
    assert np.array_equal(env.reset()[0], before[0])


def test_one_hot_rows_of_a_large_world():
    world = "\n".join(["S" + "." * 63, *["." * 64] * 62, "." * 63 + "G"])
    env = gridworld.OneHotObservation(GridWorldEnv(layout=parse(world, "large")))
    for state in (0, 77, 4095):
        env.unwrapped.state = state
        observation = env.observation(state)
        assert observation in env.observation_space
        assert np.flatnonzero(observation).tolist() == [state]
    assert env.table.rows(np.array([[5, 6]])).shape == (1, 2, 4096)


def test_wrappers_refuse_what_they_cannot_show():
    with pytest.raises(InputError, match="GridWorld"):
        gridworld.OneHotObservation(gym.make("FrozenLake-v1"))
    with pytest.raises(InputError, match="GiB"):
        gridworld.ImageObservation(GridWorldEnv(30, 30), cell_size=50)
    with pytest.raises(InputError, match="cell_size"):
        gridworld.ImageObservation(GridWorldEnv(), cell_size=0)
    with pytest.raises(InputError, match="observation kind 'pixels'"):
        make_observation(GridWorldEnv().mdp, "pixels")


def test_a_wrapped_env_can_be_made_again_from_its_spec():
    env = gridworld.ImageObservation(gym.make("GridWorld-v0", layout="cliff", slip=0.1), cell_size=10)
    again = gym.make(env.spec)
    assert again.observation_space == env.observation_space
    assert np.array_equal(again.reset(seed=0)[0], env.reset(seed=0)[0])


def test_gymnasium_knows_the_id_without_an_import_of_ours():
    code = (
        "import gymnasium as gym;"
        "env = gym.make('GridWorld-v0', layout='cliff', slip=0.1);"
        "envs = gym.make_vec('GridWorld-v0', num_envs=3, layout='cliff', slip=0.1);"
        "print(env.reset()[0], type(env.unwrapped).__name__, env.unwrapped.mdp.slip);"
        "print(*envs.reset()[0], type(envs.unwrapped).__name__, envs.unwrapped.mdp.slip)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == ["36 GridWorldEnv 0.1", "36 36 36 GridWorldVectorEnv 0.1"]


def test_registering_again_changes_nothing():
    spec = gym.spec("GridWorld-v0")
    gridworld.register_envs()
    assert gym.spec("GridWorld-v0") is spec
    assert spec.id == gridworld.ENV_ID


def walk(env, seed, steps=300):
    moves = np.random.default_rng(0).integers(4, size=steps)
    trace = [env.reset(seed=seed)]
    for move in moves:
        trace.append(env.step(move))
        if trace[-1][2]:
            trace.append(env.reset())
    return trace


def test_the_seed_fixes_the_walk():
    env = GridWorldEnv(layout=parse("S..S\n.TG.\nS...", "map"), slip=0.3)
    assert walk(env, 1) == walk(env, 1) == walk(GridWorldEnv(layout=env.mdp.layout, slip=0.3), 1)
    assert walk(env, 1) != walk(env, 2)


def test_the_global_generators_play_no_part():
    env = GridWorldEnv(layout=parse("S..S\n.TG.\nS...", "map"), slip=0.3)
    before = random.getstate(), pickle.dumps(np.random.get_state())
    first = walk(env, 1)
    assert (random.getstate(), pickle.dumps(np.random.get_state())) == before
    np.random.random(3)
    assert walk(env, 1) == first


@settings(max_examples=40)
@given(worlds(), st.integers(0, 2**32 - 1))
def test_every_transition_is_one_of_the_rules(world, seed):
    env = GridWorldEnv(layout=parse(world.text, "map"), **world.settings)
    state, _ = env.reset(seed=seed)
    assert world.cells[state] in world.starts
    for move in np.random.default_rng(seed).integers(4, size=100).tolist():
        cell = world.cells[state]
        state, reward, terminated, truncated, info = env.step(move)
        possible = {(world.state(c), r, end) for _, c, r, end in world.outcomes(cell, move)}
        assert (state, pytest.approx(reward), terminated) in [(s, r, e) for s, r, e in possible]
        assert (truncated, info) == (False, {})
        if terminated:
            state, _ = env.reset()
            assert world.cells[state] in world.starts


def counts_agree(counts, probabilities, draws):
    """Each count lies within five standard deviations of its expectation."""
    assert set(counts) <= set(probabilities)
    for what, p in probabilities.items():
        assert abs(counts[what] - p * draws) <= 5 * (p * (1 - p) * draws) ** 0.5, what


@pytest.mark.parametrize("action", range(4))
def test_slips_are_as_frequent_as_they_should_be(action):
    rows, draws = ("S....", "..#..", ".....", "....G"), 4000
    world, env = World(rows, slip=0.3), GridWorldEnv(layout=parse("\n".join(rows), "map"), slip=0.3)
    env.reset(seed=action)
    for cell in ((2, 2), (1, 1)):
        counts = Counter()
        for _ in range(draws):
            env.state = world.state(cell)
            counts[env.step(action)[0]] += 1
        counts_agree(counts, {world.state(c): p for p, c, _, _ in world.outcomes(cell, action)}, draws)


def test_starts_are_uniform():
    env, draws = GridWorldEnv(layout=parse("S.S\n.G.\nS..", "map")), 6000
    env.reset(seed=0)
    counts_agree(Counter(env.reset()[0] for _ in range(draws)), dict.fromkeys((0, 2, 6), 1 / 3), draws)


def test_a_wall_is_no_place_to_be():
    env = GridWorldEnv(layout=load("aima_4x3"))
    with pytest.raises(InputError, match=r"state=5.*wall"):
        env.state = 5


@pytest.mark.parametrize("delay", [-1, float("nan"), float("inf"), "0.1", None, True])
def test_a_delay_is_a_number_of_seconds(delay):
    with pytest.raises(InputError, match="delay"):
        GridWorldEnv(delay=delay)
