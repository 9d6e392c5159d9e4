"""The policy map: an agent's values as colours, its greedy actions as arrows, and where they lead.

A line follows the greedy policy from the start. A cell whose greedy action is not among the optimal ones has
a red frame. What training never acted in is grey: its values are guesses, and no part of the scale. A world
without places has a table.
"""

from __future__ import annotations

import functools
import math

import numpy as np

from gridworld.agents import PolicySnapshot
from gridworld.envs import rendering as drawing
from gridworld.envs.board import board_of
from gridworld.envs.rendering import AGENT, SMALLEST_TEXT, UNKNOWN, Colour, Point
from gridworld.visualization.canvas import Canvas, shown
from gridworld.visualization.paths import directions, draw_paths, explored, greedy_paths
from gridworld.visualization.picture import IMAGES_TAB, Draw, Subject, agents_gamma, visits_of
from gridworld.visualization.sheet import (
    DISAGREES,
    INK,
    NEVER_VISITED,
    PAPER,
    UNKNOWN_INK,
    VIRIDIS,
    Scale,
    Sheet,
    Swatch,
    is_dark,
    linear,
    short,
)
from gridworld.visualization.state_table import Numbers, StateTable, table_states
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

TENSORBOARD_SIDE: int | None = IMAGES_TAB

_UNKNOWN_DISAGREES: Colour = (226, 178, 174)
_SMALLEST_ARROW_CELL = 12  # pixels; below it an arrow is a blot
_ARROW = (  # its corners along and across its way, in its lengths
    *((-0.28, 0.05), (0.04, 0.05), (0.04, 0.17), (0.3, 0.0)),
    *((0.04, -0.17), (0.04, -0.05), (-0.28, -0.05)),
)


def draw(subject: Subject) -> Draw:
    """The map of the subject's greedy policy."""
    mdp, snapshot, visits = subject.evaluator.mdp, subject.snapshot, visits_of(subject)
    optimal, known = subject.evaluator.solution.optimal, explored(mdp, visits)
    caption = caption_at(subject, subject.steps)
    if not board_of(mdp).panels:
        states = table_states(mdp, visits)
        numbers = action_numbers(snapshot, states[known[states]])
        picture = draw_policy_table(mdp, states, numbers, snapshot.greedy, optimal, known, caption).frame()
        return lambda cell_size: picture
    return lambda cell_size: draw_policy_map(
        mdp, snapshot.values, snapshot.greedy, optimal, caption, cell_size, known=known
    ).frame()


def caption_at(subject: Subject, steps: int) -> str:
    """The title of a map of the subject's policy after so many steps."""
    return f"greedy policy after {steps:,} steps, the agent's gamma {agents_gamma(subject):g}"


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
    """Draw values (S,) as colours, greedy actions (S,) as arrows, and the greedy path from the start.

    Args:
        mdp: the world.
        values: the agent's V.
        greedy: the action that it would take.
        optimal: (S, A), whether an action is optimal.
        caption: a line above the grid.
        cell_size: pixels; None: 80, less on large maps.
        scale: the colours of the values, for pictures that are to be compared; without numbers then.
        known: (S,), the states that training acted in; the others are grey. None: all are known.
    """
    canvas = Canvas(mdp, cell_size, legend_rows=2)
    playable = shown(mdp)
    known = playable if known is None else known & playable
    own = linear(VIRIDIS, values[known])
    ends = scale or own
    colours = ends.colours(values)
    colours[~known] = UNKNOWN
    canvas.paint(colours[:, None])
    canvas.draw_world()
    with_numbers = scale is None and len(canvas.board.panels) <= 1  # of several panels the cells are small
    texts = {value: short(value, own.high) for value in set(values[known].tolist()) if with_numbers}
    size = canvas.number_size(0.8, texts.values())
    inks = np.where(known[:, None], np.where(is_dark(colours)[:, None], PAPER, INK), UNKNOWN_INK).tolist()
    middle = 0.5 if size is None else 0.4  # of the arrows, above the numbers
    paths = greedy_paths(mdp, greedy)
    ways = directions(mdp)[np.arange(mdp.num_states), greedy].tolist()
    draw_paths(canvas, paths, ways, middle)
    length = canvas.cell if size is None else 0.85 * canvas.cell
    for state in np.flatnonzero(playable).tolist() if canvas.cell >= _SMALLEST_ARROW_CELL else []:
        point = canvas.point(state, 0.5, middle)
        if any(ways[state]):
            corners = _arrow(*point, *ways[state], length)
            drawing.import_pygame().draw.polygon(canvas.world, inks[state], corners)
        else:
            name = mdp.action_names[greedy[state]]
            _draw_disc(canvas, point, name, length, inks[state], colours[state].tolist())
    on_path = set().union(*paths)
    for state in np.flatnonzero(known).tolist() if size is not None else []:
        plate = colours[state] if state in on_path else None
        below = canvas.point(state, 0.5, 0.83)
        canvas.number(texts[float(values[state])], below, size or 0, inks[state], plate)
    wrong = playable & ~optimal[np.arange(mdp.num_states), greedy]
    canvas.mark(np.flatnonzero(wrong & ~known), _UNKNOWN_DISAGREES)
    canvas.mark(np.flatnonzero(wrong & known), DISAGREES)
    canvas.caption(caption)
    path = Swatch("greedy path from the start" if canvas.cell >= 24 else "greedy path", AGENT, PAPER)
    swatches = [path] if paths else []
    swatches.append(Swatch("not optimal in this cell", frame=DISAGREES, thick=2))
    swatches += [] if known[playable].all() and not canvas.hidden else [NEVER_VISITED]
    canvas.legend(ends, f"value {short(ends.low, ends.high)}", short(ends.high), swatches)
    return canvas


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


def action_numbers(snapshot: PolicySnapshot, states: IntArray) -> Numbers:
    """Q of each action, scaled by these states; probabilities where the agent has no Q."""
    if snapshot.q is None:
        return Numbers("probability", snapshot.sampled, Scale(VIRIDIS, 0.0, 1.0))
    return Numbers("Q", snapshot.q, linear(VIRIDIS, snapshot.q[states]))


def draw_policy_table(
    mdp: Mdp,
    states: IntArray,
    numbers: Numbers,
    greedy: IntArray,
    optimal: BoolArray,
    known: BoolArray,
    caption: str = "",
) -> Sheet:
    """Draw numbers of actions as colours, with a frame around the greedy one; see `draw_policy_map`."""
    table = StateTable(mdp, states, mdp.action_names, legend_rows=2)
    table.paint(numbers, known)
    for row, state in enumerate(states.tolist()):
        action = int(greedy[state])
        table.mark(row, action, AGENT if optimal[state, action] else DISAGREES)
    table.caption(caption)
    swatches = [Swatch("greedy action", frame=AGENT, thick=2)]
    swatches.append(Swatch("greedy, not optimal", frame=DISAGREES, thick=2))
    swatches += [] if known[states].all() else [NEVER_VISITED]
    low, high = short(numbers.scale.low, numbers.scale.high), short(numbers.scale.high)
    table.legend(numbers.scale, f"{numbers.name} {low}", high, swatches)
    return table
