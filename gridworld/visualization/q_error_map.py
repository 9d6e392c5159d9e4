"""The error map: how far an agent's values are from the true ones, per cell and action.

A cell is cut into four triangles, one for each action, coloured by |Q - Q*|; where the actions are not the
four moves, it shows the largest error of them. An agent that has no Q shows |V - V*|, a colour per cell. Both
sides must mean the same thing: Q* has to be the optimum under the discount that the agent learns with, which
need not be the one it is evaluated with.
"""

from __future__ import annotations

import numpy as np

from gridworld.agents import PolicySnapshot
from gridworld.envs.board import board_of
from gridworld.envs.rendering import Frame
from gridworld.visualization.canvas import Canvas, shown
from gridworld.visualization.paths import moving_actions
from gridworld.visualization.picture import IMAGES_TAB, Draw, Subject, agents_gamma, visits_of
from gridworld.visualization.sheet import ORANGES, linear, short
from gridworld.visualization.state_table import Numbers, draw_table, table_states
from gridworld.world.mdp import FloatArray, Mdp
from gridworld.world.solver import Solution, solved

TENSORBOARD_SIDE: int | None = IMAGES_TAB

_MISSING = "no finite optimum"


def draw(subject: Subject) -> Draw:
    """The map of |Q - Q*|, or |V - V*| without Q."""
    mdp, snapshot, gamma = subject.evaluator.mdp, subject.snapshot, agents_gamma(subject)
    best = subject.evaluator.solution
    error = value_error(snapshot, best if gamma == best.gamma else solved(mdp, gamma))
    name = "|V - V*|" if snapshot.q is None else "|Q - Q*|"
    caption = f"{name} after {subject.steps:,} steps, at the agent's gamma {gamma:g}"
    if board_of(mdp).panels:
        return lambda cell_size: draw_error_map(mdp, error, caption, cell_size)
    states = table_states(mdp, visits_of(subject))
    numbers = Numbers("error", error, linear(ORANGES, error[states], low=0.0))
    columns = ["V"] if snapshot.q is None else mdp.action_names
    high = short(numbers.scale.high)
    picture = draw_table(mdp, states, columns, numbers, "error 0", high, _MISSING, caption)
    return lambda cell_size: picture


def value_error(snapshot: PolicySnapshot, best: Solution) -> FloatArray:
    """|Q - Q*| (S, A), or |V - V*| (S, 1) for an agent without Q; NaN where the optimum is not finite."""
    theirs, ours = (snapshot.values[:, None], best.v[:, None]) if snapshot.q is None else (snapshot.q, best.q)
    return np.abs(np.where(np.isfinite(ours), theirs - ours, np.nan))


def draw_error_map(mdp: Mdp, error: FloatArray, caption: str = "", cell_size: int | None = None) -> Frame:
    """Draw errors (S, A) or (S, 1); cells too small for triangles show the largest one of their actions."""
    canvas = Canvas(mdp, cell_size)
    moves = moving_actions(mdp) if error.shape[1] > 1 and canvas.has_grid else None
    error = error.max(axis=1, keepdims=True) if moves is None else error[:, moves]
    scale = linear(ORANGES, error[shown(mdp)], low=0.0)
    return canvas.draw_numbers(error, scale, "error 0", short(scale.high), _MISSING, caption)
