"""A command as its user meets it: what it is called, what it prints, how far it is.

Printing never fails. A command continues when a reader leaves (`| head`), a terminal is hung up, a disk is
full, or the locale cannot encode a character, which is then printed as `\\xNN`: a run is not lost to its own
messages. A command whose result is what it prints fails at its end if that could not be written, unless the
reader left. Names from files are escaped, so that none acts on a terminal.
"""

from __future__ import annotations

import errno
import io
import logging
import os
import re
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from gridworld.errors import InputError
from gridworld.process.memory_budget import is_limited

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

CONSOLE = "gridworld"
_called_from: list[Path] = []  # nothing, or the folder that `called_from` names
_SCRIPTS = Path(__file__).parents[2] / "scripts"
_SCRIPT = re.compile(r"(?:python )?(?:scripts/)?\b(train|tune|record|report|evaluate|jobs|play|check)\.py")

_LONGEST = 2000  # characters of a message
_SECONDS_BETWEEN_LINES = 5.0
_CLEAR_TO_END = "\x1b[K"

TOLD = logging.getLogger("gridworld.told")  # has what `tell` prints, for a run's log
TOLD.setLevel(logging.INFO)
TOLD.propagate = False


def command(name: str) -> str:
    """What the user types for a command: `gridworld train`, or in a checkout `python scripts/train.py`."""
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


def _is_console() -> bool:
    return _is_console_word(sys.argv[0]) or not (_SCRIPTS / "train.py").is_file()


def _is_console_word(first: str) -> bool:
    """Whether `sys.argv[0]` is of the console command, which writes e.g. `gridworld train` there."""
    return first.startswith(f"{CONSOLE} ")


@contextmanager
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


class _Forgiving(io.FileIO):
    """A file whose `write` never fails, and which keeps the first error other than a closed pipe."""

    failure: OSError | None = None
    is_result = False  # whether the command is for what it prints

    def write(self, content: ReadableBuffer, /) -> int:
        try:
            return super().write(content)
        except OSError as error:
            if error.errno != errno.EPIPE:
                self.failure = self.failure or error
            return memoryview(content).nbytes


def prepare() -> None:
    """Let printing to standard output and standard error not fail in this process; see the module."""
    logging.getLogger("gridworld").addFilter(_make_printable)
    sys.stdout = _prepared(sys.stdout, sys.__stdout__, 1)
    sys.stderr = _prepared(sys.stderr, sys.__stderr__, 2)


def _prepared(stream: TextIO | None, original: TextIO | None, number: int) -> TextIO:
    if stream is None:  # it was closed when the process began
        return open(os.devnull, "w", encoding="utf-8")
    if stream is not original or not isinstance(stream, io.TextIOWrapper):
        return stream  # somebody has replaced it
    stream.flush()
    raw = _Forgiving(number, "w", closefd=False)
    raw.is_result = number == 1 and not stream.isatty()  # a terminal that is hung up has no reader
    lines = number == 2 or stream.isatty()
    buffer = io.BufferedWriter(raw)
    return io.TextIOWrapper(buffer, stream.encoding, errors="backslashreplace", line_buffering=lines)


def result_is_in_files() -> None:
    """Note that this command's result is the files that it writes, and not what it prints."""
    if output := _output():
        output.is_result = False


@contextmanager
def printing() -> Iterator[None]:
    """Refuse at the end of the block, also of one that exits, a result that could not be printed."""
    try:
        yield
    except SystemExit:
        _check_output()
        raise
    _check_output()


def _check_output() -> None:
    sys.stdout.flush()
    output = _output()
    if output and output.failure and output.is_result:
        raise InputError(
            f"standard output: cannot be written ({output.failure.strerror}), what was printed is not "
            "complete; send it to where there is room"
        )


def _output() -> _Forgiving | None:
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return raw if isinstance(raw, _Forgiving) else None


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


def tell(text: str) -> None:
    """Print a note on a run as one line on standard error, and log it."""
    print(printable(text), file=sys.stderr)
    TOLD.info("%s", text)


def tell_error(text: str) -> None:
    """Print a mistake as one line on standard error."""
    print(f"error: {printable(text)}", file=sys.stderr)


def aligned(rows: Sequence[Sequence[str]], columns: Sequence[str]) -> list[str]:
    """Align cells in columns that are at least a blank apart, a line for each row.

    Args:
        rows: the cells, as many in every row as there are `columns`.
        columns: for each, "<" to align left (words) or ">" to align right (numbers), and its least width,
            e.g. ">9". A column is as wide as its widest cell.
    """
    forms = [
        f"{column[0]}{max([int(column[1:]), *(len(row[index]) for row in rows)])}"
        for index, column in enumerate(columns)
    ]
    return [" ".join(map(format, row, forms)).rstrip() for row in rows]


class ProgressLine:
    """A line that may be offered at any time, and is printed when it is due; never if not `enabled`.

    On a terminal it is rewritten in place; elsewhere a new one is printed now and then.
    """

    def __init__(self, enabled: bool, seconds_between_lines: float = 10.0) -> None:
        self._enabled = enabled
        self._seconds_between_lines = seconds_between_lines
        self._terminal = sys.stderr.isatty()
        self._printed = time.monotonic()
        self._shown = ""

    def show(self, text: Callable[[], str]) -> None:
        """Print the line that `text` returns; it is called only if a line is due."""
        if self._enabled and self._terminal:
            line = text()
            if line != self._shown:
                self._shown = line
                print(f"\r{line}{_CLEAR_TO_END}", end="", file=sys.stderr, flush=True)
        elif self._enabled and time.monotonic() - self._printed >= self._seconds_between_lines:
            self._printed = time.monotonic()
            print(text(), file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Remove the line from a terminal."""
        if self._shown:
            print(f"\r{_CLEAR_TO_END}", end="", file=sys.stderr, flush=True)


class Progress:
    """Progress of a run in environment steps: a bar on a terminal or in a notebook, lines elsewhere."""

    def __init__(self, total: int, label: str, enabled: bool = True) -> None:
        self._total = total
        self._label = printable(label)
        self._line = ProgressLine(enabled, _SECONDS_BETWEEN_LINES)
        self._bar: Any = None
        shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        is_notebook = "IPKernelApp" in getattr(shell, "config", {})
        if enabled and (sys.stderr.isatty() or is_notebook):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that there are no widgets, where text does as well
                if is_notebook:
                    from tqdm.auto import tqdm
                else:
                    from tqdm import tqdm
            self._bar = tqdm(total=total, desc=self._label, unit="step", unit_scale=True, dynamic_ncols=True)

    def update(self, step: int, note: str) -> None:
        """Show that `step` steps are done; `note` says how it goes."""
        if self._bar is not None:
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(min(step, self._total) - self._bar.n)
            return
        share = min(step / self._total, 1.0)
        self._line.show(lambda: f"{self._label}: step {step:,} of {self._total:,} ({share:.0%}), {note}")

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()


_is_telling: ContextVar[bool] = ContextVar("is_telling", default=False)


@contextmanager
def telling_if_slow(what: str) -> Iterator[None]:
    """Print every few seconds that the block is still at work on `what`, if memory is limited.

    That is so for commands that read what somebody else may have written (`memory_budget`). Within another
    such block only the outer one prints.
    """
    if not is_limited() or _is_telling.get():
        yield
        return
    token, over, began = _is_telling.set(True), threading.Event(), time.monotonic()

    def tell_now_and_then() -> None:
        while not over.wait(_SECONDS_BETWEEN_LINES):
            seconds = time.monotonic() - began
            print(f"{printable(what)}: {seconds:.0f} s so far; Ctrl-C ends it", file=sys.stderr, flush=True)

    teller = threading.Thread(target=tell_now_and_then, daemon=True)
    teller.start()
    try:
        yield
    finally:
        over.set()
        teller.join()
        _is_telling.reset(token)


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
