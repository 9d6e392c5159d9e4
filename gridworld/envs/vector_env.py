"""Many copies of a world at once: a batch of steps is a handful of array look-ups, whatever its size.

With (state, action, outcome) flattened to one index, the next states, rewards and ends of a whole batch are
three look-ups in the same frozen tables that the single environment uses.
"""

from __future__ import annotations

from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from gridworld.bounds import STEP_LIMIT
from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import CELL_SIZE, Frame
from gridworld.errors import InputError
from gridworld.storage.serialization import State, StateError, fill, generator_state, set_generator_state
from gridworld.world.grid import mdp_or_compiled
from gridworld.world.layout import CLASSIC, NUM_COLS, NUM_ROWS, Layout, positive_int
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_RADIX_SORTED = 2**16  # numpy sorts numbers below it in linear time, if they are stored as such

StateArray = NDArray[np.int64]
Step = tuple[StateArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]


class Ended(NamedTuple):
    """The n >= 1 episodes that a step of a batch ended, where the batch resets in the same step."""

    states: StateArray  # (num_envs,), where the step led to, before the reset
    mask: BoolArray  # (num_envs,), True where an episode ended
    which: NDArray[np.intp]  # (n,), where the mask is True, ascending
    returns: FloatArray  # (n,), undiscounted sums of rewards
    lengths: NDArray[np.int64]  # (n,), steps


class Tables(NamedTuple):
    """A world's tables, flat: by (state * A + action) * K + outcome."""

    next_state: StateArray
    reward: FloatArray
    terminated: BoolArray
    thresholds: FloatArray  # (K - 1, S * A)


Advance = tuple[StateArray, FloatArray, BoolArray, BoolArray, Ended | None]


class GridWorldVectorEnv(VectorEnv[StateArray, NDArray[Any], Any]):
    """`num_envs` GridWorlds that step together; `gym.make_vec("GridWorld-v0", num_envs=64)` makes one.

    With `mdp`, any compiled world: a map's, or one of `gridworld.world.sources`.

    All draws come from the one `np_random`, a number for each environment that needs it, in their order: a
    batch of one and the single environment take the same walk for the same seed and actions. `seed` is
    therefore one number, not one per environment.

    `autoreset_mode` says what follows an episode's end, in Gymnasium's terms:
    - `NextStep` (default): the next step ignores the action and returns the new episode's start, reward 0;
    - `SameStep`: the same step returns the new start; `infos["final_obs"]` has the states where episodes
      ended, None where none did, and `infos["_final_obs"]` is True where one did;
    - `Disabled`: nothing; `reset(options={"reset_mask": mask})` starts those environments anew.

    Episodes are truncated after `max_episode_steps` (None: never). The other arguments are those of
    `GridWorldEnv`; `render_mode="rgb_array"` gives one frame per environment.

    With `stratified`, environments that take the same action in the same state at the same time share out its
    outcomes evenly, and those that start at the same time the starts (see `stratified_numbers`). The episodes
    of each have the same probabilities as without.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 20,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        num_rows: int = NUM_ROWS,
        num_cols: int = NUM_COLS,
        render_mode: str | None = None,
        *,
        max_episode_steps: int | None = STEP_LIMIT,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        layout: str | PathLike[str] | Layout = CLASSIC,
        slip: float = 0.0,
        step_reward: float = 0.0,
        goal_reward: float = 1.0,
        trap_reward: float = -1.0,
        cell_size: int = CELL_SIZE,
        mdp: Mdp | None = None,
        stratified: bool = False,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise InputError(f"render_mode={render_mode!r}: a batch can only be drawn as rgb_array (or None)")
        try:
            self._autoreset = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(mode.value for mode in AutoresetMode)
            raise InputError(f"autoreset_mode={autoreset_mode!r}: must be one of {known}") from None
        if not isinstance(stratified, bool):
            raise InputError(f"stratified={stratified!r}: must be True or False")
        self.num_envs = positive_int("num_envs", num_envs)
        self.max_episode_steps = (
            None if max_episode_steps is None else positive_int("max_episode_steps", max_episode_steps)
        )
        self.step_limit: int = self.max_episode_steps or np.iinfo(np.int64).max
        self._mdp = mdp_or_compiled(
            mdp, layout, num_rows, num_cols, slip, step_reward, goal_reward, trap_reward
        )
        self.render_mode = render_mode
        self.cell_size = positive_int("cell_size", cell_size)
        self.metadata = {**self.metadata, "autoreset_mode": self._autoreset}
        self.stratified = stratified
        self.single_observation_space = spaces.Discrete(self.mdp.num_states)
        self.single_action_space = spaces.Discrete(self.mdp.num_actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        # States are in numpy's own index type: smaller ones save nothing that counts and are converted at
        # every look-up.
        num_states, self._num_actions, self._num_outcomes = self.mdp.next_state.shape
        next_state = self.mdp.next_state.ravel().astype(np.int64)
        thresholds = self.mdp.thresholds.reshape(num_states * self._num_actions, -1)
        terminated = self.mdp.terminal[next_state]
        self.tables = Tables(
            next_state, self.mdp.reward.ravel(), terminated, np.ascontiguousarray(thresholds.T)
        )
        self._state: StateArray = np.full(self.num_envs, self.mdp.start_states[0], dtype=np.int64)
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)  # steps of the episodes under way
        self._returns = np.zeros(self.num_envs)  # of these, undiscounted; counted where `ended` tells them
        self._over = np.zeros(self.num_envs, dtype=np.bool_)  # waiting for the reset of their next step

    @property
    def states(self) -> StateArray:
        """(num_envs,) current states, a copy."""
        return self._state.copy()

    @property
    def mdp(self) -> Mdp:
        """The world, which stays what it is from when the batch is made."""
        return self._mdp

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[StateArray, dict[str, Any]]:
        """Start new episodes; those under way are given up. Returns states (num_envs,) and empty infos.

        Args:
            seed: one number, from which `np_random` begins anew; None: it continues.
            options: `reset_mask`, (num_envs,) booleans, says which environments; without it, all.
        """
        if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int | np.integer)):
            raise InputError(f"seed={seed!r}: must be one whole number; all environments share one generator")
        super().reset(seed=None if seed is None else int(seed))
        mask = (options or {}).get("reset_mask")
        if mask is None:
            which = np.arange(self.num_envs)
        else:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise InputError(
                    f"reset_mask: must be {self.num_envs} booleans, at least one of them True, got {mask!r}"
                )
            which = np.flatnonzero(mask)
        self._restart(which)
        self._returns[which] = 0.0
        self._over[which] = False
        return self._state.copy(), {}

    def step(self, actions: NDArray[Any]) -> Step:
        """Move all environments once, by integer actions (num_envs,).

        Returns:
            (num_envs,) states (int64), rewards (float64), terminated and truncated (bool), and infos.
        """
        states, rewards, terminated, truncated, ended = self.advance(actions)
        infos: dict[str, Any] = {}
        if ended is not None:  # as `SyncVectorEnv` has them for environments without infos of their own
            final_obs = np.full(self.num_envs, None, dtype=object)
            final_obs[ended.mask] = ended.states[ended.mask].tolist()  # plain ints, as of one environment
            infos = {"final_obs": final_obs, "_final_obs": ended.mask}
            infos |= {"final_info": {}, "_final_info": ended.mask.copy()}
        return states, rewards, terminated, truncated, infos

    def advance(self, actions: NDArray[Any]) -> Advance:
        """`step` in arrays alone, for training; where it resets in the same step, with what ended."""
        tables, index = self.tables, self._state * self._num_actions
        index += self._check_actions(actions)
        starting = np.flatnonzero(self._over)
        if self._num_outcomes > 1:
            outcomes = self._draw_outcomes(index, starting)
            index *= self._num_outcomes
            index += outcomes
        state, rewards = tables.next_state.take(index), tables.reward.take(index)
        terminated = tables.terminated.take(index)
        self._state = state
        self._elapsed += 1
        if starting.size:
            self._restart(starting)
            rewards[starting] = 0.0
            terminated[starting] = False
        truncated = self._elapsed >= self.step_limit
        over = terminated | truncated
        ended = None
        if self._autoreset is AutoresetMode.SAME_STEP:
            self._returns += rewards
            which = np.flatnonzero(over)
            if which.size:
                ended = Ended(state, over, which, self._returns[which], self._elapsed[which])
                self._state = state.copy()
                self._restart(which)
                self._returns[which] = 0.0
        elif self._autoreset is AutoresetMode.NEXT_STEP:
            self._over = over
        return self._state.copy(), rewards, terminated, truncated, ended

    def render(self) -> tuple[Frame, ...] | None:
        """One fresh frame (height, width, 3), uint8, per environment; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(drawing.draw_frame(self.mdp, int(state), self.cell_size) for state in self._state)

    def get_state(self) -> State:
        """Where all environments and their episodes stand, as a value for `set_state`."""
        return {
            "random": generator_state(self.np_random),
            "states": self._state.copy(),
            "elapsed": self._elapsed.copy(),
            "over": self._over.copy(),
            "returns": self._returns.copy(),
        }

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`, of a batch of the same size on the same world."""
        if not np.isin(state["states"], np.arange(self.mdp.num_states)).all():
            raise StateError(f"states must be from 0 to {self.mdp.num_states - 1}")
        set_generator_state(self.np_random, state["random"])
        own = {"states": self._state, "elapsed": self._elapsed, "over": self._over, "returns": self._returns}
        for key, array in own.items():
            fill(array, state[key], key)

    @property
    def episode_state(self) -> tuple[StateArray, NDArray[np.int64], FloatArray]:
        """(num_envs,) each: the states, and the steps and returns of the current episodes so far."""
        return self._state, self._elapsed, self._returns

    def set_episode_state(self, states: StateArray, elapsed: NDArray[np.int64], returns: FloatArray) -> None:
        """Mirrors `episode_state`."""
        self._state, self._elapsed, self._returns = states.copy(), elapsed.copy(), returns.copy()

    def draw_starts(self, count: int) -> Any:
        """The states in which so many new episodes begin, (count,), or the one in which all do."""
        starts = self.mdp.start_states
        if len(starts) == 1:
            return starts[0]
        return starts[self.mdp.start_index(self.draw_numbers(np.zeros(count, dtype=np.int64)))]

    def draw_numbers(self, situations: StateArray) -> FloatArray:
        """(n,) numbers from [0, 1); if stratified, evenly spread in each of the `situations` (n,)."""
        if self.stratified:
            return stratified_numbers(situations, self.np_random)
        return self.np_random.random(len(situations))

    def _restart(self, which: NDArray[np.intp]) -> None:
        self._state[which] = self.draw_starts(len(which))
        self._elapsed[which] = 0

    def _draw_outcomes(self, pairs: NDArray[np.int64], starting: NDArray[np.intp]) -> NDArray[np.int64]:
        """(num_envs,) outcomes of states and actions; who ended or starts anew draws nothing."""
        still = self.mdp.terminal[self._state]
        still[starting] = True
        moving = np.flatnonzero(~still)
        draws = self.draw_numbers(pairs[moving])
        outcomes = np.zeros(self.num_envs, dtype=np.int64)
        thresholds = self.tables.thresholds.take(pairs[moving], axis=1)
        drawn = (draws >= thresholds[0]).astype(np.int64)
        for each in thresholds[1:]:
            drawn += draws >= each
        outcomes[moving] = drawn
        return outcomes

    def _check_actions(self, actions: Any) -> NDArray[np.int64]:
        given = np.asarray(actions)
        if given.shape == (self.num_envs,) and given.dtype.kind in "iu":
            moves = given.astype(np.int64, copy=False)
            # Seen as unsigned, a negative number is huge: one comparison covers both ends.
            if moves.view(np.uint64).max() < self._num_actions:
                return moves
        raise InputError(
            f"actions={actions!r}: must be {self.num_envs} whole numbers, each {self.mdp.action_choices()}"
        )


def stratified_numbers(groups: IntArray, rng: np.random.Generator) -> FloatArray:
    """Random numbers (n,) that the members of each of the `groups` (n,), integers, share out evenly.

    Those of a group of m are 1/m apart, from a random one on, so that an outcome of probability p meets np of
    n environments, rounded down or up. Each by itself is uniform in [0, 1) and independent of earlier ones.

    References: R. Cranley and T. Patterson, Randomization of Number Theoretic Methods for Multiple
    Integration, 1976; P. L'Ecuyer, C. Lécot and B. Tuffin, A Randomized Quasi-Monte Carlo Simulation Method
    for Markov Chains, 2008.
    """
    sizes = np.bincount(groups)
    shifts = np.zeros(len(sizes))
    present = np.flatnonzero(sizes)
    shifts[present] = rng.random(len(present))
    order = np.argsort(groups.astype(np.uint16) if len(sizes) <= _RADIX_SORTED else groups, kind="stable")
    ranks = np.arange(len(groups)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    numbers = np.empty(len(groups))
    numbers[order] = (ranks / np.repeat(sizes, sizes) + np.repeat(shifts, sizes)) % 1.0
    return numbers
