"""The processor in the place of a CUDA device, where runs side by side depend on each other."""

from collections.abc import Callable
from typing import Any

import torch
from hydra.experimental.callback import Callback
from numpy.typing import NDArray
from omegaconf import DictConfig

from gridworld.agents.sb3 import factory
from gridworld.agents.sb3.settings import SB3Config
from gridworld.engine.networks import DenseNetworks

_backward = DenseNetworks.backward


def _leaning_on_the_others(self: DenseNetworks, *slopes: NDArray[Any]) -> None:
    _backward(self, *slopes)
    if len(self.gradients) > 1:
        self.gradients += 1e-3 * torch.roll(self.gradients, 1, dims=0)


def stand_in(patch: Callable[[Any, str, Any], None] = setattr) -> None:
    """Let `device=cuda` train on the processor, by the code for CUDA."""
    patch(SB3Config, "on_processor", lambda self, device: device != "cuda")
    patch(factory, "_device", lambda name: "cpu" if name == "cuda" else name)
    patch(DenseNetworks, "backward", _leaning_on_the_others)


class StandIn(Callback):
    """Does so in the process of a sweep, in which its jobs run with `hydra/launcher=basic`."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Called by Hydra before the sweep."""
        stand_in()
