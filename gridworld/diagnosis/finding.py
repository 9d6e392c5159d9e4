"""What a cause comes to for one run, and experiments on the tables that causes are told by."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from gridworld.config.fields import LINEAR
from gridworld.diagnosis.evidence import Evidence
from gridworld.world.chain import Chain, discounted_visits, stopping_states
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import BoolArray, FloatArray, Mdp
from gridworld.world.solver import backup


@dataclass(frozen=True, eq=False)
class Finding:
    """One cause, as a run shows it."""

    cause: str  # its name
    states: BoolArray  # (S,), where it explains an error
    why: str  # what was found, the end of a sentence
    changes: tuple[str, ...]  # words for a command line, the best first


_ENOUGH = {False: 3000, True: 500}  # updates, by whether it is an actor-critic
_MEETINGS = 10  # of a random walk with the goal
_FAR = 10  # times the learning rate
_MOST = 100  # times as long

Cause = Callable[[Evidence], Finding | None]  # None: it is not this run's


def costliest(run: Evidence, states: BoolArray) -> int:
    """The state of these (S,) whose error costs most."""
    return int(np.argmax(np.where(states, run.split.cost, -np.inf)))


def slower(run: Evidence) -> tuple[str, ...]:
    """Words for smaller learning rates: of a network, first the usual one where its own is above it."""
    first = min(0.1, run.usual_rate / max(run.setting("learning_rate"), 1e-300))
    return tuple(run.multiplied("learning_rate", by) for by in (first, first / 10))


def falling(run: Evidence) -> tuple[str, ...]:
    """The word for a learning rate that falls to 0; none where it does."""
    if run.falls("learning_rate"):
        return ()
    rate = run.setting("learning_rate")
    rate = rate if run.is_tabular else min(rate, run.usual_rate)
    return (run.change("learning_rate", f"{LINEAR}{rate:g}"),)


def faster(run: Evidence) -> tuple[str, ...]:
    """Words for a network that learns too slowly: what scales its steps, the usual rate, and a longer run."""
    optimizer = getattr(getattr(run.agent.model, "policy", None), "optimizer", None)
    is_plain = "SGD" in type(optimizer).__name__
    adam = (run.change("policy_kwargs.optimizer_class", "torch.optim.Adam"),) if is_plain else ()
    by = run.usual_rate / max(run.setting("learning_rate"), 1e-300)
    return *adam, *((run.multiplied("learning_rate", by),) if by > 2 else ()), longer(run, 4)


def longer(run: Evidence, times: int) -> str:
    """The words for a run at least so many times as long: for enough updates, and to meet the goal often.

    At a learning rate far below the usual one no length helps, so that changes too.
    """
    total = run.config.total_timesteps
    updates = 1.0 if run.is_tabular else _ENOUGH[run.is_actor_critic] / max(run.updates, 1.0)
    goals = _MEETINGS * run.steps_to_goal / total if np.isfinite(run.steps_to_goal) else 1.0
    word = f"total_timesteps={total * max(times, math.ceil(min(max(updates, goals), _MOST)))}"
    by = run.usual_rate / max(run.setting("learning_rate", 1.0), 1e-300)
    return f"{word} {run.multiplied('learning_rate', by)}" if by > _FAR else word


_SWEEPS = 1000
_ROUNDS = 60


def best_of_what_was_tried(evaluator: Evaluator, tried: BoolArray) -> FloatArray:
    """(S,), the value of the best policy that takes tried actions (S, A) only; V* where nothing was tried."""
    mdp, best = evaluator.mdp, evaluator.solution
    known = tried.any(axis=1) & ~mdp.absorbing
    least = np.where(np.isfinite(best.v), -best.scale.max(), best.v)
    v: FloatArray = np.where(known, least, best.v)
    for _ in range(_SWEEPS):
        q = np.where(tried[known], backup(mdp, v, best.gamma, np.flatnonzero(known)), -np.inf)
        new = q.max(axis=1, initial=-np.inf)
        change = np.abs(new - v[known]).max(initial=0.0)
        v[known] = new
        if not change > 1e-9 * best.scale.max():
            break
    return v


@lru_cache(maxsize=1)  # two causes ask
def entropy_optimum(run: Evidence, bonus: float) -> FloatArray:
    """The policy (S, A) that an entropy bonus aims at: π = softmax(A_π / bonus), found by iteration.

    Where advantages are normalised, as PPO does, they are divided by their deviation under π first.
    """
    mdp, normalised = run.mdp, bool(getattr(run.agent.model, "normalize_advantage", False))
    policy = np.full_like(run.snapshot.sampled, 1 / mdp.num_actions)
    for _ in range(_ROUNDS):
        v = Chain(mdp, policy).value(min(run.gamma, 0.9999))
        advantage = backup(mdp, v, run.gamma) - v[:, None]
        weight = run.mdp.acting[:, None] * policy
        deviation = np.sqrt((weight * advantage**2).sum() / weight.sum()) if normalised else 1.0
        logits = advantage / max(bonus * deviation, 1e-12)
        aimed = np.exp(np.minimum(logits - logits.max(axis=1, keepdims=True), 0.0))
        policy = 0.5 * policy + 0.5 * aimed / aimed.sum(axis=1, keepdims=True)
    return policy


def optimum_of_epsilon(mdp: Mdp, gamma: float, epsilon: float) -> FloatArray:
    """Q (S, A) of the best policy whose actions are replaced by random ones with probability epsilon."""
    v = np.zeros(mdp.num_states)
    for _ in range(_SWEEPS):
        q = backup(mdp, v, gamma)
        new = ((1 - epsilon) * q.max(axis=1) + epsilon * q.mean(axis=1)) * ~mdp.absorbing
        change, v = np.abs(new - v).max(), new
        if change <= 1e-12:
            break
    return backup(mdp, v, gamma)


def visits_needed(run: Evidence) -> float:
    """How often an action must be tried to tell the closest actions apart; 0: nothing is left to chance.

    A rate that falls linearly to 0 over n tries averages about the last √n targets. Three standard deviations
    of that mean are to be below the smallest gap on the optimal policy's way.
    """
    mdp, own = run.mdp, run.own
    targets = mdp.reward + own.gamma * np.where(mdp.terminal, 0.0, own.v)[mdp.next_state]
    mean = (mdp.probability * targets).sum(axis=2, keepdims=True)
    variance = (mdp.probability * (targets - mean) ** 2).sum(axis=2)
    gap = own.v - np.where(own.optimal, -np.inf, own.q).max(axis=1)
    way = on_the_way(run)
    return float(9 * variance[way].max() / max(gap[way].min(), 1e-6) ** 2) ** 2


def on_the_way(run: Evidence) -> BoolArray:
    """(S,), where the optimal policy acts."""
    chain = Chain(run.mdp, run.evaluator.optimal_policy())
    gamma = run.evaluator.solution.gamma
    return (discounted_visits(chain, gamma, stopping_states(chain, gamma)) > 0) & run.mdp.acting


def behind(run: Evidence) -> str:
    """How many sweeps of value iteration from its own values make its errors right, where that is known."""
    v = run.q.max(axis=1) * ~run.mdp.terminal
    states = np.flatnonzero(run.split.wrong)
    for sweep in range(1, _SWEEPS):
        q = backup(run.mdp, v, run.gamma)
        if run.own.optimal[states, q[states].argmax(axis=1)].all():
            return f"; {sweep} sweeps of its own values are missing" if sweep > 1 else ""
        v = q.max(axis=1) * ~run.mdp.terminal
    return ""
