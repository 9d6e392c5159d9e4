"""Saving and restoring a model during SB3's `learn()`, at points where nothing is half done.

SB3 calls `on_step` before it has stored the transition. A rollout's start is the place: the transitions are
stored, the update is made. What was saved is put back when training starts, after SB3 has reset everything
that it resets then, the generators last.
"""

from __future__ import annotations

import contextlib
import math
import time
import types
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback

from gridworld.agents.sb3.factory import said
from gridworld.agents.sb3.snapshot.class_state import ClassState
from gridworld.agents.sb3.snapshot.learn_locals import LearnLocals
from gridworld.agents.sb3.snapshot.object_graph import ObjectGraph
from gridworld.agents.sb3.snapshot.value_codec import ValueCodec
from gridworld.envs.observations import ObservationTable
from gridworld.errors import InputError
from gridworld.process.console.terminal import tell
from gridworld.storage.rng_state import global_state, set_global_state
from gridworld.storage.serialization import State, StateError, fitting, same


class CheckpointCallback(BaseCallback):
    """Calls `on_step` after every step and `on_safe_point` at every rollout's start, and other callbacks.

    The others' state is a part of the model's. They are called where it makes no difference to go on from a
    state: before it is put back, and after it is saved.

    Args:
        on_step: takes the steps so far; training ends when it returns 0.
        on_safe_point: takes the steps so far; None: nothing is to be saved.
        observation: of the model's environments.
        root: the code of the function that calls `learn()`.
        others: callbacks of the user's.
        schedules: callbacks without a state, which set settings before rollouts or updates, before `others`.

    Attributes:
        state: to go on from, set before training; None: from the start.
    """

    def __init__(
        self,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None,
        observation: ObservationTable,
        root: types.CodeType,
        others: Sequence[BaseCallback] = (),
        schedules: Sequence[BaseCallback] = (),
    ) -> None:
        super().__init__()
        self._hook = on_step
        self._on_safe_point = on_safe_point
        self._values = ValueCodec(observation)
        self._observation = observation
        self._root = root
        self._others = others
        self._schedules = schedules
        self._loop: LearnLocals | None = None
        self._objects: dict[str, str] = {}
        self._classes = ClassState()
        self.state: State | None = None
        self.goes_on = True
        self.reads_locals = bool(others)  # whether anybody reads the variables of SB3's loop

    def _init_callback(self) -> None:
        for schedule in self._schedules:
            schedule.init_callback(self.model)
        for index, other in enumerate(self._others):
            with _beginning(index, other):
                other.init_callback(self.model)

    def _on_step(self) -> bool:
        self.goes_on = self._hook(self.num_timesteps) > 0
        for index, other in enumerate(self._others):
            if not other.on_step():
                self.goes_on = False
                tell(f"{_name(index, other)} stopped training after {self.num_timesteps:,} steps")
        return self.goes_on

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """See `BaseCallback.update_child_locals`."""
        for other in self._others:
            other.update_locals(locals_)

    def _on_training_start(self) -> None:
        for index, other in enumerate(self._others):
            with _beginning(index, other):
                other.on_training_start(self.locals, self.globals)
        if self._on_safe_point is None and self.state is None:
            return
        if self._loop is not None:
            raise InputError(
                "checkpoint.every: the model cannot be saved, its learn() starts training twice; train "
                "without checkpoints by checkpoint.every=null"
            )
        self._loop = LearnLocals(self._root, 3, [self.model, self, self.model.env, self.training_env])
        audit = self._audit()
        audit.state()
        self._objects = audit.objects
        if self.state is not None:
            with fitting():
                self._restore(self.state)
            self.num_timesteps = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        if self._loop is not None:
            self._loop.check(2)
        if self._on_safe_point is not None:
            self._on_safe_point(self.model.num_timesteps)
        for other in (*self._schedules, *self._others):
            other.on_rollout_start()

    def _on_rollout_end(self) -> None:
        for other in (*self._schedules, *self._others):
            other.on_rollout_end()

    def _on_training_end(self) -> None:
        if self.goes_on:
            buffer = getattr(self.model, "rollout_buffer", None)
            if isinstance(buffer, BaseBuffer):
                buffer.reset()  # as at the start of a rollout
            check_finite(self.model)
            if self._on_safe_point is not None:
                self._on_safe_point(self.model.num_timesteps)
        if self._loop is not None:
            self._loop.let_go()
        for other in self._others:
            other.on_training_end()

    def get_state(self) -> State:
        """The model's state while it waits at a rollout's start.

        Raises:
            InputError: something has come up that could not be put back.
        """
        assert self._loop is not None
        audit = self._audit()
        new = sorted(audit.objects.items() - self._objects.items())
        if new:
            path, kind = new[0]
            raise InputError(
                f"checkpoint.every: the model cannot be saved, {path} became a {kind} while it was training; "
                "train without checkpoints by checkpoint.every=null"
            )
        return {
            "model": audit.state(),
            "loop": self._loop.get_state(),
            "seconds": (time.time_ns() - self.model.start_time) / 1e9,
            "chance": global_state(),
            "torch": torch_state(),
        }

    def _audit(self) -> ObjectGraph:
        constants = [self._observation, self.model.logger.output_formats, self.locals, self.globals]
        others = {f"callbacks[{index}]": other for index, other in enumerate(self._others)}
        return ObjectGraph({"": self.model, **others}, constants, self._values, self._classes)

    def _restore(self, state: State) -> None:
        assert self._loop is not None
        total = self.model._total_timesteps
        self._audit().restore(state["model"])
        found = self._audit().state()
        values = state["model"]["values"]
        differing = [
            path
            for path, value in values.items()
            if not same(_without_seconds(found["values"].get(path)), _without_seconds(value))
        ]
        if differing or found["same"] != state["model"]["same"]:
            raise StateError(f"{(differing or ['what is shared'])[0]} could not be put back")
        self.model._total_timesteps = total  # which may be another one now
        self.model.start_time = time.time_ns() - int(state["seconds"] * 1e9)
        self._loop.set_state(state["loop"])
        set_global_state(state["chance"])
        set_torch_state(state["torch"])


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


def _without_seconds(value: Any) -> Any:
    """A written value; of environments without the seconds since their start, which go on."""
    if isinstance(value, dict) and isinstance(state := value.get("state"), dict):
        return {key: part for key, part in state.items() if key != "seconds"}
    return value


def check_finite(model: BaseAlgorithm) -> None:
    """Check that the last update left finite weights and losses.

    Raises:
        InputError: it did not.
    """
    what = not_finite(model)
    if what is not None:
        raise diverged(model, what)


def not_finite(model: BaseAlgorithm) -> str | None:
    """What the last update left that is no finite number, in words; None: nothing."""
    descent = getattr(model, "descent", None)  # of a tabulated engine, with all weights in one
    weights = model.policy.parameters() if descent is None else [descent.weights]
    # A sum takes one pass, and is finite only where all are; of very large weights it need not be.
    if not all(math.isfinite(each.sum().item()) or bool(torch.isfinite(each).all()) for each in weights):
        return "the network's weights are no finite number"
    losses = [v for key, v in model.logger.name_to_value.items() if "loss" in key]
    return None if all(math.isfinite(loss) for loss in losses) else "a loss is no finite number"


def diverged(model: BaseAlgorithm, what: str) -> InputError:
    """The error to raise where numbers are not finite; `what` says which."""
    return InputError(
        f"training diverged at update {model._n_updates:,}, after {model.num_timesteps:,} steps: {what}; "
        "try a smaller learning rate"
    )


def torch_state() -> State:
    """The state of torch's generators."""
    state: State = {"cpu": torch.get_rng_state().numpy().copy()}
    if torch.cuda.is_available() and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        state["cuda"] = [device.cpu().numpy().copy() for device in torch.cuda.get_rng_state_all()]
    return state


def set_torch_state(state: State) -> None:
    """Mirrors `torch_state`."""
    torch.set_rng_state(torch.from_numpy(state["cpu"]))
    if "cuda" in state:
        torch.cuda.set_rng_state_all([torch.from_numpy(device) for device in state["cuda"]])
