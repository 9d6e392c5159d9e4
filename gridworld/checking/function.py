"""A train function as an agent: any code that learns in a Gymnasium environment and returns a policy."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from gridworld.agents import Hook, TrainingContext
from gridworld.base.errors import InputError, in_short
from gridworld.checking.probes import UnmetError
from gridworld.config.fields import Word
from gridworld.config.train import AgentConfig
from gridworld.envs.observations import ObservationTable
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.world.evaluation import PolicySnapshot, as_numbers, policy_of_table
from gridworld.world.mdp import FloatArray

OBSERVATIONS = {"state": "none", "one_hot": "one_hot"}  # kinds of `envs.observations`
_FORMS = {"policy": "({0},) actions or ({0}, {1}) probabilities", "q": "({0}, {1})", "values": "({0},)"}


class ReturnedError(InputError):
    """A train function returned something that is not a policy."""


@dataclass
class FunctionConfig(AgentConfig):
    """A function train(env, total_timesteps, seed), and further arguments that it gets by name."""

    family: Word = "function"
    train: Any = None
    observation: str = "state"  # of `OBSERVATIONS`
    arguments: dict[str, Any] = field(default_factory=dict)

    @property
    def known(self) -> list[str]:
        """The names of further arguments."""
        try:
            parameters = list(inspect.signature(self.train).parameters.values())[3:]
        except ValueError:  # of a function in C
            return []
        kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        return [each.name for each in parameters if each.kind in kinds]

    def build(self, context: TrainingContext) -> FunctionAgent:
        """Refuse a function that cannot be called so."""
        try:
            inspect.signature(self.train).bind(None, None, None, **self.arguments)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{self.name}: must be train(env, total_timesteps, seed), and may take gamma and what has a "
                f"default ({error})"
            ) from None
        return FunctionAgent(self, context)


class SingleEnv(gym.Env[Any, Any]):
    """A batch of one as a plain Gymnasium environment; `on_step` is called with the steps so far."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        envs: GridWorldVectorEnv,
        table: ObservationTable,
        seed: int = 0,
        on_step: Hook = lambda steps: 0,
    ) -> None:
        self._envs, self._on_step = envs, on_step
        self._rows = table.rows(np.arange(envs.mdp.num_states))  # by state; a look-up for each step is slower
        envs.reset(seed=seed)
        self.np_random = envs.np_random
        self.observation_space = table.space
        self.action_space = spaces.Discrete(envs.mdp.num_actions, seed=seed)
        self._steps, self._is_over = 0, True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._envs.np_random = self.np_random
        states, _ = self._envs.reset()
        self._is_over = False
        return self._rows[states[0]].copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self._is_over:
            raise RuntimeError("env.step() after the end of an episode; call env.reset() first")
        step = self._envs.advance(np.reshape(action, 1))
        self._steps += 1
        self._on_step(self._steps)
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._is_over = terminated or truncated
        return self._rows[step.reached[0]].copy(), float(step.rewards[0]), terminated, truncated, {}


class FunctionAgent:
    """What `checking.training` asks of an agent; `unknown` has what the function does not show, and why."""

    model = None

    def __init__(self, config: FunctionConfig, context: TrainingContext) -> None:
        self._config, self._context = config, context
        self._snapshot = self._read({"policy": np.zeros(context.envs.mdp.num_numbers)})  # before training

    def learn(self, total_timesteps: int, on_step: Hook) -> None:
        """Call the function, and read what it returns."""
        config, context = self._config, self._context
        env = SingleEnv(context.envs, context.observation, context.seed, on_step)
        returned = config.train(env, total_timesteps, context.seed, **config.arguments)
        try:
            self._snapshot = self._read(returned if isinstance(returned, Mapping) else {"policy": returned})
        except InputError as error:
            reason = str(error).replace("q=...", '{"q": ...}')
            raise ReturnedError(f"{config.name} must return a policy; {reason}") from None

    def snapshot(self) -> PolicySnapshot:
        """What it has returned."""
        return self._snapshot

    def _read(self, parts: Mapping[str, Any]) -> PolicySnapshot:
        """A policy or Q or both, and perhaps values."""
        if parts.keys() - _FORMS.keys() or not parts.keys() & {"policy", "q"}:
            raise InputError(f"a dictionary has policy or q, and may have values, but not {list(parts)}")
        mdp, arguments = self._context.envs.mdp, self._config.arguments
        found = {name: self._by_state(name, part) for name, part in parts.items()}
        values = found.pop("values", None)
        policies = {name: policy_of_table(mdp, name, table, name == "q") for name, table in found.items()}
        policy = policies.get("policy", policies.get("q"))
        assert policy is not None
        self.unknown = {"parameters": "only a class shows its layers"}
        if "exploration_final_eps" not in arguments:
            self.unknown["behaviour"] = "takes no exploration_final_eps"
        if "policy" not in found or found["policy"].ndim == 1:
            self.unknown["probabilities"] = "returns no probabilities"
        if "gamma" not in arguments:
            self.unknown["values"] = "takes no gamma"
        elif values is None and "q" not in found:
            self.unknown["values"] = "returns neither q nor values"
        values = np.zeros(mdp.num_states) if values is None else values
        return PolicySnapshot(policy.argmax(axis=1), policy, values, found.get("q"))

    def _by_state(self, name: str, part: Any) -> FloatArray:
        """A function or table of observations by states; ends get the row of another state."""
        mdp, size = self._context.envs.mdp, self._context.envs.mdp.num_numbers
        live = np.flatnonzero(mdp.reachable & ~mdp.terminal)
        if callable(part):
            states = np.full(size, live[0])  # one for each observation
            states[mdp.number[live]] = live
            part = [self._row(name, part, shown) for shown in self._context.observation.rows(states)]
            part = np.ravel(part) if all(len(row) == 1 for row in part) else part
        table = as_numbers(name, part, "a function")
        form = _FORMS[name].format(size, mdp.num_actions)
        if str(table.shape) not in form:
            raise InputError(f"{name}: has shape {table.shape}; must be {form}")
        states = np.full(mdp.num_states, live[0])
        states[live] = live
        by_state: FloatArray = table[mdp.number[states]]
        if not np.isfinite(by_state).all():
            raise UnmetError(f"its {name} has numbers that are not finite")
        return by_state

    def _row(self, name: str, part: Callable[[Any], Any], shown: Any) -> Any:
        """What it says in a state."""
        try:
            row, again = (np.ravel(part(shown)) for _ in range(2))
        except Exception as error:  # it may be anybody's code
            raise UnmetError(f"its {name} fails for {shown}: {in_short(error)}") from error
        if row.dtype == object:  # such as an action and a state, as SB3's `predict` returns them
            raise InputError(f"{name}: must return an action or numbers for {shown}, not {row}"[:200])
        if row.tobytes() != again.tobytes():
            raise InputError(f"{name}: draws at random; give the best action, or probabilities")
        return row
