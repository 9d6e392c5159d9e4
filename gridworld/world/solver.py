"""The exact optimum of a world: its values and all its optimal actions.

With V = 0 at the end of an episode, the optimum is the fixed point of

    Q*(s, a) = Σ_k p(k | s, a) [ r(s, a, k) + γ V*(next(s, a, k)) ],    V*(s) = max_a Q*(s, a),

found by value iteration and made exact by policy iteration.

Without discount (γ = 1) this equation may have other fixed points, and greedy actions may never end. There V*
is the largest expected total reward that any policy has, one that never ends included. Of the actions that
keep it, those are optimal that bring gains sooner and losses later: with the smallest Σ_t t E[r_t], the slope
of the value in γ (the first two orders of Blackwell's optimality). Policy iteration in this order begins with
a policy that rests where it can stay for ever without a reward, and elsewhere surely comes to such states or
to an end if that is possible. So no fixed point but the optimum can hold it: to be better by the largest
margin, the optimum would have to stay among such states for ever, earn nothing there, and be no better than
resting. Discounts just below 1 are treated in the same way: the cost of a step gets lost in rounding.

References: M. L. Puterman, Markov Decision Processes, 1994, chapters 6, 7 and 10; R. Sutton and A. Barto,
Reinforcement Learning, 2nd ed., 2018, chapter 4; A. Veinott, Discrete dynamic programming with sensitive
discount optimality criteria, 1969; D. Bertsekas and J. Tsitsiklis, An analysis of stochastic shortest path
problems, 1991.
"""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world import levels
from gridworld.world.chain import DENSE_STATES, ORDINARY_GAMMA, Chain, Evaluation, check_gamma, one_hot_policy
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, backup, frozen, steps_to

# Two actions whose values agree to this relative precision are equally good. Rounding stays far below it.
TIE = 1e-9
# Sweeps need only find a good policy; the rest is solved exactly.
_SWEEP_TOLERANCE, _SWEEPS = 1e-9, 200
_IMPROVEMENT = 1e-11  # relative; less than that is rounding
_PATIENT = 100.0  # steps; a longer horizon, 1 / (1 - γ), adds up more of what counts as a tie in one step
_MOST_SOLUTIONS = 8  # of a world that are kept
# Relative; less than that is rounding: of elimination without subtractions, of sparse factors, of slopes.
_VISIBLE, _VISIBLE_IN_LARGE, _SAME_SLOPE = 8e-15, 1e-13, 1e-11
_KEPT = 1e-10  # relative; a policy that loses more was no improvement


def pick(table: FloatArray, actions: IntArray) -> FloatArray:
    """Look up table[s, actions[s]] (S,) in a table (S, A) with an action per state (S,)."""
    return table[np.arange(len(actions)), actions]


@dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a world under one discount γ."""

    gamma: float
    v: FloatArray  # (S,), V*
    q: FloatArray  # (S, A), Q*
    optimal: BoolArray  # (S, A), True for every action as good as the best; all actions where it is over
    scale: FloatArray  # (S,), the expected discounted sum of |reward|: what "relative" is relative to


def value_iteration(mdp: Mdp, gamma: float) -> Solution:
    """Find V*, Q* and all optimal actions, exact up to rounding.

    With γ = 1 and costs, a state from which every policy may go on paying for ever has V = -inf, and all its
    actions are as good as each other. A way to earn for ever has no finite optimum and is an InputError.
    """
    gamma = check_gamma(gamma)
    ordinary = min(gamma, ORDINARY_GAMMA)
    try:
        if levels.are_enough(mdp, gamma):
            return _solve_by_sweeps(mdp, gamma)
        swept = levels.of(mdp).optimum(ordinary, _SWEEP_TOLERANCE, _SWEEPS)
    except levels.NotConvergedError as most:
        swept = most.args[0]
    greedy: IntArray = np.argmax(backup(mdp, swept, ordinary), axis=1)
    if gamma <= ORDINARY_GAMMA:
        return _solve_discounted(mdp, gamma, greedy)
    if gamma == 1:
        greedy = _better_or_resting(mdp, greedy)
    found, optimal = _solve_by_value_and_slope(mdp, gamma, greedy)
    return Solution(gamma, found.value, backup(mdp, found.value, gamma), optimal, found.scale)


_solved: WeakKeyDictionary[Mdp, dict[float, Solution]] = WeakKeyDictionary()


def solved(mdp: Mdp, gamma: float) -> Solution:
    """What `value_iteration` finds, found once for a world and discount; its arrays are read-only."""
    gamma, solutions = check_gamma(gamma), _solved.setdefault(mdp, {})
    if gamma not in solutions:
        solution = value_iteration(mdp, gamma)
        for table in (solution.v, solution.q, solution.optimal, solution.scale):
            frozen(table)
        while len(solutions) >= _MOST_SOLUTIONS:
            del solutions[next(iter(solutions))]
        solutions[gamma] = solution
    return solutions[gamma]


def _solve_discounted(mdp: Mdp, gamma: float, greedy: IntArray) -> Solution:
    """Policy iteration from `greedy` (S,)."""
    seen = set()
    precision = _precision(gamma)
    while True:
        found = Chain(mdp, one_hot_policy(greedy, mdp.num_actions)).evaluation(gamma)
        v, scale = found.value, found.scale
        q = backup(mdp, v, gamma)
        q_scale = backup(mdp, scale, gamma, magnitude=True)
        best = np.argmax(q, axis=1)
        gain = pick(q, best) - pick(q, greedy)
        least = precision * _IMPROVEMENT * np.maximum(pick(q_scale, best), pick(q_scale, greedy))
        seen.add(greedy.tobytes())
        greedy = np.where(gain > levels.NOTHING + least, best, greedy)
        if greedy.tobytes() in seen:  # no better action anywhere; by rounding, perhaps one met before
            return _solution(mdp, gamma, v, q, scale)


def _solution(mdp: Mdp, gamma: float, v: FloatArray, q: FloatArray, scale: FloatArray) -> Solution:
    q_scale, best = backup(mdp, scale, gamma, magnitude=True), np.argmax(q, axis=1)
    tolerance = _precision(gamma) * TIE * np.maximum(q_scale, pick(q_scale, best)[:, None])
    return Solution(gamma, v, q, q >= pick(q, best)[:, None] - tolerance, scale)


def _precision(gamma: float) -> float:
    return min(1.0, _PATIENT * (1 - gamma))


def _solve_by_sweeps(mdp: Mdp, gamma: float) -> Solution:
    v = levels.of(mdp).optimum(gamma, levels.ACCURATE, levels.MOST_SWEEPS)
    q = backup(mdp, v, gamma)
    greedy = np.argmax(q, axis=1)
    paid = pick(np.einsum("sak,sak->sa", mdp.probability, np.abs(mdp.reward)), greedy)
    transition = Chain(mdp, one_hot_policy(greedy, mdp.num_actions)).transition
    return _solution(mdp, gamma, v, q, levels.of(mdp).sums(transition, paid, gamma, TIE, np.abs(v)))


def _solve_by_value_and_slope(mdp: Mdp, gamma: float, greedy: IntArray) -> tuple[Evaluation, BoolArray]:
    """Policy iteration from `greedy` (S,): the larger value first, of equal values the smaller slope.

    With γ = 1, `greedy` has a finite value wherever a policy has. Values that look equal may differ by less
    than is visible: actions that turn out to be worse are taken back, and excluded from then on.
    """
    worse = np.zeros((mdp.num_states, mdp.num_actions), dtype=np.bool_)
    seen: set[bytes] = set()
    found = Chain(mdp, one_hot_policy(greedy, mdp.num_actions)).evaluation(gamma, with_slope=True)
    while True:
        seen.add(greedy.tobytes())
        optimal, improved = _best_actions(mdp, found, gamma, greedy, worse)
        if improved.tobytes() in seen:  # no better action anywhere; by rounding, perhaps one met before
            return found, optimal
        then = Chain(mdp, one_hot_policy(improved, mdp.num_actions)).evaluation(gamma, with_slope=True)
        with np.errstate(invalid="ignore"):
            is_kept = then.value >= found.value - _KEPT * found.scale
        if (is_kept | np.isneginf(found.value)).all():
            greedy, found = improved, then
        else:
            changed = improved != greedy
            fallen = changed & ~is_kept
            states = np.flatnonzero(fallen if fallen.any() else changed)
            worse[states, improved[states]] = True


def _best_actions(
    mdp: Mdp, found: Evaluation, gamma: float, greedy: IntArray, worse: BoolArray
) -> tuple[BoolArray, IntArray]:
    """The actions (S, A) that are best as one step before a policy, and the improved policy (S,).

    The actions of `greedy` (S,) stay unless others are better by more than rounding; `worse` (S, A) are not.
    """
    assert found.slope is not None
    assert found.slope_scale is not None
    lost = ~np.isfinite(found.value)
    visible = _VISIBLE if mdp.num_states <= DENSE_STATES else _VISIBLE_IN_LARGE
    next_value, next_scale = (table[mdp.next_state] for table in (found.value, found.scale))
    delay, delay_rounding = _advantage(mdp, found.slope, found.slope_scale, gamma, next_value, next_scale)
    delay_rounding *= _SAME_SLOPE
    paid = mdp.reward, np.abs(mdp.reward)
    for negligible in (0.0, visible):  # what rounding may hide is looked for where nothing else is better
        gain, rounding = _advantage(mdp, found.value, found.scale, gamma, *paid, negligible)
        rounding *= visible
        gain[worse] = -np.inf
        better = gain > rounding
        if better.any():
            break

    as_good = gain >= -rounding
    as_good[np.arange(len(greedy)), greedy] = True
    as_good[lost] = True
    delay = np.where(as_good, delay, np.inf)
    optimal = as_good & ((delay <= delay_rounding) | lost[:, None])
    if better.any():
        best = np.where(better, gain, -np.inf).argmax(axis=1)
        return optimal, np.where(better.any(axis=1), best, greedy)
    soonest = delay.argmin(axis=1)
    is_sooner = ~lost & (pick(delay, soonest) < -pick(delay_rounding, soonest))
    return optimal, np.where(is_sooner, soonest, greedy)


def _advantage(
    mdp: Mdp,
    values: FloatArray,
    scale: FloatArray,
    gamma: float,
    reward: FloatArray,
    reward_scale: FloatArray,
    negligible: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Σ_k p_k [ r_k + γ x(next_k) - x(s) ] (S, A) for rewards r (S, A, K) and values x (S,); its size.

    Summed up as differences of values, it is exact also where all but a tiny part stays where it is; without
    a finite value it is -inf. Its size is what its rounding is relative to. Outcomes that change less than
    `negligible`, relative to their own size, change nothing: their rounding would hide what an unlikely one
    brings.
    """
    here, there = values[:, None, None], values[mdp.next_state]
    moved = mdp.next_state != np.arange(mdp.num_states)[:, None, None]
    with np.errstate(invalid="ignore"):  # inf - inf, where all is lost
        change = reward + gamma * (there - here) - (1 - gamma) * here
        size = reward_scale + moved * (scale[mdp.next_state] + scale[:, None, None])
        size += (1 - gamma) * scale[:, None, None]
        hidden = np.abs(change) < negligible * size
        change[hidden] = size[hidden] = 0.0
        sums = (np.where(mdp.probability > 0, mdp.probability * part, 0.0) for part in (change, size))
        gained, rounding = (part.sum(axis=2) for part in sums)
    unknown = ~np.isfinite(rounding)
    gained[unknown], rounding[unknown] = -np.inf, 0.0
    gained[mdp.absorbing] = rounding[mdp.absorbing] = 0.0
    return gained, rounding


def _better_or_resting(mdp: Mdp, one: IntArray) -> IntArray:
    """A policy (S,) to begin with at γ = 1: `one` where it is worth more than one that ends or rests."""
    other = _resting_policy(mdp)
    first, second = (
        Chain(mdp, one_hot_policy(each, mdp.num_actions)).evaluation(1.0) for each in (one, other)
    )
    with np.errstate(invalid="ignore"):
        better = first.value > second.value + _VISIBLE_IN_LARGE * (first.scale + second.scale)
    better |= np.isneginf(second.value) & np.isfinite(first.value)
    actions: IntArray = np.where(better, one, other)
    return actions


def _resting_policy(mdp: Mdp) -> IntArray:
    """A policy (S,) that surely comes to an end or to rest, wherever one can."""
    possible = mdp.probability > 0
    playing = ~mdp.absorbing
    going_on = _staying(mdp, possible, playing, np.ones(possible.shape[:2], dtype=np.bool_))
    if (going_on & (possible & (mdp.reward > 0)).any(axis=2)).any():
        raise InputError(
            f"gamma=1 in {mdp.name}: an episode that never ends collects rewards, so the return may be "
            "infinite; use a gamma below 1, or rewards of at most 0 on the way, e.g. env.step_reward=0"
        )
    free = ~np.asarray((possible & (mdp.reward != 0)).any(axis=2))
    resting = _staying(mdp, possible, playing, free)
    rest = np.asarray(resting.any(axis=1))
    safe: BoolArray = np.ones(mdp.num_states, dtype=np.bool_)
    while True:  # drop what can be led astray from every way there
        allowed = np.asarray((safe[mdp.next_state] | ~possible).all(axis=2))
        ways = possible & allowed[:, :, None]
        steps = steps_to(mdp, ways, mdp.terminal | rest)
        if np.array_equal(steps >= 0, safe):
            break
        safe = steps >= 0
    nearer = np.asarray((ways & (steps[mdp.next_state] < steps[:, None, None])).any(axis=2))
    policy: IntArray = np.where(rest, resting.argmax(axis=1), nearer.argmax(axis=1))
    return policy


def _staying(mdp: Mdp, possible: BoolArray, within: BoolArray, actions: BoolArray) -> BoolArray:
    """(S, A), those of `actions` by which one can stay `within` some states for ever."""
    while True:
        keeping: BoolArray = actions & within[:, None] & (within[mdp.next_state] | ~possible).all(axis=2)
        left = np.asarray(keeping.any(axis=1))
        if np.array_equal(left, within):
            return keeping
        within = left
