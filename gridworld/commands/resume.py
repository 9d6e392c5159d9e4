"""`python scripts/train.py resume=RUN`: resume a run with its own settings.

`total_timesteps=N` makes it longer, `logging.progress=false` hides its progress. `trust=true` imports the
classes that the run names wherever they are from, `anyway=true` accepts other versions or another processor.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gridworld.config.composition.words import digits
from gridworld.errors import InputError
from gridworld.process.console.terminal import result_is_in_files
from gridworld.process.memory_budget import limited
from gridworld.run.claim import alone_in, check_inside
from gridworld.run.reader import check_is_run

KEY = "resume"


@limited()
def main(arguments: Sequence[str]) -> None:
    """Resume, and print the result as a new run does."""
    result_is_in_files()
    words = _parse(arguments)
    folder = Path(words[KEY])
    check_inside(folder, KEY)
    check_is_run(folder)  # before anything is written there
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: is read-only; copy the run to where you may write and resume= the copy")

    from gridworld.restore.advice import advice
    from gridworld.restore.resume import open_unfinished  # here, since it takes a second to import
    from gridworld.run.summary import train_and_tell

    with alone_in(folder):
        unfinished = open_unfinished(folder, words.get("trust", False))
        total_timesteps, anyway = words.get("total_timesteps"), words.get("anyway", False)
        progress = words.get("logging.progress", True)
        train_and_tell(folder, lambda: unfinished.resume(total_timesteps, anyway, progress), advice)


def _parse(arguments: Sequence[str]) -> dict[str, Any]:
    kinds: dict[str, Callable[[str], Any]] = {
        KEY: _folder,
        "total_timesteps": _step_count,
        **dict.fromkeys(("logging.progress", "trust", "anyway"), _boolean),
    }
    words: dict[str, Any] = {}
    for argument in arguments:
        key, _, text = argument.partition("=")
        if key not in kinds:
            raise InputError(
                f"{argument}: a run goes on with the settings that it began with; beside {KEY}=RUN there are "
                f"{', '.join(list(kinds)[1:])}"
            )
        if key in words:
            raise InputError(f"{argument}: {key} is given already; give it once")
        try:
            words[key] = kinds[key](text)
        except ValueError as error:
            raise InputError(f"{argument}: must be {error}") from None
    return words


def _folder(text: str) -> str:
    if not text:
        raise ValueError("the folder of a run, e.g. one in runs/")
    return text


def _step_count(text: str) -> int:
    with contextlib.suppress(ValueError):
        text = digits(text)  # 1e5
    if not text.isascii() or not text.isdecimal() or len(text) > 18 or int(text) < 1:
        raise ValueError("a number of environment steps")
    return int(text)


def _boolean(text: str) -> bool:
    if text not in ("true", "false"):
        raise ValueError("true or false")
    return text == "true"
