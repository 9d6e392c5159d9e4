"""The maps of a run: its policy, at the end and over training, the error of its values, and its visits.

Each is a function of the subject, and a table where the world has no places. What training never acted in is
grey in pictures of the policy: its values are guesses, and no part of the scale.
"""

from __future__ import annotations

import contextlib
import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.envs.rendering import (
    AGENT,
    INK,
    SMALLEST_TEXT,
    UNKNOWN,
    Colour,
    Frame,
    board_of,
    fitting_cell_size,
)
from gridworld.visualization.animation import animation_of_frames
from gridworld.visualization.canvas import Canvas, directions, greedy_paths, moving_actions
from gridworld.visualization.picture import Draw, Moment, Subject, agents_gamma
from gridworld.visualization.sheet import (
    BLUES,
    DISAGREES,
    NEVER_VISITED,
    ORANGES,
    PAPER,
    UNKNOWN_INK,
    UNREACHABLE,
    VIRIDIS,
    Corners,
    Scale,
    Sheet,
    Swatch,
    counting,
    disc,
    is_dark,
    linear,
)
from gridworld.visualization.state_table import StateTable, table_states
from gridworld.world.evaluation import PolicySnapshot
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp
from gridworld.world.solver import Solution, solved

_UNKNOWN_DISAGREES: Colour = (226, 178, 174)
_SMALLEST_ARROW_CELL = 12  # pixels; below it an arrow is a blot
_ARROW = (  # its corners along and across its way, in its lengths
    *((-0.28, 0.05), (0.04, 0.05), (0.04, 0.17), (0.3, 0.0)),
    *((0.04, -0.17), (0.04, -0.05), (-0.28, -0.05)),
)
_LEARNING_SIDE, _LEARNING_MOSAIC_SIDE = 320, 640  # pixels of the animation, with one panel or several
_NO_OPTIMUM = "no finite optimum"


def policy(subject: Subject) -> Draw:
    """The map of the subject's greedy policy."""
    mdp, snapshot, visits = subject.evaluator.mdp, subject.snapshot, subject.visits
    optimal, known = subject.evaluator.solution.optimal, explored(mdp, visits)
    caption = _policy_caption(subject, subject.steps)
    if board_of(mdp).panels:
        ends = _possible(subject, snapshot.values)
        return lambda cell_size: draw_policy_map(
            mdp, snapshot.values, snapshot.greedy, optimal, caption, cell_size, known=known, ends=ends
        ).frame()
    states = table_states(mdp, visits)
    if snapshot.q is None:
        name, numbers, scale = "probability", snapshot.sampled, Scale(VIRIDIS, 0.0, 1.0)
    else:
        name, numbers, scale = "Q", snapshot.q, linear(VIRIDIS, snapshot.q[states[known[states]]])
    table = StateTable(mdp, states, mdp.action_names, legend_rows=2)
    table.paint(numbers, scale, known)
    _finish_policy_table(table, name, scale, snapshot.greedy, optimal, known, caption)
    return lambda cell_size: table.frame()


def learning(subject: Subject) -> Draw:
    """The policy map over training, in cells of `recording.cell_size`, or the table; one colour scale."""
    assert subject.history is not None
    mdp, optimal = subject.evaluator.mdp, subject.evaluator.solution.optimal
    moments = subject.history.moments()
    board, known = board_of(mdp), explored(mdp, subject.visits)
    states = np.flatnonzero(board.floor) if board.panels else table_states(mdp, subject.visits)
    visited = states[known[states]]
    values = np.stack([moment.values[visited] for moment in moments])
    scale = linear(VIRIDIS, np.clip(values, *_possible(subject, values)))
    side = _LEARNING_SIDE if len(board.panels) <= 1 else _LEARNING_MOSAIC_SIDE
    cell_size = subject.config.recording.cell_size or fitting_cell_size(mdp, side)

    def sheet(moment: Moment) -> Sheet:
        values, greedy = moment.values.astype(np.float64), moment.greedy
        caption = _policy_caption(subject, moment.step)
        if board.panels:
            return draw_policy_map(mdp, values, greedy, optimal, caption, cell_size, scale, known)
        numbers = np.full(optimal.shape, np.nan)
        np.put_along_axis(numbers, greedy[:, None].astype(np.intp), values[:, None], axis=1)
        table = StateTable(mdp, states, mdp.action_names, legend_rows=2, opaque=True)
        table.paint(numbers, scale, known, written=False)
        _finish_policy_table(table, "value", scale, greedy, optimal, known, caption)
        return table

    frames = (sheet(moment).packed() for moment in moments)
    animation = animation_of_frames(frames, [PAPER, *scale.ramp.tolist()])
    return lambda cell_size: animation


def q_error(subject: Subject) -> Draw:
    """The map of |Q - Q*|, or |V - V*| without Q; the optimum is that under the agent's own discount."""
    mdp, snapshot, gamma = subject.evaluator.mdp, subject.snapshot, agents_gamma(subject)
    best = subject.evaluator.solution
    error = value_error(snapshot, best if gamma == best.gamma else solved(mdp, gamma))
    name = "|V - V*|" if snapshot.q is None else "|Q - Q*|"
    caption = f"{name} after {subject.steps:,} steps, at the agent's gamma {gamma:g}"
    if board_of(mdp).panels:
        return lambda cell_size: draw_error_map(mdp, error, caption, cell_size)
    columns = ["V"] if snapshot.q is None else mdp.action_names
    table = StateTable(mdp, table_states(mdp, subject.visits), columns)
    picture = table.draw_numbers(
        error, linear(ORANGES, error[table.states], low=0.0), "error", _NO_OPTIMUM, caption
    )
    return lambda cell_size: picture


def visits(subject: Subject) -> Draw:
    """The map of how often training took an action in each state."""
    mdp, counts = subject.evaluator.mdp, subject.visits
    assert counts is not None
    caption = f"where {counts.sum():,} training steps were taken"
    if board_of(mdp).panels:
        return lambda cell_size: draw_visit_map(mdp, counts, caption, cell_size)
    table = StateTable(mdp, table_states(mdp, counts), mdp.action_names)
    scale, numbers = counting(BLUES, counts[table.states]), np.where(counts > 0, counts, np.nan)
    picture = table.draw_numbers(numbers, scale, "visits", "never", caption)
    return lambda cell_size: picture


def explored(mdp: Mdp, visits: NDArray[np.int64] | None) -> BoolArray:
    """The states (S,) that training acted in; without visits (S, A), those that can be reached."""
    if visits is not None and visits.any():
        return np.asarray(visits.any(axis=1))
    return mdp.reachable


def _policy_caption(subject: Subject, steps: int) -> str:
    own, scores = agents_gamma(subject), subject.evaluator.solution.gamma
    numbers = f"the agent's own estimates, discount {own:g}" + (f"; scores use {scores:g}" * (own != scores))
    return f"greedy policy after {steps:,} steps\n{numbers}"


def _possible(subject: Subject, values: NDArray[Any]) -> tuple[float, float]:
    """The least and the most that policies can be worth in states that these values may be estimates of."""
    mdp, gamma = subject.evaluator.mdp, agents_gamma(subject)
    playing = mdp.reachable & ~mdp.terminal
    ends = [-math.inf, math.inf]
    with contextlib.suppress(InputError):  # rewards may add up without an end
        ends[1] = float(solved(mdp, gamma).v[playing].max())
        if values.min() < min(0.0, mdp.reward.min()):  # worth the search for the worst policy
            ends[0] = -float(solved(replace(mdp, reward=-mdp.reward), gamma).v[playing].max())
    return ends[0], ends[1]


def draw_policy_map(
    mdp: Mdp,
    values: FloatArray,
    greedy: IntArray,
    optimal: BoolArray,
    caption: str = "",
    cell_size: int | None = None,
    scale: Scale | None = None,
    known: BoolArray | None = None,
    ends: tuple[float, float] = (-math.inf, math.inf),
) -> Canvas:
    """Draw values (S,) as colours, greedy actions (S,) as arrows, and the greedy path from the start.

    A cell whose greedy action is not one of the `optimal` (S, A) has a red frame, and one that is not `known`
    (S,) is grey. With a `scale`, for pictures that are to be compared, no numbers are written and the
    ground is white; without one, colours are between those `ends` at most.
    """
    canvas = Canvas(mdp, cell_size, legend_rows=2, opaque=scale is not None)
    playable = canvas.board.floor
    known = playable if known is None else known & playable
    shown = scale or linear(VIRIDIS, np.clip(values[known], *ends))
    colours = shown.colours(values)
    colours[~known] = UNKNOWN
    canvas.paint(colours[:, None])
    paths = greedy_paths(mdp, greedy)
    ways = directions(mdp)[np.arange(mdp.num_states), greedy].tolist()
    canvas.draw_world(paths, ways)
    with_numbers = scale is None and len(canvas.board.panels) <= 1  # of several panels the cells are small
    dark, length = is_dark(colours).tolist(), 0.7 if with_numbers else 0.85
    for state in np.flatnonzero(playable).tolist() if canvas.cell >= _SMALLEST_ARROW_CELL else []:
        point = canvas.point(state, 0.5, 0.5)
        ink, edge = (PAPER, INK) if dark[state] else (INK, PAPER)
        if not known[state]:
            ink, edge = UNKNOWN_INK, UNKNOWN
        if any(ways[state]):
            canvas.draw_shape(point, _arrow(*ways[state], length), ink, edge)
            continue
        canvas.draw_shape(point, disc(0.2 * length), ink, edge)
        if (letter := min(round(0.32 * length * canvas.cell), 40)) >= SMALLEST_TEXT:
            canvas.write(mdp.action_names[greedy[state]][:1].upper(), point, letter, edge)
    if with_numbers:
        canvas.write_values(values, known, colours, shown.high)
    wrong = playable & ~optimal[np.arange(mdp.num_states), greedy]
    canvas.mark(np.flatnonzero(wrong & ~known), _UNKNOWN_DISAGREES)
    canvas.mark(np.flatnonzero(wrong & known), DISAGREES)
    canvas.caption(caption)
    swatches = [canvas.path_swatch] if paths else []
    swatches.append(Swatch("not optimal in this cell", frame=DISAGREES, thick=2))
    swatches += [] if known[playable].all() and not canvas.hidden else [NEVER_VISITED]
    canvas.legend(shown, "value", swatches)
    return canvas


@functools.cache
def _arrow(down: int, right: int, length: float, shift: float = 0.0) -> Corners:
    """The corners of an arrow in a cell, that far along its way from the middle."""
    way = math.hypot(down, right)
    to_down, to_right = down / way, right / way
    corners = [(length * along + shift * way, length * across) for along, across in _ARROW]
    return tuple(
        (0.5 + along * to_right - across * to_down, 0.5 + along * to_down + across * to_right)
        for along, across in corners
    )


def draw_optimal_actions(canvas: Canvas, optimal: BoolArray) -> None:
    """Draw an arrow for each optimal action (S, A), outwards from the middle; a dot for one that stays."""
    ways = directions(canvas.mdp)
    for state, action in np.argwhere(optimal & canvas.board.floor[:, None]).tolist():
        down, right = ways[state, action].tolist()
        corners = _arrow(down, right, 0.6, 0.25) if down or right else disc(0.12)
        canvas.draw_shape(canvas.point(state, 0.5, 0.5), corners, INK)


def _finish_policy_table(
    table: StateTable,
    name: str,
    scale: Scale,
    greedy: IntArray,
    optimal: BoolArray,
    known: BoolArray,
    caption: str,
) -> None:
    """Frame the greedy action of each state, and add caption and legend."""
    for row, state in enumerate(table.states.tolist()):
        action = int(greedy[state])
        table.mark(row, action, AGENT if optimal[state, action] else DISAGREES)
    table.caption(caption)
    swatches = [Swatch("greedy action", frame=AGENT, thick=2)]
    swatches.append(Swatch("greedy, not optimal", frame=DISAGREES, thick=2))
    swatches += [] if known[table.states].all() else [NEVER_VISITED]
    table.legend(scale, name, swatches)


def value_error(snapshot: PolicySnapshot, best: Solution) -> FloatArray:
    """|Q - Q*| (S, A), or |V - V*| (S, 1) for an agent without Q; NaN where the optimum is not finite."""
    theirs, ours = (snapshot.values[:, None], best.v[:, None]) if snapshot.q is None else (snapshot.q, best.q)
    return np.abs(np.where(np.isfinite(ours), theirs - ours, np.nan))


def draw_error_map(mdp: Mdp, error: FloatArray, caption: str = "", cell_size: int | None = None) -> Frame:
    """Draw errors (S, A) as four triangles in each cell; a cell too small for them shows the largest."""
    canvas = Canvas(mdp, cell_size)
    moves = moving_actions(mdp) if error.shape[1] > 1 and canvas.has_grid else None
    error = error.max(axis=1, keepdims=True) if moves is None else error[:, moves]
    scale = linear(ORANGES, error[canvas.board.floor], low=0.0)
    return canvas.draw_numbers(error, scale, "error", _NO_OPTIMUM, caption)


def draw_visit_map(
    mdp: Mdp, visits: NDArray[np.int64], caption: str = "", cell_size: int | None = None
) -> Frame:
    """Draw counts (S, A) as colours, on a logarithmic scale where they span decades."""
    board = board_of(mdp)
    counts = board.summed(visits.sum(axis=1))[:, None]
    scale = counting(BLUES, counts[board.floor])
    numbers = np.where(counts > 0, counts, np.nan)
    return Canvas(mdp, cell_size).draw_numbers(numbers, scale, "visits", "never", caption)


def draw_regret(mdp: Mdp, cost: FloatArray, greedy: IntArray, caption: str, cell_size: int | None) -> Frame:
    """Draw what each state adds to a policy's regret (S,), and the way that its greedy actions take."""
    if not board_of(mdp).panels:  # a world without places: its states in a column, by what they cost
        places = np.round(cost[:, None] * 1e12 / max(cost.max(), 1e-300)).astype(np.int64)
        states = table_states(mdp, places)
        table, scale = StateTable(mdp, states, ["regret"]), linear(ORANGES, cost[states], low=0.0)
        return table.draw_numbers(np.where(cost > 0, cost, np.nan)[:, None], scale, "regret", "none", caption)
    canvas = Canvas(mdp, cell_size)
    cost = canvas.board.summed(cost)
    scale = linear(ORANGES, cost[canvas.board.floor], low=0.0)
    colours = scale.colours(cost)
    colours[cost == 0] = PAPER
    canvas.paint(colours[:, None])
    paths = greedy_paths(mdp, greedy)
    canvas.draw_world(paths, directions(mdp)[np.arange(mdp.num_states), greedy].tolist())
    canvas.write_values(cost, (cost > 0) & canvas.board.floor, colours, scale.high)
    canvas.caption(caption)
    swatches = [*([canvas.path_swatch] if paths else []), *([UNREACHABLE] if canvas.hidden else [])]
    canvas.legend(scale, "regret", swatches)
    return canvas.frame()
