"""Talking to whoever reads: a terminal, a file, a pipe that may be closed, a locale that knows no UTF-8.

What a command prints is the least of what it does. So nothing that happens to its output ends it: a reader
that leaves (`| head`), a terminal that is hung up, a full disk, or a sign that the locale cannot write,
which is then printed as `\\xNN`. And names that come out of files cannot act on the terminal.
"""

from __future__ import annotations

import io
import logging
import os
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_LONGEST = 2000  # characters of a message


class _Forgiving(io.FileIO):
    """A file descriptor that takes everything, also when nobody reads it any more."""

    def write(self, content: ReadableBuffer, /) -> int:
        try:
            return super().write(content)
        except OSError:
            return memoryview(content).nbytes


def prepare() -> None:
    """Make standard output and standard error of this process such that printing to them cannot fail."""
    logging.getLogger("gridworld").addFilter(_make_printable)
    sys.stdout = _prepared(sys.stdout, sys.__stdout__, 1)
    sys.stderr = _prepared(sys.stderr, sys.__stderr__, 2)


def _prepared(stream: TextIO | None, original: TextIO | None, number: int) -> TextIO:
    if stream is None:  # it was closed before the process began
        return open(os.devnull, "w", encoding="utf-8")
    if stream is not original or not isinstance(stream, io.TextIOWrapper):
        return stream  # somebody has put an own one in its place
    stream.flush()
    raw = _Forgiving(number, "w", closefd=False)
    lines = number == 2 or stream.isatty()
    return io.TextIOWrapper(
        io.BufferedWriter(raw), stream.encoding, errors="backslashreplace", line_buffering=lines
    )


def printable(text: str) -> str:
    """A line without signs that move the cursor, change colours or break it, and of bounded length.

    Whatever a command prints goes through this if it has a name in it that is not the program's own: of a
    folder, a job, a map or an agent, out of a file or an error.
    """
    shown = plain(text)
    return shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]} ..."


def plain(text: str) -> str:
    """The same of any length."""
    return text if text.isprintable() else "".join(map(_plain_sign, text))


def _plain_sign(sign: str) -> str:
    return sign if sign.isprintable() else repr(sign)[1:-1]


def _make_printable(record: logging.LogRecord) -> bool:
    record.msg, record.args = printable(record.getMessage()), ()
    return True


def tell_error(text: str) -> None:
    """A mistake, in one line on standard error."""
    print(f"error: {printable(text)}", file=sys.stderr)
