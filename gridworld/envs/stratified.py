"""Random numbers that environments in the same situation share out evenly.

Environments that step together, from the same state with the same action, each need a number from [0, 1) to
draw what happens. Independent numbers leave the share of each outcome to chance: of n environments, an
outcome of probability p meets np, give or take √(np(1-p)). Stratified numbers are evenly spaced, from a
random one on, so it meets np rounded down or up. Each number by itself is uniform, and independent of all
that came before; so each environment's episodes have the probabilities that they have anyway. Only what
environments do at the same time is no longer independent, which averages over them gain from.

R. Cranley and T. Patterson, Randomization of Number Theoretic Methods for Multiple Integration, 1976;
P. L'Ecuyer, C. Lécot and B. Tuffin, A Randomized Quasi-Monte Carlo Simulation Method for Markov Chains, 2008.
"""

from __future__ import annotations

import numpy as np

from gridworld.world.mdp import FloatArray, IntArray

_RADIX_SORTED = 2**16  # numpy sorts numbers below it in linear time, if they are stored as such


def stratified_numbers(groups: IntArray, rng: np.random.Generator) -> FloatArray:
    """A number for each member of some groups, each uniform in [0, 1); those of a group of m are 1/m apart.

    `groups` (n,) are integers from 0 up to about n. One number is drawn for each group that has members.
    """
    sizes = np.bincount(groups)
    shifts = np.zeros(len(sizes))
    present = np.flatnonzero(sizes)
    shifts[present] = rng.random(len(present))
    order = np.argsort(groups.astype(np.uint16) if len(sizes) <= _RADIX_SORTED else groups, kind="stable")
    ranks = np.arange(len(groups)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    numbers = np.empty(len(groups))
    numbers[order] = (ranks / np.repeat(sizes, sizes) + np.repeat(shifts, sizes)) % 1.0
    return numbers
