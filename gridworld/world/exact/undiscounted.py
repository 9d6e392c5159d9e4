"""Policy iteration without discount, and with discounts just below 1.

Without discount (γ = 1) Bellman's equation may have other fixed points than the optimum, and greedy actions
may never end. There V* is the largest expected total reward that any policy has, one that goes on for ever
included. Of the actions that keep it, those are optimal that bring gains sooner and losses later: with the
smallest Σ_t t E[r_t], the slope of the value in γ. Both are what discounting prefers as γ goes to 1 (the
first two orders of Blackwell's optimality). Policy iteration in this order, first V and then the slope,
begins with a policy that is worth something everywhere: it rests where it can stay for ever without a reward,
and elsewhere comes surely to such states or to an end if that is possible. So it cannot be caught in a fixed
point that is not the optimum: where the optimum is better by the largest margin, it would have to stay among
such states for ever, earn nothing there, and be no better than resting. Discounts just below 1 are treated in
the same way, since the cost of a step gets lost in rounding beside the value.

References: M. L. Puterman, Markov Decision Processes, 1994, chapters 7 and 10; A. Veinott, Discrete dynamic
programming with sensitive discount optimality criteria, 1969; D. Bertsekas and J. Tsitsiklis, An analysis of
stochastic shortest path problems, 1991.
"""

from __future__ import annotations

import numpy as np

from gridworld.errors import InputError
from gridworld.world.exact.bellman import pick
from gridworld.world.exact.markov_chain import DENSE_STATES, Chain, Evaluation, one_hot_policy, steps_to
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

# Relative; less than that is rounding: of elimination without subtractions, of sparse factors, of slopes.
_VISIBLE, _VISIBLE_IN_LARGE, _SAME_SLOPE = 8e-15, 1e-13, 1e-11
_KEPT = 1e-10  # relative; a policy that loses more was no improvement


def solve_by_value_and_slope(mdp: Mdp, gamma: float, greedy: IntArray) -> tuple[Evaluation, BoolArray]:
    """Policy iteration from `greedy` (S,): the larger value first, of equal values the smaller slope.

    With γ = 1, `greedy` has a finite value wherever a policy has. Slopes are looked at once no value can be
    improved. Values that look equal may differ by less than is visible: actions that turn out to be worse are
    taken back, and are out of the choice from then on.

    Returns:
        The evaluation of an optimal policy; (S, A), True for every optimal action.
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
    """The actions (S, A) that are best as one step before a policy, and the policy (S,) to go on with.

    `found` is of the policy `greedy` (S,), whose actions stay unless others are better by more than rounding;
    `worse` (S, A) are known not to be.
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

    Summed up as differences of values, it is exact also where all but a tiny part stays where it is; of an
    action without a finite value it is -inf. Its size is what its rounding is relative to. Outcomes that
    change less than `negligible`, relative to their own size, change nothing: among them the rounding of a
    likely one would hide what an unlikely one brings, and who has time waits for that.
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
    over = mdp.absorbing
    gained[unknown], rounding[unknown] = -np.inf, 0.0
    gained[over] = rounding[over] = 0.0
    return gained, rounding


def better_or_resting(mdp: Mdp, one: IntArray) -> IntArray:
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
        paid, remedy = mdp.rewards_text()
        raise InputError(
            f"gamma=1 with {paid}: who goes on for ever is paid on the way, so that the return may grow "
            f"without end; take a gamma below 1{remedy}"
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
