"""A finite world as tables: everything that touches it indexes these arrays.

A world is a Markov decision process with S states, A actions and at most K outcomes of each. An end is a
state: where a source says that a transition ends the episode, it leads to a terminal state. Terminal states
absorb: every action stays there and pays nothing.

Reference: M. L. Puterman, Markov Decision Processes, 1994, chapter 2.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from gridworld.base.bounds import Bounds

IntArray = NDArray[np.integer[Any]]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Table = TypeVar("Table")

# Of a reward, unless it is 0: the squared sum of 100,000 of the largest is finite, and the smallest is larger
# than what counts as 0.
LEAST_REWARD, MOST_REWARD = 1e-100, 1e100
EXACT = "exact"  # the `truth` of tables that are given
BY_CONSTRUCTION = "by construction"  # the `scope` of such worlds
ELSEWHERE = "the same in"  # how it says that other processes have found the same
ENUMERATED = "enumerated"  # how the `truth` begins of those that trying all actions found


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Mdp:
    """Read-only tables of one world. Two states share a `number` where only one of them is an end."""

    name: str  # what messages and pictures call it
    action_names: tuple[str, ...]  # A
    next_state: IntArray  # (S, A, K), int32
    probability: FloatArray  # (S, A, K); sums to 1 over K
    reward: FloatArray  # (S, A, K)
    terminal: BoolArray  # (S,), where an episode is over
    goal: BoolArray  # (S,), the terminal states that are a success
    start: FloatArray  # (S,), a distribution
    number: IntArray  # (S,), int64, what the environment calls each state, its observation
    places: IntArray | None = None  # (S, 3), int64: panel, row and column in pictures, -1 where it has none
    panel_names: tuple[str, ...] = ()  # what pictures call each panel, if anything
    # what messages call the state of each number, if not by place or number
    state_names: tuple[str, ...] = ()
    max_episode_steps: int | None = None  # the step limit that belongs to the world, if any
    own_observation: Any = field(default=None, repr=False)  # what the environment shows, see `world.shown`
    own_space: Any = None  # of one of these; None: as the arrays are
    truth: str = EXACT  # where the tables come from, as tables and pictures say it

    def __repr__(self) -> str:
        sizes = f"{self.num_states} states, {self.num_actions} actions"
        return f"<{type(self).__name__} {self.name}: {sizes}>"

    @property
    def num_states(self) -> int:
        """S."""
        return len(self.next_state)

    @property
    def num_actions(self) -> int:
        """A."""
        return len(self.action_names)

    @property
    def is_enumerated(self) -> bool:
        """Whether all actions were tried to find it, in an environment that ends its own episodes."""
        return self.truth.startswith(ENUMERATED)

    @property
    def scope(self) -> str:
        """How the tables are known, which a verdict about them says."""
        if self.truth.startswith(EXACT):
            return self.truth.replace(EXACT, BY_CONSTRUCTION, 1)
        here = "" if ELSEWHERE in self.truth else ", in this process"
        if not self.is_enumerated:
            return f"by its {self.truth}"
        return f"{self.truth}{here}: as far as its attributes and np_random determine it"

    @property
    def default_step_limit(self) -> int | None:
        """The step limit of a batch that is given none; None: its episodes have no limit."""
        return self.max_episode_steps

    @cached_property
    def is_stochastic(self) -> bool:
        """Whether an action may have more than one outcome somewhere."""
        return bool((np.count_nonzero(self.probability > 0, axis=2) > 1).any())

    @property
    def num_numbers(self) -> int:
        """How many observations the environment has, of which every state has one as its number."""
        return int(self.number.max()) + 1

    @cached_property
    def start_states(self) -> IntArray:
        """(n,), the states with a start, ascending."""
        return frozen(np.flatnonzero(self.start))

    @cached_property
    def _start_thresholds(self) -> FloatArray | None:
        """(n - 1,) of the starts; None where every start is as likely as any other."""
        chances = self.start[self.start_states]
        return None if (chances == chances[0]).all() else frozen(np.cumsum(chances)[:-1])

    def drawn_starts(self, draws: FloatArray) -> IntArray:
        """The start states that uniform draws (m,) from [0, 1) mean: (m,)."""
        if self._start_thresholds is None:
            index: IntArray = (draws * len(self.start_states)).astype(np.intp)
        else:
            index = np.searchsorted(self._start_thresholds, draws, side="right")
        return self.start_states[index]

    @cached_property
    def thresholds(self) -> FloatArray:
        """(S, A, K - 1): the outcome of a uniform draw is how many of them it reaches.

        Running sums; no draw reaches those behind the last possible outcome.
        """
        sums: FloatArray = np.cumsum(self.probability, axis=2)[:, :, :-1]
        behind = np.cumsum(self.probability[:, :, ::-1], axis=2)[:, :, ::-1][:, :, 1:]
        sums[behind == 0] = np.inf
        return frozen(sums)

    @cached_property
    def absorbing(self) -> BoolArray:
        """(S,), terminal, or a state that no action leaves and nothing is paid in."""
        return frozen(self.terminal | resting_states(self.next_state, self.probability, self.reward))

    @cached_property
    def trap(self) -> BoolArray:
        """(S,), bool, terminal and no goal."""
        return frozen(self.terminal & ~self.goal)

    @cached_property
    def steps_away(self) -> IntArray:
        """(S,), in how few steps an episode can come to each state; -1 where it cannot."""
        return frozen(steps_from(self.start_states, self.next_state, self.probability > 0))

    @property
    def reachable(self) -> BoolArray:
        """(S,), the states that an episode can come to."""
        return np.asarray(self.steps_away >= 0)

    @cached_property
    def acting(self) -> BoolArray:
        """(S,), the states that an episode can come to and act in."""
        return frozen(self.reachable & ~self.absorbing)

    def with_exploring_starts(self, share: float) -> Self:
        """The same world, in which a share of the episodes begins in a state drawn uniformly from `acting`.

        Reference: R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, section 5.3.
        """
        Bounds(0, 1).check("share", share)
        start = (1 - share) * self.start + share * self.acting / self.acting.sum()
        return dataclasses.replace(self, start=frozen(start))

    def digest(self) -> str:
        """The sha256 of the tables, equal for worlds in which the same happens with the same chances."""
        digest = hashlib.sha256()
        for name in ("next_state", "probability", "reward", "terminal", "goal", "start", "number"):
            digest.update(np.ascontiguousarray(getattr(self, name)).tobytes())
        return digest.hexdigest()

    def shown_digest(self) -> str:
        """The sha256 of the tables and of what the environment shows in each state."""
        parts = (np.ascontiguousarray(each).tobytes() for each in leaves_of(self.own_observation))
        return hashlib.sha256(self.digest().encode() + b"".join(parts)).hexdigest()

    def text(self) -> str:
        """What a run's manifest has of this world, beside its settings."""
        sizes = f"{self.num_states} states, {self.num_actions} actions"
        return f"{self.name}: {sizes}, sha256 {self.digest()}"

    def coordinates(self, state: int) -> tuple[int, ...]:
        """What tells a state from others in a run's files: its number; of a map, row and column."""
        return (int(self.number[state]),)

    def state_name(self, state: int) -> str:
        """What messages call a state: its name, else its place, else what it shows, else its number."""
        if self.state_names:
            return self.state_names[int(self.number[state])]
        if self.places is None or (self.places[state] < 0).any():
            if self.is_enumerated and self._usual:
                from gridworld.world.shown import unusual_numbers

                return f"observation with {unusual_numbers(self.own_observation, self._usual, state)}"
            return f"state {int(self.number[state])}"
        panel, row, col = self.places[state].tolist()
        where = f"row {row + 1}, column {col + 1}"
        return f"{where} ({self.panel_names[panel]})" if self.panel_names else where

    @cached_property
    def _usual(self) -> dict[str, NDArray[Any]]:
        from gridworld.world.shown import usual_numbers  # here, with Gymnasium, which a browser does not have

        return {} if self.own_observation is None else usual_numbers(self.own_observation)

    def action_choices(self) -> str:
        """The actions for a message: 0 (up), 1 (right), 2 (down) or 3 (left)."""
        *others, last = (f"{number} ({name})" for number, name in enumerate(self.action_names))
        return f"{', '.join(others)} or {last}" if others else last

    def predecessors(self, states: IntArray) -> IntArray:
        """States, some repeatedly, with an outcome of whatever probability into one of `states` (n,)."""
        sources, first = self._incoming
        counts = first[states + 1] - first[states]
        skipped = first[states] - (np.cumsum(counts) - counts)
        found: IntArray = sources[np.arange(counts.sum()) + np.repeat(skipped, counts)]
        return found

    @cached_property
    def _incoming(self) -> tuple[IntArray, IntArray]:
        """(S * A * K,) origins of all outcomes by where they lead; (S + 1,) where a state's part begins."""
        leads_to = self.next_state.ravel()
        origins = np.argsort(leads_to, kind="stable") // (leads_to.size // self.num_states)
        first = np.concatenate([[0], np.cumsum(np.bincount(leads_to, minlength=self.num_states))])
        return frozen(origins.astype(self.next_state.dtype)), frozen(first)


def steps_from(starts: IntArray, next_state: IntArray, taken: BoolArray) -> IntArray:
    """(S,), the fewest steps from some states by the outcomes `taken` (S, A, K); -1: there is no way."""
    size = len(next_state)
    themselves = np.arange(size)[:, None, None]
    following = np.where(taken, next_state, themselves).reshape(size, -1).tolist()
    waiting = starts.tolist()
    steps = [-1] * size
    for start in waiting:
        steps[start] = 0
    for origin in waiting:  # which grows
        for state in following[origin]:
            if steps[state] < 0:
                steps[state] = steps[origin] + 1
                waiting.append(state)
    return np.array(steps)


def steps_to(mdp: Mdp, taken: BoolArray, targets: BoolArray) -> IntArray:
    """(S,), the fewest steps to `targets` (S,) by the outcomes `taken` (S, A, K); -1: there is no way."""
    steps = np.where(targets, 0, -1)
    frontier: IntArray = np.flatnonzero(targets)
    distance = 0
    while frontier.size:
        distance += 1
        around = np.unique(mdp.predecessors(frontier))
        around = around[steps[around] < 0]
        leads = ((steps[mdp.next_state[around]] >= 0) & taken[around]).any(axis=(1, 2))
        frontier = around[leads]
        steps[frontier] = distance
    return steps


def resting_states(next_state: IntArray, probability: FloatArray, reward: FloatArray) -> BoolArray:
    """(S,), the states that no action leaves and nothing is paid in."""
    stays = (next_state == np.arange(len(next_state))[:, None, None]) & (reward == 0)
    return np.asarray((stays | (probability == 0)).all(axis=(1, 2)))


def grid_places(num_rows: int, num_cols: int) -> NDArray[np.int64]:
    """`Mdp.places` of a grid in one panel, row by row from the top left: (num_rows * num_cols, 3)."""
    row, col = np.divmod(np.arange(num_rows * num_cols), num_cols)
    return np.stack([np.zeros_like(row), row, col], axis=1)


def leaves_of(rows: Any) -> Iterator[NDArray[Any]]:
    """The arrays of what is shown in all states, if anything is, in the order of their space."""
    if isinstance(rows, dict | tuple):
        for each in rows.values() if isinstance(rows, dict) else rows:
            yield from leaves_of(each)
    elif rows is not None:
        yield rows


def taken(rows: Any, states: Any) -> Any:
    """What is shown in some states."""
    if isinstance(rows, dict):
        return {key: taken(each, states) for key, each in rows.items()}
    if isinstance(rows, tuple):
        return tuple(taken(each, states) for each in rows)
    return None if rows is None else rows[states]


def frozen(table: Table) -> Table:
    """The same array, or arrays as `leaves_of` has them, made read-only."""
    for each in leaves_of(table):
        each.setflags(write=False)
    return table


def checked_reward(what: str, value: Any) -> float:
    """A number that is neither too large nor too small to be added up; refuses anything else."""
    number = value.item() if isinstance(value, np.generic) else value
    Bounds(-MOST_REWARD, MOST_REWARD, least=LEAST_REWARD).check(what, number)
    return float(number)


def backup(
    mdp: Mdp, v: FloatArray, gamma: float, states: IntArray | slice = slice(None), magnitude: bool = False
) -> FloatArray:
    """Q(s, a) = Σ_k p_k [ r_k + γ v(next_k) ] (n, A) of `states` (n,); `magnitude` takes |r_k| for r_k."""
    reward = np.abs(mdp.reward[states]) if magnitude else mdp.reward[states]
    target = reward + gamma * v[mdp.next_state[states]]
    if target.shape[2] == 1:
        return target[:, :, 0]
    possible = mdp.probability[states] > 0  # with γ = 1 an impossible outcome may be worth -inf
    q: FloatArray = np.einsum("sak,sak->sa", mdp.probability[states], np.where(possible, target, 0.0))
    return q
