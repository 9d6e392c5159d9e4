"""An SB3 model behind the `Agent` protocol, in SB3's own loop or in `gridworld.engine`."""

from __future__ import annotations

import io
import traceback
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Dict
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from torch import nn

from gridworld.agents import Agent, Hook, Learning, SafePoint, TrainingContext, WriteScalars, misfit
from gridworld.agents.sb3.callbacks import RunCallback, check_finite, class_without_state, get_state
from gridworld.agents.sb3.factory import algorithm_and_arguments, failed, make_callbacks, make_model, unfit
from gridworld.agents.sb3.features import AgentByColour, FourierFeatures, PixelCNN
from gridworld.agents.sb3.model_file import read_model
from gridworld.agents.sb3.policy_outputs import (
    explored,
    predicted,
    predicts_by,
    read_table,
    why_no_table,
    why_unsteady,
)
from gridworld.agents.sb3.replay_counts import ReplayCounts
from gridworld.agents.sb3.settings import SB3Config
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.base.bounds import Bounds
from gridworld.base.console import tell
from gridworld.base.errors import InputError
from gridworld.base.serialization import State, StateError
from gridworld.engine.optimizer import ELEMENTWISE
from gridworld.engine.population import Population, train
from gridworld.engine.sb3_format import algorithm_of, make_run, model_file, put_weights
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import PolicySnapshot
from gridworld.world.mdp import FloatArray

# A model file holds the optimiser's numbers beside every weight, and what SB3 pickles.
_BYTES_A_BYTE, _SPARE_BYTES = 16, 64 * 2**20
# Of torch.nn, what maps every number by itself, in training as in evaluation, and never draws at random.
ACTIVATIONS = (
    *(nn.CELU, nn.ELU, nn.GELU, nn.Hardshrink, nn.Hardsigmoid, nn.Hardswish, nn.Hardtanh, nn.Identity),
    *(nn.LeakyReLU, nn.LogSigmoid, nn.Mish, nn.PReLU, nn.ReLU, nn.ReLU6, nn.SELU, nn.SiLU, nn.Sigmoid),
    *(nn.Softplus, nn.Softshrink, nn.Softsign, nn.Tanh, nn.Tanhshrink),
)
# Of `policy_kwargs`, classes with which outputs at a state follow from the parameters and that state alone.
_KNOWN_CLASSES: Mapping[str, Sequence[type]] = {
    "activation_fn": ACTIVATIONS,
    "features_extractor_class": (FourierFeatures, AgentByColour, PixelCNN),
    "optimizer_class": ELEMENTWISE,  # of which each step looks at a weight at a time
}


def build(config: SB3Config, context: TrainingContext) -> SB3Agent:
    """Build an agent that learns in the engine, if that gives what SB3's own loop would, else in that one.

    A line says why not where the engine is asked for.
    """
    sees_dict = isinstance(context.observation.space, Dict)
    algorithm, arguments = algorithm_and_arguments(config, context.features, sees_dict)
    ours = algorithm_of(algorithm) if config.engine == "tabulated" else None
    if ours is not None:
        unknown = "callbacks" if context.callbacks else unknown_to_engine(config, algorithm, arguments)
        if unknown is not None:
            ours = None
            if not context.only_asked:
                tell(f"engine: stock, since the tabulated engine does not support {unknown}")
    keeps = ours is None and not context.only_asked
    model = make_model(config, context, algorithm, arguments, with_buffers=keeps)
    if ours is not None:
        return EngineAgent(config, context, model, ours)
    agent = SB3Agent(config, context, model)
    agent.check_table()
    return agent


def unknown_to_engine(
    config: SB3Config, algorithm: type[BaseAlgorithm], arguments: Mapping[str, Any]
) -> str | None:
    """The first setting with which the engine need not give what SB3's own loop does; None: there is none."""
    known: dict[str, Sequence[Any]] = {
        "replay_buffer_class": [None, ReplayCounts] if issubclass(algorithm, DQN) else [None],
        "rollout_buffer_class": [None],
        "replay_buffer_kwargs": [None, {}],
        "rollout_buffer_kwargs": [None, {}],
        "optimize_memory_usage": [False],
        "n_steps": [1] if issubclass(algorithm, OffPolicyAlgorithm) else [arguments.get("n_steps")],
    }
    for name, values in known.items():
        if name in arguments and arguments[name] not in values:
            return f"{config.where}.{name}={config.given[name]}"
    if arguments["policy"] not in (algorithm.policy_aliases[name] for name in ("MlpPolicy", "CnnPolicy")):
        is_dict = arguments["policy"] is algorithm.policy_aliases["MultiInputPolicy"]
        return "observations that are a Dict" if is_dict else f"agent.policy={config.policy}"
    kwargs, own = arguments.get("policy_kwargs", {}), config.policy_kwargs_given
    for name, classes in _KNOWN_CLASSES.items():
        if name in kwargs and kwargs[name] not in classes:
            is_own = name in own
            key = f"{config.where}.policy_kwargs.{name}" if is_own else "observation.features"
            return f"{key}={own[name] if is_own else kwargs[name].__name__}"
    return None


class SB3Agent(Agent):
    """One SB3 model, which learns in SB3's own loop."""

    def __init__(self, config: SB3Config, context: TrainingContext, model: BaseAlgorithm) -> None:
        self.config = config
        self.observation = context.observation
        self._envs = context.envs
        self._loaded = False
        self._model = model
        self._callbacks = make_callbacks(context.callbacks)
        writers = [] if context.write_scalars is None else [_ScalarsOnly(context.write_scalars)]
        self._model.set_logger(Logger(folder=None, output_formats=list(writers)))

    def check_table(self) -> None:
        """Check that the policy can be asked, and answers the same in the same state always."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # which come again while it learns
                model, policy = self._model, self._model.policy
                if self.acts_by() is None:
                    why = why_no_table(policy, self.observation)
                else:
                    why = why_unsteady(model, policy, self.observation, self._envs.mdp)
        except InputError as error:
            raise unfit(self.config, f"cannot be evaluated: {error!s}") from None
        except Exception as error:  # the class may be anybody's
            raise failed(self.config, "cannot be evaluated", error) from error
        if why is not None:
            raise unfit(self.config, why)

    @property
    def model(self) -> BaseAlgorithm:
        return self._model

    def learn(
        self, total_timesteps: int, on_step: Hook, on_safe_point: SafePoint = None, state: State | None = None
    ) -> None:
        interval, falling = self.config.log_interval, self.config.falling()
        callback = RunCallback(on_step, on_safe_point, state, interval, self._callbacks, falling)
        try:
            self._model.learn(total_timesteps, callback=callback, log_interval=interval)
        except (InputError, OSError, StateError):
            raise
        except Exception as error:
            if isinstance(error, ValueError):  # torch's distributions refuse NaN, which SB3 lets through
                check_finite(self._model)
            is_update = any(frame.name == "train" for frame in traceback.extract_tb(error.__traceback__))
            # a custom class may have a bug, of which the traceback is wanted
            is_known = type(self._model).__module__.startswith(("stable_baselines3.", "sb3_contrib."))
            if is_update and is_known and not self._model._n_updates:
                raise failed(self.config, "cannot make its first update", error) from error
            raise

    def class_without_state(self) -> str | None:
        return class_without_state(self._model, self._callbacks)

    def get_state(self) -> State:
        return get_state(self._model, self._callbacks)

    def acts_by(self) -> str | None:
        return predicts_by(self._model, self._model.policy)

    def snapshot(self) -> PolicySnapshot:
        found = self._snapshot(*read_table(self._model.policy, self.observation))
        if self.acts_by() is None:
            return found
        return replace(found, greedy=predicted(self._model, self.observation, self._envs.mdp))

    def _snapshot(
        self, values: FloatArray, probabilities: FloatArray | None, q: FloatArray | None
    ) -> PolicySnapshot:
        if probabilities is not None:
            return PolicySnapshot(np.argmax(probabilities, axis=1), probabilities, values)
        assert q is not None
        if (scale := self.config.reward_factor) != 1:
            values, q = values / scale, q / scale
        greedy = np.argmax(q, axis=1)
        # SB3 acts at random until learning starts, while its own attribute still says 0.
        warmup = getattr(self._model, "learning_starts", 0)
        epsilon = float(getattr(self._model, "exploration_rate", 0.0))
        if not self._loaded and self._model.num_timesteps < max(warmup, 1):
            epsilon = 1.0
        return PolicySnapshot(greedy, explored(one_hot_policy(greedy, q.shape[1]), epsilon), values, q)

    def model_file(self) -> bytes:
        return model_file(self._model, ["_last_original_obs"])  # which SB3 sets before it reads it

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`: nothing in the file is unpickled as SB3 would, or run."""
        own = {
            module: state
            for module, state in self._model.get_parameters().items()
            if "param_groups" not in state  # of an optimiser, which stays as it is
        }
        size = sum(weights.nbytes for state in own.values() for weights in state.values())
        kind = f"a model of {self.config.name}"
        found, numbers = read_model(path, _SPARE_BYTES + _BYTES_A_BYTE * size, kind)
        for module in own:
            arrays, expected = (
                {name: tensor.cpu().numpy() for name, tensor in of_all.get(module, {}).items()}
                for of_all in (found, own)
            )
            if (reason := misfit(arrays, expected)) is not None:
                raise InputError(f"{path}: not {kind} for this world and observation ({module}.{reason})")
        taken: Any = {module: found[module] for module in own}
        self._model.set_parameters(taken, exact_match=False, device=self._model.device)
        self._loaded = True
        if (rate := numbers.get("exploration_rate")) is not None:
            Bounds(0, 1).check(f"{path}: exploration_rate", rate)
            self._model.exploration_rate = rate  # type: ignore[attr-defined]


class EngineAgent(SB3Agent):
    """One SB3 model, which learns in the engine."""

    def __init__(
        self, config: SB3Config, context: TrainingContext, model: BaseAlgorithm, ours: type[Population]
    ) -> None:
        super().__init__(config, context, model)
        self._algorithm, self._is_only_asked = ours, context.only_asked
        self.run = make_run(
            *(self._model, context.observation, context.envs, context.seed),
            reward_scale=config.reward_factor,
            falling=config.falling(),
            log_interval=config.log_interval,
            counts_transitions=config.counts_transitions,
            shape=config.shape,
        )
        self._algorithm([self.run], [None])

    @property
    def model(self) -> BaseAlgorithm:
        """SB3's own object, with what was learned so far; it can learn on, unless it is only asked."""
        if self._is_only_asked:
            put_weights(self.run)
            return self._model
        file = io.BytesIO(self.model_file())
        envs = GridWorldVecEnv(self._envs, self.observation, self.config.reward_factor)
        own = {"policy_kwargs": self._model.policy_kwargs.copy()}  # with this process's classes
        return type(self._model).load(file, env=envs, device=self._model.device, custom_objects=own)

    def learn(
        self, total_timesteps: int, on_step: Hook, on_safe_point: SafePoint = None, state: State | None = None
    ) -> None:
        (error,) = self.learn_together([Learning(self, total_timesteps, on_step, on_safe_point, state)])
        if error is not None:
            raise error

    def learn_together(self, learnings: Sequence[Learning]) -> list[BaseException | None]:
        agents = [learning.agent for learning in learnings if isinstance(learning.agent, EngineAgent)]
        for agent, learning in zip(agents, learnings, strict=True):
            agent.run.begin(learning.total_timesteps)
            agent.run.on_step, agent.run.on_safe_point = learning.on_step, learning.on_safe_point
        train([agent.run for agent in agents], [learning.state for learning in learnings])
        for agent in agents:
            if agent.run.failed_update is not None and not agent.run.model._n_updates:
                error = agent.run.failed_update
                agent.run.error = failed(agent.config, "cannot make its first update", error)
        return [agent.run.error for agent in agents]

    def get_state(self) -> State:
        return self.run.population.get_state(self.run)

    def snapshot(self) -> PolicySnapshot:
        return self._snapshot(*self.run.population.snapshot(self.run))

    def model_file(self) -> bytes:
        put_weights(self.run)
        buffers = ["rollout_buffer_class", "replay_buffer_class", "replay_buffer_kwargs"]
        return model_file(self._model, buffers)

    def load(self, path: Path) -> None:
        super().load(path)
        self._algorithm([self.run], [None])


class _ScalarsOnly(KVWriter):
    """Passes SB3's numbers on to the run's one event file."""

    def __init__(self, write_scalars: WriteScalars) -> None:
        self._write_scalars = write_scalars

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        wanted = {
            key: float(value)
            for key, value in key_values.items()
            if isinstance(value, int | float | np.number) and "tensorboard" not in (key_excluded[key] or ())
        }
        self._write_scalars(wanted, step)

    def close(self) -> None:
        """Nothing of its own to close."""
