"""A replay buffer that counts transitions: what it keeps, what it draws, and the engine's version of it."""

import copy
from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from helpers.support import SHORT, train_in
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from gridworld import GridWorldVectorEnv
from gridworld.agents.sb3.replay_counts import ReplayCounts, systematic_sample
from gridworld.agents.sb3.tabulated.dqn import TabulatedDQN
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.envs.observations import make_observation
from gridworld.errors import InputError
from gridworld.storage.serialization import StateError

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


def test_over_all_beginnings_the_mean_is_the_share() -> None:
    counts, beginnings = np.array([3, 0, 1, 96, 7]), (np.arange(1000) + 0.5) / 1000
    times = systematic_sample(counts, 10, beginnings)
    assert times.mean(axis=0) == pytest.approx(10 * counts / counts.sum(), abs=1e-2)
    assert len(np.unique(times, axis=0)) > 1


class Told(DQN):
    """Knows what was added to its buffer."""

    def _store_transition(
        self, buffer: Any, action: Any, obs: Any, reward: Any, done: Any, infos: Any
    ) -> None:
        self.told: Counter[Any]
        for index, info in enumerate(infos):
            following = info.get("terminal_observation", obs[index])
            ends = bool(done[index]) and not info.get("TimeLimit.truncated", False)
            self.told[
                self._last_obs[index].argmax(), action[index], following.argmax(), float(reward[index]), ends
            ] += 1
        super()._store_transition(buffer, action, obs, reward, done, infos)


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


def test_in_sb3s_own_loop_every_transition_is_counted() -> None:
    model = Told("MlpPolicy", batch(12), replay_buffer_class=ReplayCounts, learning_starts=10**6, seed=0)
    model.told = Counter()
    model.learn(8000)
    buffer = model.replay_buffer
    assert isinstance(buffer, ReplayCounts)
    assert kept(buffer) == model.told
    assert buffer.buffer_size > 256 < buffer.pos  # it has grown
    assert sum(model.told.values()) == 8000
    drawn = buffer.sample(500)
    assert drawn.observations.shape == (500, 72)
    assert len(drawn.actions.unique()) == 4
    state = copy.deepcopy(buffer.get_state())
    buffer.reset()
    assert (buffer.size(), buffer.counts.sum()) == (0, 0)
    other = ReplayCounts(1, model.observation_space, model.action_space, n_envs=NUM_ENVS)
    other.set_state(state)
    assert kept(other) == model.told


def test_the_engine_counts_the_same_and_makes_the_same_update() -> None:
    settings: dict[str, Any] = {"replay_buffer_class": ReplayCounts, "seed": 0, "device": "cpu"}
    settings |= {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0, "learning_starts": 0}
    ours, theirs = (cls("MlpPolicy", batch(), **settings) for cls in (TabulatedDQN, DQN))
    theirs.policy.load_state_dict(ours.policy.state_dict())
    for model in (ours, theirs):
        model._setup_learn(10_000)
        callback = CallbackList([])
        callback.init_callback(model)
        for _ in range(3):
            frequency = TrainFreq(40, TrainFrequencyUnit.STEP)
            model.collect_rollouts(model.env, callback, frequency, model.replay_buffer)
    states, actions, following, rewards, ends, _ = (
        part[0].tolist() for part in ours.replay_buffer.draw(1, 10, np.random.RandomState(0))
    )
    keys = zip(states, actions, following, rewards, map(bool, ends), strict=True)
    counted = Counter(dict(zip(keys, ours.replay_buffer.counts.tolist(), strict=True)))
    assert counted == kept(theirs.replay_buffer)
    total = 3 * 40 * NUM_ENVS
    assert counted.total() == total
    for model in (ours, theirs):
        model.train(2, total)  # each transition as often as it was met
    for mine, peer in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert torch.allclose(mine, peer, rtol=1e-4, atol=1e-6)
    assert ours.replay_buffer.pos == total


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("transitions", lambda column: column[::-1].copy()),
        ("transitions", lambda column: column + 10**6),
        ("transitions", lambda column: column * np.nan),
        ("transitions", lambda column: -column),
        ("rewards", lambda column: column[1:]),
        ("counts", lambda column: column * 0),
    ],
)
def test_a_state_of_no_transitions_of_this_world_is_refused(name: str, change: Callable[[Any], Any]) -> None:
    model = TabulatedDQN("MlpPolicy", batch(), replay_buffer_class=ReplayCounts, learning_starts=400)
    state = model.learn(192).replay_buffer.get_state()
    with pytest.raises(StateError, match="must be"):
        model.replay_buffer.set_state({**state, name: change(state[name])})
    model.replay_buffer.set_state(state)
    assert model.replay_buffer.pos == 192


def test_it_takes_the_memory_of_the_transitions_alone() -> None:
    buffer = ReplayCounts(10**9, spaces.Box(0, 1, (30,)), spaces.Discrete(4), n_envs=4096)
    assert sum(each.nbytes for each in vars(buffer).values() if isinstance(each, np.ndarray)) < 10**6


def test_sequences_are_refused() -> None:
    with pytest.raises(
        InputError, match="optimize_memory_usage=true: ReplayCounts stores each transition once"
    ):
        ReplayCounts(10, spaces.Discrete(4), spaces.Discrete(4), optimize_memory_usage=True)


def test_a_world_with_chances_is_certified_with_it(tmp_path: Path) -> None:
    """The shipped settings, and fewer steps."""
    world = ["env.num_rows=4", "env.num_cols=4", "env.slip=0.1", "env.step_reward=-0.1"]
    less = ["n_envs=1024", "total_timesteps=300000", "agent.target_update_interval=4096"]
    quiet = [
        "evaluation.every=100000",
        *(f"recording.{name}=false" for name in ("frames", "gif", "learning")),
    ]
    assert train_in(tmp_path, "agent=dqn", *world, *less, *quiet)["certified"]


def test_it_is_sb3s_to_use_with_other_algorithms_too(tmp_path: Path) -> None:
    words = [*SHORT["qrdqn"], COUNTS.replace("agent.", "+agent.arguments."), "env.slip=0.1"]
    assert train_in(tmp_path, *words)["total_timesteps"] > 0
