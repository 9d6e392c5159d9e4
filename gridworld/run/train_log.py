"""`train.log`: when a run began and ended, and all that was warned about or told meanwhile, a line each."""

from __future__ import annotations

import contextlib
import logging
import os
import warnings
from contextvars import ContextVar
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self, TextIO

from gridworld.errors import FolderLostError
from gridworld.process.console.terminal import TOLD, plain
from gridworld.storage.file_lock import check_ours
from gridworld.storage.system_calls import open_carefully

_printed: set[tuple[str, str, str, int]] = set()  # warnings that this process has printed


class TrainLog(logging.Handler):
    """Takes Python's warnings, what is logged as one, and what is told on standard error, inside its block.

    The lines are kept until there is a file. What goes to the terminal is the same as without it. Of runs
    that train together (`training.together`), each has its own, which takes what comes while its
    run is at work.
    """

    _all: ClassVar[list[TrainLog]] = []  # inside whose blocks the process is
    _show: ClassVar[Any]  # what Python warns with otherwise

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._lines: list[str] = []
        self._path: Path | None = None

    def __enter__(self) -> Self:
        root = logging.getLogger()
        others = [handler for handler in root.handlers if not isinstance(handler, TrainLog)]
        self._is_alone = not others  # then Python prints warnings only while there is no handler
        for logger in (root, TOLD):
            logger.addHandler(self)
        with warnings.catch_warnings():  # forgets what was warned about before, in another run
            pass
        if not self._all:
            TrainLog._show = warnings.showwarning
            warnings.showwarning = _warn
        self._all.append(self)
        self._token = _current.set(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _current.reset(self._token)
        self._all.remove(self)
        if not self._all:
            warnings.showwarning = TrainLog._show
        for logger in (logging.getLogger(), TOLD):
            logger.removeHandler(self)

    def open(self, path: Path) -> None:
        """Append to a file from here on, beginning with what was kept."""
        self._path = path
        lines, self._lines = self._lines, []
        self._append("".join(lines))

    def add(self, text: str, level: str = "INFO") -> None:
        """Append a line."""
        self._append(f"{datetime.now(UTC).isoformat(timespec='seconds')} {level} {plain(text)}\n")

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        if self._at_work() is not self:
            return
        if record.name != TOLD.name and record.levelno < logging.WARNING:
            return
        self.add(record.getMessage(), record.levelname)
        last = logging.lastResort
        has_handler = not self._is_alone or logging.getLogger(record.name).handlers
        if last is not None and record.levelno >= last.level and not has_handler:
            last.handle(record)

    @classmethod
    def _at_work(cls) -> TrainLog | None:
        """The log of the run that is at work here; in a thread, of the only one, if it is the only one."""
        return _current.get() or (cls._all[0] if len(cls._all) == 1 else None)

    def _append(self, text: str) -> None:
        if self._path is None:
            self._lines.append(text)
            return
        with contextlib.suppress(OSError, FolderLostError):  # which are told elsewhere
            check_ours(self._path)
            with open(open_carefully(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), "ab") as file:
                file.write(text.encode("utf-8", "backslashreplace"))


_current: ContextVar[TrainLog | None] = ContextVar("current", default=None)  # of the run that is at work


def _warn(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Stands for `warnings.showwarning` while a log is open."""
    if (log := TrainLog._at_work()) is not None:
        log.add(f"{category.__name__}: {message} ({filename}, line {lineno})", "WARNING")
    key = (str(message), category.__name__, filename, lineno)
    if key not in _printed:
        _printed.add(key)
        TrainLog._show(message, category, filename, lineno, file, line)
