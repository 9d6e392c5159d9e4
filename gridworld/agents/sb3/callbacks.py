"""What calls the hooks of a run while SB3's own `learn` is at work, and settings that fall over training.

SB3 calls `on_step` before it has stored the transition. A rollout's start is where nothing is half done: the
transitions are stored, the update is made. What was saved is put back when training starts, after SB3 has
reset everything that it resets then.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import FloatSchedule

from gridworld.agents.sb3.factory import first_line
from gridworld.agents.sb3.settings.schemas import SB3Config
from gridworld.agents.sb3.settings.validation import FALLING, SCHEDULES
from gridworld.agents.sb3.state import get_state, set_state
from gridworld.config.agents import Decay, falls, parse_schedule
from gridworld.errors import InputError
from gridworld.process.console import tell
from gridworld.storage.serialization import State, fitting


class RunCallback(BaseCallback):
    """Calls `on_step` after every step and `on_safe_point` at rollouts' starts, as `Agent.learn` has them.

    Settings that are `falling` are set before `others` are called, the user's callbacks.
    """

    def __init__(
        self,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None,
        state: State | None,
        log_interval: int,
        others: Sequence[BaseCallback],
        falling: dict[str, Decay],
    ) -> None:
        super().__init__()
        self._hook, self._on_safe_point, self._state = on_step, on_safe_point, state
        self._log_interval, self._others = log_interval, others
        self._schedules = [FallingSetting(name, each.initial, each.power) for name, each in falling.items()]
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
        rollouts = 0
        if isinstance(self.model, OnPolicyAlgorithm):
            rollouts = self.model.num_timesteps // (self.model.n_steps * self.model.n_envs)
        # SB3 counts rollouts from its `learn` on: only here would it log again as it does from the start.
        if self._on_safe_point is not None and rollouts % self._log_interval == 0:
            self._on_safe_point(self.model.num_timesteps)
        for other in (*self._schedules, *self._others):
            other.on_rollout_start()

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


class FallingSetting(BaseCallback):
    """Sets a number of a model of SB3's as training goes on; usable in SB3's own `learn()`.

    An entropy bonus that is large enough to keep a policy trying aims at a policy that goes on trying.
    Falling to 0, it ends at the world's own optimum. Generalised advantages with a λ near 1 are close to
    returns, by which the values follow the policy soon; with a small one they have less noise.

    Args:
        name: `ent_coef` or `learning_rate`, set before each update, or `gae_lambda`, set before each rollout.
        initial: what it falls from, to 0 at the end of training.
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
        model: Any = self.model
        value = self._decay.at(min(model.num_timesteps / model._total_timesteps, 1.0))
        if self._name == "learning_rate":  # SB3's own, so that its `load` reads the model's file anywhere
            model.lr_schedule = FloatSchedule(value)
            return
        setattr(model, self._name, value)
        if self._name == "gae_lambda":
            model.rollout_buffer.gae_lambda = value
        model.logger.record(f"train/{self._name}", value)


def falling_settings(config: SB3Config, all_of_them: bool = False) -> dict[str, Decay]:
    """An agent's settings that fall over training, or only those for which SB3 has no schedule."""
    given = vars(config) | vars(config).get("arguments", {})
    found = {name: parse_schedule(name, given[name]) for name in FALLING if falls(given.get(name))}
    return {
        name: decay
        for name, decay in found.items()
        if all_of_them or not (name in SCHEDULES and decay.power == 1)
    }


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
        raise InputError(f"{_name(index, other)} cannot begin: {first_line(error)}") from error


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
