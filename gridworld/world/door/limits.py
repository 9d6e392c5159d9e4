"""Step limits: of a `TimeLimit`, of a counter of its own, or the time at which its states are truncated."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from gridworld.world.door.beliefs import Step
from gridworld.world.door.stand_ins import Limited, Timed
from gridworld.world.door.unread import Counter, Read

if TYPE_CHECKING:
    from gridworld.world.door.search import Search, State


def counted(search: Search) -> int | None:
    """The step in which a counter of its own cuts every episode, as far as one was met."""
    counters = search.layers.counters.values()
    return min((limit for each in counters for limit in each.limits), default=None)


def met(search: Search) -> int | None:
    """The same, by a `TimeLimit` too."""
    found = search.layers.limit, counted(search)
    return min((each for each in found if each is not None), default=None)


def check(search: Search, state: State, steps: list[list[Step]]) -> None:
    """At each limit, the steps from a state must be cut, and otherwise do what they do before.

    Raises:
        Timed: a wrapper around a time limit does something else.
        Read: what compares a counter does something else, or only in some states.
    """
    layers = search.layers
    if (
        layers.limited is not None
        and layers.may_see_cuts
        and not _only_cuts(search, state, steps, layers.limited)
    ):
        raise Timed
    for counter in layers.counters.values():
        if counter.limits:
            if counter.num_checked < search.num_tried or not _only_cuts(search, state, steps, counter):
                raise Read({counter.key})
            counter.num_checked += 1


def _only_cuts(search: Search, state: State, steps: list[list[Step]], limit: Limited | Counter) -> bool:
    limit.cuts = search.is_cutting = True
    try:
        for action, usual in enumerate(steps):
            run = functools.partial(search.stepped_from, state.copy, state.depth, np.int64(action))
            cut: dict[Any, Fraction] = {}
            for (_, *shown), probability in search.branching.outcomes(run).items():
                key = (*shown[:3], shown[2] or shown[3])
                cut[key] = cut.get(key, Fraction(0)) + probability
            whole: dict[Any, Fraction] = {}
            for each in usual:
                key = (each.seen, each.reward, each.terminated, True)
                whole[key] = whole.get(key, Fraction(0)) + each.probability
            if cut != whole:
                return False
    finally:
        limit.cuts = search.is_cutting = False
    return True


def of_world(search: Search) -> tuple[int | None, bool]:
    """The step limit of what a search found, and whether something else truncates too, by the state."""
    known = [each for each in (met(search), search.limit_met) if each is not None]
    cut = {state.depth + 1 for state, step in _steps(search) if step.truncated}
    if cut:
        on = {state.depth + 1 for state, step in _steps(search) if not step.truncated}
        is_timed = all(
            search.states[step.following].depth == state.depth + 1
            for state, step in _steps(search)
            if step.following >= 0
        )
        if not is_timed or max(on, default=0) >= min(cut):  # a state must have one time
            return min(known, default=None), True
        known.append(min(cut))
    return min(known, default=None), False


def _steps(search: Search) -> Iterator[tuple[State, Step]]:
    """The steps that do not terminate an episode, with the states from which they are."""
    for state in search.states:
        for row in state.steps:
            for step in row:
                if not step.terminated:
                    yield state, step
