"""TensorBoard's event file: a sequence of events, each framed by its length and checksums.

A record is the length (8 bytes, little-endian), the length's checksum (4), the serialised event, and its
checksum (4). A checksum is CRC-32C, rotated and shifted by a constant, so that a record inside a record is
not taken for one. TensorBoard's own writer has a thread and a checksum in pure Python, which takes as long
for a picture as two evaluations, and it cannot truncate its file when a run is resumed.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import google_crc32c
from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary

from gridworld.errors import InputError
from gridworld.process.memory_budget import check_memory
from gridworld.storage.append_log import AppendLog
from gridworld.storage.safe_read import open_ordinary

_AS_EVENT = 48  # bytes of memory that a byte of a record may come to, in a list of empty values
_HEADER, _FOOTER = 12, 4  # bytes before and after an event
_VERSION = "brain.Event:2"
_MASK_DELTA = 0xA282EAD8


def read_scalars(path: Path) -> Iterator[tuple[str, int, float]]:
    """Read (tag, step, value) of an event file's scalars, in the order in which they were written."""
    with open_ordinary(path) as file:
        size = os.fstat(file.fileno()).st_size
        while (start := file.tell()) < size:
            try:
                event = Event.FromString(_record(file, size, path))
            except DecodeError:
                raise InputError(f"{path}: is damaged or cut off after {start:,} bytes") from None
            for value in event.summary.value:
                if value.HasField("simple_value"):
                    yield value.tag, event.step, value.simple_value


def _record(file: BinaryIO, size: int, path: Path) -> bytes:
    frame = file.read(_HEADER)
    if len(frame) < _HEADER or _checksum(frame[:8]) != frame[8:]:
        raise DecodeError
    length: int = struct.unpack("<Q", frame[:8])[0]
    if length > size - file.tell():
        raise DecodeError
    check_memory(path, _AS_EVENT * length)
    record = file.read(length)
    if _checksum(record) != file.read(_FOOTER):
        raise DecodeError
    return record


class EventFile:
    """An event file that is open for writing: a new one in `folder`, or that of `mark` (see `AppendLog`)."""

    def __init__(self, folder: Path, mark: dict[str, Any] | None = None) -> None:
        now = time.time()
        name = f"events.out.tfevents.{int(now)}.{os.uname().nodename}.{os.getpid()}"
        self.journal = AppendLog(folder / (name if mark is None else mark["name"]), mark)
        if mark is None:
            self._write(Event(wall_time=now, file_version=_VERSION))

    def add(self, summary: Summary, step: int) -> None:
        """Append an event with the present time."""
        self._write(Event(wall_time=time.time(), step=step, summary=summary))

    def close(self) -> None:
        self.journal.close()

    def _write(self, event: Event) -> None:
        content = event.SerializeToString()
        length = struct.pack("<Q", len(content))
        self.journal.append(b"".join([length, _checksum(length), content, _checksum(content)]))


def _checksum(content: bytes) -> bytes:
    crc = google_crc32c.value(content)
    rotated = crc >> 15 | crc << 17
    return struct.pack("<I", rotated + _MASK_DELTA & 0xFFFFFFFF)
