"""What was seen of an environment, and what follows from it: the reward worth finding, limits, reach."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gymnasium import spaces

from gridworld.checking.sampling import Env, Replays, Steps
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

UNLIMITED = 10_000  # steps of an episode that are counted where there is no limit
ENDINGS = 8  # episodes, at least, that show how an environment ends them
ERROR, WARNING = "error", "warning"


@dataclass(frozen=True)
class EnvFinding:
    """What keeps an agent from learning in an environment, or may."""

    topic: str  # one word
    severity: str  # "error": nothing can be learned, or something else than was meant; or "warning"
    evidence: str  # a sentence
    advice: str  # one change to try, a sentence


@dataclass
class Seen:
    """What was seen of an environment."""

    env: Env
    gamma: float
    steps: Steps
    replays: Replays
    interface: str  # what Gymnasium's checker says against it
    limit: int | None  # its step limit, if it is known
    mdp: Mdp | None  # its tables, if they are known exactly

    @property
    def is_stochastic(self) -> bool:
        """Whether a step may draw."""
        return self.steps.draws and (self.mdp is None or self.mdp.is_stochastic)

    @property
    def is_constant(self) -> bool:
        """Whether the observation never changes, though its space has more than one."""
        space = self.env.observation_space
        return not (isinstance(space, spaces.Discrete) and space.n == 1) and self.observed == 1

    @property
    def observed(self) -> int:
        """How many different observations there were."""
        return len(np.unique(np.append(self.steps.before, self.steps.after)))

    @cached_property
    def lengths(self) -> IntArray:
        """Steps of each episode."""
        return self.steps.time[self.steps.last] + 1

    @cached_property
    def usual(self) -> float:
        """The most frequent reward."""
        values, counts = np.unique(self.steps.reward, return_counts=True)
        return float(values[counts.argmax()]) if len(values) else 0.0

    @cached_property
    def paid(self) -> BoolArray:
        """Sampled steps worth finding: paid more than usual, or the end where all steps cost the same."""
        better = self.steps.reward > self.usual + 1e-12
        return better if better.any() or self.usual >= 0 else self.steps.terminated

    @cached_property
    def ends_at(self) -> int | None:
        """The step at which episodes are terminated by time, which the observation does not show."""
        steps, lengths = self.steps, self.lengths
        longest = int(lengths.max(initial=0))
        latest = steps.last[lengths == longest]
        shortly_before = int(np.sum((lengths >= 0.75 * longest) & (lengths < longest)))
        if longest < 3 or len(latest) < max(ENDINGS, shortly_before + 1):
            return None
        is_limit = steps.terminated[latest].all() and not steps.truncated[latest].any()
        is_met_before = np.isin(steps.after[latest], steps.before).mean() > 0.5
        return longest if is_limit and is_met_before and not self._shows_time else None

    @property
    def _shows_time(self) -> bool:
        """Whether an observed number is a function of the time."""
        if self.steps.vectors is None:
            return False
        values = self.steps.vectors[self.steps.before]
        times = np.unique(self.steps.time, return_inverse=True)[1]
        sums = np.stack([np.bincount(times, column) for column in values.T], axis=1)
        means = sums / np.bincount(times)[:, None]
        fixed = np.abs(values - means[times]).max(axis=0) < 1e-6
        return bool((fixed & (np.ptp(means, axis=0) > 0)).any())

    @cached_property
    def reach(self) -> tuple[float, int | None] | None:
        """Exactly, how likely a random policy comes to what is worth finding, and in how few steps."""
        mdp = self.mdp
        if mdp is None:
            return None
        worth = mdp.goal[mdp.next_state] | (mdp.reward > self.usual + 1e-12)
        worth &= (mdp.probability > 0) & ~mdp.absorbing[:, None, None]
        away = mdp.steps_away[worth.any(axis=(1, 2))]
        weight, origins = mdp.probability / mdp.num_actions, np.nonzero(~worth)[0]
        arriving = np.where(worth, weight, 0.0).sum(axis=(1, 2))
        at: FloatArray = mdp.start * ~mdp.absorbing
        reached = 0.0
        for _ in range(self.limit or UNLIMITED):
            reached += float(at @ arriving)
            following = np.bincount(mdp.next_state[~worth], at[origins] * weight[~worth], len(at))
            at = np.asarray(following * ~mdp.absorbing, np.float64)
            if at.sum() < 1e-12:
                break
        return reached, int(away[away >= 0].min()) + 1 if (away >= 0).any() else None
