"""The file that TensorBoard reads: events one after the other, each framed by its length and checksums.

A record is the length (8 bytes, little-endian), the length's checksum (4), the serialised event, and its
checksum (4). A checksum is CRC-32C, rotated and shifted by a constant, so that a record which holds records
is not taken for one. TensorBoard's own writer does the same from a thread of its own with a checksum in
pure Python, which takes the interpreter from whoever trains: as long as two evaluations for every picture.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import google_crc32c
from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary

from gridworld.data_files import read_bytes
from gridworld.errors import InputError
from gridworld.journal import Journal

LARGEST = 2**28  # bytes of a file that is read
_HEADER, _FOOTER = 12, 4  # bytes before and after an event
_VERSION = "brain.Event:2"
_MASK_DELTA = 0xA282EAD8


def read_scalars(path: Path) -> Iterator[tuple[str, int, float]]:
    """(tag, step, value) of every scalar, in the order in which they were written.

    Raises `InputError` for a file that is too large, cut off or damaged; a record's length is believed only
    as far as there are bytes.
    """
    content = memoryview(read_bytes(path, LARGEST))
    start = 0
    while start < len(content):
        frame = bytes(content[start : start + _HEADER])
        if len(frame) < _HEADER or _checksum(frame[:8]) != frame[8:]:
            raise InputError(f"{path}: is damaged or cut off after {start:,} bytes")
        end = start + _HEADER + struct.unpack("<Q", frame[:8])[0]
        record, checksum = bytes(content[start + _HEADER : end]), bytes(content[end : end + _FOOTER])
        try:
            if _checksum(record) != checksum:
                raise DecodeError
            event = Event.FromString(record)
        except DecodeError:
            raise InputError(f"{path}: is damaged or cut off after {start:,} bytes") from None
        for value in event.summary.value:
            if value.HasField("simple_value"):
                yield value.tag, event.step, value.simple_value
        start = end + _FOOTER


class EventFile:
    """A new event file in `folder`, or with `mark` the one there, cut back to it (`gridworld.journal`)."""

    def __init__(self, folder: Path, mark: dict[str, Any] | None = None) -> None:
        now = time.time()
        name = f"events.out.tfevents.{int(now)}.{socket.gethostname()}.{os.getpid()}"
        self.journal = Journal(folder / (name if mark is None else mark["name"]), mark)
        if mark is None:
            self._write(Event(wall_time=now, file_version=_VERSION))

    def add(self, summary: Summary, step: int) -> None:
        """Append one event, of now."""
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
