"""The visit map: how often training took an action in each cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gridworld.envs.board import board_of
from gridworld.envs.rendering import Frame
from gridworld.visualization.canvas import Canvas, shown
from gridworld.visualization.colormaps import BLUES, counting, is_dark
from gridworld.visualization.maps.state_table import draw_visit_table, table_states
from gridworld.visualization.picture import IMAGES_TAB, Draw, Subject
from gridworld.visualization.sheet import INK, PAPER, UNREACHABLE, Swatch, short
from gridworld.world.mdp import Mdp

TENSORBOARD_SIDE: int | None = IMAGES_TAB


def draw(subject: Subject) -> Draw:
    """The map of the subject's visits."""
    mdp, visits = subject.evaluator.mdp, subject.visits
    caption = f"where {visits.sum():,} training steps were taken"
    if not board_of(mdp).panels:
        picture = draw_visit_table(mdp, table_states(mdp, visits), visits, caption)
        return lambda cell_size: picture
    return lambda cell_size: draw_visit_map(mdp, visits, caption, cell_size)


def draw_visit_map(
    mdp: Mdp, visits: NDArray[np.int64], caption: str = "", cell_size: int | None = None
) -> Frame:
    """Draw counts as colours, on a logarithmic scale where they span decades.

    Args:
        mdp: the world.
        visits: (S, A), how often each action was taken in each state.
        caption: a line above the grid.
        cell_size: pixels; None: 80, less on large maps.

    Returns:
        (height, width, 3), RGB.
    """
    canvas = Canvas(mdp, cell_size)
    counts = visits.sum(axis=1)
    states = np.flatnonzero(shown(mdp))
    scale = counting(BLUES, counts[states])
    colours = scale.colours(counts.astype(np.float64))
    colours[counts == 0] = PAPER
    canvas.paint(colours[:, None])
    canvas.draw_world()
    texts = {count: short(count) for count in set(counts[states].tolist())}
    size = canvas.number_size(0.8, texts.values())
    if size is not None:
        dark = is_dark(colours)
        for state in states[counts[states] > 0].tolist():
            ink = PAPER if dark[state] else INK
            canvas.number(texts[int(counts[state])], canvas.point(state, 0.5, 0.5), size, ink)
    canvas.caption(caption)
    kind = ", log scale" if scale.logarithmic else ""
    never = [Swatch("never", fill=PAPER)] if (counts[states] == 0).any() else []
    hidden = [UNREACHABLE] if canvas.hidden else []
    canvas.legend(scale, f"visits {short(scale.low)}", f"{short(scale.high)}{kind}", [*never, *hidden])
    return canvas.frame()
