"""The state of Stable-Baselines3's own loop, between one rollout and the next, by name.

It is exact for the classes of Stable-Baselines3 and sb3-contrib: all that they change while they learn is
listed here. What a custom class keeps, only that class can know: it defines

    get_state(): a dict of numbers, strings, None, arrays, and of dicts and lists of these
    set_state(state): mirrors it

For an algorithm, that is in addition to what its base class keeps, for a layer to its parameters; a replay
buffer or callback says everything. With a custom class that does not define them a run has no checkpoints.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from stable_baselines3.common import callbacks as sb3_callbacks
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from torch import Tensor

from gridworld.storage.serialization import (
    State,
    StateError,
    fill,
    generator_state,
    global_state,
    set_generator_state,
    set_global_state,
)

_LIBRARIES = ("stable_baselines3", "sb3_contrib", "torch", "gridworld")
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_n_calls")
_NUMBERS = ("exploration_rate", "_current_progress_remaining")
_OF_CALLBACKS: dict[type[BaseCallback], tuple[str, ...]] = {  # SB3's own, and what these count
    sb3_callbacks.CallbackList: (),
    sb3_callbacks.CheckpointCallback: (),
    sb3_callbacks.EveryNTimesteps: ("last_time_trigger",),
    sb3_callbacks.StopTrainingOnMaxEpisodes: ("n_episodes", "_total_max_episodes"),
}


@runtime_checkable
class HasState(Protocol):
    """What says itself what it keeps."""

    def get_state(self) -> State:
        """All that it keeps."""

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`."""


def class_without_state(model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> str | None:
    """The path of a class of which nobody knows what it keeps; None: all are known."""
    for each in (*_custom_parts(model), *_flat(callbacks)):
        if type(each) not in _OF_CALLBACKS and not isinstance(each, HasState):
            return f"{type(each).__module__}.{type(each).__qualname__}"
    return None


def _custom_parts(model: BaseAlgorithm) -> list[Any]:
    """The model and those of its parts whose classes come from no library."""
    buffers = [getattr(model, f"{kind}_buffer", None) for kind in ("replay", "rollout")]
    parts = [model, *model.policy.modules(), model.policy.optimizer, *buffers]
    return [
        part
        for part in parts
        if part is not None and type(part).__module__.partition(".")[0] not in _LIBRARIES
    ]


def _flat(callbacks: Sequence[BaseCallback]) -> Iterator[BaseCallback]:
    """Callbacks, and those that they hold."""
    for callback in callbacks:
        yield callback
        held = [*getattr(callback, "callbacks", ()), getattr(callback, "callback", None)]
        yield from _flat([each for each in held if isinstance(each, BaseCallback)])


def get_state(model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> State:
    """The state of a model that waits between a rollout and the next, and of its callbacks."""
    loop: Any = model
    buffer = getattr(model, "replay_buffer", None)
    logged, excluded = loop.logger.name_to_value, loop.logger.name_to_excluded
    return {
        **{name: int(getattr(model, name)) for name in _COUNTERS if hasattr(model, name)},
        **{name: float(getattr(model, name)) for name in _NUMBERS if hasattr(model, name)},
        "parameters": {name: _plain(found) for name, found in model.get_parameters().items()},
        "replay": None if buffer is None else _replay_state(buffer),
        "environments": loop.env.envs.get_state(),
        "last_episode_starts": loop._last_episode_starts,
        "recent_episodes": [[each["r"], each["l"]] for each in loop.ep_info_buffer],
        "logged": [
            [name, float(value), loop.logger.name_to_count[name], "tensorboard" in (excluded[name] or ())]
            for name, value in logged.items()
        ],
        "seconds": (time.time_ns() - loop.start_time) / 1e9,
        "global_generators": global_state(),
        "torch_generators": torch_state(),
        "action_generator": generator_state(model.action_space.np_random),
        "custom_parts": [part.get_state() for part in _custom_parts(model)],
        "callbacks": [_callback_state(each) for each in _flat(callbacks)],
    }


def set_state(model: BaseAlgorithm, callbacks: Sequence[BaseCallback], state: State) -> None:
    """Mirrors `get_state`, where SB3's `learn` has begun and made no step; generators come last.

    Raises:
        StateError: the state is of another kind of model.
    """
    loop: Any = model
    for name in (*_COUNTERS, *_NUMBERS):
        if hasattr(model, name):
            setattr(model, name, type(getattr(model, name))(state[name]))
    expected = {name: _plain(found) for name, found in model.get_parameters().items()}
    if state["parameters"].keys() != expected.keys():
        raise StateError(f"the model's parameters must be {', '.join(expected)}")
    parameters = {name: _tensors(found) for name, found in state["parameters"].items()}
    for name, found in parameters.items():
        if "param_groups" in found:  # of an optimiser: its numbers of each weight, which are counted
            found["state"] = {int(number): values for number, values in found["state"].items()}
        else:
            for key, tensor in expected[name].items():
                fill(tensor, state["parameters"][name].get(key), f"{name}.{key}")
    model.set_parameters(parameters, exact_match=True, device=model.device)
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        _set_replay_state(buffer, state["replay"])
    loop.env.envs.set_state(state["environments"])
    loop._last_obs = loop.env.observation.rows(loop.env.states)
    if loop._last_episode_starts is not None:
        fill(loop._last_episode_starts, state["last_episode_starts"], "last_episode_starts")
    loop.ep_info_buffer.clear()
    loop.ep_info_buffer.extend(
        {"r": each, "l": length, "t": 0.0} for each, length in state["recent_episodes"]
    )
    for name, value, count, is_excluded in state["logged"]:
        loop.logger.record(name, float(value), exclude="tensorboard" if is_excluded else None)
        loop.logger.name_to_count[name] = int(count)
    loop.start_time = time.time_ns() - int(state["seconds"] * 1e9)
    for part, own in zip(_custom_parts(model), state["custom_parts"], strict=True):
        part.set_state(own)
    for callback, own in zip(_flat(callbacks), state["callbacks"], strict=True):
        _set_callback_state(callback, own)
    set_generator_state(model.action_space.np_random, state["action_generator"])
    set_global_state(state["global_generators"])
    set_torch_state(state["torch_generators"])


def _replay_state(buffer: Any) -> State:
    if isinstance(buffer, HasState):
        return buffer.get_state()
    count = buffer.buffer_size if buffer.full else buffer.pos
    columns = {name: column[:count] for name, column in _columns(buffer)}
    return {**columns, "pos": int(buffer.pos), "full": bool(buffer.full)}


def _set_replay_state(buffer: Any, state: State) -> None:
    if isinstance(buffer, HasState):
        buffer.set_state(state)
        return
    if not 0 <= state["pos"] < buffer.buffer_size:
        raise StateError(f"the replay's pos must be from 0 to {buffer.buffer_size - 1}")
    buffer.pos, buffer.full = int(state["pos"]), bool(state["full"])
    count = buffer.buffer_size if buffer.full else buffer.pos
    for name, column in _columns(buffer):
        fill(column[:count], state[name], f"the replay's {name}")


def _columns(buffer: ReplayBuffer) -> Iterator[tuple[str, Any]]:
    """The arrays of a replay buffer, which have a row for each step."""
    for name, column in vars(buffer).items():
        if isinstance(column, np.ndarray) and len(column) == buffer.buffer_size:
            yield name, column


def _callback_state(callback: BaseCallback) -> State:
    counted = {name: getattr(callback, name) for name in _OF_CALLBACKS.get(type(callback), ())}
    own = callback.get_state() if isinstance(callback, HasState) else None
    return {"n_calls": callback.n_calls, "num_timesteps": callback.num_timesteps, **counted, "own": own}


def _set_callback_state(callback: BaseCallback, state: State) -> None:
    for name in ("n_calls", "num_timesteps", *_OF_CALLBACKS.get(type(callback), ())):
        setattr(callback, name, int(state[name]))
    if isinstance(callback, HasState):
        callback.set_state(state["own"])


def _plain(node: Any) -> Any:
    """Tensors as arrays, keys as text."""
    if isinstance(node, dict):
        return {str(key): _plain(value) for key, value in node.items()}
    if isinstance(node, list | tuple):
        return [_plain(value) for value in node]
    return node.detach().cpu().numpy().copy() if isinstance(node, Tensor) else node


def _tensors(node: Any) -> Any:
    """Mirrors `_plain`, but for the keys."""
    if isinstance(node, dict):
        return {key: _tensors(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_tensors(value) for value in node]
    return torch.from_numpy(node.copy()) if isinstance(node, np.ndarray) else node


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
