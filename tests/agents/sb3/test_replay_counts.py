"""A replay buffer that counts transitions: what it keeps, what it draws, and the engine's version of it."""

import copy
from collections import Counter
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from helpers.support import NO_FILES, SHORT, train_in
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DQN

from gridworld import GridWorldVectorEnv
from gridworld.agents.sb3.replay_counts import ReplayCounts
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.base.errors import InputError
from gridworld.base.serialization import StateError
from gridworld.engine.replay import CountedReplay, systematic_sample
from gridworld.envs.observations import make_observation

COUNTS = "agent.replay_buffer_class=gridworld.agents.sb3.replay_counts.ReplayCounts"
NUM_ENVS = 16


def batch(side: int = 5) -> GridWorldVecEnv:
    """Slippery, with a short limit: terminations and truncations occur."""
    world: dict[str, Any] = {"num_rows": side, "num_cols": 6, "slip": 0.3, "max_episode_steps": 9}
    envs = GridWorldVectorEnv(NUM_ENVS, autoreset_mode="SameStep", step_reward=-0.1, **world)
    return GridWorldVecEnv(envs, make_observation(envs.mdp, "one_hot"))


@given(
    counts=st.lists(st.integers(0, 10**7), min_size=1, max_size=30).filter(any),
    size=st.integers(1, 10**6),
    chance=st.floats(0, 1, exclude_max=True),
)
def test_a_sample_has_of_each_its_share_rounded(counts: list[int], size: int, chance: float) -> None:
    (times,) = systematic_sample(np.array(counts), size, np.array([chance]))
    assert times.sum() == size
    for found, count in zip(times.tolist(), counts, strict=True):
        assert abs(found - Fraction(size * count, sum(counts))) < 1 + 1e-6


def kept(buffer: Any) -> Counter[Any]:
    """The transitions of SB3's rows."""
    return Counter(
        {
            (
                *(buffer.observations[row, 0].argmax(), buffer.actions[row, 0, 0]),
                *(buffer.next_observations[row, 0].argmax(), float(buffer.rewards[row, 0])),
                bool(buffer.dones[row, 0]),
            ): int(buffer.counts[row])
            for row in range(buffer.pos)
        }
    )


def steps(seed: int, count: int) -> Iterator[tuple[Any, ...]]:
    """Steps of 16 environments: states, actions, next states, rewards and whether they ended, or were cut."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        states, following = rng.integers(30, size=(2, NUM_ENVS))
        actions, rewards = rng.integers(4, size=NUM_ENVS), rng.integers(-1, 2, size=NUM_ENVS) / 4
        dones, cut = rng.random((2, NUM_ENVS)) < 0.3
        yield states, actions, following, rewards, dones, cut


def test_both_buffers_count_every_transition() -> None:
    ours, box = CountedReplay(2, 30, 4), spaces.Box(0, 1, (30,))
    theirs = ReplayCounts(10**9, box, spaces.Discrete(4), n_envs=NUM_ENVS)
    assert sum(each.nbytes for each in vars(theirs).values() if isinstance(each, np.ndarray)) < 10**6
    rows, met = np.eye(30, dtype=np.float32), Counter[Any]()
    for states, actions, following, rewards, dones, cut in steps(0, 40):
        infos = [{"TimeLimit.truncated": bool(each)} for each in cut]
        theirs.add(rows[states], rows[following], actions, rewards, dones, infos)
        ours.store(*(np.stack([each] * 2) for each in (states, actions, following, rewards, dones & ~cut)))
        met.update(zip(states, actions, following, rewards, dones & ~cut, strict=True))
    assert kept(theirs) == met
    assert theirs.buffer_size > 256 < theirs.pos  # it has grown
    for run in range(2):
        drawn = ours.draw([np.random.RandomState(0)] * 2, 1, met.total())  # each as often as it was met
        *columns, ends, shares = (column[0, run].tolist() for column in drawn)
        times = [round(share * met.total()) for share in shares]
        assert Counter(dict(zip(zip(*columns, map(bool, ends), strict=True), times, strict=True))) == met
    alone = CountedReplay(1, 30, 4)
    alone.set_state(0, ours.get_state(1))
    one, other = (
        each.draw([np.random.RandomState(5) for _ in range(runs)], 3, 50)
        for each, runs in ((ours, 2), (alone, 1))
    )
    for mine, again in zip(one, other, strict=True):
        assert np.array_equal(mine[:, :1], again)


def test_sb3s_version_samples_and_goes_on_from_its_state() -> None:
    model = DQN("MlpPolicy", batch(12), replay_buffer_class=ReplayCounts, learning_starts=10**6, seed=0)
    buffer: Any = model.learn(1920).replay_buffer
    drawn = buffer.sample(500)
    assert drawn.observations.shape == (500, 72)
    assert len(drawn.actions.unique()) == 4
    expected, state = kept(buffer), copy.deepcopy(buffer.get_state())
    buffer.reset()
    assert (expected.total(), buffer.size(), buffer.counts.sum()) == (1920, 0, 0)
    buffer.set_state(state)
    assert kept(buffer) == expected
    with pytest.raises(
        InputError, match="optimize_memory_usage=true: ReplayCounts stores each transition once"
    ):
        ReplayCounts(1, model.observation_space, model.action_space, optimize_memory_usage=True)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("transitions", lambda column: column[::-1].copy()),
        ("transitions", lambda column: column + 10**6),
        ("rewards", lambda column: column[1:]),
        ("counts", lambda column: column * 0),
    ],
)
def test_a_state_of_no_transitions_of_this_world_is_refused(name: str, change: Callable[[Any], Any]) -> None:
    replay = CountedReplay(1, 30, 4)
    for states, actions, following, rewards, dones, _ in steps(1, 12):
        replay.store(*(each[None] for each in (states, actions, following, rewards, dones)))
    state = replay.get_state(0)
    with pytest.raises(StateError, match="must be"):
        replay.set_state(0, {**state, name: change(state[name])})
    replay.set_state(0, state)


def test_it_is_sb3s_to_use_with_other_algorithms_too(tmp_path: Path) -> None:
    words = [*SHORT["qrdqn"], COUNTS.replace("agent.", "+agent.arguments.", 1), "env.slip=0.1", *NO_FILES]
    assert train_in(tmp_path, *words)["total_timesteps"] > 0
