"""GridWorld as a Gymnasium environment, one episode at a time.

Run as a program (`python -m gridworld.envs.env`) it plays one random episode in a window.
"""

from __future__ import annotations

import logging
import math
import operator
import time
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from os import PathLike
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from gridworld.base.bounds import positive_int
from gridworld.base.errors import InputError
from gridworld.envs import rendering as drawing
from gridworld.envs.rendering import CELL_SIZE, MARGIN, Colour, Frame, Point
from gridworld.world.grid import ACTION_NAMES, NUM_ACTIONS, GridMdp, mdp_or_compiled
from gridworld.world.layout import CLASSIC, NUM_COLS, NUM_ROWS, Cell, Layout
from gridworld.world.mdp import Mdp

_log = logging.getLogger("gridworld")


class GridWorldEnv(gym.Env[int, int]):
    """A walk over a grid to the goal, past the traps.

    ## Observation Space
    `Discrete(num_rows * num_cols)`: the cell's number, row by row from the top left, a plain `int`.
    `gridworld.envs.observations` has wrappers for one-hot vectors, coordinates and images.

    ## Action Space
    `Discrete(4)`: 0 up, 1 right, 2 down, 3 left. A move off the grid or into a wall stays in place. With
    `slip`, the move happens with probability 1 - slip, else one of the two at right angles to it.

    ## Rewards
    `step_reward` (default 0) plus the reward of the cell entered: goal +1, trap -1, any other 0.
    A map may have ends with rewards of their own.

    ## Starting State
    The cell marked as the start; one of them, drawn uniformly, where there are several. With `mdp`, its own
    distribution over starts.

    ## Episode End
    A goal or a trap terminates. A step after that returns `(state, 0.0, True, False, {})` and changes
    nothing. A cliff does not terminate: it pays as a trap and puts the agent back on the start. The class
    never truncates; the id `GridWorld-v0` does, after 100 steps.

    ## Arguments
    - `num_rows`, `num_cols`: the size of the layout `classic`; any other map has its own.
    - `delay`: seconds slept after each frame in human mode.
    - `render_mode`: `human`, `rgb_array`, `ansi` or None.
    - `layout`: `classic`, the name of a shipped map, a map file's path, or a `Layout`.
    - `slip`: probability of moving at a right angle instead.
    - `step_reward`: paid for every step.
    - `goal_reward`: paid for entering a goal.
    - `trap_reward`: paid for entering a trap or a cliff.
    - `rewards`: paid for entering ends with letters of their own, by letters, in place of the map's.
    - `cell_size`: pixels a cell in the picture.
    - `mdp`: a compiled world, in place of all arguments that describe one.

    Attributes `gold_cell` and `gold_state` are the first goal's where a map has several. `info` is empty.
    """

    # Shared by all instances, as Gymnasium has it.
    metadata = {"render_modes": ["human", "rgb_array", "ansi"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        num_rows: int = NUM_ROWS,
        num_cols: int = NUM_COLS,
        delay: float = 0.05,
        render_mode: str | None = None,
        *,
        layout: str | PathLike[str] | Layout = CLASSIC,
        slip: float = 0.0,
        step_reward: float = 0.0,
        goal_reward: float = 1.0,
        trap_reward: float = -1.0,
        rewards: Mapping[str, float] | None = None,
        cell_size: int = CELL_SIZE,
        mdp: Mdp | None = None,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InputError(f"render_mode={render_mode!r}: must be human, rgb_array, ansi or None")
        if isinstance(delay, bool) or not isinstance(delay, Real) or not 0 <= delay < math.inf:
            raise InputError(f"delay={delay!r}: must be a number of seconds, at least 0")
        world = mdp_or_compiled(
            mdp, layout, num_rows, num_cols, slip, step_reward, goal_reward, trap_reward, rewards
        )
        if not isinstance(world, GridMdp):
            raise InputError(f"mdp={world.name}: has no map; a batch of it is GridWorldVectorEnv(mdp=...)")
        self._mdp: GridMdp = world
        self._thresholds: tuple[float, ...] = tuple(world.thresholds[0, 0].tolist())  # of all cells and moves
        self.render_mode = render_mode
        self.delay: float = delay
        self.cell_size: int = positive_int("cell_size", cell_size)
        self.observation_space = spaces.Discrete(self.mdp.num_states)
        self.action_space = spaces.Discrete(NUM_ACTIONS)

        self._state: int = int(self.mdp.start_states[0])

        # The tutorial's public attributes; pygame's surface and clock are None until there is a window.
        self.window: Any = None
        self.clock: Any = None
        drawn = self.mdp.layout
        self.num_rows, self.num_cols = drawn.num_rows, drawn.num_cols
        self.state2grid: dict[int, Cell] = dict(enumerate(drawn.cells()))
        self.grid2state: dict[Cell, int] = {cell: state for state, cell in self.state2grid.items()}
        self.action_defs: dict[int, Callable[[int, int], Cell]] = {
            action: partial(self._move, action) for action in range(NUM_ACTIONS)
        }
        self.gold_cell = drawn.goals[0]
        self.gold_state = self.grid2state[self.gold_cell]
        self.trap_cells = list(drawn.traps)
        self.trap_states = [self.grid2state[cell] for cell in drawn.traps]
        self.terminal_states = [self.grid2state[cell] for cell in drawn.terminals]

    @property
    def mdp(self) -> GridMdp:
        """The world, which stays what it is from when the environment is made."""
        return self._mdp

    def _move(self, action: int, row: int, col: int) -> Cell:
        return self.state2grid[int(self.mdp.neighbour[self.grid2state[row, col], action])]

    @property
    def state(self) -> int:
        """The agent's cell number. It can be set to any cell but a wall."""
        return self._state

    @state.setter
    def state(self, value: int) -> None:
        state = _whole_number(value)
        if not 0 <= state < self.mdp.num_states or self.mdp.wall[state]:
            last = self.mdp.num_states - 1
            raise InputError(f"state={value!r}: must be the number of a cell that is not a wall, 0 to {last}")
        self._state = state

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Put the agent on a start; returns the state, a plain int, and an empty info.

        One number is drawn from `np_random` where there are several starts. No `options` are known.
        """
        super().reset(seed=seed)
        starts = self.mdp.start_states
        if len(starts) > 1:
            starts = self.mdp.drawn_starts(self.np_random.random(1))
        self._state = int(starts[0])
        if self.render_mode == "human":
            self._show()
        return self._state, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Move once by an action from 0 to 3. One number is drawn from `np_random` where the world slips.

        Returns the state, the reward, whether the episode terminated, False for truncated, and an empty info.
        """
        move = _whole_number(action)
        if not 0 <= move < NUM_ACTIONS:
            raise InputError(f"action={action!r}: must be 0 (up), 1 (right), 2 (down) or 3 (left)")
        state, mdp = self._state, self.mdp
        if mdp.terminal[state]:
            if self.render_mode == "human":
                self._show()
            return state, 0.0, True, False, {}
        outcome = bisect_right(self._thresholds, self.np_random.random()) if self._thresholds else 0
        self._state = int(mdp.next_state[state, move, outcome])
        if self.render_mode == "human":
            self._show()
        reward, terminated = float(mdp.reward[state, move, outcome]), bool(mdp.terminal[self._state])
        return self._state, reward, terminated, False, {}

    def render(self) -> Frame | str | None:
        """A fresh frame (`rgb_array`), the map as text (`ansi`), or None after showing it (`human`)."""
        if self.render_mode == "rgb_array":
            return drawing.draw_frame(self.mdp, self._state, self.cell_size)
        if self.render_mode == "ansi":
            return drawing.ansi(self.mdp, self._state)
        if self.render_mode == "human":
            self._show()
        else:
            gym.logger.warn(
                "render() draws nothing without a render mode; "
                'choose one when the environment is made: gym.make("GridWorld-v0", render_mode="rgb_array")'
            )
        return None

    def _show(self) -> None:
        """Draw and show one frame; keep `render_fps`, then wait. SystemExit if the user closed the window."""
        pygame = drawing.import_pygame()
        if self.window is None or not pygame.display.get_init():  # another environment may have closed it
            self._open_window()
        drawing.draw_world(self.window, self.mdp, self._state, self.cell_size)
        for event in pygame.event.get():
            if event.type == pygame.QUIT:
                self.close()
                raise SystemExit
        pygame.display.flip()
        self.clock.tick(self.metadata["render_fps"])
        time.sleep(self.delay)

    def _open_window(self) -> None:
        pygame = drawing.import_pygame()
        if self.window is None and not drawing.has_display():
            # A log line and no exception: SDL then draws off screen, where every call still works.
            _log.warning(
                "there is no display, so the window of render_mode='human' is invisible; set DISPLAY, or "
                "use 'rgb_array'"
            )
        size = drawing.frame_size(self.mdp, self.cell_size)
        pygame.display.init()  # not pygame.init(), which would look for a sound card too
        self.window, self.clock = pygame.display.set_mode(size), pygame.time.Clock()
        pygame.display.set_caption("GridWorld")

    def close(self) -> None:
        """Close the window and shut pygame down, if there is one. May be called again."""
        if self.window is not None:
            drawing.import_pygame().quit()
            self.window = self.clock = None

    def get_coords(self, row: int, col: int, loc: str = "center") -> Point | list[Point]:
        """Pixels for drawing into a cell: one (x, y) for `center`, else a list of them.

        `interior_corners` are the corners of a square that lies MARGIN inside the cell, clockwise from the
        top left; `interior_triangle` is bottom middle, top right, top left, a third of a cell from the
        centre.
        """
        x, y = drawing.cell_centre(row, col, self.cell_size)
        if loc == "center":
            return x, y
        if loc == "interior_corners":
            half = self.cell_size // 2 - MARGIN
            return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
        if loc == "interior_triangle":
            third = self.cell_size // 3
            return [(x, y + third), (x + third, y - third), (x - third, y - third)]
        raise InputError(f"loc={loc!r}: must be center, interior_corners or interior_triangle")

    def draw_object(self, screen: Any, coords_list: Sequence[Point]) -> None:
        """Draw one point (x, y) in pixels as a disc of 0.45 cell, three as a triangle, more as a polygon."""
        draw = drawing.import_pygame().draw
        if len(coords_list) == 1:
            draw.circle(screen, drawing.TRAP, coords_list[0], int(0.45 * self.cell_size))
        elif len(coords_list) >= 3:
            colour: Colour = drawing.GOAL if len(coords_list) == 3 else drawing.AGENT
            draw.polygon(screen, colour, list(coords_list))
        else:
            raise InputError(f"coords_list: {len(coords_list)} points are not a shape; give 1, 3 or more")


def _whole_number(value: Any) -> int:
    """The number itself; -1 for anything else, booleans included."""
    try:
        return -1 if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        return -1


def play_random_episode() -> None:
    """One random episode in a window, every step printed."""
    env = GridWorldEnv(render_mode="human")
    env.reset()
    terminated = False
    while not terminated:
        action = int(env.action_space.sample())
        state, reward, terminated, _, _ = env.step(action)
        print(f"action={action} ({ACTION_NAMES[action]}) state={state} reward={reward} done={terminated}")
    env.close()


if __name__ == "__main__":
    play_random_episode()
