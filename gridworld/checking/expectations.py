"""What must hold after training, against the exact numbers of the solver."""

from __future__ import annotations

import numpy as np

from gridworld.checking.training import Trained
from gridworld.world.exact.bellman import backup
from gridworld.world.exact.evaluation import Evaluator
from gridworld.world.exact.markov_chain import Chain
from gridworld.world.exact.solver import solved
from gridworld.world.mdp import BoolArray, FloatArray, Mdp

TOLERANCE = 0.1  # of a value, relative to the largest number in the world
_LEAST_BEST = 0.8  # share of steps with a best action, at the end of training
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
        where = _live(mdp) & (trained.visits.sum(axis=1) >= _VISITED * trained.visits.sum())
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
    steps = int(trained.visits.sum())
    if steps == 0:
        return "takes no steps"
    share = float(trained.visits[best].sum()) / steps
    if share < _LEAST_BEST:
        raise UnmetError(f"{share:.0%} of its last actions are best ones, must be {_LEAST_BEST:.0%}")
    return f"{share:.0%} of its last actions are best ones"


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


def _near(mdp: Mdp, found: FloatArray, exact: FloatArray, where: BoolArray) -> str:
    """The number that is farthest from the exact one."""
    tolerance = TOLERANCE * max(np.abs(exact[where]).max(), np.abs(mdp.reward).max())
    error = np.where(where, np.abs(found - exact), -1.0)
    worst = tuple(int(each) for each in np.unravel_index(np.argmax(error), error.shape))
    name = f"{'Q' if len(worst) == 2 else 'V'}({', '.join(map(str, worst))})"
    text = f"{name} {found[worst]:.3f}, exact {exact[worst]:.3f}"
    if not error[worst] <= tolerance:
        raise UnmetError(f"{text}, tolerance {tolerance:.2g}")
    return text
