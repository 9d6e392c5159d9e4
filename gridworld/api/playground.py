"""The playground in a notebook."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from os import PathLike
from typing import Any

from gridworld.api.runs import RunResult
from gridworld.api.settings import words
from gridworld.base.errors import InputError
from gridworld.base.user_input import as_path, limited
from gridworld.report.playground.page import FRAME, page_of


@dataclass(frozen=True, repr=False)
class Playground:
    """The page that solves a world, lets Q-learning learn in it, and looks into a run; `html` is its text."""

    html: str

    def _repr_html_(self) -> str:
        return FRAME.format(f'srcdoc="{escape(self.html)}"')


def playground(*world: Any, **settings: Any) -> Playground:
    """Show a world or a run in a notebook: to draw, and to watch Q-learning, next to the exact optimum.

    Args:
        world: a world's name, a map file, a finished run or its folder; or settings as for `train`,
            `"env=cliff"`, `{"env.slip": 0.1}`. None: the default world.
        settings: settings whose name has no dot.

    Returns:
        The page, which the last line of a cell shows.

    Raises:
        InputError: no such world or run, or it is too large.

    Example:
        >>> written = Path("cliff.html").write_text(playground("cliff").html)
    """
    alone = world[0] if len(world) == 1 and not settings else None
    if isinstance(alone, RunResult):
        if alone.folder is None:
            raise InputError("playground: the run has no folder; train it with folder=...")
        alone = alone.folder
    with limited():
        if isinstance(alone, str | PathLike):
            return Playground(page_of([str(as_path("playground: world", alone))]))
        return Playground(page_of(words(*world, **settings)))
