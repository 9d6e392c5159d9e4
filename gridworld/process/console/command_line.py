"""The commands as the user calls them: `gridworld train`, or `python scripts/train.py` in a checkout.

Which of the two it is, `sys.argv[0]` says: the console command puts `gridworld train` there. It is the same
in the processes of workers. Code that was not started by a command names the scripts where it has them.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path

CONSOLE = "gridworld"
_called_from: list[Path] = []  # nothing, or the folder that `called_from` names
_SCRIPTS = Path(__file__).parents[3] / "scripts"
_SCRIPT = re.compile(r"(?:python )?(?:scripts/)?\b(train|tune|record|report|evaluate|jobs|play|check)\.py")


def command(name: str) -> str:
    """What the user types for a command, e.g. `python scripts/train.py`."""
    return f"{CONSOLE} {name}" if _is_console() else f"python scripts/{name}.py"


def program(name: str) -> str:
    """A command's short name, for usage lines and messages: `train.py` or `gridworld train`."""
    return f"{CONSOLE} {name}" if _is_console() else f"{name}.py"


def as_called(text: str) -> str:
    """A text that names scripts, such as a manual, with the commands in their place where those are used."""
    return _SCRIPT.sub(rf"{CONSOLE} \1", text) if _is_console() else text


def command_line() -> list[str]:
    """The words with which this process's command was called, to be typed again."""
    first, *rest = sys.argv
    return [*first.split(), *rest] if _is_console_word(first) else ["python", first, *rest]


def recorded_command_line() -> list[str]:
    """The same for a run's records, where the script's folder is of no use."""
    first, *rest = sys.argv
    return [*first.split(), *rest] if _is_console_word(first) else [Path(first).name, *rest]


@contextlib.contextmanager
def called_from(folder: Path) -> Iterator[None]:
    """In this block the command counts as called from `folder`, whatever the current folder is."""
    before = _called_from.copy()
    _called_from[:] = [folder]
    try:
        yield
    finally:
        _called_from[:] = before


def users_folder() -> Path:
    """The folder from which the user names files: the current one, unless a job has changed that."""
    return _called_from[0] if _called_from else Path.cwd()


def _is_console() -> bool:
    return _is_console_word(sys.argv[0]) or not (_SCRIPTS / "train.py").is_file()


def _is_console_word(first: str) -> bool:
    return first.startswith(f"{CONSOLE} ")
