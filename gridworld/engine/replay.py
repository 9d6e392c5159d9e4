"""Replay buffers of P runs, which store a state's number in place of an observation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gridworld.base.serialization import State, StateError, fill
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

Float32Array = NDArray[np.float32]


class Transitions(NamedTuple):
    """n minibatches of B transitions of each of P runs, (n, P, B) each."""

    states: IntArray
    actions: IntArray
    following: IntArray
    rewards: Float32Array
    ends: Float32Array  # 1 where no value follows: at a time-out one does
    shares: FloatArray | None  # what part of its minibatch each transition makes up; None: all the same


class UniformReplay:
    """The newest transitions of P runs, drawn uniformly: SB3's `ReplayBuffer`, with its draws."""

    def __init__(self, runs: int, buffer_size: int, num_envs: int, num_states: int) -> None:
        self._rows, self._num_envs = max(buffer_size // num_envs, 1), num_envs
        self._shape, self._state = (runs, self._rows, num_envs), np.min_scalar_type(num_states - 1)
        self._position, self._is_full = 0, False

    @cached_property
    def _columns(self) -> dict[str, NDArray[Any]]:
        """Made when something is stored: who is only asked what it learned needs no memory for it."""
        shape = self._shape
        return {
            "states": np.zeros(shape, self._state),
            "actions": np.zeros(shape, np.uint8),
            "following": np.zeros(shape, self._state),
            "rewards": np.zeros(shape, np.float32),
            "ends": np.zeros(shape, np.bool_),
        }

    def store(
        self, states: IntArray, actions: IntArray, following: IntArray, rewards: FloatArray, ends: BoolArray
    ) -> None:
        """Add a step of all environments, (P, E) each."""
        step = states, actions, following, rewards, ends
        for column, values in zip(self._columns.values(), step, strict=True):
            column[:, self._position] = values
        self._position = (self._position + 1) % self._rows
        self._is_full |= self._position == 0

    def width(self, size: int) -> int:
        """How many columns a minibatch of B transitions has."""
        return size

    def draw(self, generators: Sequence[np.random.RandomState | None], count: int, size: int) -> Transitions:
        """Draw n = `count` minibatches of B = `size` for each run that has a generator here.

        Of each minibatch the steps are drawn, then the environments, as SB3 draws them.
        """
        bounds = np.array([[self._rows if self._is_full else self._position], [self._num_envs]])
        which = np.zeros((count, len(generators), size), dtype=np.int64)
        for run, generator in enumerate(generators):
            if generator is not None:
                drawn = generator.randint(0, bounds, size=(count, 2, size))
                which[:, run] = (run * self._rows + drawn[:, 0]) * self._num_envs + drawn[:, 1]
        states, actions, following, rewards, ends = (each.take(which) for each in self._columns.values())
        return Transitions(
            states.astype(np.int64),
            actions,
            following.astype(np.int64),
            rewards,
            ends.astype(np.float32),
            None,
        )

    def get_state(self, run: int) -> State:
        """What a run remembers."""
        count = self._rows if self._is_full else self._position
        columns = {name: column[run, :count].copy() for name, column in self._columns.items()}
        return {**columns, "position": self._position, "is_full": self._is_full}

    def set_state(self, run: int, state: State) -> None:
        self._position, self._is_full = int(state["position"]), bool(state["is_full"])
        if not 0 <= self._position < self._rows:
            raise StateError(f"the replay's position must be from 0 to {self._rows - 1}")
        count = self._rows if self._is_full else self._position
        for name, column in self._columns.items():
            fill(column[run, :count], state[name], f"the replay's {name}")


class CountedReplay:
    """How often each transition was met: nothing is forgotten, in little memory.

    A minibatch is drawn by systematic sampling: of a transition with the share p of all that was met, it has
    B p, rounded up or down by chance. The mean is that of uniform sampling, the noise far smaller.
    """

    def __init__(self, runs: int, num_states: int, num_actions: int) -> None:
        self._num_states, self._num_actions = num_states, num_actions
        # Of each run: ((state · A + action) · S + following) · 2 + end, and the reward as the imaginary part.
        # Complex numbers are sorted by their real parts, and then by the others.
        self._met = [np.empty(0, dtype=np.complex128) for _ in range(runs)]
        self._counts: list[IntArray] = [np.empty(0, dtype=np.int64) for _ in range(runs)]

    def store(
        self, states: IntArray, actions: IntArray, following: IntArray, rewards: FloatArray, ends: BoolArray
    ) -> None:
        numbers = ((states * self._num_actions + actions) * self._num_states + following) * 2 + ends
        for run, met in enumerate(numbers + 1j * rewards.astype(np.float32)):
            known, counts = self._met[run], self._counts[run]
            rows = np.searchsorted(known, met)
            if not len(known) or not np.array_equal(known.take(rows, mode="clip"), met):
                self._met[run] = all_of_them = np.union1d(known, met)
                self._counts[run] = np.zeros(len(all_of_them), dtype=np.int64)
                self._counts[run][np.searchsorted(all_of_them, known)] = counts
                rows = np.searchsorted(all_of_them, met)
            self._counts[run] += np.bincount(rows, minlength=len(self._counts[run]))

    def width(self, size: int) -> int:
        """See `UniformReplay.width`: as many as the run that has met most."""
        return max(map(len, self._counts))

    def draw(self, generators: Sequence[np.random.RandomState | None], count: int, size: int) -> Transitions:
        """See `UniformReplay.draw`; columns of runs that have met fewer end in transitions of no share."""
        shape = count, len(generators), self.width(size)
        found = [
            np.zeros(shape, kind)
            for kind in (np.int64, np.int64, np.int64, np.float32, np.float32, np.float64)
        ]
        for run, generator in enumerate(generators):
            if generator is None:
                continue
            part, met = slice(0, len(self._met[run])), self._met[run]
            times = systematic_sample(self._counts[run], size, generator.random_sample(count))
            numbers = met.real.astype(np.int64)
            pairs, following = np.divmod(numbers // 2, self._num_states)
            columns = (*np.divmod(pairs, self._num_actions), following, met.imag, numbers % 2, times / size)
            for table, column in zip(found, columns, strict=True):
                table[:, run, part] = column
        return Transitions(*found)

    def get_state(self, run: int) -> State:
        met = self._met[run]
        return {
            "transitions": met.real.copy(),
            "rewards": met.imag.copy(),
            "counts": self._counts[run].copy(),
        }

    def set_state(self, run: int, state: State) -> None:
        count = len(state["counts"])
        met, counts = np.empty(count, dtype=np.complex128), np.empty(count, dtype=np.int64)
        for name, column in (("transitions", met.real), ("rewards", met.imag), ("counts", counts)):
            fill(column, state[name], name)
        most = self._num_states * self._num_actions * self._num_states * 2
        is_sorted = np.isfinite(met).all() and np.array_equal(np.unique(met), met)
        if not (is_sorted and (met.real >= 0).all() and (met.real < most).all() and (counts > 0).all()):
            raise StateError(
                "transitions must be ascending transition numbers of this world, with their counts"
            )
        self._met[run], self._counts[run] = met, counts


Replay = UniformReplay | CountedReplay


def systematic_sample(counts: IntArray, size: int, chance: FloatArray) -> IntArray:
    """Draw n minibatches of B from N transitions: every N/B-th of all in a row, from a random one on.

    G. Kitagawa, Monte Carlo Filter and Smoother for Non-Gaussian Nonlinear State Space Models, 1996.

    Args:
        counts: (R,), how often each transition was met, N times in all.
        size: B.
        chance: (n,), numbers from [0, 1), where each minibatch begins.

    Returns:
        (n, R), how often each transition is in each minibatch.
    """
    ends = np.cumsum(counts)
    before = np.ceil(size * (ends / ends[-1]) - chance[:, None])  # points before each end
    before[:, -1] = size  # whatever was rounded
    counted: IntArray = np.diff(before, prepend=0).astype(np.int64)
    return counted
