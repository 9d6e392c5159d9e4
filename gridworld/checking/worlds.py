"""The worlds of the probes, as tables.

A world is a list with, for every live state and each of its actions, the outcomes (probability, next state,
reward, whether it ends the episode). An end that leads to a live state's number looks like that state to the
agent, and does not count as a visit to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes

Outcome = tuple[float, int, float, bool]
GOES_ON, ENDS = False, True
_LIMIT = 20  # steps of an episode, unless the world says otherwise
# With this bonus the soft optimum of `dear_contexts` is right with probability 3/4. Its advantages then have
# standard deviation 1, so that normalising them changes nothing.
PAY = 4 / math.sqrt(3)
BONUS = PAY / math.log(3)


def constant() -> Mdp:
    """Every episode is one step that pays 1."""
    return _world("constant", [_any(2, 1, 1.0, ENDS)])


def corridor() -> Mdp:
    """Three steps, whatever the action; the last pays 1."""
    return _world("corridor", [_any(2, 1, 0, GOES_ON), _any(2, 2, 0, GOES_ON), _any(2, 3, 1, ENDS)])


def bandit() -> Mdp:
    """One step with three actions, which pay 0, 1 and 0.5."""
    return _world("bandit", [[_sure(1, pay, ENDS) for pay in (0.0, 1.0, 0.5)]])


def two_contexts(pay: float = 1.0) -> Mdp:
    """One step from either of two states, in each of which the other action pays 1."""
    rows = [[_sure(2, pay * (state == action), ENDS) for action in range(2)] for state in range(2)]
    return _world("two contexts", rows, start=(0.5, 0.5))


def dear_contexts() -> Mdp:
    """As `two_contexts`, but the right action pays 4 / √3."""
    return two_contexts(PAY)


def delay() -> Mdp:
    """The first action decides whether the fourth step pays 1; those between have no effect."""
    first = [_sure(1, 0, GOES_ON), _sure(2, 0, GOES_ON)]
    between = [_any(2, state + 2, 0, GOES_ON) for state in (1, 2, 3, 4)]
    return _world("delay", [first, *between, _any(2, 7, 1, ENDS), _any(2, 7, 0, ENDS)])


def end_like_the_start() -> Mdp:
    """Two steps, the second pays 1 and ends in what looks like the start."""
    return _world("end like the start", [_any(2, 1, 0, GOES_ON), _any(2, 0, 1, ENDS)])


def endless() -> Mdp:
    """One state that pays 1 a step; only a step limit of 5 ends an episode."""
    return _world("endless", [_any(2, 0, 1, GOES_ON)], limit=5)


def gamble() -> Mdp:
    """One step: action 0 pays 0.1, action 1 pays 1 with probability 0.4."""
    risky = [(0.4, 1, 1.0, ENDS), (0.6, 1, 0.0, ENDS)]
    return _world("gamble", [[_sure(1, 0.1, ENDS), risky]])


def alternation() -> Mdp:
    """Two states; action 1 goes to the other one, which pays 1 on the way from state 1 to state 0."""
    first = [_sure(0, 0, GOES_ON), _sure(1, 0, GOES_ON)]
    second = [_sure(1, 0, GOES_ON), _sure(0, 1, GOES_ON)]
    return _world("alternation", [first, second], limit=10)


def trap() -> Mdp:
    """Action 0 pays 0.2 and ends; action 1 costs 0.2 and leads to where action 1 pays 1."""
    first = [_sure(2, 0.2, ENDS), _sure(1, -0.2, GOES_ON)]
    return _world("trap", [first, [_sure(2, 0, ENDS), _sure(2, 1, ENDS)]])


def slippery() -> Mdp:
    """Three cells; action 1 moves on with probability 0.8, else it stays; the last cell pays 1."""
    first = [_sure(0, 0, GOES_ON), [(0.8, 1, 0.0, GOES_ON), (0.2, 0, 0.0, GOES_ON)]]
    second = [_sure(0, 0, GOES_ON), [(0.8, 2, 1.0, ENDS), (0.2, 1, 0.0, GOES_ON)]]
    return _world("slippery", [first, second])


def _sure(leads_to: int, reward: float, ends: bool) -> list[Outcome]:
    return [(1.0, leads_to, reward, ends)]


def _any(actions: int, leads_to: int, reward: float, ends: bool) -> list[list[Outcome]]:
    return [_sure(leads_to, reward, ends)] * actions


def _world(
    name: str,
    rows: Sequence[Sequence[Sequence[Outcome]]],
    start: Sequence[float] = (1.0,),
    limit: int = _LIMIT,
) -> Mdp:
    """Compile the rows; a number without a row is an end."""
    entries = [
        ((state, action, index), outcome)
        for state, row in enumerate(rows)
        for action, outcomes in enumerate(row)
        for index, outcome in enumerate(outcomes)
    ]
    size = 1 + max(len(rows) - 1, *(leads_to for _, (_, leads_to, _, _) in entries))
    shape = size, len(rows[0]), 1 + max(index for (_, _, index), _ in entries)
    probability, reward, ends = np.zeros(shape), np.zeros(shape), np.ones(shape, dtype=np.bool_)
    next_state = np.broadcast_to(np.arange(size)[:, None, None], shape).copy()
    probability[:, :, 0] = 1.0
    for place, outcome in entries:
        probability[place], next_state[place], reward[place], ends[place] = outcome
    begins = np.pad(np.asarray(start), (0, size - len(start)))
    tables = Outcomes(
        next_state=next_state, probability=probability, reward=reward, terminated=ends, start=begins
    )
    return mdp_from_outcomes(name, tables, max_episode_steps=limit)
