"""The probes: a row each, from one state up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gridworld.checking import expectations as expect
from gridworld.checking import worlds
from gridworld.checking.training import Trained
from gridworld.world.mdp import Mdp


@dataclass(frozen=True)
class Probe:
    """One question about an implementation.

    Attributes:
        name: as the command line has it.
        world: makes the world that it trains on.
        holds: what must hold after training; raises `expectations.UnmetError`, else says what was found.
        meaning: what a failure means.
        gamma: the discount that it trains with.
        arguments: arguments of the algorithm that differ from `settings`, where it takes them.
        needs: an argument; an algorithm that does not take it is not asked.
    """

    name: str
    world: Callable[[], Mdp]
    holds: Callable[[Trained], str]
    meaning: str
    gamma: float = 0.9
    arguments: Mapping[str, Any] = field(default_factory=dict)
    needs: str = ""

    @property
    def training(self) -> tuple[str, float, str]:
        """Probes with the same one share a training run."""
        return self.world.__name__, self.gamma, repr(self.arguments)


_NO_EXPLORATION_LEFT = {"exploration_final_eps": 0.0}

PROBES = (
    Probe(
        "constant",
        worlds.constant,
        expect.values,
        "the value is not learnt at all: its loss, its optimiser or the reward that reaches it",
    ),
    Probe(
        "discount",
        worlds.corridor,
        expect.values,
        "gamma is ignored or applied at the wrong step, or a reward belongs to another step",
        gamma=0.5,
    ),
    Probe(
        "choice",
        worlds.bandit,
        expect.optimal,
        "worse actions are preferred: the sign of the advantage, or rewards beside the wrong actions",
    ),
    Probe(
        "context",
        worlds.two_contexts,
        expect.optimal,
        "the policy does not depend on the state: observations are lost, mixed up or of another step",
        arguments=_NO_EXPLORATION_LEFT,
    ),
    Probe(
        "behaviour",
        worlds.two_contexts,
        expect.acts_as_learnt,
        "it acts otherwise than it has learnt: exploration does not end, or ends late, or it sees another "
        "observation when it acts than when it learns",
        arguments=_NO_EXPLORATION_LEFT,
    ),
    Probe(
        "layers",
        worlds.two_contexts,
        expect.all_layers_learn,
        "a layer never changes: it is not in the optimiser, cut off from the gradient or never copied",
        arguments=_NO_EXPLORATION_LEFT,
    ),
    Probe(
        "exploration",
        worlds.two_contexts,
        expect.acts_at_random,
        "it explores less than its epsilon says: that is ignored, scaled or starts elsewhere",
        arguments={"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0},
        needs="exploration_final_eps",
    ),
    Probe(
        "entropy",
        worlds.dear_contexts,
        expect.soft_optimal,
        "the entropy bonus is not what its coefficient says: its sign or scale is wrong, it is missing, or "
        "it is not that of each state's policy",
        arguments={"ent_coef": worlds.BONUS},
        needs="ent_coef",
    ),
    Probe(
        "delay",
        worlds.delay,
        expect.optimal_with_values,
        "credit does not reach earlier steps: returns, traces or next observations are of the wrong step",
    ),
    Probe(
        "termination",
        worlds.end_like_the_start,
        expect.values,
        "values are taken from beyond the end of an episode: the terminal flag is ignored",
    ),
    Probe(
        "truncation",
        worlds.endless,
        expect.values,
        "a step limit is treated as an end: the value of the state where it was cut is missing",
        gamma=0.8,
    ),
    Probe(
        "stochastic",
        worlds.gamble,
        expect.optimal_with_values,
        "it does not learn the mean of a random reward, but its extreme, its median or its last draw",
    ),
    Probe(
        "alternation",
        worlds.alternation,
        expect.optimal_with_values,
        "the value of the next state is wrong: another state's, or not that of its best action",
        gamma=0.8,
    ),
    Probe(
        "trap",
        worlds.trap,
        expect.optimal_with_values,
        "the next reward counts for more than the return: what follows is not added, or costs are lost",
    ),
    Probe(
        "slip",
        worlds.slippery,
        expect.optimal_with_values,
        "uncertain moves are not averaged over, or next states are not where the world went",
    ),
    Probe(
        "target",
        worlds.endless,
        expect.first_backup,
        "targets are not computed with the target network: it never had an update, the values moved on",
        gamma=0.8,
        arguments={"target_update_interval": 10_000_000},
        needs="target_update_interval",
    ),
)
