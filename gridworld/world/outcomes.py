"""A world from outcomes that end episodes.

Sources of worlds say of an outcome that it ends the episode, and where it leads: a state with a number that
agents see. Here such a transition leads to a terminal state. That is the state with this number, where
nothing but ends leads there; otherwise a further state, which shows the same number.

An end is a goal if it pays as much as the best of all ends that can be reached, unless the source says itself
which are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, checked_reward, frozen

MOST_ACTIONS = 256
MOST_STATES = 512 * 512
_SUM = 1e-9  # how far probabilities may be from 1 in sum


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcomes:
    """What a source says: N numbered states, A actions, K outcomes of each.

    Attributes:
        next_state: (N, A, K), integers, the number of the state that follows.
        probability: (N, A, K), float64; 0 for an outcome that does not exist.
        reward: (N, A, K), float64.
        terminated: (N, A, K), bool, whether the outcome ends the episode.
        start: (N,), float64, a distribution.
        success: (N, A, K), bool, which ends are goals; None: those that pay best.
    """

    next_state: IntArray
    probability: FloatArray
    reward: FloatArray
    terminated: BoolArray
    start: FloatArray
    success: BoolArray | None = None


def mdp_from_outcomes(
    name: str,
    outcomes: Outcomes,
    *,
    action_names: Sequence[str] | None = None,
    places: IntArray | None = None,
    max_episode_steps: int | None = None,
    own_observation: NDArray[Any] | None = None,
    truth: str = "exact",
) -> Mdp:
    """Compile what a source says into a world.

    Args:
        name: of the world.
        outcomes: its transitions and starts.
        action_names: A names; None: their numbers.
        places: (N, 3), see `Mdp`; None: pictures have no place for states.
        max_episode_steps: see `Mdp`.
        own_observation: (N, *shape), see `Mdp`.
        truth: see `Mdp`.

    Returns:
        The world. States 0 to N - 1 are the numbered ones, whatever follows are further ends.

    Raises:
        InputError: shapes that do not fit, no probabilities, numbers of no state, or too many of them.
    """
    _check(name, outcomes)
    ends = _Ends(outcomes)
    extra = ends.number[len(outcomes.start) :]
    size, actions, count = len(ends.number), *outcomes.next_state.shape[1:]
    terminal = np.zeros(size, dtype=np.bool_)
    terminal[ends.states] = True
    goal = np.zeros(size, dtype=np.bool_)
    goal[ends.states] = ends.success

    next_state = np.empty((size, actions, count), dtype=np.int32)
    probability, reward = np.zeros(next_state.shape), np.zeros(next_state.shape)
    numbered = slice(0, len(outcomes.start))
    next_state[numbered], reward[numbered] = ends.leads_to, outcomes.reward
    probability[numbered] = outcomes.probability
    next_state[terminal] = np.flatnonzero(terminal)[:, None, None]
    probability[terminal] = np.eye(count)[0]
    reward[terminal] = 0.0
    reward[probability == 0] = 0.0
    stays = (next_state == np.arange(size)[:, None, None]) & (reward == 0)
    names = tuple(action_names) if action_names is not None else tuple(map(str, range(actions)))
    return Mdp(
        name=name,
        action_names=names,
        next_state=frozen(next_state),
        probability=frozen(probability),
        reward=frozen(reward),
        terminal=frozen(terminal),
        goal=frozen(goal),
        start=frozen(np.concatenate([outcomes.start, np.zeros(len(extra))])),
        thresholds=frozen(_thresholds(probability)),
        absorbing=frozen(terminal | (stays | (probability == 0)).all(axis=(1, 2))),
        number=frozen(ends.number),
        places=None if places is None else frozen(places[ends.number]),
        max_episode_steps=max_episode_steps,
        own_observation=None if own_observation is None else frozen(own_observation[ends.number]),
        truth=truth,
    )


class _Ends:
    """The terminal states that outcomes need.

    Attributes:
        states: (E,), integers, the terminal states.
        success: (E,), bool, which of them are goals.
        number: (S,), integers, the number of every state.
        leads_to: (N, A, K), integers, the state that each outcome leads to.
    """

    def __init__(self, outcomes: Outcomes) -> None:
        possible = outcomes.probability > 0
        playing = _playing(outcomes, possible)
        ending = possible & outcomes.terminated
        first = ending & playing[:, None, None]
        success = outcomes.success if outcomes.success is not None else _best_paid(outcomes.reward, first)
        self.number: IntArray = np.arange(len(playing), dtype=np.int64)
        self.leads_to: IntArray = outcomes.next_state.astype(np.int64)
        found: dict[tuple[int, bool], int] = {}
        taken = set(np.flatnonzero(playing).tolist())
        for mask in (first, ending & ~first):
            for where in np.argwhere(mask):
                key = int(outcomes.next_state[tuple(where)]), bool(success[tuple(where)])
                if mask is not first and (key[0], not key[1]) in found:
                    key = key[0], not key[1]  # what nobody reaches needs no end of its own
                if key not in found:
                    found[key] = self._state_for(key[0], taken)
                self.leads_to[tuple(where)] = found[key]
        self.states: IntArray = np.array(list(found.values()), dtype=np.int64)
        self.success: BoolArray = np.array([success for _, success in found], dtype=np.bool_)

    def _state_for(self, number: int, taken: set[int]) -> int:
        """The numbered state itself, where it is free; else a further one."""
        if number not in taken:
            taken.add(number)
            return number
        self.number = np.append(self.number, number)
        return len(self.number) - 1


def _playing(outcomes: Outcomes, possible: BoolArray) -> BoolArray:
    """(N,), the states in which an episode may go on."""
    goes_on = possible & ~outcomes.terminated
    reached = outcomes.start > 0
    frontier: IntArray = np.flatnonzero(reached)
    while frontier.size:
        following = np.unique(outcomes.next_state[frontier][goes_on[frontier]])
        frontier = following[~reached[following]]
        reached[frontier] = True
    return reached


def _best_paid(reward: FloatArray, ending: BoolArray) -> BoolArray:
    best = reward[ending].max(initial=-np.inf)
    return np.asarray(reward == best)


def _thresholds(probability: FloatArray) -> FloatArray:
    """(S, A, K - 1): running sums; no draw reaches those behind the last possible outcome."""
    sums: FloatArray = np.cumsum(probability, axis=2)[:, :, :-1]
    behind = np.cumsum(probability[:, :, ::-1], axis=2)[:, :, ::-1][:, :, 1:]
    sums[behind == 0] = np.inf
    return sums


def _check(name: str, outcomes: Outcomes) -> None:
    shape = outcomes.next_state.shape
    for what in ("probability", "reward", "terminated", "success"):
        table = getattr(outcomes, what)
        if table is not None and table.shape != shape:
            raise InputError(
                f"{name}: {what} has shape {table.shape}, next_state has {shape}; give one shape"
            )
    if len(shape) != 3 or 0 in shape:
        raise InputError(f"{name}: next_state has shape {shape}, must be (states, actions, outcomes)")
    if outcomes.start.shape != shape[:1]:
        raise InputError(f"{name}: start has shape {outcomes.start.shape}, must be ({shape[0]},)")
    if shape[0] > MOST_STATES or shape[1] > MOST_ACTIONS:
        raise InputError(
            f"{name}: {shape[0]:,} states and {shape[1]:,} actions are too many; at most {MOST_STATES:,} "
            f"states and {MOST_ACTIONS} actions can be solved for"
        )
    _check_distribution(name, "start", outcomes.start[None])
    _check_distribution(name, "probability", outcomes.probability)
    wrong = (outcomes.next_state < 0) | (outcomes.next_state >= shape[0])
    if wrong.any():
        state, action, outcome = (int(index) for index in np.argwhere(wrong)[0])
        raise InputError(
            f"{name}: next_state of state {state}, action {action} is "
            f"{outcomes.next_state[state, action, outcome]}, must be from 0 to {shape[0] - 1}"
        )
    for reward in np.unique(outcomes.reward[outcomes.probability > 0]):
        checked_reward(f"{name}: a reward", float(reward))


def _check_distribution(name: str, what: str, table: FloatArray) -> None:
    wrong = ~((table >= 0).all(axis=-1) & (np.abs(table.sum(axis=-1) - 1) <= _SUM))
    if wrong.any():
        where = np.argwhere(wrong)[0]
        place = "" if what == "start" else f" of state {where[0]}, action {where[1]}"
        raise InputError(
            f"{name}: {what}{place} is {table[tuple(where)].tolist()[:8]}, with sum "
            f"{table[tuple(where)].sum():.12g}; must be probabilities with sum 1"
        )
