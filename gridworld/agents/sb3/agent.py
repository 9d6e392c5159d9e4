"""An SB3 model behind the `Agent` protocol."""

from __future__ import annotations

import io
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.save_util import recursive_getattr

from gridworld.agents import PolicySnapshot, TrainingContext, WriteScalars
from gridworld.agents.sb3.callbacks import RunCallback, check_finite, diverged, make_callbacks
from gridworld.agents.sb3.factory import UnfitError, cannot_update, make_model
from gridworld.agents.sb3.falling_setting import falling_settings
from gridworld.agents.sb3.model_file import check_weights, flat, read_parameters, reason
from gridworld.agents.sb3.policy_outputs import Reading, epsilon_greedy, read, read_states, why_no_table
from gridworld.agents.sb3.settings.schemas import SB3Config, reward_scale
from gridworld.agents.sb3.state import class_without_state
from gridworld.bounds import Bounds
from gridworld.config.agents import AgentConfig
from gridworld.errors import InputError
from gridworld.storage.serialization import State, StateError
from gridworld.world.mdp import FloatArray, IntArray

# A model file holds the optimiser's numbers beside every weight, and what SB3 pickles: the last
# observations, say.
_BYTES_A_BYTE = 16
_SPARE_BYTES = 64 * 2**20
_FIRST_YEAR = 1980  # of the zip format


class SB3Agent:
    """One SB3 model.

    Args:
        config: its settings.
        context: what it learns on.
    """

    def __init__(self, config: AgentConfig, context: TrainingContext, with_buffers: bool = True) -> None:
        assert isinstance(config, SB3Config)
        if (today := time.localtime()).tm_year < _FIRST_YEAR:
            raise InputError(
                f"the clock says {time.strftime('%Y-%m-%d', today)}, and SB3's model.zip can have no date "
                f"before {_FIRST_YEAR}; set the clock"
            )
        torch.set_num_threads(context.threads)
        self.config = config
        self.observation = context.observation
        self._envs = context.envs
        self._loaded = False
        self._model = make_model(config, context, with_buffers and not context.only_asked)
        if with_buffers:
            self._check_table()
        self._callbacks = make_callbacks(context.callbacks)
        writers = [] if context.write_scalars is None else [_ScalarsOnly(context.write_scalars)]
        self._model.set_logger(Logger(folder=None, output_formats=list(writers)))

    def _check_table(self) -> None:
        """Check that the policy can be asked, and answers the same in the same state always."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # which come again while it learns
                reason = why_no_table(self._model.policy, self.observation)
        except Exception as error:  # the class may be anybody's
            raise cannot_update(self.config, error) from error
        if reason is not None:
            raise UnfitError(self.config, reason)

    @property
    def model(self) -> BaseAlgorithm:
        """SB3's."""
        return self._model

    def learn(
        self,
        total_timesteps: int,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None = None,
        state: State | None = None,
    ) -> None:
        """See `gridworld.agents.Agent.learn`."""
        falling = falling_settings(self.config)
        self._callback = RunCallback(
            on_step, on_safe_point, state, self.config.log_interval, self._callbacks, falling
        )
        try:
            self._model.learn(total_timesteps, callback=self._callback, log_interval=self.config.log_interval)
        except FloatingPointError as error:
            raise diverged(self._model, str(error)) from None
        except (InputError, OSError, StateError):
            raise
        except Exception as error:
            if isinstance(error, ValueError):  # torch's distributions refuse NaN, which SB3 lets through
                check_finite(self._model)
            if self._refuses_settings(error):
                raise cannot_update(self.config, error) from error
            raise

    def _refuses_settings(self, error: Exception) -> bool:
        """Whether an error is of the first update of a library's class; one of somebody's own has a bug."""
        is_update = any(frame.name == "train" for frame in traceback.extract_tb(error.__traceback__))
        library = type(self._model).__module__.partition(".")[0]
        return is_update and not self._model._n_updates and library in ("stable_baselines3", "sb3_contrib")

    def class_without_state(self) -> str | None:
        """See `gridworld.agents.Agent.class_without_state`."""
        return class_without_state(self._model, self._callbacks)

    def get_state(self) -> State:
        """See `gridworld.agents.Agent.get_state`, for while it learns."""
        return self._callback.get_state()

    def snapshot(self) -> PolicySnapshot:
        """See `gridworld.agents.Agent.snapshot`."""
        values, probabilities, q = read_states(self.observation.num_states, self._read)
        if probabilities is not None:
            return PolicySnapshot(np.argmax(probabilities, axis=1), probabilities, values)
        return self._of_q(values, q)

    def _of_q(self, values: FloatArray, q: FloatArray | None) -> PolicySnapshot:
        assert q is not None
        if (scale := reward_scale(self.config)) != 1:
            values, q = values / scale, q / scale
        return PolicySnapshot(np.argmax(q, axis=1), epsilon_greedy(q, self._exploration_rate()), values, q)

    def _exploration_rate(self) -> float:
        """That of DQN; SB3 acts at random until learning starts, while its own attribute still says 0."""
        warmup = getattr(self._model, "learning_starts", 0)
        if not self._loaded and self._model.num_timesteps < max(warmup, 1):
            return 1.0
        return float(getattr(self._model, "exploration_rate", 0.0))

    def _read(self, states: IntArray) -> Reading:
        observations, _ = self._model.policy.obs_to_tensor(self.observation.rows(states))
        return read(self._model.policy, observations)

    def model_file(self) -> bytes:
        """See `gridworld.agents.Agent.model_file`."""
        content = io.BytesIO()
        self._model.save(content)
        return content.getvalue()

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`.

        Reads tensors and one number: nothing in the file is unpickled as SB3 would, or run.
        """
        own = self._model.get_parameters()
        modules = [name for name in own if isinstance(recursive_getattr(self._model, name), torch.nn.Module)]
        expected = flat({name: own[name] for name in modules})
        most = _SPARE_BYTES + _BYTES_A_BYTE * sum(weights.nbytes for weights in expected.values())
        try:
            parameters, rate = read_parameters(path, most)
            found = {name: parameters.get(name, {}) for name in modules}
            check_weights(flat(found), expected)
            self._model.set_parameters(found, exact_match=False, device=self._model.device)
        except InputError:
            raise
        except Exception as error:  # zipfile, torch and SB3, each in their way
            raise InputError(
                f"{path}: not a model of {self.config.name} for this world and observation ({reason(error)})"
            ) from None
        self._loaded = True
        if rate is not None:
            Bounds(0, 1).check(f"{path}: exploration_rate", rate)
            self._model.exploration_rate = rate  # type: ignore[attr-defined]


class _ScalarsOnly(KVWriter):
    """Hands SB3's numbers on to the run's one event file."""

    def __init__(self, write_scalars: WriteScalars) -> None:
        self._write_scalars = write_scalars

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        self._write_scalars(
            {
                key: float(value)
                for key, value in key_values.items()
                if isinstance(value, int | float | np.number)
                and "tensorboard" not in (key_excluded[key] or ())
            },
            step,
        )

    def close(self) -> None:
        """Nothing of its own to close."""
