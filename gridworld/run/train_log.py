"""`train.log`: when a run began and ended, and all that was warned about or told meanwhile, a line each."""

from __future__ import annotations

import contextlib
import logging
import warnings
from contextvars import ContextVar
from datetime import UTC, datetime
from logging.handlers import MemoryHandler
from pathlib import Path
from typing import ClassVar, Self

from gridworld.process.console.terminal import TOLD, plain
from gridworld.storage.atomic_write import remove_path

_WARNINGS = "py.warnings"  # the logger to which Python's warnings are sent
_printed: set[str] = set()  # warnings that this process has printed


class TrainLog:
    """Takes Python's warnings, what is logged as one, and what is told on standard error, inside its block.

    The lines are kept until there is a file. What goes to the terminal is the same as without it. Of runs
    that train together (`training.together`), each has its own, which takes what comes while its
    run is at work.
    """

    _all: ClassVar[list[TrainLog]] = []  # inside whose blocks the process is

    def __init__(self) -> None:
        self._handler = MemoryHandler(1)  # keeps everything until it has a target
        self._handler.addFilter(self._takes)

    def __enter__(self) -> Self:
        for logger in (logging.getLogger(), TOLD):
            logger.addHandler(self._handler)
        with warnings.catch_warnings():  # forgets what was warned about before, in another run
            pass
        logging.captureWarnings(True)
        self._all.append(self)
        self._token = _current.set(self)
        return self

    def __exit__(self, *error: object) -> None:
        _current.reset(self._token)
        self._all.remove(self)
        logging.captureWarnings(bool(self._all))
        for logger in (logging.getLogger(), TOLD):
            logger.removeHandler(self._handler)
        if self._handler.target is not None:
            self._handler.target.close()

    def open(self, path: Path) -> None:
        """Append to a file from here on, beginning with what was kept."""
        with contextlib.suppress(OSError):  # which are told elsewhere
            if path.is_symlink() or not path.is_file():
                remove_path(path)
            file = logging.FileHandler(path, encoding="utf-8", errors="backslashreplace")
            file.setFormatter(_Lines())
            file.handleError = lambda record: None  # type: ignore[method-assign]
            self._handler.setTarget(file)
            self._handler.flush()

    def add(self, text: str, level: int = logging.INFO) -> None:
        """Append a line."""
        self._handler.emit(TOLD.makeRecord(TOLD.name, level, "", 0, text, (), None))

    def _takes(self, record: logging.LogRecord) -> bool:
        """Whether a record is for this run's log; what would be printed without the log still is."""
        # In a thread, the log of the only run is meant, if there is one only.
        at_work = _current.get() or (self._all[0] if len(self._all) == 1 else None)
        if at_work is not self or (record.name != TOLD.name and record.levelno < logging.WARNING):
            return False
        text, last = record.getMessage(), logging.lastResort
        handlers = [*logging.getLogger().handlers, *logging.getLogger(record.name).handlers]
        others = [each for each in handlers if not isinstance(each, MemoryHandler | logging.NullHandler)]
        is_new = record.name != _WARNINGS or text not in _printed
        if record.name == _WARNINGS:
            _printed.add(text)
        if last is not None and record.levelno >= last.level and not others and is_new:
            last.handle(record)
        return True


class _Lines(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        return f"{now} {record.levelname} {plain(record.getMessage().strip())}"


_current: ContextVar[TrainLog | None] = ContextVar("current", default=None)  # of the run that is at work
