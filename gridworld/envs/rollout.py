"""Playing episodes: estimates of a policy's scores by sampling, and the states of a single episode."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridworld.envs.intervals import Estimate, estimate_mean, estimate_share
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.storage.serialization import independent_generator
from gridworld.world.chain import check_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import FloatArray, IntArray, Mdp


@dataclass(frozen=True)
class SampledScores:
    """Estimates of one policy's scores from episodes, each truncated at the step limit.

    `goal`, `trap` and `timeout` are shares of the episodes; `length` is in steps.
    """

    episodes: int
    discounted_return: Estimate
    goal: Estimate
    trap: Estimate
    timeout: Estimate
    episode_return: Estimate
    length: Estimate


def sample_episodes(evaluator: Evaluator, policy: FloatArray, episodes: int, seed: int) -> SampledScores:
    """Estimate the scores of a policy (S, A) from episodes; its draws are independent of `seed`."""
    policy = check_policy(evaluator.mdp, policy)
    envs = GridWorldVectorEnv(
        episodes, max_episode_steps=evaluator.max_episode_steps, autoreset_mode="Disabled", mdp=evaluator.mdp
    )
    actions = independent_generator(seed)  # the environments take the seed's own
    cumulative = policy.cumsum(axis=1)
    states, _ = envs.reset(seed=seed)
    running = np.ones(episodes, dtype=np.bool_)
    discounted, total, length = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes)
    for step in range(evaluator.max_episode_steps):
        draws = actions.random(episodes)[:, None]
        chosen = np.minimum((draws >= cumulative[states]).sum(axis=1), policy.shape[1] - 1)
        states, rewards, terminated, _, _ = envs.step(chosen)
        discounted += running * rewards * evaluator.solution.gamma**step
        total += running * rewards
        length += running
        running &= ~terminated
        if not running.any():
            break
    limit, rewards = evaluator.max_episode_steps, evaluator.mdp.reward[evaluator.mdp.probability > 0]
    paid = max(np.ptp(rewards), np.abs(rewards).max())  # what one step may change
    at_most = max(paid, np.abs(rewards).min() * limit)  # ... and going on to the limit, or not
    return SampledScores(
        episodes=episodes,
        discounted_return=estimate_mean(discounted, paid, at_most),
        goal=estimate_share(evaluator.mdp.goal[states]),
        trap=estimate_share(evaluator.mdp.trap[states]),
        timeout=estimate_share(running),
        episode_return=estimate_mean(total, paid, at_most),
        length=estimate_mean(length, 0.0, limit, (0.0, limit)),
    )


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode: states (n + 1,) from start to end or step limit, actions and rewards (n,)."""

    states: IntArray
    actions: IntArray
    rewards: FloatArray

    def beginning(self, states: int) -> Episode:
        """The episode up to its first so many states."""
        return Episode(self.states[:states], self.actions[: states - 1], self.rewards[: states - 1])


def play(mdp: Mdp, policy: FloatArray, max_episode_steps: int, seed: int) -> Episode:
    """Play one episode of a policy (S, A); what it draws is independent of `seed`, the environment's."""
    policy = check_policy(mdp, policy)
    env = GridWorldVectorEnv(1, max_episode_steps=max_episode_steps, autoreset_mode="Disabled", mdp=mdp)
    chance = independent_generator(seed)  # the environment takes the seed's own
    first, _ = env.reset(seed=seed)
    states, actions, rewards, over = [int(first[0])], list[int](), list[float](), False
    while not over:
        row = policy[states[-1]]
        actions.append(int(chance.choice(len(row), p=row)))
        following, reward, terminated, truncated, _ = env.step(np.array(actions[-1:]))
        states.append(int(following[0]))
        rewards.append(float(reward[0]))
        over = bool(terminated[0] or truncated[0])
    return Episode(np.array(states), np.array(actions), np.array(rewards))
