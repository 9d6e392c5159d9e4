"""The probes: a row each, from one state up, and what must hold after training, by the solver's numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from gridworld.checking import worlds
from gridworld.checking.worlds import BONUS
from gridworld.world.chain import Chain
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import BoolArray, FloatArray, Mdp
from gridworld.world.solver import backup, solved

if TYPE_CHECKING:
    from gridworld.checking.training import Trained

TOLERANCE = 0.1  # of a value, relative to the largest number in the world
LEAST_BEST = 0.99  # share of late steps with a best action
PROBABILITY = 0.06  # tolerance of an action's
_VISITED = 0.05  # share of steps; an actor-critic knows the values of the states that it is in
_LIMIT = 100


class UnmetError(Exception):
    """An expectation that does not hold; says what was found instead."""


def values(trained: Trained) -> str:
    """Its values are the exact ones: Q* of a learner of Q, of an actor-critic V of its own policy."""
    mdp, last = trained.mdp, trained.last
    if last.q is not None:
        return _near(mdp, last.q, solved(mdp, trained.gamma).q)
    often = trained.late.sum(axis=1) >= _VISITED * trained.late.sum()
    return _near(mdp, last.values, Chain(mdp, last.sampled).value(trained.gamma), often)


def optimal(trained: Trained) -> str:
    """Its deterministic policy is optimal from the start, exactly."""
    mdp = trained.mdp
    score = Evaluator(mdp, trained.gamma, mdp.max_episode_steps or _LIMIT).score(trained.greedy)
    if not score.certified:
        actions = trained.greedy.argmax(axis=1)[mdp.reachable & ~mdp.terminal].tolist()
        raise UnmetError(f"its best actions are {actions}, with regret {score.regret:.3g}")
    return "optimal"


def optimal_with_values(trained: Trained) -> str:
    """Both."""
    return f"{optimal(trained)}, {values(trained)}"


def acts_as_learnt(trained: Trained) -> str:
    """At the end of training nearly all its actions are optimal."""
    best = solved(trained.mdp, trained.gamma).optimal
    steps = int(trained.late.sum())
    if steps == 0:
        return "takes no steps"
    share = float(trained.late[best].sum()) / steps
    if share < LEAST_BEST:
        raise UnmetError(f"{share:.0%} of its last actions are best ones, must be {LEAST_BEST:.0%}")
    return f"{share:.0%} of its last actions are best ones"


def acts_at_random(trained: Trained) -> str:
    """In training, all actions of a state are as frequent as each other."""
    shares = trained.visits / np.maximum(trained.visits.sum(axis=1, keepdims=True), 1)
    uniform = np.full(shares.shape, 1 / trained.mdp.num_actions)
    return _near(trained.mdp, shares, uniform, probability=True)


def soft_optimal(trained: Trained) -> str:
    """Its policy is the best one for the reward of its one step and `worlds.BONUS` times its entropy."""
    gains = np.exp(solved(trained.mdp, trained.gamma).q / BONUS)
    aim = gains / gains.sum(axis=1, keepdims=True)
    return _near(trained.mdp, trained.last.sampled, aim, probability=True)


def all_layers_learn(trained: Trained) -> str:
    """Training has changed every parameter."""
    if trained.frozen:
        raise UnmetError(f"{', '.join(trained.frozen)} did not change")
    return "all have changed"


def first_backup(trained: Trained) -> str:
    """Its Q values are one backup of what it had before training."""
    mdp = trained.mdp
    assert trained.first.q is not None
    assert trained.last.q is not None
    exact = backup(mdp, np.where(mdp.terminal, 0.0, trained.first.q.max(axis=1)), trained.gamma)
    return _near(mdp, trained.last.q, exact)


def _near(
    mdp: Mdp,
    found: FloatArray,
    exact: FloatArray,
    states: BoolArray | None = None,
    probability: bool = False,
) -> str:
    """Compare numbers of live states, or of these (S,) of them; says which is farthest from the exact one."""
    where = mdp.reachable & ~mdp.terminal & (True if states is None else states)
    where = np.broadcast_to(where.reshape(-1, *[1] * (exact.ndim - 1)), exact.shape)
    largest = max(np.abs(exact[where]).max(), np.abs(mdp.reward).max())
    tolerance = PROBABILITY if probability else TOLERANCE * largest
    error = np.where(where, np.abs(found - exact), -1.0)
    worst = tuple(int(each) for each in np.unravel_index(np.argmax(error), error.shape))
    name = "P" if probability else "Q" if len(worst) == 2 else "V"
    text = f"{name}({', '.join(map(str, worst))}) {found[worst]:.3f}, exact {exact[worst]:.3f}"
    if not error[worst] <= tolerance:
        raise UnmetError(f"{text}, tolerance {tolerance:.2g}")
    return text


@dataclass(frozen=True)
class Probe:
    """One question about an implementation."""

    name: str  # as the command line has it
    world: Callable[[], Mdp]  # makes the world that it trains on
    holds: Callable[[Trained], str]  # after training; raises `UnmetError`, else says what was found
    meaning: str  # what a failure means
    gamma: float = 0.9  # that it trains with
    arguments: Mapping[str, Any] = field(default_factory=dict)  # that differ from `settings`
    needs: str = ""  # an argument; an algorithm that does not take it is not asked

    @property
    def training(self) -> tuple[str, float, str]:
        """Probes with the same one share a training run."""
        return self.world.__name__, self.gamma, repr(self.arguments)


_NO_EXPLORATION_LEFT = {"exploration_final_eps": 0.0}

# fmt: off
PROBES = (
    Probe("constant", worlds.constant, values,
          "the value is not learnt at all: its loss, its optimiser or the reward that reaches it"),
    Probe("discount", worlds.corridor, values,
          "gamma is ignored or applied at the wrong step, or a reward belongs to another step",
          gamma=0.5),
    Probe("choice", worlds.bandit, optimal,
          "worse actions are preferred: the sign of the advantage, or rewards beside the wrong actions"),
    Probe("context", worlds.two_contexts, optimal,
          "the policy does not depend on the state: observations are lost, mixed up or of another step",
          arguments=_NO_EXPLORATION_LEFT),
    Probe("behaviour", worlds.two_contexts, acts_as_learnt,
          "it acts otherwise than it has learnt: exploration does not end, or ends late, or it sees another "
          "observation when it acts than when it learns",
          arguments=_NO_EXPLORATION_LEFT),
    Probe("layers", worlds.two_contexts, all_layers_learn,
          "a layer never changes: it is not in the optimiser, cut off from the gradient or never copied",
          arguments=_NO_EXPLORATION_LEFT),
    Probe("exploration", worlds.two_contexts, acts_at_random,
          "it explores less than its epsilon says: that is ignored, scaled or starts elsewhere",
          arguments={"exploration_initial_eps": 1.0, "exploration_final_eps": 1.0},
          needs="exploration_final_eps"),
    Probe("entropy", worlds.dear_contexts, soft_optimal,
          "the entropy bonus is not what its coefficient says: its sign or scale is wrong, it is missing, or "
          "it is not that of each state's policy",
          arguments={"ent_coef": BONUS}, needs="ent_coef"),
    Probe("delay", worlds.delay, optimal_with_values,
          "credit does not reach earlier steps: returns, traces or next observations are of the wrong step"),
    Probe("termination", worlds.end_like_the_start, values,
          "values are taken from beyond the end of an episode: the terminal flag is ignored"),
    Probe("truncation", worlds.endless, values,
          "a step limit is treated as an end: the value of the state where it was cut is missing",
          gamma=0.8),
    Probe("stochastic", worlds.gamble, optimal_with_values,
          "it does not learn the mean of a random reward, but its extreme, its median or its last draw"),
    Probe("alternation", worlds.alternation, optimal_with_values,
          "the value of the next state is wrong: another state's, or not that of its best action",
          gamma=0.8),
    Probe("trap", worlds.trap, optimal_with_values,
          "the next reward counts for more than the return: what follows is not added, or costs are lost"),
    Probe("slip", worlds.slippery, optimal_with_values,
          "uncertain moves are not averaged over, or next states are not where the world went"),
    Probe("target", worlds.endless, first_backup,
          "targets are not computed with the target network: it never had an update, the values moved on",
          gamma=0.8, arguments={"target_update_interval": 10_000_000}, needs="target_update_interval"),
)
# fmt: on
