"""P x E environments that step together, by look-ups in the tables of one world.

Each run draws slips and starts from its own generator, in the order in which `GridWorldVectorEnv` draws them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.envs.statistics_env import StatisticsVectorEnv
from gridworld.envs.vector_env import StateArray
from gridworld.world.mdp import BoolArray, FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """One step; arrays are (P · E,)."""

    pairs: StateArray  # state · A + action
    last_states: StateArray  # where the steps led to, before the reset of episodes that ended
    rewards: FloatArray
    terminated: BoolArray
    over: BoolArray  # terminated or at the step limit
    which: StateArray  # (m,), ascending, where the m episodes that ended were
    returns: FloatArray  # (m,), theirs, undiscounted
    lengths: StateArray  # (m,), theirs


@dataclass(frozen=True, eq=False, slots=True)
class Rollout:
    """n steps; arrays are (n, P, E)."""

    pairs: StateArray  # state · A + action
    rewards: FloatArray
    last_states: StateArray
    terminated: BoolArray
    truncated: BoolArray  # cut off by the step limit alone
    final_states: StateArray  # (P, E), after the last step
    ended: list[tuple[StateArray, FloatArray, StateArray]]  # of each run, (step, return, length)


class Environments:
    """The environments of P runs in one world, which reset in the step that ends an episode.

    The runs' own batches are stale until `put_back`, but for their statistics.
    """

    def __init__(self, batches: Sequence[StatisticsVectorEnv]) -> None:
        first = batches[0]
        self._batches, self.num_envs = batches, first.num_envs
        self.num_actions, self._num_outcomes = first.mdp.next_state.shape[1:]
        self._tables = first.tables
        self._thresholds = first.tables.thresholds
        self._terminal, self._start_states = first.mdp.terminal, first.mdp.start_states
        self._limit = first.step_limit
        self._bounds = np.arange(len(batches) + 1) * self.num_envs
        states, elapsed, returns = zip(*(batch.episode_state for batch in batches), strict=True)
        self.states = np.concatenate(states)  # (P · E,)
        self._elapsed, self._returns = np.concatenate(elapsed), np.concatenate(returns)

    def put_back(self) -> None:
        """Let the runs' own batches stand where these environments are."""
        for run, batch in enumerate(self._batches):
            part = slice(*self._bounds[run : run + 2])
            batch.set_episode_state(self.states[part], self._elapsed[part], self._returns[part])

    def step(self, actions: StateArray) -> Step:
        """Move all environments once; actions are (P · E,)."""
        pairs = self.states * self.num_actions
        pairs += actions
        index = pairs
        if self._num_outcomes > 1:
            index = pairs * self._num_outcomes
            index += self._outcomes(pairs)
        last_states, rewards = self._tables.next_state.take(index), self._tables.reward.take(index)
        terminated = self._tables.terminated.take(index)
        self._elapsed += 1
        self._returns += rewards
        over = self._elapsed >= self._limit
        over |= terminated
        which = np.flatnonzero(over)
        ended = which, self._returns.take(which), self._elapsed.take(which)
        self.states = last_states
        if len(which):
            self.states = last_states.copy()
            self.states[which] = self._starts(which)
            self._returns[which] = 0.0
            self._elapsed[which] = 0
        return Step(pairs, last_states, rewards, terminated, over, *ended)

    def roll(self, policies: FloatArray, draws: NDArray[np.float32]) -> Rollout:
        """Step n times with policies (P, S, A); uniform draws (n, P · E) say which actions are taken."""
        runs, num_states, num_actions = policies.shape
        limits = np.ascontiguousarray(policies.cumsum(axis=2).reshape(-1, num_actions).T[:-1])
        first = np.repeat(np.arange(runs) * num_states, self.num_envs)
        steps = []
        for draw in draws:
            beyond = draw >= limits.take(self.states + first, axis=1)
            steps.append(self.step(np.add.reduce(beyond, axis=0, dtype=np.int64)))
        shape = len(draws), runs, self.num_envs
        pairs, rewards, last_states, terminated, over = (
            np.stack([getattr(step, name) for step in steps]).reshape(shape)
            for name in ("pairs", "rewards", "last_states", "terminated", "over")
        )
        finals = self.states.reshape(runs, -1)
        ended = self._ended(steps, runs)
        return Rollout(pairs, rewards, last_states, terminated, over & ~terminated, finals, ended)

    def _ended(self, steps: Sequence[Step], runs: int) -> list[tuple[StateArray, FloatArray, StateArray]]:
        step = np.repeat(np.arange(len(steps)), [len(each.which) for each in steps])
        which, returns, lengths = (
            np.concatenate([getattr(each, name) for each in steps])
            for name in ("which", "returns", "lengths")
        )
        run = which // self.num_envs
        order = np.argsort(run, kind="stable")
        cuts = np.searchsorted(run[order], np.arange(runs + 1))
        of_runs = (order[a:b] for a, b in itertools.pairwise(cuts))
        return [(step[part], returns[part], lengths[part]) for part in of_runs]

    def _outcomes(self, pairs: StateArray) -> StateArray:
        moving = np.flatnonzero(~self._terminal.take(self.states))
        situations = pairs[moving]
        draws = self._by_run(moving, lambda batch, part: batch.draw_numbers(situations[part]))
        thresholds = self._thresholds.take(situations, axis=1)
        drawn = (draws >= thresholds[0]).astype(np.int64)
        for each in thresholds[1:]:
            drawn += draws >= each
        outcomes = np.zeros(len(pairs), dtype=np.int64)
        outcomes[moving] = drawn
        return outcomes

    def _starts(self, which: StateArray) -> StateArray:
        if len(self._start_states) == 1:
            return np.full(len(which), self._start_states[0])
        starts: StateArray = self._by_run(
            which, lambda batch, part: batch.draw_starts(part.stop - part.start)
        )
        return starts

    def _by_run(self, which: StateArray, draw: Callable[[StatisticsVectorEnv, slice], Any]) -> Any:
        """What each run's own generator draws for its part of these environments, which are ascending."""
        parts = itertools.starmap(slice, itertools.pairwise(np.searchsorted(which, self._bounds).tolist()))
        return np.concatenate([draw(*pair) for pair in zip(self._batches, parts, strict=True)])
