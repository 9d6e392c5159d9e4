"""What it costs to see only the environment's own observation, where that stands for several states."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from gridworld.world.mdp import IntArray, Mdp, frozen
from gridworld.world.outcomes import absorbing_states, thresholds_of
from gridworld.world.solver import solved

_MOST_SOLUTIONS = 64


def aliased(mdp: Mdp) -> list[IntArray]:
    """The groups of states to act in that have the same observation of the environment's own."""
    if mdp.own_observation is None:
        return []
    acting = np.flatnonzero(mdp.acting)
    shown = mdp.own_observation[acting].reshape(len(acting), -1)
    group = np.unique(shown, axis=0, return_inverse=True)[1].ravel()
    groups = [acting[group == number] for number in np.flatnonzero(np.bincount(group) > 1)]
    return [np.asarray(each) for each in groups]


def cost_of_own_observation(mdp: Mdp, gamma: float) -> float | None:
    """The least regret of a deterministic policy that sees only the environment's own observation.

    None where that would take too long to find. A policy that draws its actions may do better.
    """
    solution, groups = solved(mdp, gamma), aliased(mdp)
    if all(solution.optimal[group].all(axis=0).any() for group in groups):
        return 0.0
    if mdp.num_actions ** len(groups) > _MOST_SOLUTIONS:
        return None
    best = max(
        float(solved(_bound(mdp, groups, actions), gamma).v @ mdp.start)
        for actions in itertools.product(range(mdp.num_actions), repeat=len(groups))
    )
    return float(solution.v @ mdp.start) - best


def _bound(mdp: Mdp, groups: list[IntArray], actions: tuple[int, ...]) -> Mdp:
    """The world in which every action of a group's states is a certain one."""
    tables = {key: getattr(mdp, key).copy() for key in ("next_state", "probability", "reward")}
    for group, action in zip(groups, actions, strict=True):
        for table in tables.values():
            table[group] = table[group][:, [action]]
    tables["absorbing"] = absorbing_states(**tables, terminal=mdp.terminal)
    tables["thresholds"] = thresholds_of(tables["probability"])
    return replace(mdp, **{key: frozen(table) for key, table in tables.items()})
