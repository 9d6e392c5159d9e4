"""What a picture of a run is drawn from, and how its drawer is found.

A drawer is a module of this package with

    draw(subject) -> Draw                a function of a cell size
    TENSORBOARD_SIDE: int | None         pixels of its longest side in TensorBoard; None: as in its file

Which pictures there are, and which module draws each, is declared in `gridworld.config.pictures`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import PolicySnapshot
from gridworld.config.train import TrainConfig
from gridworld.envs.rendering import Frame
from gridworld.errors import InputError
from gridworld.visualization.animation import Animation
from gridworld.world.evaluation import Evaluator

if TYPE_CHECKING:
    from gridworld.visualization.policy_history import PolicyHistory

# Pixels that pictures have in TensorBoard. It scales by skipping pixels: thin lines vanish, text frays.
IMAGES_TAB = 350
TIME_SERIES_CARD = 240

# A picture for a cell size in pixels; None: the picture's own.
Draw = Callable[[int | None], Frame | Animation]


class Subject(Protocol):
    """What pictures are of: an agent after some training in its world."""

    @property
    def config(self) -> TrainConfig: ...

    @property
    def is_trusted(self) -> bool:
        """Whether the environment that the settings name may be made, which runs its code."""

    @property
    def evaluator(self) -> Evaluator: ...

    @property
    def snapshot(self) -> PolicySnapshot: ...

    @property
    def steps(self) -> int:
        """How many environment steps it was trained for."""

    @property
    def visits(self) -> NDArray[np.int64]:
        """(S, A), how often training took each action in each state."""

    @property
    def history(self) -> PolicyHistory | None:
        """The policy over training, where it was kept."""


def agents_gamma(subject: Subject) -> float:
    """The discount that the agent learns with; the evaluation's where it has none of its own."""
    return float(getattr(subject.config.agent, "gamma", subject.evaluator.solution.gamma))


def visits_of(subject: Subject) -> NDArray[np.int64] | None:
    """The subject's visits; None where the run has none, for pictures that can be drawn without."""
    try:
        return subject.visits
    except InputError:
        return None


class Drawer(Protocol):
    """The two names of a drawer's module."""

    TENSORBOARD_SIDE: int | None

    def draw(self, subject: Subject) -> Draw:
        """Prepare the picture: what does not depend on its size is computed here, once."""


def drawer(name: str) -> Drawer:
    """The module of that name in this package."""
    return cast("Drawer", importlib.import_module(f"{__package__}.{name}"))
