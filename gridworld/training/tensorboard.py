"""What TensorBoard shows of a run: its event file, with scalars, pictures, hyperparameters and charts.

An event file is a sequence of events, each framed by its length (8 bytes, little-endian), the length's
checksum (4) and its own (4). A checksum is CRC-32C, rotated and shifted by a constant, so that a record
inside a record is not taken for one. TensorBoard's own writer has a thread and a checksum in pure Python,
which takes as long for a picture as two evaluations, and it cannot truncate its file when a run is resumed.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import struct
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import google_crc32c
from google.protobuf.message import DecodeError
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.compat.proto.types_pb2 import DT_STRING
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.custom_scalar import metadata as layout_metadata
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2
from tensorboard.plugins.text import metadata as text_metadata

from gridworld.base.atomic_write import AppendLog
from gridworld.base.errors import InputError
from gridworld.base.safe_read import open_ordinary
from gridworld.base.user_input import check_memory
from gridworld.config.settings import ON_RESULT, flat, with_effects
from gridworld.config.train import TrainConfig

HParamValue = bool | float | str | None

HOW_TO_READ = (  # of what TensorBoard does to curves by default
    "Set *Smoothing* to 0 and switch *Ignore outliers in chart scaling* off: these values are exact. "
    "`train`, `rollout` and `online` alone are samples."
)

_AS_EVENT = 48  # bytes of memory that a byte of a record may come to, in a list of empty values
_HEADER, _FOOTER = 12, 4  # bytes before and after an event
_VERSION = "brain.Event:2"
_MASK_DELTA = 0xA282EAD8


def hparams(config: TrainConfig) -> dict[str, HParamValue]:
    """The settings that affect the result, flat: {"agent.learning_rate": 0.003, ...}."""
    return {
        key: value if value is None or isinstance(value, bool | int | float | str) else str(value)
        for key, value in flat(with_effects(ON_RESULT, dataclasses.asdict(config)))
        if value != {}
    }


def as_markdown(content: Mapping[str, Any]) -> str:
    """A table with a row for every entry."""
    rows = (f"| {key} | {str(value).replace('|', chr(92) + '|')} |" for key, value in flat(content))
    return "\n".join(["| | |", "|---|---|", *rows])


class EventWriter:
    """Writes one event file, new or continued from its `mark`, which is opened when it is first needed.

    One that `is_first` seems to be older than others, so that TensorBoard lists it before them.
    """

    def __init__(self, folder: Path, mark: dict[str, Any] | None = None, is_first: bool = False) -> None:
        self._folder, self._mark, self._is_first = folder, mark, is_first

    @functools.cached_property
    def log(self) -> AppendLog:
        """The file as bytes."""
        if self._mark is not None:
            return AppendLog(self._folder / self._mark["name"], self._mark)
        now = time.time()
        name = f"events.out.tfevents.{int(now)}.{os.uname().nodename}.{os.getpid()}"
        log = AppendLog(self._folder / name)
        log.append(_framed(Event(wall_time=1.0 if self._is_first else now, file_version=_VERSION)))
        return log

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Write one event with a value for every tag."""
        self._add([{"tag": tag, "simple_value": value} for tag, value in values.items()], step)

    def image(self, tag: str, encoded: bytes, size: tuple[int, int], step: int) -> None:
        """Write an encoded PNG or GIF, `size` pixels wide and high; TensorBoard's Images tab plays it."""
        width, height = size
        image = {"height": height, "width": width, "colorspace": 3, "encoded_image_string": encoded}
        self._add([{"tag": tag, "image": image}], step)

    def hparams(self, values: Mapping[str, HParamValue]) -> None:
        """Write the run's entry in the HParams table; its metrics are scalar tags of this same run.

        Nothing is said of the whole experiment: then TensorBoard looks at all runs that it shows, and puts
        the settings that differ between them first.
        """
        start = plugin_data_pb2.SessionStartInfo(start_time_secs=time.time())
        for name, value in values.items():
            if isinstance(value, bool):
                start.hparams[name].bool_value = value
            elif isinstance(value, int | float):
                start.hparams[name].number_value = value
            else:
                # A name that the locale could not decode has characters that no protocol buffer takes.
                start.hparams[name].string_value = str(value).encode("utf-8", "backslashreplace").decode()
        self._session(metadata.SESSION_START_INFO_TAG, session_start_info=start)

    def end_session(self, succeeded: bool) -> None:
        """Write how the run ended, for the HParams table."""
        status = api_pb2.STATUS_SUCCESS if succeeded else api_pb2.STATUS_FAILURE
        end = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=time.time())
        self._session(metadata.SESSION_END_INFO_TAG, session_end_info=end)

    def text(self, tag: str, markdown: str, step: int) -> None:
        """Write a text for the Text tab."""
        self._tensor(tag, text_metadata.PLUGIN_NAME, markdown.encode("utf-8", "backslashreplace"), step)

    def charts(self, title: str, charts: Mapping[str, Sequence[str]]) -> None:
        """Write charts of several tags each, for the Custom Scalars tab: {chart title: tags}."""
        self._layout(title, [{"title": name, "multiline": {"tag": tags}} for name, tags in charts.items()])

    def bands(self, title: str, bands: Mapping[str, tuple[str, str, str]]) -> None:
        """Write charts with a band around a line, for the same tab: {title: tags of value, low and high}."""
        series = {
            name: {"value": value, "lower": low, "upper": high} for name, (value, low, high) in bands.items()
        }
        self._layout(title, [{"title": name, "margin": {"series": [each]}} for name, each in series.items()])

    def close(self) -> None:
        """Close the file."""
        self.log.close()

    def _layout(self, title: str, charts: Sequence[dict[str, Any]]) -> None:
        content = layout_pb2.Layout(category=[{"title": title, "chart": charts}]).SerializeToString()
        self._tensor(layout_metadata.CONFIG_SUMMARY_TAG, layout_metadata.PLUGIN_NAME, content, 0)

    def _tensor(self, tag: str, plugin: str, content: bytes, step: int) -> None:
        """Write what TensorBoard's plugin of that name shows."""
        tensor = {"dtype": DT_STRING, "string_val": [content], "tensor_shape": {}}
        shown_by = {"plugin_data": {"plugin_name": plugin}}
        self._add([{"tag": tag, "metadata": shown_by, "tensor": tensor}], step)

    def _session(self, tag: str, **content: Any) -> None:
        data = plugin_data_pb2.HParamsPluginData(version=metadata.PLUGIN_DATA_VERSION, **content)
        plugin = {"plugin_name": metadata.PLUGIN_NAME, "content": data.SerializeToString()}
        self._add([{"tag": tag, "metadata": {"plugin_data": plugin}}], 0)

    def _add(self, values: Sequence[dict[str, Any]], step: int) -> None:
        event = Event(wall_time=time.time(), step=step, summary=Summary(value=values))
        self.log.append(_framed(event))


def _framed(event: Event) -> bytes:
    content = event.SerializeToString()
    length = struct.pack("<Q", len(content))
    return b"".join([length, _checksum(length), content, _checksum(content)])


def _checksum(content: bytes) -> bytes:
    crc = google_crc32c.value(content)
    rotated = crc >> 15 | crc << 17
    return struct.pack("<I", rotated + _MASK_DELTA & 0xFFFFFFFF)


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
