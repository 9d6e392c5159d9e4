"""Temporal-difference control with a table: the loop that Q-learning, SARSA and expected SARSA share.

After a step from (s, a) to reward r and state s', Q(s, a) moves towards r + γ V(s'), where V is the
algorithm's own estimate. Q of a terminal state is 0 and stays 0, so that nothing follows there. An episode
that the step limit cuts off is no end: its target looks at the state where it was cut.

An algorithm defines `state_values`. By default its target is taken from them, and the next actions are drawn
after the update, as in the book; SARSA overrides both. `gridworld.agents.tabular.batch_update` says how a
batch of environments updates one table.

Reference: R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, chapter 6.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gridworld.agents import PolicySnapshot, TrainingContext
from gridworld.agents.tabular.batch_update import StepSize, update
from gridworld.agents.tabular.epsilon_greedy import draw_actions, epsilon_greedy, rows_of
from gridworld.agents.tabular.model_file import model_bytes, read_model
from gridworld.agents.tabular.settings import TabularConfig
from gridworld.agents.tabular.training_log import TrainingLog
from gridworld.config.agents import MOST_KEPT, Schedule, parse_schedule
from gridworld.config.fields import Effect, affects, bounds, rate
from gridworld.errors import InputError
from gridworld.storage.rng_state import generator_state, independent_generator, set_generator_state
from gridworld.storage.serialization import State, fill, fitting
from gridworld.world.mdp import LEAST_REWARD, MOST_REWARD, FloatArray, IntArray

if TYPE_CHECKING:
    from gridworld.envs.vector_env import Ended


@dataclass
class TabularControlConfig(TabularConfig):
    """Temporal-difference control. Where Stable-Baselines3 has the same setting, it has the same name."""

    # step size; a number; lin_NUMBER, sqrt_NUMBER and quad_NUMBER fall to 0
    learning_rate: Schedule = field(default=0.1, metadata=rate(1, above=True))
    # times (visits of the state and action) ** -power
    learning_rate_power: float = field(default=0.0, metadata=bounds(0, 1))
    # of every action in every state that is no end
    initial_value: float = field(default=0.0, metadata=bounds(-MOST_REWARD, MOST_REWARD, least=LEAST_REWARD))
    # of training, in which epsilon falls linearly
    exploration_fraction: float = field(default=1.0, metadata=bounds(0, 1, above=True))
    # epsilon when training begins
    exploration_initial_eps: float = field(default=1.0, metadata=bounds(0, 1))
    exploration_final_eps: float = field(default=0.05, metadata=bounds(0, 1))  # epsilon after that fraction
    # episodes that the means in TensorBoard are taken over
    stats_window_size: int = field(default=100, metadata=affects(Effect.LABELS) | bounds(1, MOST_KEPT))
    # episodes between two points there
    log_interval: int = field(default=100, metadata=affects(Effect.LABELS) | bounds(1))


class TabularControl(ABC):
    """One table Q (S, A) of float64, learned on a batch of environments.

    Attributes:
        q: (S, A), the table.
        visits: (S, A), int64, the number of updates of each entry.
        exploration_rate: epsilon.
    """

    def __init__(self, config: TabularControlConfig, context: TrainingContext) -> None:
        mdp = context.envs.mdp
        self.config = config
        self.q: FloatArray = np.full((mdp.num_states, mdp.num_actions), config.initial_value)
        self.q[mdp.terminal] = 0.0
        self.visits: IntArray = np.zeros(self.q.shape, dtype=np.int64)
        self.exploration_rate = config.exploration_initial_eps
        self._context = context
        self._rate = parse_schedule("agent.learning_rate", config.learning_rate)
        self._random = independent_generator(context.seed)  # the environments take the seed's own
        self._steps = 0
        self._actions: IntArray = np.zeros(context.envs.num_envs, dtype=np.int64)  # chosen, not yet taken
        self._log = TrainingLog(config.stats_window_size, config.log_interval, context.write_scalars)

    @property
    def model(self) -> FloatArray:
        """The table."""
        return self.q

    @abstractmethod
    def state_values(self, q: FloatArray) -> FloatArray:
        """V of the policy whose Q the table is.

        Args:
            q: (n, A), rows of the table.

        Returns:
            (n,), their values.
        """

    def _values_ahead(self, reached: IntArray) -> FloatArray:
        """(num_envs,), what the update takes the values of the states reached for, (num_envs,)."""
        rows, index = rows_of(self.q, reached)
        return self.state_values(rows)[index]

    def _next_actions(self, states: IntArray, ended: Ended | None) -> IntArray:
        """(num_envs,), the actions to take in `states` (num_envs,), after the update."""
        return self._act(states)

    def learn(
        self,
        total_timesteps: int,
        on_step: Callable[[int], int],
        on_safe_point: Callable[[int], None] | None = None,
        state: State | None = None,
    ) -> None:
        """See `gridworld.agents.Agent.learn`."""
        envs, gamma = self._context.envs, self.config.gamma
        q, visits = self.q.reshape(-1), self.visits.reshape(-1)  # flat views
        states, _ = envs.reset(seed=self._context.seed)
        self._steps, self._actions = 0, self._act(states)
        if state is not None:
            with fitting():
                self._set_state(state)
            states = envs.states
        goes_on = True
        while goes_on and self._steps < total_timesteps:
            step_size = self._step_size(self._steps / total_timesteps)
            pairs = states * self.q.shape[1] + self._actions
            states, rewards, _, _, ended = envs.advance(self._actions)
            self._steps = steps = self._steps + envs.num_envs
            self.exploration_rate = self._epsilon(steps / total_timesteps)
            reached = states if ended is None else ended.states  # before the reset of what is over
            error = update(q, visits, pairs, rewards + gamma * self._values_ahead(reached), step_size)
            if not error < np.inf:
                raise InputError(
                    f"agent={self.config.name}: training diverged at step {steps:,}, the error of its update "
                    "is no finite number; try a smaller learning rate"
                )
            self._actions = self._next_actions(states, ended)
            rates = {
                "rollout/exploration_rate": self.exploration_rate,
                "train/learning_rate": step_size.rate,
            }
            self._log.add(ended, error, rates, steps)
            goes_on = on_step(steps) > 0
            if on_safe_point is not None and goes_on:
                on_safe_point(steps)

    def class_without_state(self) -> None:
        """See `gridworld.agents.Agent.class_without_state`."""
        return

    def get_state(self) -> State:
        """See `gridworld.agents.Agent.get_state`."""
        return {
            "envs": self._context.envs.get_state(),
            "random": generator_state(self._random),
            "q": self.q.copy(),
            "visits": self.visits.copy(),
            "exploration_rate": self.exploration_rate,
            "steps": self._steps,
            "actions": self._actions.copy(),
            "log": self._log.get_state(),
        }

    def _set_state(self, state: State) -> None:
        """Mirrors `get_state`, once learning has begun."""
        self._context.envs.set_state(state["envs"])
        set_generator_state(self._random, state["random"])
        fill(self.q, state["q"], "q")
        fill(self.visits, state["visits"], "visits")
        self.exploration_rate = float(state["exploration_rate"])
        self._steps = int(state["steps"])
        fill(self._actions, state["actions"], "actions")
        self._log.set_state(state["log"])

    def _act(self, states: IntArray) -> IntArray:
        return draw_actions(self.q, self.exploration_rate, states, self._random.random(len(states)))

    def _epsilon(self, progress: float) -> float:
        """ε after that share of training: linear over the configured fraction of it, then the final one."""
        start, end = self.config.exploration_initial_eps, self.config.exploration_final_eps
        return start + (end - start) * min(progress / self.config.exploration_fraction, 1.0)

    def _step_size(self, progress: float) -> StepSize:
        return StepSize(self._rate.at(progress), self.config.learning_rate_power)

    def snapshot(self) -> PolicySnapshot:
        """Of equally good actions, the first is the greedy one; the sampled policy takes any of them."""
        return PolicySnapshot(
            greedy=self.q.argmax(axis=1),
            sampled=epsilon_greedy(self.q, self.exploration_rate),
            values=self.state_values(self.q),
            q=self.q.copy(),
        )

    def model_file(self) -> bytes:
        """See `gridworld.agents.Agent.model_file`."""
        return model_bytes(
            self.config.algorithm,
            {"q": self.q, "visits": self.visits, "exploration_rate": np.array(self.exploration_rate)},
        )

    def load(self, path: Path) -> None:
        """See `gridworld.agents.Agent.load`."""
        like = {"q": self.q, "visits": self.visits, "exploration_rate": np.array(0.0)}
        arrays = read_model(path, self.config.algorithm, like)
        epsilon = float(arrays["exploration_rate"])
        if not 0 <= epsilon <= 1:
            raise InputError(f"{path}: exploration_rate={epsilon}: must be from 0 to 1")
        self.q, self.visits, self.exploration_rate = arrays["q"], arrays["visits"], epsilon
