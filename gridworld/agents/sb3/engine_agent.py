"""A model of SB3 that learns in `gridworld.engine`, behind the `Agent` protocol."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor

from gridworld.agents import Learning, PolicySnapshot, TrainingContext
from gridworld.agents.sb3.agent import SB3Agent
from gridworld.agents.sb3.factory import cannot_update
from gridworld.agents.sb3.features import FIXED, LEARNED
from gridworld.agents.sb3.settings.schemas import SB3Config, counts_transitions, reward_scale
from gridworld.agents.sb3.settings.validation import FALLING
from gridworld.agents.sb3.vec_env import GridWorldVecEnv
from gridworld.config.agents import falls, parse_schedule
from gridworld.engine.population import train
from gridworld.engine.sb3_format import Kind, algorithm_of, make_run, model_file, put_weights
from gridworld.storage.serialization import State


class EngineAgent(SB3Agent):
    """A run of the engine.

    Args:
        config: its settings.
        context: what it learns on.
    """

    def __init__(self, config: SB3Config, context: TrainingContext) -> None:
        super().__init__(config, context, with_buffers=False)
        algorithm = algorithm_of(type(self._model))
        assert algorithm is not None
        self._algorithm, self._is_only_asked = algorithm, context.only_asked
        given = vars(config) | vars(config).get("arguments", {})
        falling = {name: parse_schedule(name, given[name]) for name in FALLING if falls(given.get(name))}
        self.run = make_run(
            self._model,
            context.observation,
            context.envs,
            context.seed,
            extractors_kind(self._model),
            reward_scale(config),
            falling,
            config.log_interval,
        )
        self.run.counts_transitions = counts_transitions(given)
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
        values, probabilities, q = self.run.population.snapshot(self.run)
        if probabilities is not None:
            return PolicySnapshot(np.argmax(probabilities, axis=1), probabilities, values)
        return self._of_q(values, q)

    def model_file(self) -> bytes:
        """See `gridworld.agents.Agent.model_file`."""
        return model_file(self.run)

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`."""
        super().load(path)
        self._algorithm([self.run], [None])


def extractors_kind(model: Any) -> Kind:
    """Of a model's features extractors, see `engine.inputs.Inputs`."""
    kinds = {type(each) for each in model.policy.modules() if isinstance(each, BaseFeaturesExtractor)}
    if kinds == {FlattenExtractor}:
        return "flat"
    if kinds <= {FlattenExtractor, *FIXED}:
        return "fixed"
    return "patches" if kinds <= set(LEARNED) else "any"
