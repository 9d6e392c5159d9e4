"""Temporal-difference control with a table: the loop that Q-learning, SARSA and expected SARSA share.

After a step from (s, a) to reward r and state s', Q(s, a) moves towards r + γ V(s'), where V is the
algorithm's own estimate. Q of a terminal state is 0 and stays 0, so that nothing follows there. An episode
that the step limit cuts off is no end: its target looks at the state where it was cut.

Reference: R. Sutton and A. Barto, Reinforcement Learning, 2nd ed., 2018, chapter 6.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent, Hook, SafePoint, TrainingContext, misfit
from gridworld.base.bounds import Bounds, Rate, parse_schedule
from gridworld.base.errors import InputError
from gridworld.base.safe_read import read_bytes
from gridworld.base.serialization import (
    State,
    fill,
    fitting,
    generator_state,
    independent_generator,
    set_generator_state,
)
from gridworld.base.user_input import npz_arrays, npz_bytes
from gridworld.config.fields import MOST_KEPT, Effect, Schedule, Word, setting
from gridworld.config.train import AgentConfig, TrainConfig
from gridworld.world.evaluation import PolicySnapshot
from gridworld.world.mdp import LEAST_REWARD, MOST_REWARD, FloatArray, IntArray

if TYPE_CHECKING:
    from gridworld.envs.vector_env import Step

_BELOW_ONE = 1 - 2**-53  # replaces a step of 1, after which nothing of the past is left
_SPARE_BYTES = 2**20  # of a model file, for the frames around its arrays


@dataclass
class TabularConfig(AgentConfig):
    family: Word = "tabular"
    gamma: float = setting(0.99, Bounds(0, 1))  # the discount it learns with

    def check(self, run: TrainConfig) -> None:
        super().check(run)
        if run.observation.kind != "none":
            what = f"observation={run.observation.kind}"
            raise InputError(f"{what}: agent={self.name} keeps a table over states; must be none")
        if run.callbacks:
            raise InputError(
                f"callbacks: agent={self.name} does not call Stable-Baselines3's callbacks; leave them out"
            )
        if run.device not in ("cpu", "auto"):
            raise InputError(f"device={run.device}: agent={self.name} runs on the CPU; must be cpu")

    def weights(self, path: Path, most: int) -> dict[str, Any]:
        return read_arrays(path, most)


@dataclass
class TabularControlConfig(TabularConfig):
    """Temporal-difference control. Where Stable-Baselines3 has the same setting, it has the same name."""

    # step size; a number; lin_NUMBER, sqrt_NUMBER and quad_NUMBER fall to 0
    learning_rate: Schedule = setting(0.1, Rate(high=1, above=True))
    # times (visits of the state and action) ** -power
    learning_rate_power: float = setting(0.0, Bounds(0, 1))
    # of every action in every state that is no end
    initial_value: float = setting(0.0, Bounds(-MOST_REWARD, MOST_REWARD, least=LEAST_REWARD))
    # of training, in which epsilon falls linearly
    exploration_fraction: float = setting(1.0, Bounds(0, 1, above=True))
    # epsilon when training begins
    exploration_initial_eps: float = setting(1.0, Bounds(0, 1))
    exploration_final_eps: float = setting(0.05, Bounds(0, 1))  # epsilon after that fraction
    # episodes that the means in TensorBoard are taken over
    stats_window_size: int = setting(100, Effect.LABELS, Bounds(1, MOST_KEPT))
    # episodes between two points there
    log_interval: int = setting(100, Effect.LABELS, Bounds(1))


class TabularAgent(Agent):
    """An agent that is a table Q (S, A) of float64, `q`. Its model file is an .npz of `arrays`."""

    q: FloatArray
    config: TabularConfig

    @property
    def model(self) -> FloatArray:
        return self.q

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any]]:
        """What it has learned, by names."""

    def model_file(self) -> bytes:
        return npz_bytes({"algorithm": np.array(self.config.algorithm), **self.arrays()})

    def read(self, path: Path) -> dict[str, NDArray[Any]]:
        """Read a model file of arrays that have the names, types and shapes of its own."""
        own, algorithm = self.arrays(), self.config.algorithm
        found = read_arrays(path, _SPARE_BYTES + sum(array.nbytes for array in own.values()), algorithm)
        written_by = str(found.pop("algorithm", "something else"))
        if written_by != algorithm:
            raise InputError(f"{path}: not a model of {algorithm} but of {written_by[:50]}")
        if (reason := misfit(found, own)) is not None:
            raise InputError(f"{path}: not a model of {algorithm} for this world ({reason})")
        return found


class TabularControl(TabularAgent):
    """Temporal-difference control on a batch of environments.

    Attributes:
        visits: (S, A), int64, the number of updates of each entry.
        exploration_rate: epsilon.
    """

    def __init__(self, config: TabularControlConfig, context: TrainingContext) -> None:
        mdp = context.envs.mdp
        self.config: TabularControlConfig = config
        self.q = np.full((mdp.num_states, mdp.num_actions), config.initial_value)
        self.q[mdp.terminal] = 0.0
        self.visits: IntArray = np.zeros(self.q.shape, dtype=np.int64)
        self.exploration_rate = config.exploration_initial_eps
        self._context = context
        self._rate = parse_schedule("agent.learning_rate", config.learning_rate)
        self._random = independent_generator(context.seed)  # the environments take the seed's own
        self._steps = 0
        self._actions: IntArray = np.zeros(context.envs.num_envs, dtype=np.int64)  # chosen, not yet taken
        self._episodes, self._next_log = 0, config.log_interval  # that have ended, and that are logged next
        self._last: deque[tuple[float, int]] = deque(maxlen=config.stats_window_size)  # (return, length)
        self._error, self._updates = 0.0, 0  # since the last log

    @abstractmethod
    def state_values(self, q: FloatArray) -> FloatArray:
        """(n,), V of the policy whose Q the table is, from rows (n, A) of the table."""

    def _values_ahead(self, reached: IntArray) -> FloatArray:
        """What the update takes the values (num_envs,) of the states reached for."""
        rows, index = _rows_of(self.q, reached)
        return self.state_values(rows)[index]

    def _next_actions(self, step: Step) -> IntArray:
        """(num_envs,), the actions to take after a step and the update."""
        return self._act(step.states)

    def learn(
        self, total_timesteps: int, on_step: Hook, on_safe_point: SafePoint = None, state: State | None = None
    ) -> None:
        envs, config = self._context.envs, self.config
        q, visits = self.q.reshape(-1), self.visits.reshape(-1)  # flat views
        states, _ = envs.reset(seed=self._context.seed)
        self._steps, self._actions = 0, self._act(states)
        if state is not None:
            with fitting():
                self._set_state(state)
        start, final = config.exploration_initial_eps, config.exploration_final_eps
        should_continue = True
        while should_continue and self._steps < total_timesteps:
            rate = self._rate.at(self._steps / total_timesteps)
            step = envs.advance(self._actions)
            self._steps = steps = self._steps + envs.num_envs
            explored = min(steps / total_timesteps / config.exploration_fraction, 1.0)
            self.exploration_rate = start + (final - start) * explored
            targets = step.rewards + config.gamma * self._values_ahead(step.reached)
            error = update(q, visits, step.pairs, targets, rate, config.learning_rate_power)
            if not error < np.inf:
                raise InputError(
                    f"agent={config.name}: training diverged at step {steps:,}, its error is not finite; "
                    "try a smaller learning rate"
                )
            self._actions = self._next_actions(step)
            self._log(step, error, rate)
            should_continue = on_step(steps) > 0
            if on_safe_point is not None and should_continue:
                on_safe_point(steps)

    def _log(self, step: Step, error: float, rate: float) -> None:
        """Count an update, and write means, under SB3's names, if enough episodes have ended."""
        self._episodes += len(step.which)
        self._last.extend(zip(step.returns.tolist(), step.lengths.tolist(), strict=True))
        self._error += error
        self._updates += 1
        write = self._context.write_scalars
        if write is None or self._episodes < self._next_log:
            return
        self._next_log = self._episodes + self.config.log_interval
        episode_return, length = np.mean(self._last, axis=0).tolist()
        scalars = {
            "rollout/ep_rew_mean": episode_return,
            "rollout/ep_len_mean": length,
            "rollout/exploration_rate": self.exploration_rate,
            "train/learning_rate": rate,
            "train/loss": self._error / self._updates,
        }
        write(scalars, self._steps)
        self._error, self._updates = 0.0, 0

    def get_state(self) -> State:
        return {
            "envs": self._context.envs.get_state(),
            "random": generator_state(self._random),
            "q": self.q.copy(),
            "visits": self.visits.copy(),
            "actions": self._actions.copy(),
            "exploration_rate": self.exploration_rate,
            "error": self._error,
            "counts": [self._steps, self._episodes, self._next_log, self._updates],
            "last": [list(episode) for episode in self._last],
        }

    def _set_state(self, state: State) -> None:
        """Mirrors `get_state`, once learning has begun."""
        self._context.envs.set_state(state["envs"])
        set_generator_state(self._random, state["random"])
        for name, array in (("q", self.q), ("visits", self.visits), ("actions", self._actions)):
            fill(array, state[name], name)
        self.exploration_rate, self._error = float(state["exploration_rate"]), float(state["error"])
        self._steps, self._episodes, self._next_log, self._updates = map(int, state["counts"])
        self._last.clear()
        self._last.extend((float(total), int(length)) for total, length in state["last"])

    def _act(self, states: IntArray) -> IntArray:
        return draw_actions(self.q, self.exploration_rate, states, self._random.random(len(states)))

    def snapshot(self) -> PolicySnapshot:
        """Of equally good actions, the first is the greedy one; the sampled policy takes any of them."""
        return PolicySnapshot(
            greedy=self.q.argmax(axis=1),
            sampled=epsilon_greedy(self.q, self.exploration_rate),
            values=self.state_values(self.q),
            q=self.q.copy(),
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {"q": self.q, "visits": self.visits, "exploration_rate": np.array(self.exploration_rate)}

    def load(self, path: Path) -> None:
        arrays = self.read(path)
        epsilon = float(arrays["exploration_rate"])
        Bounds(0, 1).check(f"{path}: exploration_rate", epsilon)
        self.q, self.visits, self.exploration_rate = arrays["q"], arrays["visits"], epsilon


def update(
    q: FloatArray, visits: IntArray, pairs: IntArray, targets: FloatArray, rate: float, power: float = 0.0
) -> float:
    """Update a flat table with a batch of transitions, in place; returns their mean squared error before.

    With one environment it is the textbook's Q(s, a) ← Q(s, a) + α [y - Q(s, a)], where at the n-th visit of
    (s, a) α = rate · n^-power (with 1/2 < power <= 1 as Robbins and Monro, 1951, ask of it). With more, all
    targets y come from the table as it was, and the transitions are taken in the order of their environments.
    Where k of them are at the same (s, a), with step sizes α_1, ..., α_k, these k steps come to

        Q(s, a) ← Q(s, a) + Σ_j w_j [y_j - Q(s, a)],    w_j = α_j Π_(l > j) (1 - α_l)

    with Q on the right as it was before. Plain addition of the errors would overshoot as soon as k α > 2.
    Targets may be a batch old: J. N. Tsitsiklis, Asynchronous stochastic approximation and Q-learning, 1994.

    `q` and `visits`, which counts updates, are (S * A,); `pairs`, s * A + a, and `targets` y are (n,).
    """

    def sizes_at(visit: IntArray) -> FloatArray:
        return rate * visit.astype(np.float64) ** -power if power else np.full(len(visit), rate)

    errors = targets - q[pairs]
    if len(pairs) == 1:  # nothing to share
        visits[pairs] += 1
        q[pairs] += sizes_at(visits[pairs]) * errors
    else:
        order = np.argsort(pairs, kind="stable")  # brings equal pairs together, first come first
        arranged = pairs[order]
        starts = np.flatnonzero(np.concatenate([[True], arranged[1:] != arranged[:-1]]))
        lengths = np.diff(starts, append=len(pairs))
        where, last = arranged[starts], np.repeat(starts + lengths - 1, lengths)
        # The n-th visit: those before the batch, and those in the batch up to this one.
        sizes = sizes_at(np.repeat(visits[where] - starts + 1, lengths) + np.arange(len(pairs)))
        kept = np.log1p(-np.minimum(sizes, _BELOW_ONE)).cumsum()
        weights = sizes * np.exp(kept[last] - kept)
        q[where] += np.add.reduceat(weights * errors[order], starts)
        visits[where] += lengths
    return float(errors @ errors) / len(errors)


def epsilon_greedy(q: FloatArray, epsilon: float) -> FloatArray:
    """π(a | s) (..., A) of values Q (..., A): with probability ε any action, else one of the best."""
    best = q == q.max(axis=-1, keepdims=True)
    policy: FloatArray = epsilon / q.shape[-1] + (1 - epsilon) * best / best.sum(axis=-1, keepdims=True)
    return policy


def draw_actions(q: FloatArray, epsilon: float, states: IntArray, draws: FloatArray) -> IntArray:
    """Draw ε-greedy actions (n,): each the first whose cumulative probability exceeds its draw in [0, 1)."""
    rows, index = _rows_of(q, states)
    thresholds = epsilon_greedy(rows, epsilon)[:, :-1].cumsum(axis=1)
    actions = np.zeros(len(states), dtype=np.int64)
    for threshold in thresholds.T:
        actions += draws >= threshold[index]
    return actions


def _rows_of(q: FloatArray, states: IntArray) -> tuple[FloatArray, IntArray | slice]:
    """The rows of Q to compute with, the whole table if that is less, and where in them `states` are."""
    return (q, states) if len(q) <= len(states) else (q[states], slice(None))


def read_arrays(path: Path, most: int, algorithm: str = "a table") -> dict[str, NDArray[Any]]:
    """Read all arrays of a model file of at most `most` bytes."""
    content = read_bytes(path, most, copies=3)  # beside it a member and the array in it
    return npz_arrays(path, content, f"a model of {algorithm}")
