"""`python scripts/train.py resume=RUN`: resume a run with its own settings.

`total_timesteps=N` makes it longer, `logging.progress=false` hides its progress. `trust=true` imports the
classes that the run names wherever they are from, `anyway=true` accepts other versions or another processor.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from gridworld.config.composition.words import digits
from gridworld.errors import InputError
from gridworld.process.memory_budget import limited
from gridworld.run.folder import alone_in, check_inside
from gridworld.run.reader import check_is_run

KEY, STEPS = "resume", "total_timesteps"
_SWITCHES = {"logging.progress": "true", "trust": "false", "anyway": "false"}  # with their defaults


@limited()
def main(arguments: Sequence[str]) -> None:
    """Resume, and print the result as a new run does."""
    words = _parse(arguments)
    total_timesteps = _step_count(words[STEPS]) if STEPS in words else None
    progress, trust, anyway = ((words.get(name) or usual) == "true" for name, usual in _SWITCHES.items())
    folder = Path(words[KEY])
    check_inside(folder, KEY)
    check_is_run(folder)  # before anything is written there
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: is read-only; copy the run to where you may write and resume= the copy")

    from gridworld.restore.advice import advice
    from gridworld.restore.resume import open_unfinished  # here, since it takes a second to import
    from gridworld.run.summary import train_and_tell

    with alone_in(folder):
        unfinished = open_unfinished(folder, trust)
        train_and_tell(folder, lambda: unfinished.resume(total_timesteps, anyway, progress), advice)


def _parse(arguments: Sequence[str]) -> dict[str, str]:
    words: dict[str, str] = {}
    for argument in arguments:
        key, _, text = argument.partition("=")
        if key not in (KEY, STEPS, *_SWITCHES):
            raise InputError(
                f"{argument}: a run goes on with the settings that it began with; beside {KEY}=RUN there are "
                f"{', '.join([STEPS, *_SWITCHES])}"
            )
        if key in words:
            raise InputError(f"{argument}: {key} is given already; give it once")
        if key in _SWITCHES and text not in ("true", "false"):
            raise InputError(f"{argument}: must be true or false")
        if key == KEY and not text:
            raise InputError(f"{argument}: must be the folder of a run, e.g. one in runs/")
        words[key] = text
    return words


def _step_count(text: str) -> int:
    try:
        count = int(digits(text))  # 1e5
        if 1 <= count < 10**18:
            return count
    except ValueError:
        pass
    raise InputError(f"{STEPS}={text}: must be a number of environment steps")
