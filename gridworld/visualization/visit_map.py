"""The visit map: how often training took an action in each cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gridworld.envs.board import board_of
from gridworld.envs.rendering import Frame
from gridworld.visualization.canvas import Canvas, shown
from gridworld.visualization.picture import IMAGES_TAB, Draw, Subject
from gridworld.visualization.sheet import BLUES, Scale, counting, short
from gridworld.visualization.state_table import Numbers, draw_table, table_states
from gridworld.world.mdp import Mdp

TENSORBOARD_SIDE: int | None = IMAGES_TAB


def draw(subject: Subject) -> Draw:
    """The map of the subject's visits."""
    mdp, visits = subject.evaluator.mdp, subject.visits
    caption = f"where {visits.sum():,} training steps were taken"
    if board_of(mdp).panels:
        return lambda cell_size: draw_visit_map(mdp, visits, caption, cell_size)
    states = table_states(mdp, visits)
    numbers = Numbers("visits", np.where(visits > 0, visits, np.nan), counting(BLUES, visits[states]))
    picture = draw_table(mdp, states, mdp.action_names, numbers, *_ends(numbers.scale), "never", caption)
    return lambda cell_size: picture


def draw_visit_map(
    mdp: Mdp, visits: NDArray[np.int64], caption: str = "", cell_size: int | None = None
) -> Frame:
    """Draw counts (S, A) as colours, on a logarithmic scale where they span decades."""
    counts = visits.sum(axis=1, keepdims=True)
    scale = counting(BLUES, counts[shown(mdp)])
    numbers = np.where(counts > 0, counts, np.nan)
    return Canvas(mdp, cell_size).draw_numbers(numbers, scale, *_ends(scale), "never", caption)


def _ends(scale: Scale) -> tuple[str, str]:
    return f"visits {short(scale.low)}", short(scale.high) + (", log scale" if scale.logarithmic else "")
