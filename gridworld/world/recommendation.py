"""What the exact tables of a world recommend for an agent that is to learn in it.

An agent's settings may follow the world's discounts and its chances. Nothing here becomes a target: an
agent learns from samples alone. The agents' yaml files call these functions through
`gridworld.config.composition.world_rules`.

A decision between two actions is clear where their difference in value is large beside the error of what is
learnt. That error has two parts: what noise leaves, σ / √n after n samples whose targets r + γ V(s') have the
standard deviation σ, and what a network leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gridworld.world.exact.evaluation import REGRET_TOLERANCE
from gridworld.world.exact.markov_chain import Chain
from gridworld.world.exact.occupancy import discounted_visits, stopping_states
from gridworld.world.exact.solver import Solution, solved
from gridworld.world.mdp import BoolArray, FloatArray, Mdp

_SAMPLES = 4000  # of a state and action that a run sees
_NETWORK_ERROR = 0.01  # of a value
_LEAST_SCALE = 0.01
_NEARLY_AS_CLEAR = 0.5  # of the clearest


def has_chance(mdp: Mdp) -> bool:
    """Whether an action may have more than one outcome somewhere."""
    return bool((np.count_nonzero(mdp.probability > 0, axis=2) > 1).any())


def clearest_gamma(mdp: Mdp, candidates: Sequence[float], evaluation_gamma: float) -> float:
    """Choose the discount that an agent learns with.

    Args:
        mdp: the world.
        candidates: discounts, ascending; those above the evaluation's are left out.
        evaluation_gamma: the evaluation's discount, which is the last candidate.

    Returns:
        The smallest whose decisions are nearly as clear as those of the clearest candidate, since values
        settle sooner under a smaller discount. A discount with an optimal policy that the evaluation does
        not certify has no clear decisions.

    Raises:
        InputError: the world has no finite optimum under one of them.
    """
    ascending = [*(each for each in candidates if each < evaluation_gamma), evaluation_gamma]
    clear = [clarity(mdp, each, evaluation_gamma) for each in ascending]
    enough = _NEARLY_AS_CLEAR * max(clear)
    return next(each for each, found in zip(ascending, clear, strict=True) if found >= enough)


def quadratic_scale(mdp: Mdp, gamma: float) -> float | None:
    """Choose what rewards are multiplied with for an agent that learns values by Huber's loss.

    Huber's loss is quadratic up to an error of 1 and linear beyond. Where outcomes differ by more, what
    minimises it is not their mean, and a rare fall counts for less than it costs. Where no outcome is farther
    from the mean than 1, it is.

    Args:
        mdp: the world.
        gamma: the agent's discount.

    Returns:
        The largest factor of two decimals under which that is so; None: 1, or larger.

    Raises:
        InputError: the world has no finite optimum.
    """
    own = solved(mdp, gamma)
    farthest = float(np.abs(_deviations(mdp, own)).max(where=mdp.probability > 0, initial=0.0))
    return None if farthest <= 1 else max(math.floor(100 / farthest) / 100, _LEAST_SCALE)


def clarity(mdp: Mdp, gamma: float, evaluation_gamma: float) -> float:
    """How clear the least clear decision is to an agent that learns with a discount.

    Args:
        mdp: the world.
        gamma: the agent's discount.
        evaluation_gamma: the evaluation's.

    Returns:
        The smallest difference in value between the best and another action, in units of the error of what is
        learnt, among those pairs of a state and an action that would cost the certificate; 0 where such an
        action is optimal under `gamma`; inf where no action costs it.
    """
    best, own = solved(mdp, evaluation_gamma), solved(mdp, gamma)
    matters = costly(mdp, best)
    if not matters.any():
        return np.inf
    if (own.optimal & matters).any():
        return 0.0
    variance = (mdp.probability * _deviations(mdp, own) ** 2).sum(axis=2)
    of_best = variance[np.arange(mdp.num_states), np.argmax(own.q, axis=1)]
    error = np.sqrt((variance + of_best[:, None]) / _SAMPLES + _NETWORK_ERROR**2)
    return float(((own.v[:, None] - own.q) / error)[matters].min())


def costly(mdp: Mdp, best: Solution) -> BoolArray:
    """The mistakes that a policy is not certified with.

    Args:
        mdp: the world.
        best: its optimum under the evaluation's discount.

    Returns:
        (S, A), True where taking this action at every visit, and optimal ones elsewhere, costs more than the
        certificate allows, to first order: the discounted visits of the state under the optimum times what
        the action loses (S. Kakade and J. Langford, Approximately Optimal Approximate Reinforcement
        Learning, ICML 2002, lemma 6.1).
    """
    policy = best.optimal / best.optimal.sum(axis=1, keepdims=True)
    chain = Chain(mdp, policy)
    visits = discounted_visits(chain, best.gamma, stopping_states(chain, best.gamma))
    allowed = REGRET_TOLERANCE * float(mdp.start @ best.scale)
    found: BoolArray = visits[:, None] * (best.v[:, None] - best.q) > allowed
    return found


def _deviations(mdp: Mdp, own: Solution) -> FloatArray:
    """(S, A, K), of the target r + γ V*(s') of each outcome from Q*(s, a), the mean of them."""
    apart: FloatArray = mdp.reward + own.gamma * own.v[mdp.next_state] - own.q[:, :, None]
    return apart
