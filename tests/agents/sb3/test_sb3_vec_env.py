"""The batch as SB3 sees it equals SB3's own DummyVecEnv over monitored single environments."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from gridworld import GridWorldVectorEnv, InputError, OneHotObservation
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.envs.observations import make_observation


def batch(num_envs: int, **arguments: object) -> GridWorldVecEnv:
    envs = GridWorldVectorEnv(num_envs, autoreset_mode="SameStep", **arguments)
    return GridWorldVecEnv(envs, make_observation(envs.mdp, "one_hot"))


def test_every_step_equals_dummy_vec_env() -> None:
    ours = batch(5, max_episode_steps=12)
    peer = DummyVecEnv(
        [lambda: Monitor(OneHotObservation(gym.make("GridWorld-v0", max_episode_steps=12)))] * 5
    )
    assert np.array_equal(ours.reset(), peer.reset())
    rng = np.random.default_rng(0)
    ends = [0, 0]  # terminations and truncations
    for _ in range(400):
        actions = rng.integers(4, size=5)
        got, expected = ours.step(actions), peer.step(actions)
        for mine, theirs in zip(got[:3], expected[:3], strict=True):
            assert np.array_equal(mine, theirs)
            assert mine.dtype == theirs.dtype
        for done, mine, theirs in zip(got[2], got[3], expected[3], strict=True):
            if not done:
                assert mine == {}
                continue
            assert np.array_equal(mine["terminal_observation"], theirs["terminal_observation"])
            assert mine["TimeLimit.truncated"] == theirs["TimeLimit.truncated"]
            assert [mine["episode"][key] for key in "rl"] == [theirs["episode"][key] for key in "rl"]
            assert mine["episode"]["t"] >= 0
            ends[mine["TimeLimit.truncated"]] += 1
    assert min(ends) > 10


def test_spaces_attributes_and_monitoring() -> None:
    envs = batch(3)
    assert envs.observation_space == gym.spaces.Box(0, 1, (30,), np.float32)
    assert envs.action_space == gym.spaces.Discrete(4)
    assert envs.get_attr("max_episode_steps", [0, 2]) == [100, 100]
    assert envs.env_is_wrapped(Monitor) == [True] * 3
    assert not envs.has_attr("no_such_thing")
    with pytest.raises(InputError, match="no individual methods"):
        envs.env_method("reset")
    with pytest.raises(InputError, match="SameStep"):
        GridWorldVecEnv(GridWorldVectorEnv(2), make_observation(envs.envs.mdp, "one_hot"))


@pytest.mark.parametrize("algorithm", [DQN, PPO])
def test_environments_and_exploration_draw_from_different_streams(algorithm: type) -> None:
    """A PCG64 generator's increment is the number of its stream."""
    model = algorithm("MlpPolicy", batch(2, slip=0.2), seed=3)
    model.env.reset()
    streams = [
        each.np_random.bit_generator.state["state"]["inc"]
        for each in (model.action_space, model.env.envs, np.random.default_rng(3).bit_generator)
        if hasattr(each, "np_random")
    ]
    assert len(set(streams)) == len(streams) == 2
