"""How good a policy is: exactly, by solving for its value, and by playing episodes beside that.

The exact scores carry no sampling noise and cannot hang: a policy that walks in circles has a time-out
probability of 1, whatever its number of steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gridworld.chain import Chain, Outcome, check_policy, one_hot_policy
from gridworld.layout import Cell
from gridworld.mdp import BoolArray, FloatArray, IntArray, Mdp
from gridworld.solve import Solution, value_iteration
from gridworld.vector_env import GridWorldVectorEnv

REGRET_TOLERANCE = 1e-6  # relative; a detour of one step costs at least 1 % at the default discount


@dataclass(frozen=True)
class Score:
    """Exact scores of one policy, in expectation over starts."""

    value: float  # discounted
    regret: float  # optimal value - value, at least 0 up to rounding
    certified: bool  # no policy is better
    outcome: Outcome

    def numbers(self) -> dict[str, float | int]:
        """All of it flat, under the names that files and charts use."""
        return {
            "value": self.value,
            "regret": self.regret,
            "certified": int(self.certified),
            "goal_probability": self.outcome.goal,
            "trap_probability": self.outcome.trap,
            "timeout_probability": self.outcome.timeout,
            "return": self.outcome.expected_return,
            "length": self.outcome.expected_length,
        }


@dataclass(frozen=True)
class Estimate:
    """A mean over sampled episodes with its 95 % interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:.4g} [{self.low:.3g}, {self.high:.3g}]"


@dataclass(frozen=True)
class Sampled:
    """Scores of one policy as estimated from episodes, each cut at the step limit."""

    episodes: int
    value: Estimate  # discounted
    goal: Estimate
    trap: Estimate
    timeout: Estimate
    episode_return: Estimate
    length: Estimate


class Judge:
    """Scores policies of one world under one discount and step limit. Solves the world once."""

    def __init__(self, mdp: Mdp, gamma: float, max_episode_steps: int) -> None:
        self.mdp = mdp
        self.max_episode_steps = max_episode_steps
        self.solution: Solution = value_iteration(mdp, gamma)
        self.optimal_value = self._at_start(self.solution.v)
        self.optimum: Outcome = Chain(mdp, self.optimal_policy()).outcome(max_episode_steps)

    def optimal_policy(self) -> FloatArray:
        """(S, A), deterministic: the first of the optimal actions."""
        return one_hot_policy(np.argmax(self.solution.optimal, axis=1))

    def score(self, policy: FloatArray) -> Score:
        """The exact scores of a policy table (S, A)."""
        chain = Chain(self.mdp, policy)
        value = self._at_start(chain.value(self.solution.gamma))
        regret = self.optimal_value - value
        certified = regret <= REGRET_TOLERANCE * self._at_start(self.solution.scale)
        return Score(value, regret, certified, chain.outcome(self.max_episode_steps))

    def endless_cells(self, policy: FloatArray) -> list[Cell]:
        """Cells in which the policy may walk for ever; empty for one that ends."""
        cols = self.mdp.layout.num_cols
        return [divmod(int(state), cols) for state in Chain(self.mdp, policy).endless_states()]

    def sample(self, policy: FloatArray, episodes: int, seed: int) -> Sampled:
        """Play `episodes` episodes, all at once."""
        policy = check_policy(self.mdp, policy)
        envs = GridWorldVectorEnv(
            episodes,
            max_episode_steps=self.max_episode_steps,
            autoreset_mode="Disabled",
            **self.mdp.settings(),
        )
        actions = np.random.default_rng(seed)
        cumulative = policy.cumsum(axis=1)
        states, _ = envs.reset(seed=seed)
        running = np.ones(episodes, dtype=np.bool_)
        discounted, total, length = np.zeros(episodes), np.zeros(episodes), np.zeros(episodes)
        for step in range(self.max_episode_steps):
            draws = actions.random(episodes)[:, None]
            chosen = np.minimum((draws >= cumulative[states]).sum(axis=1), policy.shape[1] - 1)
            states, rewards, terminated, _, _ = envs.step(chosen)
            discounted += running * rewards * self.solution.gamma**step
            total += running * rewards
            length += running
            running &= ~terminated
            if not running.any():
                break
        return Sampled(
            episodes=episodes,
            value=_mean(discounted),
            goal=_share(self.mdp.goal[states]),
            trap=_share(self.mdp.trap[states]),
            timeout=_share(running),
            episode_return=_mean(total),
            length=_mean(length),
        )

    def _at_start(self, values: FloatArray) -> float:
        starts = self.mdp.start_states
        return float(values[starts] @ self.mdp.start[starts])


def play_episode(mdp: Mdp, policy: FloatArray, max_episode_steps: int, seed: int) -> IntArray:
    """States of one episode, from its start to its end or the step limit."""
    policy = check_policy(mdp, policy)
    env = GridWorldVectorEnv(
        1, max_episode_steps=max_episode_steps, autoreset_mode="Disabled", **mdp.settings()
    )
    actions = np.random.default_rng(seed)
    states, _ = env.reset(seed=seed)
    visited, over = [int(states[0])], False
    while not over:
        row = policy[visited[-1]]
        states, _, terminated, truncated, _ = env.step(np.array([actions.choice(len(row), p=row)]))
        visited.append(int(states[0]))
        over = bool(terminated[0] or truncated[0])
    return np.array(visited)


_Z = 1.96  # standard deviations of the normal distribution on either side of 95 % of it


def _mean(samples: FloatArray) -> Estimate:
    """Normal approximation."""
    mean, count = float(samples.mean()), len(samples)
    half_width = _Z * float(samples.std(ddof=1)) / count**0.5 if count > 1 else math.inf
    return Estimate(mean, mean - half_width, mean + half_width)


def _share(hits: BoolArray) -> Estimate:
    """Wilson's score interval, which stays honest where no episode, or every one, is a hit.

    E. B. Wilson, Journal of the American Statistical Association 22, 1927.
    """
    count, share = len(hits), float(hits.mean())
    middle = (share + _Z**2 / (2 * count)) / (1 + _Z**2 / count)
    spread = share * (1 - share) / count + _Z**2 / (4 * count**2)
    half_width = _Z / (1 + _Z**2 / count) * spread**0.5
    return Estimate(share, max(0.0, middle - half_width), min(1.0, middle + half_width))
