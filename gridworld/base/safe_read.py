"""Reading files that somebody else may have written, within bounds and without following links.

A file is read only if it is a regular file of bounded size: not through a symbolic link, which could lead to
any file of the reader's, and not a pipe or a device, which need not end. JSON nests a hundred levels at most,
and its numbers fit into 64 bits. Nothing is resolved, imported or unpickled. Every function raises
`InputError`, with a sentence that names the file, and `BudgetError` where it would take too much memory.

JSON may have a seal, which is a checksum over all of its content. A seal finds damage and changes. It finds
no forgery: whoever writes a file can seal it. In CSV no cell is a formula to a spreadsheet: a text that
begins as one, and is no number, is written behind an apostrophe, as spreadsheets do it themselves.
"""

from __future__ import annotations

import csv
import errno
import hashlib
import io
import json
import math
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, cast

from gridworld.base.bounds import LARGEST_INTEGER
from gridworld.base.console import plain
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory

LARGEST_JSON = 4 * 2**20  # bytes
LARGEST_CSV = 64 * 2**20
FORMAT = 2  # of sealed JSON
_DEEPEST = 100  # levels of JSON; what reads it further may call itself for each
# Bytes of memory that a byte of text may come to as Python's objects: short strings in short lists.
_AS_CSV, AS_JSON = 64, 48
_FORMULA = re.compile(r"'*[=+\-@\uff1d\uff0b\uff0d\uff20]")  # the last four are as wide as Chinese signs


def open_ordinary(path: Path, mode: str = "rb", most: float = math.inf) -> BinaryIO:
    """Open a regular file of at most `most` bytes; "r+b" to write to it, too, without a buffer."""
    try:  # without O_NONBLOCK, opening a pipe waits for somebody to write into it
        flags = (os.O_RDONLY if mode == "rb" else os.O_RDWR) | os.O_NOFOLLOW | os.O_NONBLOCK
        descriptor = os.open(path, flags)
    except FileNotFoundError:
        raise InputError(f"{path.parent}: has no {path.name}") from None
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise InputError(f"{path}: is a symbolic link, which is not followed out of a run") from None
        what = "read" if mode == "rb" else "written"
        raise InputError(f"{path}: cannot be {what} ({error.strerror})") from None
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and found.st_size <= most:
        return cast("BinaryIO", open(descriptor, mode, buffering=-1 if mode == "rb" else 0))
    os.close(descriptor)
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{path}: is not an ordinary file")
    size = f"{most / 2**20:,.0f} MiB" if most >= 2**20 else f"{most:,} bytes"
    raise InputError(f"{path}: is larger than {size}")


def read_bytes(path: Path, most: int, copies: int = 1) -> bytes:
    """Read a whole file of at most `most` bytes, of which `copies` will be in memory."""
    with open_ordinary(path, most=most) as file:
        check_memory(path, copies * os.fstat(file.fileno()).st_size)
        try:
            return file.read(most)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def read_table(path: Path) -> str:
    """Read the text of a table (CSV) of at most `LARGEST_CSV` bytes."""
    return as_table(read_bytes(path, LARGEST_CSV), path)


def read_object(path: Path, most: int = LARGEST_JSON) -> dict[str, Any]:
    """Read a JSON object from a file of at most `most` bytes."""
    return as_object(read_bytes(path, most), path)


def as_text(content: bytes, path: Path) -> str:
    """Decode UTF-8; `path` is for the error's sentence."""
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path}: cannot be read, it is not UTF-8 text") from None


def as_table(content: bytes, path: Path) -> str:
    """Decode a table (CSV) that will be parsed into rows and cells; `path` is for the error's sentence."""
    check_memory(path, _AS_CSV * len(content))
    return as_text(content, path)


def as_object(content: bytes, path: Path) -> dict[str, Any]:
    """Parse a JSON object; `path` is for the error's sentence."""
    check_memory(path, AS_JSON * len(content))
    text = as_text(content, path)
    try:
        found = json.loads(text, parse_constant=_number, parse_float=_number, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON, it was changed or cut off ({error})") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: must be a JSON object")
    if _is_deeper(found, _DEEPEST):
        raise InputError(f"{path}: is nested too deeply, more than {_DEEPEST} levels")
    return found


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:20]} is too large, or not a number")
    return number


def _whole(text: str) -> int:
    number = int(text)
    if abs(number) >= LARGEST_INTEGER:
        raise ValueError(f"{text[:20]}... is too large a number")
    return number


def _is_deeper(content: Any, most: int) -> bool:
    inner = content.values() if isinstance(content, dict) else content
    return most == 0 or any(_is_deeper(each, most - 1) for each in inner if isinstance(each, dict | list))


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its format and its seal; those that it had are replaced."""
    whole = {"format": FORMAT} | {key: content[key] for key in content if key not in ("format", "seal")}
    return whole | {"seal": _seal(json.loads(json.dumps(whole)))}  # as it will be read


def read_sealed(path: Path) -> dict[str, Any]:
    """Read the JSON object in a file and check its seal."""
    content = read_object(path)
    found = content.get("format")
    if type(found) is not int or found != FORMAT:
        raise InputError(
            f"{path}: has format {str(found)[:20]}, this version reads {FORMAT}; "
            "was it made by an older version?"
        )
    if content.get("seal") != _seal(content):
        raise InputError(
            f"{path}: was changed or damaged: its seal does not match its content; restore a good copy"
        )
    return content


def _seal(content: Mapping[str, Any]) -> str:
    unsealed = {key: value for key, value in content.items() if key != "seal"}
    return sha256(json.dumps(unsealed, sort_keys=True).encode())


def check_no_link(path: Path) -> None:
    """Refuse a path that is a symbolic link, which writing would follow."""
    if path.is_symlink():
        raise InputError(f"{path}: is a symbolic link, which is not written through; remove it")


def sha256(content: bytes) -> str:
    """SHA-256 as hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


def file_sha256(path: Path, most: int) -> str:
    """SHA-256 of a file of at most `most` bytes, which is not held in memory."""
    with open_ordinary(path, most=most) as file:
        return hashlib.file_digest(cast("io.BufferedReader", file), "sha256").hexdigest()


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as the text of a file, a line each."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_cell, row) for row in rows)
    return text.getvalue()


def csv_rows(text: str) -> Iterator[list[str]]:
    """The rows that `csv_text` was given. Raises `csv.Error`."""
    for row in csv.reader(io.StringIO(text)):
        yield [cell[cell.startswith("'") and _FORMULA.match(cell) is not None :] for cell in row]


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return value
    text = plain(value)
    try:
        float(text)
    except ValueError:
        return f"'{text}" if _FORMULA.match(text) else text
    return text
