"""Playing episodes: a policy's scores estimated by sampling, with 95 % intervals, and a single episode."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gridworld.base.serialization import independent_generator
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.world.chain import check_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp
from gridworld.world.metrics import Z_95, wilson_interval

_BUDGET = 10**7  # outcomes: about a tenth of a second


@dataclass(frozen=True)
class Estimate:
    """A mean over samples with its 95 % interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        low, high = (f"{end:.{4 if abs(end) > 999 else 3}g}" for end in (self.low, self.high))
        return f"{self.mean:.4g} [{low}, {high}]"


def _estimate_share(hits: BoolArray) -> Estimate:
    count, total = int(hits.sum()), len(hits)
    return Estimate(count / total, *wilson_interval(count, total))


def _estimate_mean(
    samples: FloatArray, unseen: float, unseen_if_equal: float, bounds: tuple[float, float]
) -> Estimate:
    """The mean of samples (n,), with a normal interval that is widened by what rare samples may hide.

    The half-width is z²R/2n + z √(s²/n + z²R²/4n²): z²R/n for equal samples, z s/√n for many, widened as
    Wilson's interval is for a share. R, their range, is at least `unseen`, or `unseen_if_equal` where all are
    equal. No sample is outside of `bounds`, and so is no end of the interval.
    """
    count, mean, seen = len(samples), float(samples.mean()), float(np.ptp(samples))
    spread = max(unseen, seen) if seen else unseen_if_equal
    variance = float(samples.var(ddof=1)) / count if count > 1 else math.inf
    hidden = Z_95**2 * spread / (2 * count)
    half_width = hidden + math.hypot(Z_95 * variance**0.5, hidden)
    low, high = max(bounds[0], mean - half_width), min(bounds[1], mean + half_width)
    return Estimate(mean, min(low, mean), max(high, mean))  # which may be a bound but for rounding


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
    mdp, limit, gamma = evaluator.mdp, evaluator.max_episode_steps, evaluator.solution.gamma
    rewards = mdp.reward[mdp.probability > 0]
    paid = max(np.ptp(rewards), np.abs(rewards).max())  # what one step may change
    at_most = max(paid, np.abs(rewards).min() * limit)  # ... and going on to the limit, or not
    steps = np.broadcast_to(~mdp.terminal[:, None, None], mdp.reward.shape)
    return SampledScores(
        episodes=episodes,
        discounted_return=_estimate_mean(discounted, paid, at_most, _possible(mdp, mdp.reward, gamma, limit)),
        goal=_estimate_share(mdp.goal[states]),
        trap=_estimate_share(mdp.trap[states]),
        timeout=_estimate_share(running),
        episode_return=_estimate_mean(total, paid, at_most, _possible(mdp, mdp.reward, 1.0, limit)),
        length=_estimate_mean(length, 0.0, limit, _possible(mdp, steps, 1.0, limit)),
    )


def _possible(mdp: Mdp, counted: FloatArray | BoolArray, gamma: float, limit: int) -> tuple[float, float]:
    """The least and the greatest discounted sum of numbers (S, A, K) in an episode, whoever acts.

    Exact within a budget; of the steps beyond it each counts the extreme number.
    """
    ends = []
    for sign in (-1, 1):
        paid = np.where(mdp.probability > 0, sign * counted, -np.inf)
        best, left = np.zeros(mdp.num_states), limit
        while left and (limit - left) * paid.size < _BUDGET:
            before, left = best, left - 1
            best = (paid + gamma * before[mdp.next_state]).max(axis=(1, 2))
            if np.array_equal(best, before):
                left = 0
        ends.append(sign * float(best[mdp.start_states].max() + left * max(paid.max(), 0.0)) + 0.0)  # no -0
    return ends[0], ends[1]


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
