"""Rollouts of several batches at once, under policies that stand still.

While a policy stands still, nothing that is done between two steps changes what the next one does. So a
rollout of n steps is computed first, for all batches of P runs together, and told step by step afterwards:
each step of P x E environments is as few array look-ups as one of E. Every batch draws from its own
generator, in the order in which `GridWorldVectorEnv.advance` would.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.envs.vector_env import Advance, Ended, GridWorldVectorEnv, StateArray
from gridworld.world.mdp import BoolArray, FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Rollout:
    """What n steps of a batch of E environments came to; arrays are (n, E) unless said otherwise.

    Attributes:
        states: int64, that the steps began in.
        actions: int64.
        pairs: int64, states * A + actions.
        rewards: float64.
        last_states: int64, where the steps led to, before the reset of episodes that ended.
        terminated: bool.
        truncated: bool, whether the step limit was reached, also where the episode ended by itself.
        final_states: (E,), int64, after the last step.
        which: (m,), where the m episodes that ended were, step by step.
        returns: (m,), theirs, undiscounted.
        lengths: (m,), theirs, in steps.
        first_ended: n + 1, of each step, the first of the m that it ended.
    """

    states: StateArray
    actions: StateArray
    pairs: StateArray
    rewards: FloatArray
    last_states: StateArray
    terminated: BoolArray
    truncated: BoolArray
    final_states: StateArray
    which: StateArray
    returns: FloatArray
    lengths: StateArray
    first_ended: Sequence[int]

    def ended(self, first: int, stop: int) -> tuple[FloatArray, StateArray]:
        """The returns and lengths of the episodes that steps ended, from `first` to before `stop`."""
        part = slice(self.first_ended[first], self.first_ended[stop])
        return self.returns[part], self.lengths[part]

    def step(self, number: int) -> Advance:
        """What `GridWorldVectorEnv.advance` returns for a step."""
        rewards, terminated = self.rewards[number], self.terminated[number]
        truncated, last_states = self.truncated[number], self.last_states[number]
        start, end = self.first_ended[number], self.first_ended[number + 1]
        if start == end:
            return last_states, rewards, terminated, truncated, None
        following = self.final_states if number + 1 == len(self.states) else self.states[number + 1]
        which = self.which[start:end]
        ended = Ended(
            last_states, terminated | truncated, which, self.returns[start:end], self.lengths[start:end]
        )
        return following, rewards, terminated, truncated, ended


def shape_of(batch: GridWorldVectorEnv) -> tuple[int, ...]:
    """What must be equal for batches to be rolled together: environments, actions, outcomes."""
    return (batch.num_envs, *batch.mdp.next_state.shape[1:])


def roll(
    batches: Sequence[GridWorldVectorEnv], thresholds: Sequence[FloatArray], draws: NDArray[np.float32]
) -> list[Rollout]:
    """Step P batches n times.

    Args:
        batches: that reset in the same step; equal by `shape_of`. They are left as n calls of their
            `advance` leave them, but for what a subclass counts.
        thresholds: of each, (A - 1, S): a draw means the action that is the number of those it reaches.
        draws: (P, n, E), uniform in [0, 1).

    Returns:
        The rollout of each.
    """
    runs, steps, count = draws.shape
    joint = _Joint(batches)
    limits = np.concatenate(thresholds, axis=1)
    first = np.repeat(_starts([each.shape[1] for each in thresholds]), count)  # of a run's states
    states, actions, last_states = (np.empty((runs, steps, count), dtype=np.int64) for _ in range(3))
    rewards = np.empty((runs, steps, count))
    terminated, truncated = (np.empty((runs, steps, count), dtype=np.bool_) for _ in range(2))
    ended = []
    for step in range(steps):
        states[:, step] = joint.states.reshape(runs, count)
        beyond = draws[:, step].ravel() >= limits.take(joint.states + first, axis=1)
        chosen = np.add.reduce(beyond, axis=0, dtype=np.int64)
        actions[:, step] = chosen.reshape(runs, count)
        *found, over = joint.advance(chosen)
        for table, part in zip((last_states, rewards, terminated, truncated), found, strict=True):
            table[:, step] = part.reshape(runs, count)
        if len(over[0]):
            ended.append((np.full(len(over[0]), step), *over))
    joint.put_back()
    pairs = states * batches[0].mdp.num_actions + actions
    tables = zip(states, actions, pairs, rewards, last_states, terminated, truncated, strict=True)
    finals = joint.states.reshape(runs, count)
    of_runs = _of_runs(ended, runs, steps, count)
    runs_of: list[Any] = list(zip(tables, finals, of_runs, strict=True))
    return [Rollout(*[*table, final, *over]) for table, final, over in runs_of]


class _Joint:
    """Batches as one, with the tables of their worlds one behind the other."""

    def __init__(self, batches: Sequence[GridWorldVectorEnv]) -> None:
        self._batches, self._count = batches, batches[0].num_envs
        self._num_actions, self._num_outcomes = batches[0].mdp.next_state.shape[1:]
        mdps = {id(batch.mdp): batch for batch in batches}
        tables = [batch.tables for batch in mdps.values()]
        firsts = dict(zip(mdps, _starts([len(table.reward) for table in tables]).tolist(), strict=True))
        self._next_state, self._reward, self._terminated = (
            getattr(tables[0], name)
            if len(tables) == 1
            else np.concatenate([getattr(table, name) for table in tables])
            for name in ("next_state", "reward", "terminated")
        )
        first = [firsts[id(batch.mdp)] // self._num_outcomes for batch in batches]
        self._first_pair = np.repeat(np.array(first, dtype=np.int64), self._count)
        if self._num_outcomes > 1:
            self._thresholds = np.concatenate([table.of_pairs() for table in tables], axis=1)
            self._still = np.concatenate([batch.mdp.terminal for batch in mdps.values()])
        self._first_state = self._first_pair // self._num_actions
        self._limits = np.repeat([batch.step_limit for batch in batches], self._count)
        starts = [batch.mdp.start_states for batch in batches]
        first_starts = np.repeat([each[0] for each in starts], self._count)
        self._only_starts = first_starts if all(len(each) == 1 for each in starts) else None
        self.states, self._elapsed, self._returns = (
            np.concatenate(arrays) for arrays in zip(*(batch.under_way for batch in batches), strict=True)
        )

    def advance(self, actions: StateArray) -> tuple[StateArray, FloatArray, BoolArray, BoolArray, Any]:
        """See `GridWorldVectorEnv.advance`; the last are where episodes ended, their returns and lengths."""
        index = self.states * self._num_actions
        index += actions
        index += self._first_pair
        if self._num_outcomes > 1:
            outcomes = self._draw_outcomes(index)
            index *= self._num_outcomes
            index += outcomes
        states, rewards = self._next_state.take(index), self._reward.take(index)
        terminated = self._terminated.take(index)
        self.states = states
        self._elapsed += 1
        truncated = self._elapsed >= self._limits
        self._returns += rewards
        which = np.flatnonzero(terminated | truncated)
        over = which, self._returns[which], self._elapsed[which]
        if len(which):
            self.states = states.copy()
            self.states[which] = self._draw_starts(which)
            self._returns[which] = 0.0
            self._elapsed[which] = 0
        return states, rewards, terminated, truncated, over

    def put_back(self) -> None:
        """Let the batches go on from here."""
        size = self._count
        for run, batch in enumerate(self._batches):
            part = slice(run * size, (run + 1) * size)
            batch.go_on_from(self.states[part], self._elapsed[part], self._returns[part])

    def _draw_outcomes(self, pairs: StateArray) -> StateArray:
        moving = np.flatnonzero(~self._still.take(self.states + self._first_state))
        situations = pairs[moving]
        draws = self._draws(moving, situations)
        thresholds = self._thresholds.take(situations, axis=1)
        drawn = (draws >= thresholds[0]).astype(np.int64)
        for each in thresholds[1:]:
            drawn += draws >= each
        outcomes = np.zeros(len(pairs), dtype=np.int64)
        outcomes[moving] = drawn
        return outcomes

    def _draw_starts(self, which: StateArray) -> StateArray:
        if self._only_starts is not None:
            return self._only_starts[which]
        cuts = self._cuts(which)
        starts = np.empty(len(which), dtype=np.int64)
        for batch, (start, end) in zip(self._batches, itertools.pairwise(cuts), strict=True):
            if start < end:
                starts[start:end] = batch.draw_starts(end - start)
        return starts

    def _draws(self, where: StateArray, situations: StateArray) -> FloatArray:
        """A number for each of these places, from the generators of their batches."""
        parts = zip(self._batches, itertools.pairwise(self._cuts(where)), strict=True)
        return np.concatenate([batch.draw_numbers(situations[start:end]) for batch, (start, end) in parts])

    def _cuts(self, where: StateArray) -> list[int]:
        """Of ascending places, the first of each batch; and their number."""
        bounds = np.arange(len(self._batches) + 1) * self._count
        cuts: list[int] = np.searchsorted(where, bounds).tolist()
        return cuts


def _of_runs(ended: list[Any], runs: int, steps: int, count: int) -> list[tuple[Any, ...]]:
    """Of each run, where its episodes ended, their returns and lengths, and the first of each step."""
    if not ended:
        nothing = np.zeros(0, dtype=np.int64)
        return [(nothing, np.zeros(0), nothing, [0] * (steps + 1))] * runs
    step, which, returns, lengths = (np.concatenate(arrays) for arrays in zip(*ended, strict=True))
    key = which // count * steps + step
    order = np.argsort(key, kind="stable")
    which, returns, lengths = which[order] % count, returns[order], lengths[order]
    first = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=runs * steps))])
    found = []
    for run in range(runs):
        of_run = first[run * steps : (run + 1) * steps + 1]
        part = slice(of_run[0], of_run[-1])
        found.append((which[part], returns[part], lengths[part], (of_run - of_run[0]).tolist()))
    return found


def _starts(lengths: Sequence[int]) -> StateArray:
    """Where parts of these lengths begin, one behind the other."""
    return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
