"""Causes in what a run optimises: its own discount, and what it pays for exploring."""

from __future__ import annotations

import numpy as np

from gridworld.diagnosis.evidence import (
    Evidence,
    Finding,
    costliest,
    entropy,
    entropy_optimum,
    optimum_of_epsilon,
    percent,
)
from gridworld.training.setup import SAME, recommended_gamma
from gridworld.world.mdp import FloatArray
from gridworld.world.solver import pick, solved

_CLEARER = 5  # times the gap
_FAINT = 1e-3  # of the largest reward: less than a network's values resolve
_SPREAD = 0.5  # of the entropy of a uniform policy
_POOR = 0.5  # of a uniform policy's regret


def other_optimum(run: Evidence) -> Finding | None:
    """What it does is optimal under its own discount, exactly."""
    best = run.evaluator.solution
    states = run.split.wrong & (run.gap <= SAME * run.own.scale)
    if run.gamma == best.gamma or not states.any():
        return None
    why = f"its policy is optimal under its gamma of {run.gamma:g}, not under the evaluation's {best.gamma:g}"
    gammas = dict.fromkeys((recommended_gamma(run.evaluator), best.gamma))
    return Finding("objective", states, why, tuple(run.change("gamma", each) for each in gammas))


def hopeless_gamma(run: Evidence) -> Finding | None:
    """As `faint_gamma`, where the difference is too small for any network."""
    limit = np.full(run.mdp.num_states, _FAINT * run.largest_reward)
    return None if run.is_tabular else _faint(run, limit)


def faint_gamma(run: Evidence) -> Finding | None:
    """Under its own discount, actions differ by less than a network errs, and under another by much more."""
    return _faint(run, np.abs(run.q - run.own.q).max(axis=1))


def _faint(run: Evidence, limit: FloatArray) -> Finding | None:
    better = recommended_gamma(run.evaluator)
    clear = gap_under(run, better)
    states = run.split.wrong & (run.gap < limit) & (clear > _CLEARER * run.gap)
    if better == run.gamma or not states.any():
        return None
    worst = costliest(run, states)
    worth = f"the right action is worth only {run.gap[worst]:.2g} more, less than the error of its values"
    if run.gap[worst] <= SAME * run.own.scale[worst]:
        worth = "the right action and the one that it takes are worth the same"
    gains = f"with gamma={better:g} the right one is worth {clear[worst]:.2g} more"
    why = f"with gamma={run.gamma:g}, {worth}; {gains}"
    return Finding("objective", states, why, (run.change("gamma", better),))


def gap_under(run: Evidence, gamma: float) -> FloatArray:
    """(S,), what the greedy action loses under a discount."""
    best = solved(run.mdp, gamma)
    return np.asarray(best.v - pick(best.q, run.greedy))


def too_much_entropy(run: Evidence) -> Finding | None:
    """The policy that its entropy bonus aims at is itself poor."""
    bonus = run.last_setting("ent_coef")
    if not run.is_actor_critic or bonus <= 0:
        return None
    aim = entropy_optimum(run, bonus)
    states = run.split.wrong & (entropy(aim) > _SPREAD)
    regret, worst = (run.evaluator.score(each).regret for each in (aim, np.full_like(aim, 1 / aim.shape[1])))
    if regret < _POOR * worst or not states.any():
        return None
    why = (
        f"even the policy that its entropy bonus of {bonus:g} aims at has a regret of {regret:.3g}; a "
        f"uniform one has {worst:.3g}"
    )
    return Finding("entropy", states, why, tuple(run.change("ent_coef", bonus / by) for by in (10, 100)))


def too_much_epsilon(run: Evidence) -> Finding | None:
    """What it does is optimal for one that explores for ever, which is what on-policy control learns."""
    epsilon = run.setting("exploration_final_eps")
    if run.config.agent.algorithm not in ("sarsa", "expected_sarsa") or epsilon <= 0:
        return None
    q = optimum_of_epsilon(run.mdp, run.gamma, epsilon)
    gap = q.max(axis=1) - pick(q, run.greedy)
    unresolved = (gap < np.abs(run.q - q).max(axis=1)) & (run.gap > _CLEARER * gap)
    states = run.split.wrong & ((gap <= 1e-9) | unresolved)
    if not states.any():
        return None
    why = f"it learns what is optimal for an agent that takes {percent(epsilon)} of its actions at random"
    return Finding("epsilon", states, why, (run.change("exploration_final_eps", epsilon / 10),))
