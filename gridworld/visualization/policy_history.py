"""The policy over training: snapshots at evenly spread evaluations, and their animation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import PolicySnapshot
from gridworld.envs.board import board_of
from gridworld.envs.rendering import fitting_cell_size
from gridworld.storage.serialization import State
from gridworld.visualization.animation import animation_of_frames
from gridworld.visualization.canvas import shown
from gridworld.visualization.paths import explored
from gridworld.visualization.picture import Draw, Subject
from gridworld.visualization.policy_map import caption_at, draw_policy_map, draw_policy_table
from gridworld.visualization.sheet import PAPER, VIRIDIS, Sheet, linear
from gridworld.visualization.state_table import Numbers, table_states

TENSORBOARD_SIDE: int | None = None

_MOST = 48  # moments
_MOST_NUMBERS = 5_000_000  # of all moments together: some 25 MB
_SIDE = 320  # pixels of the animation
_MOSAIC_SIDE = 640  # pixels, where there are several panels


def draw(subject: Subject) -> Draw:
    """The policy map, or table, over training as an animation of one size, with one scale of colours."""
    assert subject.history is not None
    mdp, optimal = subject.evaluator.mdp, subject.evaluator.solution.optimal
    moments = subject.history.moments()
    board, known = board_of(mdp), explored(mdp, subject.visits)
    states = np.flatnonzero(shown(mdp)) if board.panels else table_states(mdp, subject.visits)
    visited = states[known[states]]
    scale = linear(VIRIDIS, np.stack([moment.values[visited] for moment in moments]))
    cell_size = fitting_cell_size(mdp, _SIDE if len(board.panels) <= 1 else _MOSAIC_SIDE)

    def sheet(moment: Moment) -> Sheet:
        values, greedy = moment.values.astype(np.float64), moment.greedy
        caption = caption_at(subject, moment.step)
        if board.panels:
            return draw_policy_map(mdp, values, greedy, optimal, caption, cell_size, scale, known)
        numbers = np.full(optimal.shape, np.nan)
        np.put_along_axis(numbers, greedy[:, None].astype(np.intp), values[:, None], axis=1)
        drawn = Numbers("value", numbers, scale, written=False)
        return draw_policy_table(mdp, states, drawn, greedy, optimal, known, caption)

    frames = (sheet(moment).packed() for moment in moments)
    animation = animation_of_frames(frames, [PAPER, *scale.ramp.tolist()])
    return lambda cell_size: animation


@dataclass(frozen=True, eq=False)
class Moment:
    """What is kept of an evaluation."""

    step: int
    values: NDArray[np.float32]  # (S,)
    greedy: NDArray[np.uint8]  # (S,)


class PolicyHistory:
    """Every evaluation of a short training, every second, fourth, ... of a long one, and always the last."""

    def __init__(self, num_states: int) -> None:
        self._most = max(4, min(_MOST, _MOST_NUMBERS // num_states))
        self._every = 1
        self._seen = 0
        self._kept: list[Moment] = []
        self._last: Moment | None = None

    def add(self, step: int, snapshot: PolicySnapshot) -> None:
        """Take in one more evaluation, after `step` environment steps."""
        self._last = Moment(step, snapshot.values.astype(np.float32), snapshot.greedy.astype(np.uint8))
        if self._seen % self._every == 0:
            if len(self._kept) == self._most:
                del self._kept[1::2]
                self._every *= 2
            if self._seen % self._every == 0:
                self._kept.append(self._last)
        self._seen += 1

    def moments(self) -> list[Moment]:
        """The kept evaluations from the first to the last, at most 49."""
        if self._last is None or (self._kept and self._kept[-1] is self._last):
            return list(self._kept)
        return [*self._kept, self._last]

    def get_state(self) -> State:
        """The kept evaluations, and how many were seen."""
        moments = self.moments()
        return {
            "every": self._every,
            "seen": self._seen,
            "kept": len(self._kept),
            "steps": [moment.step for moment in moments],
            "values": [moment.values for moment in moments],
            "greedy": [moment.greedy for moment in moments],
        }

    def set_state(self, state: State) -> None:
        """Continue from a state."""
        columns = state["steps"], state["values"], state["greedy"]
        moments = [Moment(*moment) for moment in zip(*columns, strict=True)]
        self._every, self._seen = int(state["every"]), int(state["seen"])
        self._kept = moments[: state["kept"]]
        self._last = moments[-1] if moments else None
