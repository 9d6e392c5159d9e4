"""Output to a terminal, a file or a pipe: printing never fails, and names from files act on no terminal.

A command goes on when a reader leaves (`| head`), a terminal is hung up, a disk is full, or the locale cannot
encode a character, which is then printed as `\\xNN`: a run is not lost to its own messages. A command whose
result is what it prints fails at its end if that could not be written, unless the reader left.
"""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from gridworld.errors import InputError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_LONGEST = 2000  # characters of a message

TOLD = logging.getLogger("gridworld.told")  # has what `tell` prints, for a run's log
TOLD.setLevel(logging.INFO)
TOLD.propagate = False


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


def _prepared(stream: TextIO | None, original: TextIO | None, number: int) -> TextIO:
    if stream is None:  # it was closed when the process began
        return open(os.devnull, "w", encoding="utf-8")
    if stream is not original or not isinstance(stream, io.TextIOWrapper):
        return stream  # somebody has replaced it
    stream.flush()
    raw = _Forgiving(number, "w", closefd=False)
    raw.is_result = number == 1 and not stream.isatty()  # a terminal that is hung up has no reader
    lines = number == 2 or stream.isatty()
    return io.TextIOWrapper(
        io.BufferedWriter(raw), stream.encoding, errors="backslashreplace", line_buffering=lines
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
