"""The batch that agents learn on: it counts visits, and the returns of the episodes that ended.

From the counts N(s, a) it can pay for exploring: a step that takes action a in state s pays its reward and
β / sqrt(N(s, a)), with the visits of this step counted. Returns are those of the world's own rewards.

References: A. Strehl and M. Littman, An analysis of model-based interval estimation for Markov decision
processes, 2008 (MBIE-EB); M. Bellemare et al., Unifying count-based exploration and intrinsic motivation,
2016.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from gridworld.base.serialization import State, fill
from gridworld.envs.vector_env import GridWorldVectorEnv, StateArray, Step
from gridworld.world.mdp import FloatArray


class Returns(NamedTuple):
    """Undiscounted returns of some episodes."""

    episodes: int
    total: float

    @property
    def mean(self) -> float | None:
        """Their mean; None where there is no episode."""
        return self.total / self.episodes if self.episodes else None

    def merged(self, others: Returns) -> Returns:
        """These and `others`."""
        return Returns(self.episodes + others.episodes, self.total + others.total)


NO_EPISODES = Returns(0, 0.0)


class TrainingVectorEnv(GridWorldVectorEnv):
    """A `GridWorldVectorEnv` that resets in the same step, so that every step is one that an agent chose.

    `exploration_bonus` is β, at least 0; `visits` (S, A), int64, counts how often each action was
    taken in each state; it is the same array always.
    """

    def __init__(self, num_envs: int, *, exploration_bonus: float = 0.0, **settings: Any) -> None:
        super().__init__(num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **settings)
        self.exploration_bonus = exploration_bonus
        self.visits = np.zeros((self.mdp.num_states, self.mdp.num_actions), dtype=np.int64)
        self._flat_visits = self.visits.reshape(-1)
        self._ended = NO_EPISODES  # since they were last taken

    def _advance(self, pairs: StateArray) -> Step:
        step = super()._advance(pairs)
        self.count(pairs[None], step.rewards[None])
        if step.which.size:
            self._add_returns([step.returns])
        return step

    def count(self, pairs: NDArray[Any], rewards: FloatArray) -> None:
        """Count n steps, `pairs` (n, num_envs) of state * A + action, and add the bonus to their rewards."""
        if not self.exploration_bonus:
            np.add.at(self._flat_visits, pairs.ravel(), 1)
            return
        for taken, paid in zip(pairs, rewards, strict=True):
            np.add.at(self._flat_visits, taken, 1)
            paid += self.exploration_bonus / np.sqrt(self._flat_visits.take(taken))

    def add_returns(self, steps: NDArray[Any], returns: FloatArray) -> None:
        """Add the returns (m,) of episodes that ended in `steps` (m,), ascending."""
        bounds = np.flatnonzero(np.diff(steps)) + 1
        self._add_returns(part for part in np.split(returns, bounds) if len(part))

    def _add_returns(self, of_steps: Iterable[FloatArray]) -> None:
        """Add the returns of the episodes that each of some steps ended."""
        episodes, total = self._ended
        for returns in of_steps:
            episodes += len(returns)
            total += float(np.add.reduce(returns))
        self._ended = Returns(episodes, total)

    def get_state(self) -> State:
        """See `GridWorldVectorEnv.get_state`."""
        return {
            **super().get_state(),
            "visits": self.visits.copy(),
            "ended": self._ended.episodes,
            "ended_return": self._ended.total,
        }

    def set_state(self, state: State) -> None:
        """See `GridWorldVectorEnv.set_state`."""
        super().set_state(state)
        fill(self.visits, state["visits"], "visits")
        self._ended = Returns(int(state["ended"]), float(state["ended_return"]))

    def take_returns(self) -> Returns:
        """The returns of the episodes that ended since the last call, or since the start."""
        taken, self._ended = self._ended, NO_EPISODES
        return taken
