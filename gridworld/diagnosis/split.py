"""Where a policy's regret comes from: its exact share of each state.

The performance-difference lemma says

    V*(start) - V_π(start) = Σ_s d_π(s) [ V*(s) - Σ_a π(a|s) Q*(s, a) ],    d_π(s) = Σ_t γ^t P(s_t = s),

a sum over states of the discounted visits under π times what its action there loses.
With γ = 1 a policy that never ends has no such sum. The walk then stops where it cannot end any more, and
such a state costs its visits times V* - V_π, all that is lost from there on.

As `world.exact.evaluation` has it, value and regret are without a step limit. What an episode of training
loses by being cut off is therefore no part of the split.

Reference: S. Kakade and J. Langford, Approximately optimal approximate reinforcement learning, ICML 2002.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gridworld.world.exact.evaluation import Evaluator, Score
from gridworld.world.exact.markov_chain import Chain, discounted_visits, stopping_states
from gridworld.world.mdp import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class RegretSplit:
    """The regret of one policy by state.

    Attributes:
        score: of the policy.
        visits: (S,), the discounted visits from the start distribution on; where a walk that cannot end is
            stopped, the probability to stop there.
        lost: (S,), what one visit costs.
        cost: (S,), their product; sums to the regret.
        wrong: (S,), bool: reached, and its action is not among the optimal ones.
    """

    score: Score
    visits: FloatArray
    lost: FloatArray
    cost: FloatArray
    wrong: BoolArray


def split_regret(evaluator: Evaluator, policy: FloatArray) -> RegretSplit:
    """Split the regret of a policy over the states where it errs.

    Args:
        evaluator: of the world, under the discount that counts.
        policy: (S, A), action probabilities.
    """
    mdp, best = evaluator.mdp, evaluator.solution
    chain = Chain(mdp, policy)
    stops = stopping_states(chain, best.gamma)
    visits = discounted_visits(chain, best.gamma, stops)
    with np.errstate(invalid="ignore"):  # where V* is -inf, every action is as good
        chosen = np.where(chain.policy > 0, chain.policy * best.q, 0.0).sum(axis=1)
        lost = best.v - chosen
        lost[stops] = (best.v - chain.value(best.gamma))[stops]
        cost = np.where(visits > 0, visits * lost, 0.0)
    lost, cost = (np.where(np.isnan(each), 0.0, each) for each in (lost, cost))
    errs = ((chain.policy > 0) & ~best.optimal).any(axis=1) & ~mdp.absorbing
    return RegretSplit(evaluator.score(policy), visits, lost, cost, (visits > 0) & errs)
