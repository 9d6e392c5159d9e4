"""A command as its user meets it: what it is called, what it prints, how far it is.

Printing never fails. A command continues when a reader leaves (`| head`), a terminal is hung up, a disk is
full, or the locale cannot encode a character, which is then printed as `\\xNN`: a run is not lost to its own
messages. A command fails at its end if there was no room for what it printed. Names from files are escaped,
so that none acts on a terminal.
"""

from __future__ import annotations

import errno
import gc
import io
import logging
import os
import re
import shlex
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from gridworld.base.errors import InputError
from gridworld.base.user_input import is_limited, users_folder

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

CONSOLE = "gridworld"
_SCRIPTS = Path(__file__).parents[2] / "scripts"
_SCRIPT = re.compile(r"(?:python )?(?:scripts/)?\b([a-z]+)\.py(?!\w)")

_LONGEST = 2000  # characters of a message
_SECONDS_BETWEEN_LINES = 5.0
_SIZE_OF_NOTEBOOK = (120, 1)
_OBJECTS_BETWEEN_COLLECTIONS = 50_000  # 700 is Python's own, and takes a sixth of the time of a short run
_NO_READER = (errno.EPIPE, errno.EIO)  # it left, or its terminal was hung up
_failures: list[OSError] = []  # to write to standard output

TOLD = logging.getLogger("gridworld.told")  # has what `tell` prints, for a run's log
TOLD.setLevel(logging.INFO)
TOLD.propagate = False


def command(name: str) -> str:
    """What to type for a command, as this one was typed: `gridworld train`, `python scripts/train.py`.

    From Python or a program, it is `gridworld train`.
    """
    if not _is_script():
        return f"{CONSOLE} {name}"
    return f"python {shlex.quote(str(Path(sys.argv[0]).with_name(f'{name}.py')))}"


def program(name: str) -> str:
    """A command's short name, for usage lines and messages: `train.py` or `gridworld train`."""
    return f"{name}.py" if _is_script() else f"{CONSOLE} {name}"


def as_called(text: str) -> str:
    """A text that names scripts, such as a manual, with the commands in their place where those are used."""
    return text if _is_script() else _SCRIPT.sub(rf"{CONSOLE} \1", text)


def command_line() -> list[str]:
    """The words with which this process's command was called, to be typed again."""
    first, *rest = sys.argv
    return [*first.split(), *rest] if _is_console_word(first) else ["python", first, *rest]


def recorded_command_line() -> list[str]:
    """The same for a run's records, where the script's folder is of no use."""
    first, *rest = sys.argv
    return [*first.split(), *rest] if _is_console_word(first) else [Path(first).name, *rest]


def _is_script() -> bool:
    return (users_folder() / sys.argv[0]).resolve().parent == _SCRIPTS.resolve()


def _is_console_word(first: str) -> bool:
    """Whether `sys.argv[0]` is of the console command, which writes e.g. `gridworld train` there."""
    return first.startswith(f"{CONSOLE} ")


class _Forgiving(io.FileIO):
    """Standard output or standard error: its `write` never fails, and notes where there is no room."""

    def write(self, content: ReadableBuffer, /) -> int:
        try:
            return super().write(content)
        except OSError as error:
            if self.fileno() == 1 and error.errno not in _NO_READER:
                _failures.append(error)
            return memoryview(content).nbytes


def prepare() -> None:
    """Let printing not fail in this process (see the module), and look for garbage less often."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    logging.getLogger("gridworld").addFilter(_make_printable)
    sys.stdout = _prepared(sys.stdout, sys.__stdout__, 1)
    sys.stderr = _prepared(sys.stderr, sys.__stderr__, 2)


def _prepared(stream: TextIO | None, original: TextIO | None, number: int) -> TextIO:
    if stream is None:  # it was closed when the process began
        return open(os.devnull, "w", encoding="utf-8")
    if stream is not original or not isinstance(stream, io.TextIOWrapper):
        return stream  # somebody has replaced it
    stream.flush()
    lines = number == 2 or stream.isatty()
    buffer = io.BufferedWriter(_Forgiving(number, "w", closefd=False))
    return io.TextIOWrapper(buffer, stream.encoding, errors="backslashreplace", line_buffering=lines)


@contextmanager
def printing() -> Iterator[None]:
    """Flush the output at the end of the block, and refuse one for which there was no room."""
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        if _failures:
            raise InputError(
                f"standard output: cannot be written ({_failures[0].strerror}), so the output is "
                "incomplete; write it to a disk with free space"
            )


def printable(text: str) -> str:
    """Escape what would move a terminal's cursor, change its colours or begin a line, and bound the length.

    For whatever a command prints that has a name in it from outside: of a folder, a job, a map or an agent,
    from a file or an error.
    """
    shown = plain(text)
    return shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]} ..."


def plain(text: str) -> str:
    """`printable` for text of any length."""
    if text.isprintable():
        return text
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in text)


def _make_printable(record: logging.LogRecord) -> bool:
    record.msg, record.args = printable(record.getMessage()), ()
    return True


def coloured(verdict: str, is_good: bool) -> str:
    """A verdict, on a terminal green or red; plain in a pipe or a file, and where `NO_COLOR` is set."""
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not sys.stdout.isatty():
        return verdict
    return f"\x1b[{32 if is_good else 31}m{verdict}\x1b[0m"


def tell(text: str) -> None:
    """Print a note on a run as one line on standard error, and log it."""
    print(printable(text), file=sys.stderr)
    TOLD.info("%s", text)


def tell_error(text: str) -> None:
    """Print a mistake as one line on standard error."""
    print(f"error: {printable(text)}", file=sys.stderr)


def aligned(rows: Sequence[Sequence[str]], columns: Sequence[str]) -> list[str]:
    """Align cells in columns that are a blank apart, a line for each row.

    `columns` says for each "<" to align left (words) or ">" right (numbers), and its least width, as ">9".
    """
    forms = [
        f"{column[0]}{max([int(column[1:]), *(len(row[index]) for row in rows)])}"
        for index, column in enumerate(columns)
    ]
    return [" ".join(map(format, row, forms)).rstrip() for row in rows]


class ProgressLine:
    """A line that may be offered at any time, and is printed when it is due; never if not `enabled`.

    On a terminal and in a notebook it is rewritten in place; elsewhere a new one is printed now and then.
    """

    def __init__(self, enabled: bool, seconds_between_lines: float = 10.0) -> None:
        self._enabled = enabled
        self._seconds_between_lines = seconds_between_lines
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        self._in_place = sys.stderr.isatty() or "IPKernelApp" in getattr(shell, "config", {})
        self._printed = time.monotonic()
        self._shown = ""

    def show(self, text: Callable[[], str]) -> None:
        """Print the line that `text` returns, which is called if one is due.

        Where it is too long, it lacks its label, and then its last parts.
        """
        if self._enabled and self._in_place:
            line, room = text(), shutil.get_terminal_size(_SIZE_OF_NOTEBOOK).columns - 1
            line = line if len(line) <= room else line.split(": ", 1)[-1]
            while len(line) > room and ", " in line:
                line = line.rpartition(", ")[0]
            line = line[:room]
            print(f"\r{line:<{len(self._shown)}}", end="", file=sys.stderr, flush=True)
            self._shown = line
        elif self._enabled and time.monotonic() - self._printed >= self._seconds_between_lines:
            self._printed = time.monotonic()
            print(text(), file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Remove the line from a terminal."""
        if self._shown:
            print(f"\r{'':{len(self._shown)}}\r", end="", file=sys.stderr, flush=True)
            self._shown = ""

    def close(self) -> None:
        """Leave the line on a terminal as it is, and begin another."""
        if self._shown:
            print(file=sys.stderr)


class Progress(ProgressLine):
    """Progress of a run in environment steps."""

    def __init__(self, total: int, label: str, enabled: bool = True) -> None:
        super().__init__(enabled, _SECONDS_BETWEEN_LINES)
        self._total, self._label = total, printable(label)
        self._first = (0, 0.0)  # the step and the moment of the first update

    def update(self, step: int, note: str) -> None:
        """Show that `step` steps are done; `note` says how it goes."""
        total, now = max(self._total, step), time.monotonic()  # it trains by whole rollouts
        self._first = self._first if self._first[1] else (step, now)
        first, begun = self._first
        left = time_left(step - first, total - step, now - begun) if step < total else ""
        self.show(lambda: f"{self._label}: step {step:,} of {total:,} ({step / total:.0%}){left}, {note}")


_is_telling: ContextVar[bool] = ContextVar("is_telling", default=False)


@contextmanager
def telling_if_slow(what: str) -> Iterator[None]:
    """Print every few seconds that the block is still at work on `what`, if memory is limited.

    That is so for commands that read what somebody else may have written (`user_input`). Within another
    such block only the outer one prints.
    """
    if not is_limited() or _is_telling.get():
        yield
        return
    token, began = _is_telling.set(True), time.monotonic()

    def tell_seconds() -> None:
        seconds = time.monotonic() - began
        print(f"{printable(what)}: {seconds:.0f} s so far; Ctrl-C ends it", file=sys.stderr, flush=True)

    try:
        with repeating(_SECONDS_BETWEEN_LINES, tell_seconds):
            yield
    finally:
        _is_telling.reset(token)


@contextmanager
def repeating(seconds: float, call: Callable[[], None]) -> Iterator[None]:
    """Call a function every so many seconds, in a thread, while the block runs."""
    over = threading.Event()

    def work() -> None:
        while not over.wait(seconds):
            call()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def time_left(done: int, to_do: int, seconds: float) -> str:
    """How long the rest may take if `done` parts took `seconds`, e.g. ", about 30 s left"; "" for none."""
    return f", about {duration(to_do * seconds / done)} left" if done > 0 else ""


def duration(seconds: float) -> str:
    """A time in the one or two units that say enough, e.g. "3 min 20 s"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
