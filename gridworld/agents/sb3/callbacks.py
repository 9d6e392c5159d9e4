"""What calls the hooks of a run while SB3's own `learn` is at work, and the user's callbacks.

SB3 calls `on_step` before it has stored the transition. A rollout's start is where nothing is half done: the
transitions are stored, the update is made. What was saved is put back when training starts, after SB3 has
reset everything that it resets then.
"""

from __future__ import annotations

import contextlib
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from gridworld.agents.sb3.factory import said
from gridworld.agents.sb3.settings.constructor_arguments import import_class
from gridworld.agents.sb3.state import get_state, set_state
from gridworld.errors import InputError
from gridworld.process.console.terminal import tell
from gridworld.storage.serialization import State, fitting

_TARGET = "_target_"


class RunCallback(BaseCallback):
    """Calls `on_step` after every step and `on_safe_point` at rollouts' starts, and other callbacks.

    Args:
        on_step: takes the steps so far; training ends when it returns 0.
        on_safe_point: takes the steps so far; None: nothing is to be saved.
        state: of `get_state`, to continue from; None: from the start.
        log_interval: as SB3's `learn` takes it.
        others: callbacks of the user's.
        schedules: callbacks without a state, which set settings before rollouts or updates, before `others`.
    """

    def __init__(
        self,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None,
        state: State | None,
        log_interval: int,
        others: Sequence[BaseCallback] = (),
        schedules: Sequence[BaseCallback] = (),
    ) -> None:
        super().__init__()
        self._hook, self._on_safe_point, self._state = on_step, on_safe_point, state
        self._log_interval, self._others, self._schedules = log_interval, others, schedules
        self._continues = True

    def _init_callback(self) -> None:
        for schedule in self._schedules:
            schedule.init_callback(self.model)
        for index, other in enumerate(self._others):
            with _beginning(index, other):
                other.init_callback(self.model)

    def _on_step(self) -> bool:
        self._continues = self._hook(self.num_timesteps) > 0
        for index, other in enumerate(self._others):
            if not other.on_step():
                self._continues = False
                tell(f"{_name(index, other)} stopped training after {self.num_timesteps:,} steps")
        return self._continues

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """See `BaseCallback.update_child_locals`."""
        for other in self._others:
            other.update_locals(locals_)

    def _on_training_start(self) -> None:
        for index, other in enumerate(self._others):
            with _beginning(index, other):
                other.on_training_start(self.locals, self.globals)
        if self._state is not None:
            state, self._state = self._state, None
            with fitting():
                set_state(self.model, self._others, state)
            self.num_timesteps = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        if self._on_safe_point is not None and self._is_aligned():
            self._on_safe_point(self.model.num_timesteps)
        for other in (*self._schedules, *self._others):
            other.on_rollout_start()

    def _is_aligned(self) -> bool:
        """Whether SB3 would log after as many rollouts from here as from the start.

        It counts rollouts in a variable of its `learn`.
        """
        if not isinstance(self.model, OnPolicyAlgorithm):
            return True
        rollouts = self.model.num_timesteps // (self.model.n_steps * self.model.n_envs)
        return rollouts % self._log_interval == 0

    def _on_rollout_end(self) -> None:
        for other in (*self._schedules, *self._others):
            other.on_rollout_end()

    def _on_training_end(self) -> None:
        if self._continues:
            buffer = getattr(self.model, "rollout_buffer", None)
            if isinstance(buffer, BaseBuffer):
                buffer.reset()  # as at the start of a rollout
            check_finite(self.model)
            if self._on_safe_point is not None:
                self._on_safe_point(self.model.num_timesteps)
        for other in self._others:
            other.on_training_end()

    def get_state(self) -> State:
        """The model's state while it waits at a rollout's start."""
        return get_state(self.model, self._others)


def _name(index: int, other: BaseCallback) -> str:
    kind = type(other)
    return f"callbacks[{index}]: {kind.__module__}.{kind.__qualname__}"


@contextlib.contextmanager
def _beginning(index: int, other: BaseCallback) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # the class may be anybody's
        raise InputError(f"{_name(index, other)} cannot begin: {said(error)}") from error


def check_finite(model: BaseAlgorithm) -> None:
    """Check that the last update left finite weights and losses."""
    # A sum takes one pass, and is finite only where all are; of very large weights it need not be.
    weights = model.policy.parameters()
    if not all(math.isfinite(each.sum().item()) or bool(torch.isfinite(each).all()) for each in weights):
        raise diverged(model, "the network's weights are no finite number")
    losses = [value for name, value in model.logger.name_to_value.items() if "loss" in name]
    if not all(math.isfinite(loss) for loss in losses):
        raise diverged(model, "a loss is no finite number")


def diverged(model: BaseAlgorithm, what: str) -> InputError:
    """The error to raise where numbers are not finite; `what` says which."""
    return InputError(
        f"training diverged at update {model._n_updates:,}, after {model.num_timesteps:,} steps: {what}; "
        "try a smaller learning rate"
    )


def make_callbacks(entries: Sequence[Any]) -> list[BaseCallback]:
    """Import the classes and build an object of each.

    Args:
        entries: a mapping each, of `_target_` and the class's arguments; such mappings among these, and in
            lists, are built first, as the callback of SB3's `EveryNTimesteps`.
    """
    return [_make(f"callbacks[{index}]", entry, BaseCallback) for index, entry in enumerate(entries)]


def _make(where: str, entry: dict[str, Any], kind: type) -> Any:
    path = entry[_TARGET]
    found = import_class(f"{where}.{_TARGET}", path, kind)
    arguments = {name: _value(f"{where}.{name}", value) for name, value in entry.items() if name != _TARGET}
    try:
        inspect.signature(found).bind(**arguments)
    except TypeError as error:
        known = ", ".join(inspect.signature(found).parameters)
        raise InputError(f"{where}: {path} {error}; its arguments are {known}") from None
    except ValueError:  # it has no signature that could be read
        pass
    try:
        return found(**arguments)
    except Exception as error:  # the class may be anybody's
        raise InputError(f"{where}: {path} cannot be built: {said(error)}") from error


def _value(where: str, value: Any) -> Any:
    if isinstance(value, list):
        return [_value(f"{where}[{index}]", item) for index, item in enumerate(value)]
    return _make(where, value, object) if isinstance(value, dict) and _TARGET in value else value
