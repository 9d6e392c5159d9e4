"""The worlds of maps: a layout and its rewards, compiled into tables.

A move succeeds with probability 1 - slip; otherwise one of the two perpendicular moves happens instead, with
probability slip / 2 each. A move off the grid or into a wall leaves the agent where it is. The reward of a
step is `step_reward` plus the reward of the cell entered (goal, trap, an end's own, or nothing). A move into
a cliff pays as one into a trap and leads to the start, so that no agent is ever on a cliff cell. Walls absorb
as terminal cells do.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, overload

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

from gridworld.base.bounds import STEP_LIMIT, Bounds, positive_int
from gridworld.base.errors import InputError
from gridworld.world.layout import CLASSIC, MOVES, NUM_COLS, NUM_ROWS, Cell, Layout, load
from gridworld.world.mdp import BoolArray, FloatArray, IntArray, Mdp, checked_reward, frozen, grid_places

ACTION_NAMES = ("up", "right", "down", "left")
NUM_ACTIONS = len(MOVES)


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class GridMdp(Mdp):
    """The tables of a map: a state is a cell, A = 4 actions, K outcomes (1 without slip, 3 with).

    `neighbour` (S, A), int32, is where a move leads by borders and walls alone; `wall` and `cliff` are (S,).
    """

    layout: Layout
    slip: float
    step_reward: float
    goal_reward: float
    trap_reward: float
    neighbour: IntArray
    wall: BoolArray
    cliff: BoolArray

    @property
    def default_step_limit(self) -> int:
        """The step limit of a batch that is given none: the world's own, or a map's 100."""
        return self.max_episode_steps or STEP_LIMIT

    @cached_property
    def thresholds(self) -> FloatArray:
        """(S, A, K - 1), of every move alike."""
        given = np.array([1 - self.slip, 1 - self.slip / 2] if self.slip else [])
        return np.broadcast_to(given, (*self.neighbour.shape, len(given)))

    @cached_property
    def absorbing(self) -> BoolArray:
        """(S,), the ends and the walls."""
        return frozen(self.terminal | self.wall)

    def text(self) -> str:
        """The map."""
        return self.layout.text()

    def coordinates(self, state: int) -> tuple[int, ...]:
        """Row and column."""
        return divmod(state, self.layout.num_cols)


@overload
def compile_mdp(
    layout: Layout,
    slip: float = ...,
    step_reward: float = ...,
    goal_reward: float = ...,
    trap_reward: float = ...,
) -> GridMdp: ...


@overload
def compile_mdp(
    layout: Mapping[int, Any] | Sequence[Any], slip: ArrayLike = ..., *, start: ArrayLike = ...
) -> Mdp: ...


def compile_mdp(
    layout: Any,
    slip: Any = 0.0,
    step_reward: float = 0.0,
    goal_reward: float = 1.0,
    trap_reward: float = -1.0,
    *,
    start: Any = None,
) -> Mdp:
    """Compile a map and its rewards, or a transition table, into a world.

    Args:
        layout: the map; or a table `P`, as environments of Gymnasium have it: `P[state][action]` is a list of
            (probability, next state, reward, terminated), of N states and A actions, numbered from 0.
        slip: of a map, the probability that a move goes to one side instead; of a table, `start`.
        step_reward: of every step, on a map.
        goal_reward: of entering a goal.
        trap_reward: of entering a trap or a cliff.
        start: of a table, (N,) probabilities, or one state.

    Raises:
        InputError: a setting or a table that makes no world.

    Example:
        >>> stay, leave, over = [(1.0, 0, 0.0, False)], [(1.0, 1, 1.0, True)], [(1.0, 1, 0.0, True)]
        >>> compile_mdp({0: {0: stay, 1: leave}, 1: {0: over, 1: over}}, start=0)
        <Mdp P: 2 states, 2 actions>
    """
    if isinstance(layout, Mapping | list | tuple):
        from gridworld.world.sources.gymnasium_table import mdp_of_table  # here, since maps need NumPy alone

        return mdp_of_table(layout, slip if start is None else start)
    if not isinstance(layout, Layout):
        raise InputError(
            f"layout={layout!r:.50}: must be a Layout; load({layout!r:.50}) reads a map by name or file, and "
            f"compile_env({layout!r:.50}) compiles the world of that name, with its rewards"
        )
    Bounds(0, 1).check("slip", slip)
    slip = float(slip)
    given = {"step_reward": step_reward, "goal_reward": goal_reward, "trap_reward": trap_reward}
    rewards: dict[str, Any] = {key: checked_reward(key, value) for key, value in given.items()}
    step_reward, goal_reward, trap_reward = rewards.values()
    if layout.cliffs and trap_reward > 0:
        raise InputError(
            f"trap_reward={trap_reward}: must be at most 0 on maps with a cliff, since the agent may fall "
            "again and again"
        )
    goal, trap, wall, cliff = (
        _mask(layout, cells) for cells in (layout.goals, layout.traps, layout.walls, layout.cliffs)
    )
    absorbing = goal | trap | wall
    neighbour = _neighbours(layout, wall)

    # Outcome 0 is the move itself; with slip, 1 and 2 are the moves at right angles to it.
    outcomes = [neighbour] if slip == 0 else [neighbour, np.roll(neighbour, -1, 1), np.roll(neighbour, 1, 1)]
    chances = [1.0] if slip == 0 else [1 - slip, slip / 2, slip / 2]
    next_state = np.stack(outcomes, axis=-1)
    entered = step_reward + goal_reward * goal + trap_reward * (trap | cliff)
    for end in layout.ends:
        pays = checked_reward(f"{layout.name}: reward of {end.letter}", end.reward)
        entered[_mask(layout, end.cells)] = step_reward + pays
    reward = entered[next_state]
    next_state[cliff[next_state]] = layout.state(layout.starts[0])  # the only one where there is a cliff
    next_state[absorbing] = np.flatnonzero(absorbing).reshape(-1, 1, 1)
    reward[absorbing] = 0.0

    start = _mask(layout, layout.starts) / len(layout.starts)
    return GridMdp(
        name=layout.name,
        action_names=ACTION_NAMES,
        layout=layout,
        slip=slip,
        **rewards,
        neighbour=frozen(neighbour),
        next_state=frozen(next_state),
        probability=np.broadcast_to(np.array(chances), next_state.shape),
        reward=frozen(reward),
        terminal=frozen(goal | trap),
        goal=frozen(goal),
        wall=frozen(wall),
        cliff=frozen(cliff),
        start=frozen(start),
        number=frozen(np.arange(goal.size)),
        places=frozen(grid_places(layout.num_rows, layout.num_cols)),
    )


def mdp_or_compiled(
    mdp: Mdp | None,
    layout: str | PathLike[str] | Layout,
    num_rows: int,
    num_cols: int,
    slip: float,
    step_reward: float,
    goal_reward: float,
    trap_reward: float,
    rewards: Mapping[str, float] | None = None,
) -> Mdp:
    """The world of an environment's arguments: `mdp`, or else the one that the others describe.

    `num_rows` and `num_cols` of the layout `classic` also mean by their defaults that none are given.
    """
    described = (layout, num_rows, num_cols, slip, step_reward, goal_reward, trap_reward)
    if mdp is None:
        rows, cols = positive_int("num_rows", num_rows), positive_int("num_cols", num_cols)
        given = load(layout, None if rows == NUM_ROWS else rows, None if cols == NUM_COLS else cols, rewards)
        return compile_mdp(given, slip, step_reward, goal_reward, trap_reward)
    if not isinstance(mdp, Mdp):
        raise InputError(f"mdp={str(mdp)[:50]}: must be a compiled world, as from `compile_mdp`")
    if described != (CLASSIC, NUM_ROWS, NUM_COLS, 0.0, 0.0, 1.0, -1.0) or rewards:
        raise InputError(f"mdp={mdp.name}: has its own layout, slip and rewards; leave these arguments out")
    return mdp


def _mask(layout: Layout, cells: tuple[Cell, ...] | frozenset[Cell]) -> BoolArray:
    mask = np.zeros(layout.num_rows * layout.num_cols, dtype=np.bool_)
    mask[[layout.state(cell) for cell in cells]] = True
    return mask


def _neighbours(layout: Layout, wall: BoolArray) -> IntArray:
    states = np.arange(wall.size, dtype=np.int32)
    row, col = np.divmod(states[:, None], layout.num_cols)
    down, right = np.array(MOVES, dtype=np.int32).T
    target = np.clip(row + down, 0, layout.num_rows - 1) * layout.num_cols
    target += np.clip(col + right, 0, layout.num_cols - 1)
    return np.where(wall[target], states[:, None], target).astype(np.int32)
