"""What was seen of an environment, and what follows from it: the reward worth finding, limits, reach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gymnasium import spaces

from gridworld.base.errors import InputError
from gridworld.examining.sampling import Env, Replays, Steps
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, backup

UNLIMITED = 10_000  # steps of an episode that are counted where there is no limit
ENDINGS = 8  # episodes, at least, that show how an environment ends them
ERROR, WARNING = "error", "warning"
_ROUNDING = 1e-12  # of a reward


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
    make: Callable[[], Env]  # makes another
    gamma: float
    steps: Steps
    replays: Replays
    interface: str  # what Gymnasium's checker says against it
    limit: int | None  # its step limit, if it is known
    mdp: Mdp | None  # its tables, if they are known exactly
    refusal: InputError | None = None  # why they are not

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
    def bar(self) -> float:
        """Rewards above this are worth finding: above the usual if that is paid, else above 0 if some are."""
        rewards = self.steps.reward
        if self.mdp is not None:
            rewards = self.mdp.reward[self.mdp.acting][self.mdp.probability[self.mdp.acting] > 0]
        for bar in (max(self.usual, 0.0), 0.0):
            better = rewards > bar + _ROUNDING
            if better.any() and not better.all():
                return bar
        return self.usual

    @cached_property
    def paid(self) -> BoolArray:
        """Sampled steps worth finding: paid more than `bar`, or the end where all steps cost the same."""
        better = self.steps.reward > self.bar + _ROUNDING
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
        is_limit = steps.terminated[latest].all()
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
    def _worth(self) -> BoolArray:
        """(S, A, K), the outcomes worth finding in a known world: those above `bar`, or else into a goal."""
        mdp = self.mdp
        assert mdp is not None
        possible = (mdp.probability > 0) & mdp.acting[:, None, None]
        better = possible & (mdp.reward > self.bar + _ROUNDING)
        if better.any() or (mdp.is_enumerated and self.usual >= 0):
            return better
        return possible & mdp.goal[mdp.next_state]

    @cached_property
    def returns(self) -> tuple[float, float] | None:
        """The least and the largest discounted return of any policy within the step limit, exactly."""
        if (mdp := self.mdp) is None:
            return None
        found, least_change = [], _ROUNDING * np.abs(mdp.reward).max()
        for chosen in (np.min, np.max):
            v, change = np.zeros(mdp.num_states), np.inf
            steps = iter(range(self.limit or UNLIMITED))
            while change > least_change and next(steps, None) is not None:
                before, v = v, chosen(backup(mdp, v, self.gamma), axis=1)
                change = np.abs(v - before).max()
            found.append(float(mdp.start @ v))
        return found[0], found[1]

    @property
    def worth(self) -> str:
        """What is worth finding, in words."""
        paid, mdp = self.steps.reward[self.steps.reward > self.bar + _ROUNDING], self.mdp
        if mdp is not None:
            paid = mdp.reward[self._worth & (mdp.reward > self.bar + _ROUNDING)]
        if len(paid):
            is_one = np.ptp(paid) < _ROUNDING
            return f"the reward of {paid[0]:.4g}" if is_one else f"a reward above {self.bar + 0.0:.4g}"
        if mdp is None or not mdp.trap[mdp.reachable].any():
            return "an end"
        return "an end that pays best" if mdp.is_enumerated else "the goal"

    @cached_property
    def reach(self) -> tuple[float, int] | None:
        """How likely a random policy comes to what is worth finding, and in how few steps it can be reached.

        Both are exact; a probability below 1 is never rounded to 1. None: the world is not known, or nothing
        in it is worth finding.
        """
        mdp = self.mdp
        if mdp is None or not self._worth.any():
            return None
        worth = self._worth
        weight, origins = mdp.probability / mdp.num_actions, np.nonzero(~worth)[0]
        arriving = np.where(worth, weight, 0.0).sum(axis=(1, 2))
        at: FloatArray = mdp.start
        reached = 0.0
        missed = float(at @ mdp.absorbing)  # what is over without it
        for _ in range(self.limit or UNLIMITED):
            at = np.where(mdp.absorbing, 0.0, at)
            reached += float(at @ arriving)
            at = np.bincount(mdp.next_state[~worth], at[origins] * weight[~worth], len(at)).astype(np.float64)
            missed += float(at @ mdp.absorbing)
            if (at @ ~mdp.absorbing) < 1e-15:
                break
        missed += float(at @ ~mdp.absorbing)
        likely = min(reached, np.nextafter(1.0, 0.0)) if missed else 1.0
        return likely, int(mdp.steps_away[worth.any(axis=(1, 2))].min()) + 1
