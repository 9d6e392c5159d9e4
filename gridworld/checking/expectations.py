"""What must hold after training, against the exact numbers of the solver."""

from __future__ import annotations

import numpy as np

from gridworld.checking.training import Trained
from gridworld.checking.worlds import BONUS
from gridworld.world.exact.evaluation import Evaluator
from gridworld.world.exact.markov_chain import Chain
from gridworld.world.exact.solver import backup, solved
from gridworld.world.mdp import BoolArray, FloatArray, Mdp

TOLERANCE = 0.1  # of a value, relative to the largest number in the world
LEAST_BEST = 0.99  # share of late steps with a best action
PROBABILITY = 0.06  # tolerance of an action's
_VISITED = 0.05  # share of steps; an actor-critic knows the values of the states that it is in
_LIMIT = 100


class UnmetError(Exception):
    """An expectation that does not hold; says what was found instead."""


def values(trained: Trained) -> str:
    """Its values are the exact ones: Q* of a learner of Q, of an actor-critic V of its own policy."""
    mdp, found, last = trained.mdp, trained.last.q, trained.last
    if found is not None:
        exact = solved(mdp, trained.gamma).q
        where = np.broadcast_to(_live(mdp)[:, None], exact.shape)
    else:
        found, exact = last.values, Chain(mdp, last.sampled).value(trained.gamma)
        where = _live(mdp) & (trained.late.sum(axis=1) >= _VISITED * trained.late.sum())
    return _near(mdp, found, exact, where)


def optimal(trained: Trained) -> str:
    """Its deterministic policy is optimal from the start, exactly."""
    mdp = trained.mdp
    score = Evaluator(mdp, trained.gamma, mdp.max_episode_steps or _LIMIT).score(trained.greedy)
    if not score.certified:
        actions = trained.greedy.argmax(axis=1)[_live(mdp)].tolist()
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
    return _are_probable(trained.mdp, shares, np.full(shares.shape, 1 / trained.mdp.num_actions))


def soft_optimal(trained: Trained) -> str:
    """Its policy is the best one for the reward of its one step and `worlds.BONUS` times its entropy."""
    gains = np.exp(solved(trained.mdp, trained.gamma).q / BONUS)
    return _are_probable(trained.mdp, trained.last.sampled, gains / gains.sum(axis=1, keepdims=True))


def all_layers_learn(trained: Trained) -> str:
    """Training has changed every parameter."""
    if trained.frozen:
        raise UnmetError(f"{', '.join(trained.frozen)} did not change")
    return "all have changed"


def first_backup(trained: Trained) -> str:
    """Its Q values are one backup of what it had before training."""
    assert trained.first.q is not None
    mdp = trained.mdp
    exact = backup(mdp, np.where(mdp.terminal, 0.0, trained.first.q.max(axis=1)), trained.gamma)
    found = trained.last.q
    assert found is not None
    return _near(mdp, found, exact, np.broadcast_to(_live(mdp)[:, None], exact.shape))


def _live(mdp: Mdp) -> BoolArray:
    return np.asarray(mdp.reachable & ~mdp.terminal)


def _are_probable(mdp: Mdp, found: FloatArray, exact: FloatArray) -> str:
    return _near(mdp, found, exact, np.broadcast_to(_live(mdp)[:, None], exact.shape), probability=True)


def _near(mdp: Mdp, found: FloatArray, exact: FloatArray, where: BoolArray, probability: bool = False) -> str:
    """The number that is farthest from the exact one."""
    tolerance = TOLERANCE * max(np.abs(exact[where]).max(), np.abs(mdp.reward).max())
    if probability:
        tolerance = PROBABILITY
    error = np.where(where, np.abs(found - exact), -1.0)
    worst = tuple(int(each) for each in np.unravel_index(np.argmax(error), error.shape))
    name = "P" if probability else "Q" if len(worst) == 2 else "V"
    text = f"{name}({', '.join(map(str, worst))}) {found[worst]:.3f}, exact {exact[worst]:.3f}"
    if not error[worst] <= tolerance:
        raise UnmetError(f"{text}, tolerance {tolerance:.2g}")
    return text
