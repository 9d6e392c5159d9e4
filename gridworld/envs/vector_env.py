"""Many copies of a world at once: a batch of steps is a handful of array look-ups, whatever its size.

With (state, action, outcome) flattened to one index, the next states, rewards and ends of a whole batch are
three look-ups in the same frozen tables that the single environment uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from gridworld.base.bounds import MOST_ENVS, STEP_LIMIT, Bounds, positive_int
from gridworld.base.errors import InputError
from gridworld.base.serialization import State, StateError, fill, generator_state, set_generator_state
from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import CELL_SIZE, Frame
from gridworld.world.grid import mdp_or_compiled
from gridworld.world.layout import CLASSIC, NUM_COLS, NUM_ROWS, Layout
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp

_RADIX_SORTED = 2**16  # numpy sorts numbers below it in linear time, if they are stored as such
_NOWHERE, _NO_RETURNS = np.empty(0, dtype=np.intp), np.empty(0)

StateArray = NDArray[np.int64]


class Step(NamedTuple):
    """A step of a batch, (num_envs,) each, and the m episodes that ended where it resets in the same step."""

    states: StateArray  # the current ones
    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray  # at the step limit
    pairs: StateArray  # state * A + action, where it began
    reached: StateArray  # where it led to, before the reset
    which: NDArray[np.intp]  # (m,), ascending, where the episodes ended
    returns: FloatArray  # (m,), undiscounted sums of rewards
    lengths: NDArray[np.int64]  # (m,), steps


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
        rewards: Mapping[str, float] | None = None,
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
        Bounds(1, MOST_ENVS).check("num_envs", self.num_envs)
        self.max_episode_steps = (
            None if max_episode_steps is None else positive_int("max_episode_steps", max_episode_steps)
        )
        self.step_limit: int = self.max_episode_steps or np.iinfo(np.int64).max
        self._mdp = mdp_or_compiled(
            mdp, layout, num_rows, num_cols, slip, step_reward, goal_reward, trap_reward, rewards
        )
        self.render_mode = render_mode
        self.cell_size = positive_int("cell_size", cell_size)
        self.metadata = {**self.metadata, "autoreset_mode": self._autoreset}
        self.stratified = stratified
        self.single_observation_space = spaces.Discrete(self.mdp.num_states)
        self.single_action_space = spaces.Discrete(self.mdp.num_actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        # The world's tables, flat: by (state * A + action) * K + outcome; thresholds are (K - 1, S * A).
        # States are in numpy's own index type: smaller ones save nothing that counts and are converted at
        # every look-up.
        num_states, self._num_actions, self._num_outcomes = self.mdp.next_state.shape
        self._next_state, self._reward = self.mdp.next_state.ravel().astype(np.int64), self.mdp.reward.ravel()
        self._terminated = self.mdp.terminal[self._next_state]
        thresholds = self.mdp.thresholds.reshape(num_states * self._num_actions, -1)
        self._thresholds = np.ascontiguousarray(thresholds.T)
        self._state: StateArray = np.full(self.num_envs, self.mdp.start_states[0], dtype=np.int64)
        self._elapsed = np.zeros(self.num_envs, dtype=np.int64)  # steps of the episodes under way
        self._returns = np.zeros(self.num_envs)  # of these, undiscounted; where it resets in the same step
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

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[StateArray, FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Move all environments once, by integer actions (num_envs,).

        Returns:
            (num_envs,) states (int64), rewards (float64), terminated and truncated (bool), and infos.
        """
        step = self.advance(actions)
        infos: dict[str, Any] = {}
        if step.which.size:  # as `SyncVectorEnv` has them for environments without infos of their own
            mask, final_obs = step.terminated | step.truncated, np.full(self.num_envs, None, dtype=object)
            final_obs[step.which] = step.reached[step.which].tolist()  # plain ints, as of one environment
            infos = {"final_obs": final_obs, "_final_obs": mask, "final_info": {}, "_final_info": mask.copy()}
        return step.states, step.rewards, step.terminated, step.truncated, infos

    def advance(self, actions: NDArray[Any]) -> Step:
        """`step` in arrays alone, for training."""
        pairs = self._state * self._num_actions
        pairs += self._check_actions(actions)
        return self._advance(pairs)

    def _advance(self, pairs: StateArray) -> Step:
        starting, index = np.flatnonzero(self._over), pairs
        if self._num_outcomes > 1:
            index = pairs * self._num_outcomes
            index += self._draw_outcomes(pairs, starting)
        state, rewards = self._next_state.take(index), self._reward.take(index)
        terminated = self._terminated.take(index)
        self._state = state
        self._elapsed += 1
        if starting.size:
            self._restart(starting)
            rewards[starting] = 0.0
            terminated[starting] = False
        truncated = self._elapsed >= self.step_limit
        over, which, returns, lengths = terminated | truncated, _NOWHERE, _NO_RETURNS, _NOWHERE
        if self._autoreset is AutoresetMode.SAME_STEP:
            self._returns += rewards
            which = np.flatnonzero(over)
            if which.size:
                returns, lengths = self._returns.take(which), self._elapsed.take(which)
                self._state = state.copy()
                self._restart(which)
                self._returns[which] = 0.0
        elif self._autoreset is AutoresetMode.NEXT_STEP:
            self._over = over
        states = self._state.copy()
        return Step(states, rewards, terminated, truncated, pairs, state, which, returns, lengths)

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

    def draw_numbers(self, which: NDArray[np.intp], situations: StateArray) -> FloatArray:
        """(n,) numbers from [0, 1) for these environments (n,), ascending.

        If stratified, they are evenly spread in each of the `situations` (n,).
        """
        if self.stratified:
            return stratified_numbers(situations, self.np_random)
        return self.np_random.random(len(situations))

    def _restart(self, which: NDArray[np.intp]) -> None:
        starts = self.mdp.start_states
        if len(starts) > 1:
            starts = self.mdp.drawn_starts(self.draw_numbers(which, np.zeros_like(which)))
        self._state[which] = starts
        self._elapsed[which] = 0

    def _draw_outcomes(self, pairs: NDArray[np.int64], starting: NDArray[np.intp]) -> NDArray[np.int64]:
        """(num_envs,) outcomes of states and actions; who ended or starts anew draws nothing."""
        still = self.mdp.terminal.take(self._state)
        still[starting] = True
        moving = np.flatnonzero(~still)
        situations = pairs[moving]
        draws = self.draw_numbers(moving, situations)
        outcomes = np.zeros(self.num_envs, dtype=np.int64)
        thresholds = self._thresholds.take(situations, axis=1)
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
