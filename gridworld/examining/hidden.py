"""Whether something hidden decides what follows: the time, what was drawn at reset, or the step before.

Where the states can be enumerated, all of them that show the same are compared, which is exact, also of what
beliefs about them would take too long to enumerate. Elsewhere, in a sample of an environment whose steps draw
nothing, one observation and action with two outcomes is a proof.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from itertools import combinations, islice
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gridworld.base.errors import TooLargeError
from gridworld.examining.seen import Seen
from gridworld.world.door.attributes import differing, held_by, is_plain
from gridworld.world.door.beliefs import State, summed
from gridworld.world.door.counters import counted
from gridworld.world.door.known import state_reader
from gridworld.world.door.search import Search
from gridworld.world.mdp import BoolArray, IntArray, Mdp
from gridworld.world.shown import content

_MOST_STATES, _SECONDS = 20_000, 10.0  # of a search
_LOOKED_AT, _NAMED = 12, 3  # states that are compared by their attributes; attributes that are named
_LEAST = 5  # conflicts, at least, that a cause must explain
_TIME, _RESET, _BEFORE = "the step count", "what is drawn at reset", "the step before"
_PAST = "more of the past than the step before"
_LATE = (
    " The first step of each episode shows what reset() showed: if it should not, make the observation after "
    "the state changes."
)
_ADVICE = {
    _TIME: "add the time to the observation (gymnasium.wrappers.TimeAwareObservation).",
    _RESET: "show {}, which reset() chooses, e.g. the place of the goal.",
    _BEFORE: "show {}, e.g. a velocity or the last action, or use FrameStackObservation.",
    _PAST: "show {}; a recurrent policy or stacked observations are second best.",
}


def hides(mdp: Mdp) -> bool:
    """Whether observations stand for several states."""
    return re.search("observations stand for|beliefs about", mdp.truth) is not None


def hidden(seen: Seen) -> tuple[str, str] | None:
    """The evidence and the advice; None where nothing is found."""
    steps = seen.steps
    may_hide = isinstance(seen.refusal, TooLargeError) if seen.mdp is None else hides(seen.mdp)
    found = _by_states(seen) if may_hide else None
    if not (found or seen.mdp is not None or steps.draws):
        found = _by_conflict(seen)
    if found and _BEFORE in found[0] and (steps.after == steps.before)[steps.first].all():
        found = found[0], found[1] + _LATE
    return found


def pays_totals(seen: Seen) -> bool:
    """Whether rewards are sums so far: what they grow by follows from the step as it is seen, they do not."""
    steps = seen.steps
    added = np.round(steps.reward - np.where(steps.time == 0, 0.0, np.append(0.0, steps.reward[:-1])), 9)
    step = _numbers(steps.before, steps.action, steps.after)
    total, own = (
        _several(step, np.unique(np.round(each, 9), return_inverse=True)[1]) for each in (steps.reward, added)
    )
    grows = np.bincount(step, added != 0) > 0  # a step in place may be paid as the step before, by chance
    return bool((total & grows).sum() >= _LEAST and not own.any())


def _by_states(seen: Seen) -> tuple[str, str] | None:
    """Compare the outcomes in states that show the same, exactly, and what tells these states apart."""
    env = seen.make()
    if state_reader(env.unwrapped) is not None:  # what the rules of a game hide belongs to it
        return None
    bounds: Any = {"most_states": _MOST_STATES, "most_seconds": _SECONDS}
    search = Search("env", env, **bounds, compares=False, keeps_copies=True)
    try:
        search.explore()
    except TooLargeError:
        if not search.num_tried:
            return None
    except Exception:  # its code may be anybody's
        return None
    known = (counted(search), seen.ends_at and seen.ends_at - 1, len(search.states))
    limit = min(each for each in known if each is not None)
    states = [each for each in search.states if each.steps and each.depth < limit]
    tried = "" if search.budget.is_explored else f" of the first {len(states):,} states"
    entered = [(-1, -1, each) for each in search.resets.starts]
    entered += [
        (state.number, action, step)
        for state in states
        for action, row in enumerate(state.steps)
        for step in row
        if not (step.terminated or step.truncated)
    ]
    shown: dict[int, set[bytes]] = {-1: {b""}}  # observations with which a state is entered
    for _, _, step in entered:
        shown.setdefault(step.following, set()).add(step.seen)
    alike: dict[bytes, dict[Any, list[int]]] = {}  # states by what they show, and by what follows
    for state in states:
        for observation in shown[state.number]:
            outcomes = _outcomes_in(state)
            alike.setdefault(observation, {}).setdefault(outcomes, []).append(state.number)
    conflicts = {observation: found for observation, found in alike.items() if len(found) > 1}
    if not conflicts:
        return None
    origins, following = (
        np.array(each) for each in zip(*((o, s.following) for o, _, s in entered), strict=True)
    )
    at, times = np.isin(np.arange(len(search.states)), following[origins < 0]), []
    for _ in range(min(limit, 2 * max(each.depth for each in states) + 2)):
        times.append(at)
        at = np.isin(np.arange(len(at)), following[(origins >= 0) & at[origins]])
    is_step = origins >= 0
    links = coo_array((is_step[is_step], (origins[is_step], following[is_step])), (len(at), len(at)))
    parts, when = connected_components(links, directed=False)[1], np.stack(times)
    before: dict[tuple[int, bytes], set[Any]] = {}
    for origin, action, step in entered:
        earlier = {(action, each) for each in shown[origin]}
        before.setdefault((step.following, step.seen), set()).update(earlier)
    contexts: dict[str, Callable[[bytes, list[int]], set[Any]]] = {
        _TIME: lambda _, states: set(np.flatnonzero(when[:, states].any(axis=1)).tolist()),
        _RESET: lambda _, states: set(parts[states].tolist()),
        _BEFORE: lambda shown, states: set().union(*(before[each, shown] for each in states)),
    }
    cause = _PAST
    for name, context in contexts.items():
        found = [[context(shown, each) for each in by.values()] for shown, by in conflicts.items()]
        if all(sum(map(len, sets)) == len(set().union(*sets)) for sets in found):
            cause = name
            break
    names = _names(search, conflicts)
    evidence = (
        f"in {len(conflicts):,} of {len(alike):,} observations{tried} the same action has different outcomes "
        f"(exact): they depend on {cause}{f' ({names})' if names else ''}, which is not observed."
    )
    return evidence, _ADVICE[cause].format(names or "what is missing")


def _outcomes_in(state: State) -> tuple[frozenset[Any], ...]:
    """How likely each action is followed by what; of an end only if it pays, for sooner may be better."""
    outcomes = []
    for row in state.steps:
        shares = summed(
            ((seen, np.sign(reward) if over else round(reward, 9), over), share)
            for share, _, seen, reward, over, _ in row
        )
        outcomes.append(frozenset(shares.items()))
    return tuple(outcomes)


def _names(search: Search, conflicts: dict[bytes, dict[Any, list[int]]]) -> str:
    """The fewest attributes in which two states of one observation, with different outcomes, differ."""
    counts: Counter[tuple[str, ...]] = Counter()
    for found in islice(conflicts.values(), _LOOKED_AT):
        groups = [[_values(search, each) for each in states[:_LOOKED_AT]] for states in found.values()]
        for group, other in combinations(groups[:_LOOKED_AT], 2):
            pairs = [(one, two) for one in group for two in other]
            differ = [tuple(differing(one, two)) for one, two in pairs]
            counts[min(differ, key=len)] += 1
    least = min((len(each) for each in counts if each), default=0)
    names = max((each for each in counts if len(each) == least), key=lambda each: counts[each], default=())
    return ", ".join(names) if len(names) <= _NAMED else ""


def _values(search: Search, state: int) -> dict[str, bytes]:
    search.layers.put(search.states[state].copy, search.states[state].depth)
    held = (each for layer in search.layers.layers for each in held_by(layer))
    return {name: content(value) for name, value in held if is_plain(value)}


def _numbers(*columns: IntArray | BoolArray) -> IntArray:
    """A number for each row of the columns, equal for equal rows."""
    return np.unique(np.stack(columns), axis=1, return_inverse=True)[1].ravel()


def _outcomes(seen: Seen) -> tuple[IntArray, IntArray, IntArray]:
    """Of each step the pair (observation, action), what came of it, and the pair before, as numbers."""
    steps = seen.steps
    by_limit = (steps.time + 1 == seen.ends_at) & np.isin(steps.after, steps.before)
    ended = steps.terminated & ~by_limit
    rewards = np.unique(np.round(steps.reward, 9), return_inverse=True)[1]
    pair, outcome = _numbers(steps.before, steps.action), _numbers(steps.after, rewards, ended)
    return pair, outcome, np.where(steps.time == 0, -1, np.append(-1, pair[:-1]))


def _several(group: IntArray, outcome: IntArray) -> BoolArray:
    """Of each group of steps, whether it has more than one outcome."""
    return np.bincount(np.unique(np.stack([group, outcome]), axis=1)[0]) > 1


def _histories(time: IntArray, pair: IntArray) -> IntArray:
    """A number for each step, equal where the episodes so far are."""
    numbers: dict[tuple[int, int], int] = {}
    history, last = np.zeros_like(pair), -1
    for step, (start, each) in enumerate(zip((time == 0).tolist(), pair.tolist(), strict=True)):
        last = history[step] = numbers.setdefault((-1 if start else last, each), len(numbers))
    return history


def _by_conflict(seen: Seen) -> tuple[str, str] | None:
    steps = seen.steps
    pair, outcome, previous = _outcomes(seen)
    several = _several(pair, outcome)
    inside = several[pair]
    if not inside.any() or _only_the_end_pays_differently(seen, pair, inside):
        return None
    cause, histories = _PAST, _histories(steps.time, pair)
    by = {_TIME: steps.time, _RESET: steps.episode, _BEFORE: previous}
    if seen.replays.plays and all(each == seen.replays.plays[0] for each in seen.replays.plays):
        del by[_RESET]  # other seeds change nothing
    elif _several(histories, outcome).any():
        cause, by = _RESET, {}  # all that could be seen was the same
    usual = np.bincount(_numbers(pair, outcome))[_numbers(pair, outcome)] / np.bincount(pair)[pair]
    for name, context in by.items():
        asked = np.flatnonzero(inside)
        if name != _RESET:  # one step of each history, since all of them have the same outcome
            asked = asked[np.unique(histories[inside], return_index=True)[1]]
        group = _numbers(pair[asked], context[asked])
        size = np.bincount(group)
        again = size > 1
        by_chance = np.sum((1 - np.bincount(group, usual[asked]) / size)[again])
        if by_chance >= _LEAST and (_several(group, outcome[asked]) & again).sum() <= 0.02 * again.sum():
            cause = name
            break
    one = int(np.argmax(inside))
    two = int(np.argmax((pair == pair[one]) & (outcome != outcome[one])))
    kind = f"rewards of {steps.reward[one]:.4g} and {steps.reward[two]:.4g}"
    if steps.after[one] != steps.after[two]:
        kind = "two observations"
    elif steps.reward[one] == steps.reward[two]:
        kind = "an end and none"
    return (
        f"its steps draw nothing, yet {several.sum():,} of {np.sum(np.bincount(pair) > 1):,} pairs of "
        f"observation and action that came again had different outcomes (e.g. {kind}): they depend on "
        f"{cause}, which is not observed.",
        _ADVICE[cause].format("what is missing"),
    )


def _only_the_end_pays_differently(seen: Seen, pair: IntArray, inside: BoolArray) -> bool:
    """Whether outcomes differ only in how much the end pays, with one sign, as where sooner is better."""
    steps, final = seen.steps, inside & seen.steps.terminated
    rewards = np.where(steps.terminated, 0.0, np.round(steps.reward, 9))
    rest = _numbers(steps.after, np.unique(rewards, return_inverse=True)[1], steps.terminated)
    signs = np.unique(np.sign(steps.reward[final]))
    return len(signs) == 1 and signs[0] != 0 and not _several(pair, rest).any()
