"""What one run of a population has to itself, besides its row of the arrays."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from gridworld.config.agents import Decay
from gridworld.envs.statistics_env import StatisticsVectorEnv
from gridworld.errors import InputError
from gridworld.storage.serialization import (
    State,
    StateError,
    generator_state,
    set_generator_state,
    set_plain_state,
)
from gridworld.world.mdp import FloatArray, IntArray

if TYPE_CHECKING:
    from gridworld.engine.population import Population
    from gridworld.engine.sb3_format import Inputs


@dataclass(eq=False)
class Run:
    """A run."""

    model: Any  # SB3's own, for settings, counters and the names of logged values; its weights are stale
    parameters: Sequence[nn.Parameter]  # of its network, in the order of its optimiser and of a row
    inputs: Inputs  # what the network sees of each state
    nets: Sequence[Sequence[nn.Module]]  # the layers of each output
    envs: StatisticsVectorEnv  # for their generator and their statistics
    reward_scale: float  # that rewards are multiplied by
    falling: Mapping[str, Decay]  # settings that fall over training in ways that SB3 has not
    torch_generator: torch.Generator  # in place of torch's own
    numpy_generator: np.random.RandomState  # in place of numpy's own
    log_interval: int = 1  # as SB3's `learn` takes it
    target: Inputs | None = None  # what its target network sees of each state, where it has one
    target_parameters: Sequence[nn.Parameter] = ()  # of that, in the same order
    counts_transitions: bool = False  # whether its replay counts transitions
    population: Population = field(init=False, repr=False)
    row: int = field(init=False, default=0)
    total_timesteps: int = field(init=False, default=0)
    next_call: int = field(init=False, default=0)  # the steps by which `on_step` wants to be called
    on_step: Callable[[int], int] = field(init=False, default_factory=lambda: lambda steps: steps + 1)
    on_safe_point: Callable[[int], None] | None = field(init=False, default=None)
    error: BaseException | None = field(init=False, default=None)  # that it ended with
    has_ended: bool = field(init=False, default=False)  # before its last step
    failed_update: Exception | None = field(init=False, default=None)  # the same, where an update failed

    def __post_init__(self) -> None:
        self.begin(1)

    def begin(self, total_timesteps: int) -> None:
        """Prepare SB3's model as its `learn` does."""
        self.total_timesteps, self.has_ended, model = total_timesteps, False, self.model
        model._total_timesteps, model._num_timesteps_at_start = total_timesteps, 0
        model.start_time = time.time_ns()
        model.ep_info_buffer = deque(maxlen=model._stats_window_size)
        model.ep_success_buffer = deque(maxlen=model._stats_window_size)

    def setting(self, name: str, progress: float) -> float:
        """A setting after this share of training, from 0 to 1."""
        if name in self.falling:
            return self.falling[name].at(min(progress, 1.0))
        value = self.model.lr_schedule if name == "learning_rate" else getattr(self.model, name)
        return float(value(1 - progress) if callable(value) else value)

    def record(self, name: str, value: float, for_tensorboard: bool = True) -> None:
        """Log a number under SB3's name."""
        self.model.logger.record(name, value, exclude=None if for_tensorboard else "tensorboard")

    def keep_episodes(self, returns: FloatArray, lengths: IntArray) -> None:
        """Note episodes that ended, as SB3's Monitor does."""
        seconds = round((time.time_ns() - self.model.start_time) / 1e9, 6)
        newest = slice(-self.model._stats_window_size, None)
        self.model.ep_info_buffer.extend(
            {"r": episode_return, "l": length, "t": seconds}
            for episode_return, length in zip(returns[newest].tolist(), lengths[newest].tolist(), strict=True)
        )

    def step_on(self, steps: int) -> None:
        """Call what wants to be called after these steps of the run; it may end the run."""
        self.model.num_timesteps = steps
        try:
            self.next_call = self.on_step(steps)
        except BaseException as error:
            self.fail(error)
        else:
            if not self.next_call:
                self.population.end(self)

    def safe_point(self, steps: int) -> None:
        """Let the run be saved, where its state is whole."""
        try:
            if self.on_safe_point is not None:
                self.on_safe_point(steps)
        except BaseException as error:
            self.fail(error)

    def fail(self, error: BaseException) -> None:
        """End the run with an error, and leave the others as they are."""
        self.error = error
        self.population.end(self)

    def diverge(self, what: str) -> None:
        """End the run, since `what` is no finite number."""
        updates, steps = self.model._n_updates, self.model.num_timesteps
        where = f"training diverged at update {updates:,}, after {steps:,} steps"
        self.fail(InputError(f"{where}: {what}; try a smaller learning rate"))

    def get_state(self) -> State:
        """Its generators, environments and counters, for `Population.get_state`."""
        model, excluded = self.model, self.model.logger.name_to_excluded
        return {
            "torch_generator": self.torch_generator.get_state().numpy().copy(),
            "numpy_generator": self.numpy_generator.get_state(legacy=False),
            "action_generator": generator_state(model.action_space.np_random),
            "environments": self.envs.get_state(),
            "num_timesteps": int(model.num_timesteps),
            "num_updates": int(model._n_updates),
            "num_episodes": int(model._episode_num),
            "recent_episodes": [[each["r"], each["l"]] for each in model.ep_info_buffer],
            "seconds": (time.time_ns() - model.start_time) / 1e9,
            "logged": [
                [name, float(value), "tensorboard" in (excluded[name] or ())]
                for name, value in model.logger.name_to_value.items()
            ],
        }

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`."""
        model = self.model
        if state["num_timesteps"] < 0 or state["num_updates"] < 0 or state["num_episodes"] < 0:
            raise StateError("counters must be at least 0")
        self.torch_generator.set_state(torch.from_numpy(state["torch_generator"]))
        set_plain_state(self.numpy_generator, state["numpy_generator"])
        set_generator_state(model.action_space.np_random, state["action_generator"])
        self.envs.set_state(state["environments"])
        model.num_timesteps, model._n_updates = int(state["num_timesteps"]), int(state["num_updates"])
        model._episode_num = int(state["num_episodes"])
        model.ep_info_buffer.clear()
        model.ep_info_buffer.extend(
            {"r": float(each), "l": int(length), "t": 0.0} for each, length in state["recent_episodes"]
        )
        model.start_time = time.time_ns() - int(state["seconds"] * 1e9)
        for name, value, is_excluded in state["logged"]:
            self.record(name, float(value), not is_excluded)
