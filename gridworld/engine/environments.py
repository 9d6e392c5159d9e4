"""P x E environments that step together, by look-ups in the tables of one world."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from gridworld.envs.training_env import TrainingVectorEnv
from gridworld.envs.vector_env import GridWorldVectorEnv, StateArray, Step
from gridworld.world.mdp import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False, slots=True)
class Rollout:
    """n steps; arrays are (n, P, E)."""

    pairs: StateArray  # state · A + action
    rewards: FloatArray
    reached: StateArray  # where the steps led to, before the reset of episodes that ended
    terminated: BoolArray
    truncated: BoolArray  # cut off by the step limit alone
    final_states: StateArray  # (P, E), after the last step
    ended: list[tuple[StateArray, FloatArray, StateArray]]  # of each run, (step, return, length)


class Environments(GridWorldVectorEnv):
    """The environments of P runs as one batch; each run's draws are those of its own batch.

    The runs' own batches are stale until `put_back`, but for their generators and statistics.
    """

    def __init__(self, batches: Sequence[TrainingVectorEnv]) -> None:
        first, runs = batches[0], len(batches)
        super().__init__(
            runs * first.num_envs,
            max_episode_steps=first.max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
            mdp=first.mdp,
        )
        self._batches, self._bounds = batches, np.arange(runs + 1) * first.num_envs
        columns = zip(*(batch.episode_state for batch in batches), strict=True)
        self.set_episode_state(*map(np.concatenate, columns))

    def put_back(self) -> None:
        """Let the runs' own batches stand where these environments are."""
        for batch, part in zip(self._batches, map(slice, self._bounds, self._bounds[1:]), strict=False):
            batch.set_episode_state(self._state[part], self._elapsed[part], self._returns[part])

    def take(self, actions: IntArray) -> Step:
        """`advance` without a check of the actions, (P · E,)."""
        return self._advance(self._state * self._num_actions + actions)

    def roll(self, policies: FloatArray, draws: NDArray[np.float32]) -> Rollout:
        """Step n times with policies (P, S, A); uniform draws (n, P · E) say which actions are taken."""
        runs, num_states, num_actions = policies.shape
        limits = np.ascontiguousarray(policies.cumsum(axis=2).reshape(-1, num_actions).T[:-1])
        first = np.repeat(np.arange(runs) * num_states, self._bounds[1])
        steps = []
        for draw in draws:
            beyond = draw >= limits.take(self._state + first, axis=1)
            steps.append(self.take(np.add.reduce(beyond, axis=0, dtype=np.int64)))
        shape = len(draws), runs, -1
        pairs, rewards, reached, terminated, truncated = (
            np.stack([getattr(step, name) for step in steps]).reshape(shape)
            for name in ("pairs", "rewards", "reached", "terminated", "truncated")
        )
        finals, ended = self.states.reshape(runs, -1), self._ended(steps)
        return Rollout(pairs, rewards, reached, terminated, truncated & ~terminated, finals, ended)

    def _ended(self, steps: Sequence[Step]) -> list[tuple[StateArray, FloatArray, StateArray]]:
        number = np.repeat(np.arange(len(steps)), [len(step.which) for step in steps])
        which, returns, lengths = (
            np.concatenate([getattr(step, name) for step in steps])
            for name in ("which", "returns", "lengths")
        )
        run = which // self._bounds[1]
        order = np.argsort(run, kind="stable")
        cuts = np.searchsorted(run[order], np.arange(len(self._bounds)))
        of_runs = (order[a:b] for a, b in itertools.pairwise(cuts))
        return [(number[part], returns[part], lengths[part]) for part in of_runs]

    def draw_numbers(self, which: StateArray, situations: StateArray) -> FloatArray:
        """See `GridWorldVectorEnv.draw_numbers`: each run's own generator draws for its environments."""
        cuts = np.searchsorted(which, self._bounds).tolist()
        parts = itertools.starmap(slice, itertools.pairwise(cuts))
        of_runs = zip(self._batches, parts, strict=True)
        return np.concatenate([batch.draw_numbers(which[part], situations[part]) for batch, part in of_runs])
