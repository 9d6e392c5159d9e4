"""The exception for a user's mistake, and its relatives; each is explained in one sentence."""

from __future__ import annotations

import errno
import os
import shlex
from pathlib import Path
from typing import Any

EXIT_CODE = 2
GYMNASIUM = (  # the interface of an environment
    "reset(self, *, seed=None, options=None) must return (observation, info), and step "
    "(observation, reward, terminated, truncated, info)"
)
OLD_GYM = f"is written for the old Gym: write `import gymnasium as gym`; {GYMNASIUM}"
DISTRIBUTION = "gridworld-sb3"  # the package's name for pip; on PyPI another project has `gridworld`


class InputError(ValueError):
    """A mistake in a map, a setting, an action or a file, explained in one sentence.

    The sentence names the thing, where it is, and what would be right. Command lines print it without a
    traceback and exit with `EXIT_CODE`.
    """


class MachineError(InputError):
    """A disk was full or gone. What was begun is an interrupted run, to be resumed once that is put right."""


class FolderLostError(InputError):
    """The folder that this run was at work in is gone, or is another process's by now."""


class TooLargeError(InputError):
    """A world has more states than may be tried, or takes longer."""


def reason(error: BaseException) -> str:
    """What went wrong, for a sentence."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, OSError) and error.strerror:
        return error.strerror + (f": {error.filename}" if error.filename else "")
    return f"{type(error).__name__}: {error}"


def on_a_line(thing: Any) -> str:
    """A thing as text on one line, shortened."""
    text = " ".join(str(thing).split())
    return text if len(text) <= 160 else f"{text[:157]}..."


def in_short(error: BaseException) -> str:
    """The kind of an exception of somebody else's code, and the first line of what it says."""
    try:
        lines = str(error).strip().splitlines()
    except Exception:  # its own code fails, too
        lines = []
    return f"{type(error).__name__}: {lines[0][:200]}" if lines else type(error).__name__


def failure(error: OSError) -> str:
    """Which file, what went wrong with it, and what would be right where that is known, as a sentence."""
    where = str(error.filename or "")
    what = error.strerror or str(error) or type(error).__name__
    if where and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        folder = os.path.dirname(where) or os.curdir
        what += f"; choose another folder, or make {folder} writable"
    elif error.errno in (errno.ENOSPC, errno.EDQUOT):
        what += "; free some space there"
    return f"{where}: {what}" if where else what


def install_command(extra: str) -> str:
    """What installs an optional part, of a checkout or of an installed wheel."""
    checkout = Path(__file__).parents[2]
    if (checkout / "pyproject.toml").is_file():
        return f"pip install -e {shlex.quote(f'{checkout}[{extra}]')}"
    return f"pip install '{DISTRIBUTION}[{extra}]'"  # pip finds the wheel installed, and adds what is missing
