"""The error map: how far an agent's values are from the true ones, per cell and action.

A cell is cut into four triangles, one for each action, coloured by |Q - Q*|; where the actions are not the
four moves, it shows the largest error of them. An agent that has no Q shows |V - V*|, a colour per cell. Both
sides must mean the same thing: Q* has to be the optimum under the discount that the agent learns with, which
need not be the one it is evaluated with.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import PolicySnapshot
from gridworld.envs.board import board_of
from gridworld.envs.rendering import Colour, Frame
from gridworld.visualization.canvas import Canvas, shown
from gridworld.visualization.colormaps import ORANGES, is_dark, linear
from gridworld.visualization.maps.directions import moving_actions
from gridworld.visualization.maps.policy_map import visits_of
from gridworld.visualization.maps.state_table import draw_error_table, table_states
from gridworld.visualization.picture import IMAGES_TAB, Draw, Subject, agents_gamma
from gridworld.visualization.sheet import INK, PAPER, UNREACHABLE, Swatch, short
from gridworld.world.exact.solver import Solution, solved
from gridworld.world.layout import MOVES
from gridworld.world.mdp import FloatArray, Mdp

TENSORBOARD_SIDE: int | None = IMAGES_TAB

_SEPARATOR: Colour = (205, 205, 205)
_SMALLEST_SEPARATED_CELL = 24  # pixels


def draw(subject: Subject) -> Draw:
    """The map of |Q - Q*|, or |V - V*| without Q."""
    evaluator, snapshot = subject.evaluator, subject.snapshot
    best = evaluator.solution
    gamma = agents_gamma(subject)
    if gamma != best.gamma:
        best = solved(evaluator.mdp, gamma)
    error = value_error(snapshot, best)
    name = "|V - V*|" if snapshot.q is None else "|Q - Q*|"
    caption = f"{name} after {subject.steps:,} steps, at the agent's gamma {gamma:g}"
    if not board_of(evaluator.mdp).panels:
        states = table_states(evaluator.mdp, visits_of(subject))
        picture = draw_error_table(evaluator.mdp, states, error, caption)
        return lambda cell_size: picture
    return lambda cell_size: draw_error_map(evaluator.mdp, error, caption, cell_size)


def value_error(snapshot: PolicySnapshot, best: Solution) -> FloatArray:
    """Compare an agent's values with the optimal ones.

    Args:
        snapshot: the agent's values.
        best: the optimum under the agent's own discount.

    Returns:
        |Q - Q*| (S, A), or |V - V*| (S, 1) for an agent without Q; NaN where the optimum is not finite.
    """
    theirs, ours = (snapshot.values[:, None], best.v[:, None]) if snapshot.q is None else (snapshot.q, best.q)
    return np.abs(np.where(np.isfinite(ours), theirs - ours, np.nan))


def draw_error_map(mdp: Mdp, error: FloatArray, caption: str = "", cell_size: int | None = None) -> Frame:
    """Draw errors as colours; cells too small for triangles show the largest error of their actions.

    Args:
        mdp: the world.
        error: (S, A) or (S, 1); NaN is left white.
        caption: a line above the grid.
        cell_size: pixels; None: 80, less on large maps.

    Returns:
        (height, width, 3), RGB.
    """
    canvas = Canvas(mdp, cell_size)
    sides = moving_actions(mdp) if error.shape[1] == len(MOVES) and canvas.has_grid else None
    error = error.max(axis=1, keepdims=True) if sides is None else error[:, sides]
    per_action = sides is not None
    playable = shown(mdp)
    states = np.flatnonzero(playable)
    scale = linear(ORANGES, error[states], low=0.0)
    known = np.isfinite(error)
    colours = np.where(known[..., None], scale.colours(np.where(known, error, 0.0)), PAPER)
    colours = colours.astype(np.uint8)
    separated = np.empty((mdp.num_states, 1, 3), dtype=np.uint8)
    separated[:] = _SEPARATOR
    canvas.paint(
        np.concatenate([colours, separated], axis=1), _triangles(canvas.cell) if per_action else None
    )
    canvas.draw_world()
    texts = {number: short(number, scale.high) for number in set(error[states][known[states]].tolist())}
    size = canvas.number_size(0.36 if per_action else 0.8, texts.values())
    if size is not None:
        dark = is_dark(colours)
        for state, part in zip(*(axis.tolist() for axis in np.nonzero(known)), strict=True):
            if playable[state]:
                down, right = MOVES[part] if per_action else (0, 0)
                middle = canvas.point(state, 0.5 + 0.29 * right, 0.5 + 0.33 * down)
                ink = PAPER if dark[state, part] else INK
                canvas.number(texts[float(error[state, part])], middle, size, ink)
    canvas.caption(caption)
    unknown = [] if known[states].all() else [Swatch("no finite optimum", fill=PAPER)]
    swatches = [*unknown, *([UNREACHABLE] if canvas.hidden else [])]
    canvas.legend(scale, "error 0", short(scale.high), swatches)
    return canvas.frame()


def _triangles(cell: int) -> NDArray[np.intp]:
    """(cell, cell), the number in `MOVES` of the triangle a pixel is in; 4 on the lines between them."""
    down, right = np.mgrid[:cell, :cell]
    upper, other = down - right, down + right - cell  # signs tell the side of the two diagonals
    parts = np.where(upper < 0, np.where(other < 0, 0, 1), np.where(other < 0, 3, 2))
    if cell >= _SMALLEST_SEPARATED_CELL:
        parts[(upper == 0) | (other == 0)] = len(MOVES)
    return parts.astype(np.intp)
