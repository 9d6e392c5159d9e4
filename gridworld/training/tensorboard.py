"""What TensorBoard shows of a run: scalars, pictures, hyperparameters and the charts' layout.

Written with TensorBoard's own message types; torch is not needed for it.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.summary_pb2 import Summary, SummaryMetadata
from tensorboard.compat.proto.tensor_pb2 import TensorProto
from tensorboard.compat.proto.tensor_shape_pb2 import TensorShapeProto
from tensorboard.compat.proto.types_pb2 import DT_STRING
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.custom_scalar import metadata as layout_metadata
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2
from tensorboard.plugins.text import metadata as text_metadata

from gridworld.config.settings import ON_RESULT, flat, with_effects
from gridworld.config.train import TrainConfig
from gridworld.envs.frames.rendering import Frame
from gridworld.storage.append_log import AppendLog
from gridworld.storage.event_file import EventFile
from gridworld.visualization.files import encode_png

HParamValue = bool | float | str | None


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
    """Writes one event file, which is opened when it is first needed. Steps are environment steps."""

    def __init__(self, folder: Path, mark: dict[str, Any] | None = None) -> None:
        """A new file, or with a mark the one that is there.

        Args:
            folder: where the file is.
            mark: where a file ended that is to be continued, see `storage.append_log`.
        """
        self._folder, self._mark = folder, mark

    @functools.cached_property
    def _file(self) -> EventFile:
        return EventFile(self._folder, self._mark)

    @property
    def log(self) -> AppendLog:
        """The file as bytes."""
        return self._file.journal

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """Write one event with a value for every tag."""
        self._file.add(
            Summary(value=[Summary.Value(tag=tag, simple_value=v) for tag, v in values.items()]), step
        )

    def image(self, tag: str, frame: Frame, step: int) -> None:
        """Write a picture as PNG."""
        self._image(tag, encode_png(frame), (frame.shape[1], frame.shape[0]), step)

    def animation(self, tag: str, gif: bytes, size: tuple[int, int], step: int) -> None:
        """Write an encoded GIF, `size` pixels wide and high; TensorBoard's Images tab plays it."""
        self._image(tag, gif, size, step)

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
        self._session(
            metadata.SESSION_START_INFO_TAG, plugin_data_pb2.HParamsPluginData(session_start_info=start)
        )

    def end_session(self, succeeded: bool) -> None:
        """Write how the run ended, for the HParams table."""
        status = api_pb2.STATUS_SUCCESS if succeeded else api_pb2.STATUS_FAILURE
        end = plugin_data_pb2.SessionEndInfo(status=status, end_time_secs=time.time())
        self._session(metadata.SESSION_END_INFO_TAG, plugin_data_pb2.HParamsPluginData(session_end_info=end))

    def text(self, tag: str, markdown: str, step: int) -> None:
        """Write a text for the Text tab."""
        plugin = SummaryMetadata.PluginData(plugin_name=text_metadata.PLUGIN_NAME)
        content = markdown.encode("utf-8", "backslashreplace")
        value = Summary.Value(
            tag=tag,
            metadata=SummaryMetadata(plugin_data=plugin),
            tensor=TensorProto(dtype=DT_STRING, string_val=[content], tensor_shape=TensorShapeProto()),
        )
        self._file.add(Summary(value=[value]), step)

    def charts(self, title: str, charts: Mapping[str, Sequence[str]]) -> None:
        """Write charts of several tags each, for the Custom Scalars tab: {chart title: tags}."""
        self._layout(
            title,
            [
                layout_pb2.Chart(title=name, multiline=layout_pb2.MultilineChartContent(tag=tags))
                for name, tags in charts.items()
            ],
        )

    def bands(self, title: str, bands: Mapping[str, tuple[str, str, str]]) -> None:
        """Write charts with a band around a line, for the same tab: {title: tags of value, low and high}."""
        series = layout_pb2.MarginChartContent.Series
        self._layout(
            title,
            [
                layout_pb2.Chart(
                    title=name,
                    margin=layout_pb2.MarginChartContent(series=[series(value=value, lower=low, upper=high)]),
                )
                for name, (value, low, high) in bands.items()
            ],
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _layout(self, title: str, charts: Sequence[layout_pb2.Chart]) -> None:
        category = layout_pb2.Category(title=title, chart=charts)
        content = layout_pb2.Layout(category=[category]).SerializeToString()
        plugin = SummaryMetadata.PluginData(plugin_name=layout_metadata.PLUGIN_NAME)
        value = Summary.Value(
            tag=layout_metadata.CONFIG_SUMMARY_TAG,
            metadata=SummaryMetadata(plugin_data=plugin),
            tensor=TensorProto(dtype=DT_STRING, string_val=[content], tensor_shape=TensorShapeProto()),
        )
        self._file.add(Summary(value=[value]), 0)

    def _image(self, tag: str, encoded: bytes, size: tuple[int, int], step: int) -> None:
        width, height = size
        picture = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
        self._file.add(Summary(value=[Summary.Value(tag=tag, image=picture)]), step)

    def _session(self, tag: str, content: plugin_data_pb2.HParamsPluginData) -> None:
        content.version = metadata.PLUGIN_DATA_VERSION
        plugin = SummaryMetadata.PluginData(
            plugin_name=metadata.PLUGIN_NAME, content=content.SerializeToString()
        )
        value = Summary.Value(tag=tag, metadata=SummaryMetadata(plugin_data=plugin))
        self._file.add(Summary(value=[value]), 0)
