"""A batch of worlds does what as many single ones would."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from helpers.oracle import MOVES, worlds
from hypothesis import given
from hypothesis import strategies as st

from gridworld import GridWorldEnv, GridWorldVectorEnv, InputError
from gridworld.envs.vector_env import stratified_numbers
from gridworld.world.layout import parse
from gridworld.world.mdp import FloatArray, IntArray

MODES = list(AutoresetMode)
TWO_STARTS = parse("S..T\n.#..\nS..G", "two starts")
UP, RIGHT, DOWN, LEFT = range(4)


def moves(num_steps, num_envs, seed=0):
    return np.random.default_rng(seed).integers(4, size=(num_steps, num_envs))


def same(results, others):
    """Equal observations, rewards and flags."""
    return all(np.array_equal(a, b) for a, b in zip(results[:4], others[:4], strict=True))


def assert_same_infos(ours, theirs):
    """The same keys in the same order, and in every array the same values of the same types."""
    assert list(ours) == list(theirs)
    for mine, other in zip(ours.values(), theirs.values(), strict=True):
        assert type(mine) is type(other)
        if isinstance(mine, dict):
            assert_same_infos(mine, other)
            continue
        assert (mine.dtype, mine.shape) == (other.dtype, other.shape)
        assert mine.tolist() == other.tolist()
        assert [type(value) for value in mine.tolist()] == [type(value) for value in other.tolist()]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("num_envs", "arguments"),
    [
        *[(5, {"layout": name, "step_reward": -0.1}) for name in ("classic", "frozen_lake_4x4", "maze")],
        # One environment of a batch draws as a single one does.
        *[(1, {"layout": name, "slip": 0.4}) for name in (TWO_STARTS, "frozen_lake_4x4", "cliff")],
        *[(1, {"layout": TWO_STARTS, "slip": slip, "stratified": True}) for slip in (0.0, 0.4)],
    ],
    ids=str,
)
def test_a_batch_equals_gymnasiums_own(num_envs, arguments, mode):
    arguments = {"max_episode_steps": 12, "autoreset_mode": mode, **arguments}
    native = gym.make_vec("GridWorld-v0", num_envs, **arguments)
    single = {key: arguments[key] for key in arguments.keys() - {"autoreset_mode", "stratified"}}
    copies = SyncVectorEnv([lambda: gym.make("GridWorld-v0", **single)] * num_envs, autoreset_mode=mode)
    assert native.observation_space == copies.observation_space
    assert native.action_space == copies.action_space
    assert native.metadata["autoreset_mode"] == copies.metadata["autoreset_mode"] == mode
    assert np.array_equal(native.reset(seed=5)[0], copies.reset(seed=5)[0])
    endings = 0
    for actions in moves(200, num_envs):
        ours, theirs = native.step(actions), copies.step(actions)
        assert same(ours, theirs)
        assert [part.dtype for part in ours[:4]] == [part.dtype for part in theirs[:4]]
        assert_same_infos(ours[4], theirs[4])
        over = ours[2] | ours[3]
        endings += over.sum()
        if mode is AutoresetMode.DISABLED and over.any():
            options = {"reset_mask": over}
            assert np.array_equal(native.reset(options=options)[0], copies.reset(options=options)[0])
    assert endings > 10
    while not over.any():
        over = np.any([native.step(actions)[2:4], copies.step(actions)[2:4]], axis=(0, 1))
    assert np.array_equal(
        native.reset(seed=6)[0], copies.reset(seed=6)[0]
    )  # of one that waits for its own, too
    assert same(native.step(actions), copies.step(actions))


def test_without_a_limit_nothing_is_cut_off_and_an_end_stays():
    envs = GridWorldVectorEnv(2, max_episode_steps=None, autoreset_mode="Disabled")
    envs.reset()
    for action in (RIGHT, RIGHT, RIGHT, RIGHT, DOWN):
        envs.step([action, UP])
    for _ in range(300):
        assert [part.tolist() for part in envs.step([UP, UP])[:4]] == [
            [10, 0],
            [0, 0],
            [True, False],
            [False] * 2,
        ]


@given(worlds(), st.sampled_from(MODES), st.integers(0, 2**32 - 1))
def test_every_transition_of_a_big_batch_is_one_of_the_rules(world, mode, seed):
    envs = GridWorldVectorEnv(
        64, layout=parse(world.text, "map"), autoreset_mode=mode, max_episode_steps=None, **world.settings
    )
    rules = {
        (world.state(cell), action): {
            (world.state(c), r, end) for _, c, r, end in world.outcomes(cell, action)
        }
        for cell in world.cells
        for action in MOVES
    }
    starts = {world.state(cell) for cell in world.starts}
    states, _ = envs.reset(seed=seed)
    assert set(states.tolist()) <= starts
    over = np.zeros(64, dtype=bool)
    for actions in moves(20, 64, seed):
        following, rewards, terminated, truncated, infos = envs.step(actions)
        ended_at = np.where(infos["_final_obs"], infos["final_obs"], following) if infos else following
        for i, before in enumerate(zip(states.tolist(), actions.tolist(), strict=True)):
            if over[i] and mode is AutoresetMode.NEXT_STEP:
                assert following[i] in starts
                assert (rewards[i], terminated[i]) == (0.0, False)
            else:
                state, reward, end = int(ended_at[i]), float(rewards[i]), bool(terminated[i])
                assert any((state, end) == (s, e) and abs(reward - r) < 1e-12 for s, r, e in rules[before])
            if mode is AutoresetMode.SAME_STEP and terminated[i]:
                assert following[i] in starts
        assert not truncated.any()
        states, over = following, terminated


def test_starts_and_slips_are_independent_and_fair():
    num_envs = 20_000
    envs = GridWorldVectorEnv(num_envs, layout=TWO_STARTS, slip=0.4)
    starts, _ = envs.reset(seed=0)
    assert abs((starts == 0).sum() - num_envs / 2) < 5 * (num_envs / 4) ** 0.5
    states, *_ = envs.step(np.full(num_envs, RIGHT))
    top = starts == 0  # right with 0.6, up into the border with 0.2, down with 0.2
    for state, p in ((1, 0.6), (0, 0.2), (4, 0.2)):
        assert abs((states[top] == state).sum() - p * top.sum()) < 5 * (p * (1 - p) * top.sum()) ** 0.5


NO_ACTIONS = (
    *([0, 1], [[0, 1, 2]], 0, [0.0, 1.0, 2.0], [0, np.nan, 2], [0, -1, 2], [0, 4, 2], [True, False, True]),
    *([0, 2**63, 2], [0, -(2**63), 2], ["0", "1", "2"], [0, None, 2], None, 1, []),
)


@pytest.mark.parametrize(
    "actions", [*NO_ACTIONS, *map(np.array, NO_ACTIONS), np.array([0, 2**64 - 1, 2], np.uint64)], ids=repr
)
def test_what_are_no_actions_is_refused(actions):
    envs = GridWorldVectorEnv(3)
    envs.reset()
    envs.step([RIGHT, DOWN, UP])
    with pytest.raises(InputError, match="actions"):
        envs.step(actions)
    assert envs.states.tolist() == [1, 6, 0]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("seed", seed) for seed in ([1, 2, 3], 1.5, "1", True)],
        *[
            ("reset_mask", mask)
            for mask in (np.array([1, 0, 1]), np.zeros(3, dtype=bool), np.array([True]), "all")
        ],
    ],
    ids=repr,
)
def test_a_batch_has_one_seed_and_a_reset_mask_one_boolean_per_environment(name, value):
    arguments = {"seed": value} if name == "seed" else {"options": {"reset_mask": value}}
    with pytest.raises(InputError, match=name):
        GridWorldVectorEnv(3).reset(**arguments)


@pytest.mark.parametrize("dtype", [np.int8, np.int32, np.uint8, np.uint64, list])
def test_whole_numbers_of_any_kind_are_actions(dtype):
    envs = GridWorldVectorEnv(3)
    envs.reset()
    actions = [RIGHT, DOWN, UP] if dtype is list else np.array([RIGHT, DOWN, UP], dtype=dtype)
    assert envs.step(actions)[0].tolist() == [1, 6, 0]


def test_a_frame_per_environment():
    envs = gym.make_vec("GridWorld-v0", num_envs=2, render_mode="rgb_array", cell_size=10)
    one = gym.make("GridWorld-v0", render_mode="rgb_array", cell_size=10)
    envs.reset()
    one.reset()
    envs.step([RIGHT, UP])
    one.step(RIGHT)
    first, second = envs.render()
    assert np.array_equal(first, one.render())
    assert not np.array_equal(first, second)
    assert GridWorldVectorEnv(2).render() is None


@pytest.mark.parametrize("mode", MODES)
def test_returned_arrays_are_fresh(mode):
    touched, left_alone = (GridWorldVectorEnv(4, slip=0.2, autoreset_mode=mode) for _ in range(2))
    left_alone.reset(seed=3)
    touched.reset(seed=3)[0][:] = 29
    touched.states[:] = 29
    for actions in np.random.default_rng(0).integers(4, size=(150, 4)):
        mine, theirs = touched.step(actions), left_alone.step(actions)
        assert same(mine, theirs)
        infos = mine[4]
        for part in (*mine[:4], *(infos[key] for key in infos if key != "final_info")):
            part[:] = 1


# ---- draws that environments share out evenly: each one's own chances stay what they are ----

GROUPS = st.lists(st.integers(0, 9), min_size=1, max_size=60).map(np.array)


def by_hand(groups: IntArray, rng: np.random.Generator) -> FloatArray:
    """Group by group, member by member."""
    numbers = np.empty(len(groups))
    for group in sorted(set(groups.tolist())):
        shift = rng.random()
        members = [place for place, other in enumerate(groups) if other == group]
        for rank, place in enumerate(members):
            numbers[place] = (rank / len(members) + shift) % 1.0
    return numbers


@given(GROUPS, st.integers(0, 2**32 - 1), st.sampled_from([0, 70_000]))
def test_the_numbers_are_those_of_a_loop_over_groups(groups: IntArray, seed: int, first: int) -> None:
    found, expected = np.random.default_rng(seed), np.random.default_rng(seed)
    assert np.array_equal(stratified_numbers(groups + first, found), by_hand(groups, expected))
    assert found.bit_generator.state == expected.bit_generator.state


def test_the_starts_are_spread_over_the_states() -> None:
    mdp = GridWorldEnv().mdp.with_exploring_starts(1.0)
    envs = GridWorldVectorEnv(len(mdp.start_states) * 7, mdp=mdp, stratified=True)
    states, _ = envs.reset(seed=0)
    assert (np.bincount(states)[mdp.start_states] == 7).all()
