"""Whether something hidden decides what follows: the time, what was drawn at reset, or the step before.

In a deterministic environment, one observation and action with two outcomes is a proof. In a stochastic one,
a chi-square test for each pair asks whether the frequencies of outcomes depend on the time or the step
before. Of numbers that never come again, a regression asks whether the step before explains what they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np
from gymnasium import spaces
from scipy.special import chdtrc

from gridworld.checking.seen import Seen
from gridworld.world.mdp import BoolArray, FloatArray, IntArray

_TESTED, _SURE, _EFFECT = 40, 1e-4, 0.25  # visits of a pair, p value after correction, Cramér's V
_MOST_PAIRS = 200
_MOST_INPUTS = 12  # numbers of an observation, and actions, of the regression
_UNEXPLAINED = 0.2  # of the variance; the step before must explain three quarters of that
_TIME, _RESET, _BEFORE = "the step count", "what is drawn at reset", "the step before"
_PAST = "more of the past than the step before"
_ADVICE = {
    _TIME: "add the time to the observation (gymnasium.wrappers.TimeAwareObservation).",
    _RESET: "show what reset() chooses, e.g. the place of the goal.",
    _BEFORE: "show what is missing, e.g. a velocity or the last action, or use FrameStackObservation.",
    _PAST: "show what is missing; a recurrent policy or stacked observations are second best.",
}


def hidden(seen: Seen) -> tuple[str, str] | None:
    """The evidence and the advice; None where nothing is found."""
    pair, outcome, previous = _outcomes(seen)
    found = (_by_chance if seen.steps.draws else _by_conflict)(seen, pair, outcome, previous)
    return found or _by_regression(seen)


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


def _by_conflict(seen: Seen, pair: IntArray, outcome: IntArray, previous: IntArray) -> tuple[str, str] | None:
    steps = seen.steps
    several = _several(pair, outcome)
    inside = several[pair]
    if not inside.any() or _only_the_end_pays_differently(seen, pair, inside):
        return None
    cause = _PAST
    by = {_TIME: steps.time, _RESET: steps.episode, _BEFORE: previous}
    if seen.replays.plays and all(each[0] == seen.replays.plays[0][0] for each in seen.replays.plays):
        del by[_RESET]  # other seeds change nothing
    elif _several(_histories(steps.time, pair), outcome).any():
        cause, by = _RESET, {}  # all that could be seen was the same
    for name, context in by.items():
        group = _numbers(pair[inside], context[inside])
        again = np.bincount(group) > 1
        if again.sum() >= 5 and (_several(group, outcome[inside]) & again).sum() <= 0.02 * again.sum():
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
        _ADVICE[cause],
    )


def _only_the_end_pays_differently(seen: Seen, pair: IntArray, inside: BoolArray) -> bool:
    """Whether outcomes differ only in how much the end pays, with one sign, as where sooner is better."""
    steps, final = seen.steps, inside & seen.steps.terminated
    rewards = np.where(steps.terminated, 0.0, np.round(steps.reward, 9))
    rest = _numbers(steps.after, np.unique(rewards, return_inverse=True)[1], steps.terminated)
    signs = np.unique(np.sign(steps.reward[final]))
    return len(signs) == 1 and signs[0] != 0 and not _several(pair, rest).any()


def _by_chance(seen: Seen, pair: IntArray, outcome: IntArray, previous: IntArray) -> tuple[str, str] | None:
    counts = np.bincount(pair)
    pairs = [each for each in np.argsort(-counts)[:_MOST_PAIRS].tolist() if counts[each] >= _TESTED]
    times = np.digitize(seen.steps.time, np.quantile(seen.steps.time, [0.25, 0.5, 0.75]))
    tests = {
        name: [test for each in pairs if (test := _association(context[pair == each], outcome[pair == each]))]
        for name, context in ((_BEFORE, previous), (_TIME, times))
    }
    count = sum(map(len, tests.values()))
    for name, found in tests.items():
        sure = [each for each in found if each[0] * count < _SURE and each[1] > _EFFECT]
        if sure:
            p, effect, visits = min(sure)
            return (
                f"in {len(sure)} of {len(found)} pairs of observation and action, what follows depends on "
                f"{name} (Cramér's V {effect:.2f} in {visits} visits, p < {max(p * count, 1e-99):.0e} after "
                f"correction for {count} tests).",
                _ADVICE[name],
            )
    return None


def _association(context: IntArray, outcome: IntArray) -> tuple[float, float, int] | None:
    """The p value of independence by chi-square, Cramér's V and the visits; None where they are too few."""
    table = np.zeros((int(context.max()) + 2, int(outcome.max()) + 1))
    np.add.at(table, (context + 1, outcome), 1)
    table = table[table.sum(axis=1) >= 10]
    frequent = table.sum(axis=0) >= 10
    table = np.column_stack([table[:, frequent], table[:, ~frequent].sum(axis=1)])
    table = table[:, table.sum(axis=0) >= 10]
    smaller = min(table.shape) - 1
    if smaller < 1:
        return None
    expected = table.sum(axis=1)[:, None] * table.sum(axis=0) / table.sum()
    if expected.min() < 1:
        return None
    chi = float(((table - expected) ** 2 / expected).sum())
    p = float(chdtrc((table.shape[0] - 1) * (table.shape[1] - 1), chi))
    return p, float(np.sqrt(chi / table.sum() / smaller)), len(context)


def _by_regression(seen: Seen) -> tuple[str, str] | None:
    steps, actions = seen.steps, seen.env.action_space
    here = np.flatnonzero(steps.time > 0)
    values = steps.vectors
    if values is None or not np.isfinite(values).all() or not 1 <= values.shape[1] <= _MOST_INPUTS:
        return None
    if not isinstance(actions, spaces.Discrete) or actions.n > _MOST_INPUTS or len(here) < 1_000:
        return None
    if seen.observed < len(steps.time) / 4:  # they come again
        return None
    scaled = (values - values.mean(axis=0)) / (values.std(axis=0) + 1e-12)
    now, then = scaled[steps.before[here]], scaled[steps.before[here - 1]]
    one_hot = np.eye(int(steps.action.max()) + 1)
    act, act_before = one_hot[steps.action[here]], one_hot[steps.action[here - 1]]
    squares = [one * two for one, two in combinations_with_replacement(now.T, 2)]
    inputs = np.column_stack(
        [np.ones(len(now)), now, *squares, act, *(now * each[:, None] for each in act.T)]
    )
    for place, change in enumerate((values[steps.after[here]] - values[steps.before[here]]).T):
        without, with_it = (
            _unexplained(each, change) for each in (inputs, np.column_stack([inputs, then, act_before]))
        )
        if without > _UNEXPLAINED and with_it < without / 4:
            return (
                f"observation and action leave {without:.0%} of the variance of the change of its number "
                f"{place} unexplained, with {_BEFORE} {with_it:.0%} (regression, {len(here) // 2:,} "
                "held-out steps).",
                _ADVICE[_BEFORE],
            )
    return None


def _unexplained(inputs: Sequence[FloatArray] | FloatArray, target: FloatArray) -> float:
    """The share of the variance of the second half that a regression on the first leaves."""
    inputs, half = np.asarray(inputs), len(target) // 2
    if target.std() < 1e-9:
        return 0.0
    weights = np.linalg.lstsq(inputs[:half], target[:half], rcond=None)[0]
    return float(np.mean((target[half:] - inputs[half:] @ weights) ** 2) / max(target[half:].var(), 1e-30))
