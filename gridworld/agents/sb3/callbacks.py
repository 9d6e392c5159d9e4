"""SB3's own loop: the hooks of a run, settings that fall over training, and the state between two rollouts.

SB3 calls `on_step` before it has stored the transition. Nothing is half done at a rollout's start: the
transitions are stored, the update is made. What was saved is put back when training starts, after SB3 has
reset everything that it resets then.

The state is exact for the classes of Stable-Baselines3 and sb3-contrib. A custom class says by `get_state`
and `set_state` what else it keeps (docs/how-to/resume.md); with one that does not a run has no checkpoints.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common import callbacks as sb3_callbacks
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import FloatSchedule

from gridworld.agents import Hook, SafePoint
from gridworld.agents.sb3.model_file import load_tensors
from gridworld.agents.sb3.settings import SCHEDULES
from gridworld.base.bounds import Decay
from gridworld.base.console import tell
from gridworld.base.serialization import (
    State,
    StateError,
    fill,
    fitting,
    generator_state,
    global_state,
    set_generator_state,
    set_global_state,
)
from gridworld.engine.population import diverged, log_state, set_log_state

_LIBRARIES = ("stable_baselines3", "sb3_contrib", "torch", "gridworld", "builtins")  # None is no part
_NUMBERS = (
    *("num_timesteps", "_n_updates", "_episode_num", "_n_calls"),
    *("exploration_rate", "_current_progress_remaining"),
)
_OF_CALLBACKS: dict[type[BaseCallback], tuple[str, ...]] = {  # SB3's own, and what these count
    sb3_callbacks.CallbackList: (),
    sb3_callbacks.CheckpointCallback: (),
    sb3_callbacks.EveryNTimesteps: ("last_time_trigger",),
    sb3_callbacks.StopTrainingOnMaxEpisodes: ("n_episodes", "_total_max_episodes"),
}


class RunCallback(CallbackList):
    """Calls `on_step` after every step and `on_safe_point` at rollouts' starts, as `Agent.learn` has them.

    Settings that are `falling` without a schedule of SB3's are set before the user's callbacks are called.
    """

    def __init__(
        self,
        on_step: Hook,
        on_safe_point: SafePoint,
        state: State | None,
        log_interval: int,
        others: Sequence[BaseCallback],
        falling: dict[str, Decay],
    ) -> None:
        self._schedules = [
            FallingSetting(name, decay.initial, decay.power)
            for name, decay in falling.items()
            if not (name in SCHEDULES and decay.power == 1)
        ]
        super().__init__([*self._schedules, *others])
        self._hook, self._on_safe_point, self._state = on_step, on_safe_point, state
        self._log_interval, self._others = log_interval, others
        self._continues = True

    def _on_step(self) -> bool:
        self._continues = self._hook(self.num_timesteps) > 0
        for index, other in enumerate(self._others):
            if not other.on_step():
                self._continues = False
                tell(
                    f"callbacks[{index}]: {_path(other)} stopped training after {self.num_timesteps:,} steps"
                )
        return self._continues

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self._state is not None:
            with fitting():
                set_state(self.model, self._others, self._state)
            for each in self._schedules:
                each.put_back()
            self._state = None
            self.num_timesteps = self.model.num_timesteps

    def _on_rollout_start(self) -> None:
        check_finite(self.model)
        rollouts = 0
        if isinstance(self.model, OnPolicyAlgorithm):
            rollouts = self.model.num_timesteps // (self.model.n_steps * self.model.n_envs)
        # SB3 counts rollouts from its `learn` on: only here would it log again as it does from the start.
        if self._on_safe_point is not None and rollouts % self._log_interval == 0:
            self._on_safe_point(self.model.num_timesteps)
        super()._on_rollout_start()

    def _on_training_end(self) -> None:
        if self._continues:
            buffer = getattr(self.model, "rollout_buffer", None)
            if isinstance(buffer, BaseBuffer):
                buffer.reset()  # as at the start of a rollout
            check_finite(self.model)
            if self._on_safe_point is not None:
                self._on_safe_point(self.model.num_timesteps)
        super()._on_training_end()
        for callback in _flat([self]):
            callback.locals = {}  # SB3 puts the callback itself there: a circle


class FallingSetting(BaseCallback):
    """Lets a number of a model of SB3's fall to 0 over training; usable in SB3's own `learn()`.

    An entropy bonus that is large enough to keep a policy trying aims at a policy that goes on trying.
    Falling to 0, it ends at the world's own optimum. Generalised advantages with a λ near 1 are close to
    returns, by which the values follow the policy soon; with a small one they have less noise.

    Args:
        name: `ent_coef` or `learning_rate`, set before each update, or `gae_lambda`, set before each rollout.
        initial: what it falls from.
        power: 1 lets it fall linearly, 2 with the square of what is left of training.
    """

    def __init__(self, name: str, initial: float, power: float = 1.0) -> None:
        super().__init__()
        self._name, self._decay = name, Decay(initial, power)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._name == "gae_lambda":
            self._set()

    def _on_rollout_end(self) -> None:
        if self._name != "gae_lambda":
            self._set()

    def _set(self) -> None:
        value = self._set_as_after(self.model.num_timesteps)
        if self._name != "learning_rate":  # which SB3 logs
            self.logger.record(f"train/{self._name}", value)

    def put_back(self) -> None:
        """Set it as the last rollout before a checkpoint did."""
        model: Any = self.model
        rollout = model.n_steps * model.n_envs if self._name == "gae_lambda" else 0
        self._set_as_after(model.num_timesteps - rollout)

    def _set_as_after(self, steps: int) -> float:
        model: Any = self.model
        value = self._decay.at(min(steps / model._total_timesteps, 1.0))
        if self._name == "learning_rate":  # SB3's own, so that its `load` reads the model's file anywhere
            model.lr_schedule = FloatSchedule(value)
        else:
            setattr(model, self._name, value)
        if self._name == "gae_lambda":
            model.rollout_buffer.gae_lambda = value
        return value


def _path(thing: object) -> str:
    return f"{type(thing).__module__}.{type(thing).__qualname__}"


def check_finite(model: BaseAlgorithm) -> None:
    """Check that the last update left finite weights and losses."""
    if not all(bool(torch.isfinite(each).all()) for each in model.policy.parameters()):
        raise diverged(model, "a weight")
    losses = [value for name, value in model.logger.name_to_value.items() if "loss" in name]
    if not all(math.isfinite(loss) for loss in losses):
        raise diverged(model, "a loss")


@runtime_checkable
class HasState(Protocol):
    """A custom class that says what it keeps."""

    def get_state(self) -> State:
        """All that it keeps."""

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`."""


def class_without_state(model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> str | None:
    """The path of a class of which nobody knows what it keeps; None: all are known."""
    unknown = [each for each in _parts(model) if type(each).__module__.partition(".")[0] not in _LIBRARIES]
    unknown += [each for each in _flat(callbacks) if type(each) not in _OF_CALLBACKS]
    return next((_path(each) for each in unknown if not isinstance(each, HasState)), None)


def _parts(model: Any) -> list[Any]:
    """The model and all of which somebody may write a class."""
    buffers = [getattr(model, f"{kind}_buffer", None) for kind in ("replay", "rollout")]
    return [model, *model.policy.modules(), model.policy.optimizer, *buffers]


def _flat(callbacks: Sequence[BaseCallback]) -> Iterator[BaseCallback]:
    """Callbacks, and those that they hold."""
    for callback in callbacks:
        yield callback
        held = [*getattr(callback, "callbacks", ()), getattr(callback, "callback", None)]
        yield from _flat([each for each in held if isinstance(each, BaseCallback)])


def _with_state(model: Any, callbacks: Sequence[BaseCallback]) -> list[HasState]:
    return [each for each in (*_parts(model), *_flat(callbacks)) if isinstance(each, HasState)]


def get_state(model: Any, callbacks: Sequence[BaseCallback]) -> State:
    """The state of a model that waits between a rollout and the next, and of its callbacks."""
    return {
        **{name: getattr(model, name) for name in _NUMBERS if hasattr(model, name)},
        "parameters": {name: _saved(each) for name, each in model.get_parameters().items()},
        "replay": _replay(model),
        "environments": model.env.envs.get_state(),
        "last_episode_starts": model._last_episode_starts,
        **log_state(model),
        "global_generators": global_state(),
        "torch_generators": _torch_state(),
        "action_generator": generator_state(model.action_space.np_random),
        "own": [each.get_state() for each in _with_state(model, callbacks)],
        "callbacks": [{name: getattr(each, name) for name in _counts(each)} for each in _flat(callbacks)],
    }


def set_state(model: Any, callbacks: Sequence[BaseCallback], state: State) -> None:
    """Mirrors `get_state`, where SB3's `learn` has begun and made no step; generators come last."""
    for name in _NUMBERS:
        if hasattr(model, name):
            setattr(model, name, type(getattr(model, name))(state[name]))
    parameters = {name: load_tensors(each.tobytes()) for name, each in state["parameters"].items()}
    model.set_parameters(parameters, exact_match=True, device=model.device)
    if _replay(model):
        buffer, pos = model.replay_buffer, int(state["replay"]["pos"])
        if not 0 <= pos < buffer.buffer_size:
            raise StateError(f"the replay's pos must be from 0 to {buffer.buffer_size - 1}")
        buffer.pos, buffer.full = pos, bool(state["replay"]["full"])
        for name, rows in _replay(model).items():
            if isinstance(rows, np.ndarray):
                fill(rows, state["replay"][name], f"the replay's {name}")
    model.env.envs.set_state(state["environments"])
    model._last_obs = model.env.observation.rows(model.env.states)
    if model._last_episode_starts is not None:
        fill(model._last_episode_starts, state["last_episode_starts"], "last_episode_starts")
    set_log_state(model, state)
    for callback, counts in zip(_flat(callbacks), state["callbacks"], strict=True):
        for name in _counts(callback):
            setattr(callback, name, int(counts[name]))
    for each, own in zip(_with_state(model, callbacks), state["own"], strict=True):
        each.set_state(own)
    set_generator_state(model.action_space.np_random, state["action_generator"])
    set_global_state(state["global_generators"])
    torch.set_rng_state(torch.from_numpy(state["torch_generators"]["cpu"]))
    if "cuda" in state["torch_generators"]:
        torch.cuda.set_rng_state_all([torch.from_numpy(each) for each in state["torch_generators"]["cuda"]])


def _saved(tensors: dict[str, Any]) -> NDArray[np.uint8]:
    content = io.BytesIO()
    torch.save(tensors, content)
    return np.frombuffer(content.getvalue(), dtype=np.uint8)


def _torch_state() -> State:
    state: State = {"cpu": torch.get_rng_state().numpy().copy()}
    if torch.cuda.is_available() and torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        state["cuda"] = [device.cpu().numpy().copy() for device in torch.cuda.get_rng_state_all()]
    return state


def _replay(model: Any) -> State:
    """Views of the steps in a replay buffer of SB3's, and where it is; {} where there is none."""
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None or isinstance(buffer, HasState):
        return {}
    count = buffer.buffer_size if buffer.full else buffer.pos
    held = {name: each if isinstance(each, dict) else {"": each} for name, each in vars(buffer).items()}
    arrays = {
        f"{name}.{key}" if key else name: each
        for name, parts in held.items()
        for key, each in parts.items()
        if isinstance(each, np.ndarray)
    }
    rows = {name: each[:count] for name, each in arrays.items() if len(each) == buffer.buffer_size}
    return {**rows, "pos": int(buffer.pos), "full": bool(buffer.full)}


def _counts(callback: BaseCallback) -> tuple[str, ...]:
    return ("n_calls", "num_timesteps", *_OF_CALLBACKS.get(type(callback), ()))
