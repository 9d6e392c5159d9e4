"""Causes in a network, told by the oracle ablation: the same network, fitted to the exact answer."""

from __future__ import annotations

import numpy as np

from gridworld.diagnosis.evidence import Evidence
from gridworld.diagnosis.finding import Finding, slower
from gridworld.world.evaluation import Evaluator
from gridworld.world.markov_chain import one_hot_policy
from gridworld.world.mdp import IntArray


def cannot_represent(run: Evidence) -> Finding | None:
    """The same network with new weights cannot be fitted."""
    if _fits(run, fresh=True) is not False:
        return None
    why = "its network cannot hold the answer: with new weights and fitted to the exact one, it still errs"
    wide = "agent.policy_kwargs.net_arch=[64,64]"
    if not hasattr(run.config.agent, "policy_kwargs"):
        wide = "++agent.arguments.policy_kwargs.net_arch=[64,64]"
    kinds = () if run.config.observation.kind == "one_hot" else ("observation=one_hot",)
    return Finding("network", run.split.wrong, why, (wide, *kinds))


def spoilt_policy(run: Evidence) -> Finding | None:
    """As `spoilt`, of a policy that explores by itself: what it did not try follows from its weights."""
    return spoilt(run) if run.is_actor_critic else None


def spoilt(run: Evidence) -> Finding | None:
    """Its own weights cannot be fitted any more, where new ones can."""
    if _fits(run, fresh=False) is not False:
        return None
    why = "its weights are spoilt: fitted to the exact answer from them it still errs, from new ones not"
    return Finding("rate", run.split.wrong, why, slower(run))


def _fits(run: Evidence, fresh: bool) -> bool | None:
    """Whether a network learns the exact optimum of its own objective; None: none, or too large to try."""
    if run.config.agent.family != "sb3" or run.own.gamma > 0.9999:  # where actions hardly differ
        return None
    from gridworld.agents.sb3.oracle_fit import oracle_fit  # imports torch

    judge = Evaluator(run.mdp, run.own.gamma, 1)

    def is_optimal(greedy: IntArray) -> bool:
        return judge.score(one_hot_policy(greedy, run.mdp.num_actions)).certified

    return oracle_fit(run.agent, run.own, np.flatnonzero(run.acting), is_optimal, fresh)
