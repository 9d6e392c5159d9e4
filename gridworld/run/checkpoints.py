"""Checkpoints of a run: its whole state in one file, written atomically; the last two are kept.

    checkpoints/000000012032.state    after 12,032 steps; `numpy.load` opens it

A power cut harms none, since the files that a checkpoint has marks of (`base.atomic_write`) are written
first. A checkpoint that is damaged, or whose files are, is passed over for the one before.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gridworld.base.atomic_write import remove_path, sync_folder, write_bytes
from gridworld.base.errors import InputError
from gridworld.base.safe_read import check_no_link, read_bytes
from gridworld.base.serialization import State, StateError, decode, encode
from gridworld.base.together import clock
from gridworld.base.user_input import BudgetError
from gridworld.run.folder import CHECKPOINTS

_KEPT = 2  # the newest
_SUFFIX = ".state"
_LEAST_SECONDS = 2.0  # between two checkpoints, with "auto"
_MOST_SHARE = 0.02  # of the time that may go to them, with "auto"
_MOST_BYTES = 1 << 33  # of a file
_DIGITS = 18  # of the steps in a name: counters of 64 bits have room for as many


def steps_of(path: Path) -> int:
    """The environment steps in a checkpoint's file name; -1 for a name that is none of ours."""
    return int(path.stem) if path.stem.isdecimal() and len(path.stem) <= _DIGITS else -1


class Checkpoints:
    """The checkpoints in a run's folder."""

    def __init__(self, run_folder: Path) -> None:
        self.folder = run_folder / CHECKPOINTS
        self.newest: int | None = None  # steps at the one that this process wrote last, or resumed from

    def save(self, steps: int, state: State, durable: bool = True, small: bool = False) -> None:
        """Write the state after so many environment steps, and remove the oldest checkpoint.

        An `OSError` leaves the ones before. `durable` makes it survive a power cut; `small` takes longer.
        """
        check_no_link(self.folder)
        self.folder.mkdir(exist_ok=True)
        write_bytes(self._path(steps), encode(state, compress=small), durable)
        if durable:
            sync_folder(self.folder.parent)
        self.newest = steps
        self.keep(_KEPT)

    def keep(self, count: int) -> None:
        """Remove all but the `count` newest."""
        for old in self.files()[count:]:
            remove_path(old)

    def files(self) -> list[Path]:
        """The files, newest first; refuses a folder that is a link: what it leads to is another's."""
        check_no_link(self.folder)
        return sorted(self.folder.glob(f"[0-9]*{_SUFFIX}"), reverse=True)

    def states(self) -> Iterator[tuple[Path, State | StateError]]:
        """Each file, newest first, with its state, or why it cannot be read."""
        for path in self.files():
            try:
                yield path, decode(read_bytes(path, _MOST_BYTES), path)
            except BudgetError:
                raise
            except (InputError, StateError) as error:
                yield path, StateError(str(error).removeprefix(f"{path}: "))

    def forget_after(self, steps: int) -> None:
        """Remove the checkpoints of more than `steps` environment steps, from which the run is resumed."""
        for path in self.files():
            if path.name > self._path(steps).name:
                remove_path(path)
        self.newest = steps

    def _path(self, steps: int) -> Path:
        return self.folder / f"{steps:012}{_SUFFIX}"


class Pace:
    """When the next checkpoint is due: every so many steps; None: never; "auto": as `_MOST_SHARE` allows."""

    def __init__(self, every: int | str | None, steps: int = 0) -> None:
        self.never = every is None
        self._every = every if isinstance(every, int) else None
        self._last = steps
        self._at = clock() + _LEAST_SECONDS

    def is_due(self, steps: int) -> bool:
        """Whether a checkpoint is due after so many environment steps."""
        if self.never or steps == 0:
            return False
        if self._every is None:
            return clock() >= self._at
        return steps // self._every > self._last // self._every

    def took(self, steps: int, seconds: float) -> None:
        """Note that a checkpoint was written after so many environment steps, and the seconds it took."""
        self._last = steps
        self._at = clock() + max(_LEAST_SECONDS, seconds / _MOST_SHARE)
