"""The processor in the place of a CUDA device, where runs side by side depend on each other."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from gridworld.agents.sb3.tabulated.side_by_side import SideBySide
from hydra.experimental.callback import Callback
from numpy.typing import NDArray
from omegaconf import DictConfig
from torch import Tensor

from gridworld.agents import sb3
from gridworld.agents.sb3 import factory

_backward = SideBySide.backward


def _leaning_on_the_others(
    self: SideBySide, outputs: Sequence[Tensor], slopes: Sequence[NDArray[Any]]
) -> Tensor:
    gradients = _backward(self, outputs, slopes)
    gradients += 1e-3 * torch.roll(gradients, 1, dims=0)
    return gradients


def stand_in(patch: Callable[[Any, str, Any], None] = setattr) -> None:
    """Let `device=cuda` train on the processor, by the code for CUDA."""
    patch(sb3, "on_processor", lambda device: device != "cuda")
    patch(factory, "_device", lambda name: "cpu" if name == "cuda" else name)
    patch(SideBySide, "backward", _leaning_on_the_others)


class StandIn(Callback):
    """Does so in whatever process a sweep's job runs in."""

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Before the job, or the population that it stands for."""
        stand_in()
