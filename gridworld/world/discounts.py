"""Whether the discount that an agent learns with leads to the optimum that it is judged by.

Another discount may make another policy optimal: a shorter horizon takes a risk, or a detour, that a longer
one does not. Then no agent that learns perfectly can be certified.
"""

from __future__ import annotations

import numpy as np

from gridworld.world.exact.evaluation import Evaluator, Score
from gridworld.world.exact.markov_chain import one_hot_policy
from gridworld.world.exact.solver import solved

_USUAL = (0.8, 0.9, 0.95, 0.97, 0.99)
_QUICKLY_SOLVED = 20_000  # outcomes of all states and actions: a few tenths of a second


def score_of_optimum(judge: Evaluator, gamma: float) -> Score:
    """The score of the optimum under another discount; of its ties, the actions that `judge` finds best."""
    mdp, best = judge.mdp, judge.solution
    own = solved(mdp, gamma)
    rank = np.where(own.optimal, np.maximum(best.q, np.finfo(np.float64).min), -np.inf)
    return judge.score(one_hot_policy(rank.argmax(axis=1), mdp.num_actions))


def fitting_discounts(judge: Evaluator) -> list[float]:
    """The usual discounts, and the judge's own, whose optimum is certified; in a large world its own only."""
    usual = _USUAL if judge.mdp.probability.size <= _QUICKLY_SOLVED else ()
    gammas = sorted({*usual, judge.solution.gamma})
    return [gamma for gamma in gammas if score_of_optimum(judge, gamma).certified]
