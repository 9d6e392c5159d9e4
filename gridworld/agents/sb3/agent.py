"""An SB3 model behind the `Agent` protocol, in SB3's own loop or in `gridworld.engine`."""

from __future__ import annotations

import io
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor

from gridworld.agents import Learning, PolicySnapshot, TrainingContext, WriteScalars
from gridworld.agents.sb3.callbacks import RunCallback, check_finite, diverged, falling_settings
from gridworld.agents.sb3.factory import UnfitError, cannot_update, make_callbacks, make_model
from gridworld.agents.sb3.features import FIXED, LEARNED
from gridworld.agents.sb3.model_file import check_weights, flat, read_parameters, reason
from gridworld.agents.sb3.policy_outputs import explored, read_table, why_no_table
from gridworld.agents.sb3.settings.schemas import SB3Config, counts_transitions, reward_scale
from gridworld.agents.sb3.state import class_without_state
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.bounds import Bounds
from gridworld.engine.population import train
from gridworld.engine.sb3_format import Kind, algorithm_of, make_run, model_file, put_weights
from gridworld.errors import InputError
from gridworld.storage.serialization import State, StateError
from gridworld.world.chain import one_hot_policy
from gridworld.world.mdp import FloatArray

# A model file holds the optimiser's numbers beside every weight, and what SB3 pickles: the last
# observations, say.
_BYTES_A_BYTE = 16
_SPARE_BYTES = 64 * 2**20
_FIRST_YEAR = 1980  # of the zip format


class SB3Agent:
    """One SB3 model, which learns in SB3's own loop."""

    def __init__(self, config: SB3Config, context: TrainingContext, with_buffers: bool = True) -> None:
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
        interval, falling = self.config.log_interval, falling_settings(self.config)
        self._callback = RunCallback(on_step, on_safe_point, state, interval, self._callbacks, falling)
        try:
            self._model.learn(total_timesteps, callback=self._callback, log_interval=interval)
        except FloatingPointError as error:
            raise diverged(self._model, str(error)) from None
        except (InputError, OSError, StateError):
            raise
        except Exception as error:
            if isinstance(error, ValueError):  # torch's distributions refuse NaN, which SB3 lets through
                check_finite(self._model)
            is_update = any(frame.name == "train" for frame in traceback.extract_tb(error.__traceback__))
            library = type(self._model).__module__.partition(".")[0]
            is_known = library in ("stable_baselines3", "sb3_contrib")  # a custom class may have a bug
            if is_update and is_known and not self._model._n_updates:
                raise cannot_update(self.config, error) from error
            raise

    def class_without_state(self) -> str | None:
        """See `gridworld.agents.Agent.class_without_state`."""
        return class_without_state(self._model, self._callbacks)

    def get_state(self) -> State:
        """See `gridworld.agents.Agent.get_state`, for while it learns."""
        return self._callback.get_state()

    def snapshot(self) -> PolicySnapshot:
        """See `gridworld.agents.Agent.snapshot`."""
        return self._snapshot(*read_table(self._model.policy, self.observation))

    def _snapshot(
        self, values: FloatArray, probabilities: FloatArray | None, q: FloatArray | None
    ) -> PolicySnapshot:
        if probabilities is not None:
            return PolicySnapshot(np.argmax(probabilities, axis=1), probabilities, values)
        assert q is not None
        if (scale := reward_scale(self.config)) != 1:
            values, q = values / scale, q / scale
        greedy = np.argmax(q, axis=1)
        sampled = explored(one_hot_policy(greedy, q.shape[1]), self._exploration_rate())
        return PolicySnapshot(greedy, sampled, values, q)

    def _exploration_rate(self) -> float:
        """That of DQN; SB3 acts at random until learning starts, while its own attribute still says 0."""
        warmup = getattr(self._model, "learning_starts", 0)
        if not self._loaded and self._model.num_timesteps < max(warmup, 1):
            return 1.0
        return float(getattr(self._model, "exploration_rate", 0.0))

    def model_file(self) -> bytes:
        """See `gridworld.agents.Agent.model_file`."""
        content = io.BytesIO()
        self._model.save(content)
        return content.getvalue()

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`: nothing in the file is unpickled as SB3 would, or run."""
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


class EngineAgent(SB3Agent):
    """One SB3 model, which learns in the engine."""

    def __init__(self, config: SB3Config, context: TrainingContext) -> None:
        super().__init__(config, context, with_buffers=False)
        algorithm = algorithm_of(type(self._model))
        assert algorithm is not None
        self._algorithm, self._is_only_asked = algorithm, context.only_asked
        self.run = make_run(
            self._model,
            context.observation,
            context.envs,
            context.seed,
            extractors_kind(self._model),
            reward_scale(config),
            falling_settings(config, all_of_them=True),
            config.log_interval,
        )
        self.run.counts_transitions = counts_transitions(vars(config) | vars(config).get("arguments", {}))
        self._algorithm([self.run], [None])

    @property
    def model(self) -> BaseAlgorithm:
        """SB3's own object, with what was learnt so far; it can learn on, unless it is only asked."""
        if self._is_only_asked:
            put_weights(self.run)
            return self._model
        file = io.BytesIO(self.model_file())
        envs = GridWorldVecEnv(self._envs, self.observation, reward_scale(self.config))
        return type(self._model).load(file, env=envs, device=self._model.device)

    def learn(
        self,
        total_timesteps: int,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None = None,
        state: State | None = None,
    ) -> None:
        """See `gridworld.agents.Agent.learn`."""
        (error,) = self.learn_together([Learning(self, total_timesteps, on_step, on_safe_point, state)])
        if error is not None:
            raise error

    def learn_together(self, learnings: Sequence[Learning]) -> list[BaseException | None]:
        """See `gridworld.agents.learn_together`."""
        agents = [learning.agent for learning in learnings if isinstance(learning.agent, EngineAgent)]
        for agent, learning in zip(agents, learnings, strict=True):
            agent.run.begin(learning.total_timesteps)
            agent.run.on_step, agent.run.on_safe_point = learning.on_step, learning.on_safe_point
        train([agent.run for agent in agents], [learning.state for learning in learnings])
        for agent in agents:
            if agent.run.failed_update is not None and not agent.run.model._n_updates:
                agent.run.error = cannot_update(agent.config, agent.run.failed_update)
        return [agent.run.error for agent in agents]

    def get_state(self) -> State:
        """See `gridworld.agents.Agent.get_state`."""
        return self.run.population.get_state(self.run)

    def snapshot(self) -> PolicySnapshot:
        """See `gridworld.agents.Agent.snapshot`."""
        return self._snapshot(*self.run.population.snapshot(self.run))

    def model_file(self) -> bytes:
        """See `gridworld.agents.Agent.model_file`."""
        return model_file(self.run)

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`."""
        super().load(path)
        self._algorithm([self.run], [None])


def extractors_kind(model: Any) -> Kind:
    """Of a model's features extractors, see `engine.sb3_format.Inputs`."""
    kinds = {type(each) for each in model.policy.modules() if isinstance(each, BaseFeaturesExtractor)}
    if kinds == {FlattenExtractor}:
        return "flat"
    if kinds <= {FlattenExtractor, *FIXED}:
        return "fixed"
    return "patches" if kinds <= set(LEARNED) else "any"


class _ScalarsOnly(KVWriter):
    """Passes SB3's numbers on to the run's one event file."""

    def __init__(self, write_scalars: WriteScalars) -> None:
        self._write_scalars = write_scalars

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        numbers = {
            key: value for key, value in key_values.items() if isinstance(value, int | float | np.number)
        }
        wanted = {
            key: float(value)
            for key, value in numbers.items()
            if "tensorboard" not in (key_excluded[key] or ())
        }
        self._write_scalars(wanted, step)

    def close(self) -> None:
        """Nothing of its own to close."""
