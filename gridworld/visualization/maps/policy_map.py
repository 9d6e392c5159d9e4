"""The policy map: an agent's values as colours, its greedy actions as arrows, and where they lead.

A line follows the greedy policy from the start. A cell whose greedy action is not among the optimal ones has
a red frame. What training never acted in is grey: its values are guesses, and no part of the scale.
"""

from __future__ import annotations

import functools
import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gridworld.envs import rendering as drawing
from gridworld.envs.board import board_of
from gridworld.envs.rendering import AGENT, SMALLEST_TEXT, UNKNOWN, Colour, Point
from gridworld.errors import InputError
from gridworld.visualization.canvas import Canvas, shown
from gridworld.visualization.colormaps import VIRIDIS, Scale, is_dark, linear
from gridworld.visualization.maps.directions import directions
from gridworld.visualization.maps.greedy_path import explored, greedy_paths
from gridworld.visualization.maps.state_table import draw_policy_table, held, table_states
from gridworld.visualization.picture import IMAGES_TAB, Draw, Subject, agents_gamma
from gridworld.visualization.sheet import (
    DISAGREES,
    INK,
    NEVER_VISITED,
    PAPER,
    UNKNOWN_INK,
    Swatch,
    short,
)
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

TENSORBOARD_SIDE: int | None = IMAGES_TAB
_UNKNOWN_DISAGREES: Colour = (226, 178, 174)

_ARROW = (  # its corners along and across its way, in its lengths
    (-0.28, 0.05),
    (0.04, 0.05),
    (0.04, 0.17),
    (0.3, 0.0),
    (0.04, -0.17),
    (0.04, -0.05),
    (-0.28, -0.05),
)
_SMALLEST_ARROW_CELL = 12  # pixels; below it an arrow is a blot


def draw(subject: Subject) -> Draw:
    """The map of the subject's greedy policy."""
    mdp, snapshot = subject.evaluator.mdp, subject.snapshot
    optimal = subject.evaluator.solution.optimal
    caption = caption_at(subject, subject.steps)
    known = explored_by(subject)
    if not board_of(mdp).panels:
        states = table_states(mdp, visits_of(subject))
        numbers = held(snapshot, states[known[states]])
        picture = draw_policy_table(mdp, states, numbers, snapshot.greedy, optimal, known, caption).frame()
        return lambda cell_size: picture
    return lambda cell_size: draw_policy_map(
        mdp, snapshot.values, snapshot.greedy, optimal, caption, cell_size, known=known
    ).frame()


def caption_at(subject: Subject, steps: int) -> str:
    """The title of a map of the subject's policy after so many steps."""
    return f"greedy policy after {steps:,} steps, the agent's gamma {agents_gamma(subject):g}"


def explored_by(subject: Subject) -> BoolArray:
    """Which states the subject's training acted in, (S,)."""
    return explored(subject.evaluator.mdp, visits_of(subject))


def visits_of(subject: Subject) -> NDArray[np.int64] | None:
    """The subject's visits; None where the run has none, as its policy can be drawn without."""
    try:
        return subject.visits
    except InputError:
        return None


def draw_policy_map(
    mdp: Mdp,
    values: FloatArray,
    greedy: IntArray,
    optimal: BoolArray,
    caption: str = "",
    cell_size: int | None = None,
    scale: Scale | None = None,
    known: BoolArray | None = None,
) -> Canvas:
    """Draw values as colours, greedy actions as arrows, and the greedy path from the start.

    Args:
        mdp: the world.
        values: (S,), the agent's V.
        greedy: (S,), the action that it would take.
        optimal: (S, A), whether an action is optimal.
        caption: a line above the grid.
        cell_size: pixels; None: 80, less on large maps.
        scale: the colours of the values, for pictures that are to be compared; without numbers then.
        known: (S,), the states that training acted in; the others are grey. None: all are known.

    Returns:
        The finished picture.
    """
    canvas = Canvas(mdp, cell_size, legend_rows=2)
    playable = shown(mdp)
    known = playable if known is None else known & playable
    states = np.flatnonzero(playable)
    own = linear(VIRIDIS, values[known])
    ends = scale or own
    colours = ends.colours(values)
    colours[~known] = UNKNOWN
    canvas.paint(colours[:, None])
    canvas.draw_world()
    with_numbers = scale is None and len(canvas.board.panels) <= 1  # of several panels the cells are small
    texts = {value: short(value, own.high) for value in set(values[known].tolist()) if with_numbers}
    size = canvas.number_size(0.8, texts.values())
    dark = is_dark(colours)
    inks = np.where(known[:, None], np.where(dark[:, None], PAPER, INK), UNKNOWN_INK).tolist()
    middle = 0.5 if size is None else 0.4  # of the arrows, above the numbers
    paths = greedy_paths(mdp, greedy)
    ways = directions(mdp)[np.arange(mdp.num_states), greedy].tolist()
    draw_paths(canvas, paths, ways, middle)
    length = canvas.cell if size is None else 0.85 * canvas.cell
    for state in states.tolist() if canvas.cell >= _SMALLEST_ARROW_CELL else []:
        point = canvas.point(state, 0.5, middle)
        if any(ways[state]):
            _draw_arrow(canvas, point, ways[state], length, inks[state])
        else:
            name, paper = mdp.action_names[greedy[state]], colours[state].tolist()
            _draw_disc(canvas, point, name, length, inks[state], paper)
    on_path = set().union(*paths)
    if size is not None:
        for state in np.flatnonzero(known).tolist():
            plate = colours[state] if state in on_path else None
            below = canvas.point(state, 0.5, 0.83)
            canvas.number(texts[float(values[state])], below, size, inks[state], plate)
    wrong = playable & ~optimal[np.arange(mdp.num_states), greedy]
    canvas.mark(np.flatnonzero(wrong & ~known), _UNKNOWN_DISAGREES)
    canvas.mark(np.flatnonzero(wrong & known), DISAGREES)
    canvas.caption(caption)
    canvas.legend(
        ends,
        f"value {short(ends.low, ends.high)}",
        short(ends.high),
        _swatches(canvas.cell, bool(paths), bool(known[states].all()) and not canvas.hidden),
    )
    return canvas


def _swatches(cell: int, has_path: bool, all_known: bool) -> list[Swatch]:
    path = Swatch("greedy path from the start" if cell >= 24 else "greedy path", AGENT, PAPER)
    wrong = Swatch("not optimal in this cell", frame=DISAGREES, thick=2)
    return [*([path] if has_path else []), wrong, *([] if all_known else [NEVER_VISITED])]


def draw_paths(canvas: Canvas, paths: list[list[int]], ways: list[list[int]], middle: float) -> None:
    """A ring around each start, and lines through the states where one is beside the next.

    Args:
        canvas: is drawn on.
        paths: the states of each path.
        ways: where each state's arrow points, down and right.
        middle: how far below a cell's upper edge, in cells.
    """
    place = canvas.board.place
    for path in paths:
        placed, lines = [state for state in path if place[state][0] >= 0], []
        for state, following in pairwise(placed):
            down, right = place[following][0] - place[state][0], place[following][1] - place[state][1]
            if abs(down) + abs(right) <= 1 or [down, right] == ways[state]:  # which may be along a diagonal
                lines.append((canvas.point(state, 0.5, middle), canvas.point(following, 0.5, middle)))
                if canvas.mdp.terminal[following] and canvas.has_grid:  # what is drawn there stays whole
                    (x, y), (to_x, to_y) = lines[-1]
                    lines[-1] = (x, y), ((x + to_x) / 2, (y + to_y) / 2)
        canvas.line(lines, AGENT)
        if placed:
            canvas.ring(canvas.point(placed[0], 0.5, middle), AGENT)


def _draw_arrow(canvas: Canvas, middle: Point, way: list[int], size: float, ink: Colour) -> None:
    arrow = _arrow(*middle, *way, size)
    drawing.import_pygame().draw.polygon(canvas.world, ink, arrow)


def _draw_disc(canvas: Canvas, middle: Point, name: str, size: float, ink: Colour, paper: Colour) -> None:
    """For an action that does not move a disc, with the action's first letter where there is room for it."""
    drawing.import_pygame().draw.circle(canvas.world, ink, middle, round(0.2 * size))
    letter = min(round(0.32 * size), 20)
    if letter >= SMALLEST_TEXT:
        canvas.number(name[:1].upper(), middle, letter, paper)


@functools.lru_cache(maxsize=1 << 13)  # the same arrows are drawn in every picture of an animation
def _arrow(x: float, y: float, down: int, right: int, size: float) -> list[Point]:
    length = math.hypot(down, right)
    to_down, to_right = down / length, right / length
    return [
        (x + size * (along * to_right - across * to_down), y + size * (along * to_down + across * to_right))
        for along, across in _ARROW
    ]
