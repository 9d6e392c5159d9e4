"""Pictures of a run, each declared at the field of its setting.

The run's folder, TensorBoard, `record.py` and the report's page read the table. To add a picture, add a field
to `RecordingConfig` and a function to `gridworld.visualization` (see `gridworld.visualization.picture`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

from gridworld.config.fields import bounds

_PICTURE = "picture"  # in a field's metadata


@dataclass(frozen=True)
class Picture:
    """A file, or a folder of numbered PNGs, that is drawn when training is over."""

    file: str  # in the run's folder; its ending says what it is written as
    drawer: str  # "module.function" in `gridworld.visualization`, which draws it
    caption: str | None = None  # in a report's page; None: it has no place there
    while_training: bool = False  # TensorBoard has it every `logging.policy_map_every` evaluations
    setting: str = ""  # its name in `recording.*`

    @property
    def name(self) -> str:
        """What `record.py --format` and TensorBoard call it."""
        return Path(self.file).stem

    @property
    def label(self) -> str:
        """What a warning calls it: the files of one episode have one name, so that it is told once."""
        return self.file if self.caption else f"the {self.drawer.partition('.')[0]}"

    @property
    def is_map(self) -> bool:
        """Whether it is a still picture of the whole world."""
        return self.file.endswith(".png")

    @property
    def is_in_tensorboard(self) -> bool:
        """Whether TensorBoard can show it."""
        return self.file.endswith((".png", ".gif"))


def picture(
    file: str, drawer: str, caption: str | None = None, while_training: bool = False
) -> dict[str, Any]:
    """A field's metadata; the arguments are those of `Picture`."""
    return {_PICTURE: Picture(file, drawer, caption, while_training)}


@dataclass
class RecordingConfig:
    """Pictures in the run's folder; TensorBoard gets them too."""

    # values and greedy actions
    policy_map: bool = field(
        default=True, metadata=picture("policy.png", "maps.policy", "policy", while_training=True)
    )
    # how far the values are from the true ones
    q_error: bool = field(
        default=True, metadata=picture("q_error.png", "maps.q_error", "error of its values")
    )
    # where training has been
    visits: bool = field(
        default=True, metadata=picture("visits.png", "maps.visits", "visits while it learnt")
    )
    # the policy over training
    learning: bool = field(
        default=True, metadata=picture("learning.gif", "maps.learning", "policy while it learnt")
    )
    # the final greedy policy's episode; MP4 needs the extra `video`
    frames: bool = field(default=True, metadata=picture("frames", "episode.episode"))
    gif: bool = field(default=True, metadata=picture("episode.gif", "episode.episode"))
    mp4: bool = field(default=False, metadata=picture("episode.mp4", "episode.episode"))
    # pixels of the episode's; null: 100, less on large maps
    cell_size: Optional[int] = field(default=None, metadata=bounds(2))  # noqa: UP045
    fps: int = field(default=4, metadata=bounds(1, 100))  # frames a second


PICTURES: tuple[Picture, ...] = tuple(
    dataclasses.replace(each.metadata[_PICTURE], setting=each.name)
    for each in dataclasses.fields(RecordingConfig)
    if _PICTURE in each.metadata
)
