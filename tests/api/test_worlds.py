"""Gymnasium's own environments in a Python program: as exact tables, as batches, and under `evaluate`."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers import FlattenObservation, TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

import gridworld
from gridworld import InputError


def test_compile_env_takes_whatever_holds_a_world():
    lake = gym.make("FrozenLake-v1")
    text = gridworld.compile_env(lake).text()
    assert repr(gridworld.compile_env(lake)) == "<Mdp FrozenLake-v1: 16 states, 4 actions>"
    for env in (
        lake.unwrapped,
        make_vec_env("FrozenLake-v1", 2),
        gym.make_vec("FrozenLake-v1", 2, vectorization_mode="sync"),
    ):
        assert gridworld.compile_env(env).text() == text
    limits = [lake, make_vec_env("FrozenLake-v1", 2), TimeLimit(lake.unwrapped, 7), lake.unwrapped]
    assert [gridworld.compile_env(env).max_episode_steps for env in limits] == [100, 100, 7, None]
    grid = gym.make("GridWorld-v0")
    assert gridworld.compile_env(grid) is grid.unwrapped.mdp


@pytest.mark.parametrize(
    ("env", "told"),
    [
        (gym.make("CartPole-v1"), "env: CartPoleEnv contains neither a GridWorld nor a transition table"),
        (make_vec_env("CartPole-v1", 1), "env: CartPoleEnv contains neither a GridWorld"),
        (3, "env: int contains neither a GridWorld"),
        (gym.make("Taxi-v4", fickle_passenger=True), "Taxi-v4: fickle_passenger=True"),
    ],
)
def test_compile_env_refuses_what_it_cannot_know(env, told):
    with pytest.raises(InputError, match=f"^{told}"):
        gridworld.compile_env(env)


def test_a_batch_of_a_world_has_its_step_limit():
    taxi = gridworld.compile_env(gym.make("Taxi-v4"))
    batch = gridworld.make_vec(taxi, 50)
    assert (batch.num_envs, batch.max_episode_steps, batch.single_action_space.n) == (50, 200, 6)
    states, _ = batch.reset(seed=0)
    assert (taxi.start[states] > 0).all()
    assert batch.step(np.zeros(50, dtype=int))[1].tolist() == [-1.0] * 50
    assert gridworld.make_vec(taxi, 1, max_episode_steps=3).max_episode_steps == 3
    assert gridworld.make_vec(gridworld.compile_env(gym.make("CliffWalking-v1"))).max_episode_steps is None
    assert gridworld.make_vec(gridworld.compile_mdp(gridworld.load("classic"))).max_episode_steps == 100
    with pytest.raises(InputError, match="mdp=FrozenLake: must be a compiled world"):
        gridworld.make_vec("FrozenLake")


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
