"""The batch as SB3 sees it equals SB3's own DummyVecEnv over monitored single environments."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.evaluation import evaluate_policy
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
    truncations = terminations = 0
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
            assert (mine["episode"]["r"], mine["episode"]["l"]) == (
                theirs["episode"]["r"],
                theirs["episode"]["l"],
            )
            assert mine["episode"]["t"] >= 0
            truncations += mine["TimeLimit.truncated"]
            terminations += not mine["TimeLimit.truncated"]
    assert truncations > 10
    assert terminations > 10


def test_spaces_attributes_and_monitoring() -> None:
    envs = batch(3)
    assert envs.observation_space == gym.spaces.Box(0, 1, (30,), np.float32)
    assert envs.action_space == gym.spaces.Discrete(4)
    assert envs.get_attr("max_episode_steps", [0, 2]) == [100, 100]
    assert envs.env_is_wrapped(Monitor) == [True] * 3
    assert not envs.has_attr("no_such_thing")
    with pytest.raises(InputError, match="no methods of their own"):
        envs.env_method("reset")
    with pytest.raises(InputError, match="SameStep"):
        GridWorldVecEnv(GridWorldVectorEnv(2), make_observation(envs.envs.mdp, "one_hot"))


@pytest.mark.parametrize("algorithm", [DQN, PPO])
@pytest.mark.parametrize("kind", ["one_hot", "coordinates", "none", "image"])
def test_sb3_learns_on_it_as_it_is(algorithm: type, kind: str) -> None:
    envs = GridWorldVectorEnv(2, autoreset_mode="SameStep")
    arguments = (
        {"n_steps": 8, "batch_size": 16} if algorithm is PPO else {"learning_starts": 4, "buffer_size": 100}
    )
    policy = "CnnPolicy" if kind == "image" else "MlpPolicy"
    vec_env = GridWorldVecEnv(envs, make_observation(envs.mdp, kind))
    model = algorithm(policy, vec_env, seed=0, device="cpu", **arguments).learn(32)
    assert model.num_timesteps == 32
    mean, _ = evaluate_policy(model, vec_env, n_eval_episodes=2)
    assert -1 <= mean <= 1


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
