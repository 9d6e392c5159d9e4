"""Putting the files of a run back as they were, where it cannot be resumed or made longer after all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gridworld.errors import InputError
from gridworld.run.checkpoints import Checkpoints
from gridworld.run.folder import CURVE, ERROR_FILE, EVALUATIONS, EVENTS, MANIFEST
from gridworld.run.reader import RunReader
from gridworld.storage.atomic_write import write_bytes
from gridworld.storage.safe_read import open_ordinary
from gridworld.storage.serialization import State

# What changes before training is over; the manifest is the last to be put back.
_CHANGED = (CURVE, EVENTS, EVALUATIONS, ERROR_FILE, "source*.diff", MANIFEST)


class FilesBefore:
    """The files that resuming a run changes until training is over, as they are now.

    Args:
        run: The run.
        state: The checkpoint. Of the files that grow, what is before its marks does not change.

    Attributes:
        steps: Environment steps at the checkpoint.
    """

    def __init__(self, run: RunReader, state: State) -> None:
        self._run, self._folder = run, run.folder
        self.steps = int(state["steps"])
        marks = state["marks"]
        lengths = {mark["name"]: mark["length"] for mark in marks.values() if mark is not None}
        self._ends: dict[Path, tuple[int, bytes]] = {}
        for path in self._files():
            with open_ordinary(path) as file:
                length = file.seek(lengths.get(path.name, 0))
                self._ends[path] = length, file.read()

    def has_result(self) -> bool:
        """Whether the run was finished, and the files that hold its result still do so."""
        if not self._run.is_finished:
            return False
        try:
            for path in self._run.results():
                if path.name not in _CHANGED:
                    self._run.verify(path)
        except (InputError, OSError):
            return False
        return True

    def put_back(self) -> None:
        """Write what has changed since as it was, and remove the checkpoints that were added.

        Raises:
            OSError: A file cannot be written.
        """
        Checkpoints(self._folder).forget_after(self.steps)
        for path in self._files():
            if path not in self._ends:
                path.unlink()
        for path, (length, end) in self._ends.items():
            beginning = path.read_bytes()[:length] if length else b""
            write_bytes(path, beginning + end, durable=True)

    def _files(self) -> Iterator[Path]:
        for pattern in _CHANGED:
            yield from (path for path in self._folder.glob(pattern) if path.is_file())
