"""The picture shows what the specification says, pixel by pixel, on any machine."""

import os
import re
import subprocess
import sys
import time
import zlib

import numpy as np
import pygame
import pytest
from helpers.oracle import DEFAULT_ROWS, World

from gridworld import GridWorldEnv, InputError
from gridworld.world.layout import Layout, parse

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
TRAP, GOAL, AGENT = (50, 50, 50), (230, 180, 50), (100, 100, 220)
TRICKY = ("S.#T", ".GT.", "#..S")


def frame_of(rows, state, cell_size=100):
    env = GridWorldEnv(render_mode="rgb_array", layout=parse("\n".join(rows), "map"), cell_size=cell_size)
    env.reset()
    env.state = state
    return env.render()


def expected(world, state, size):
    """(H, W, 3) colours, and (H, W) where they are certain: 1.5 pixels off the edge of a shape."""
    rows, cols = len(world.cells) // world.num_cols, world.num_cols
    y, x = np.mgrid[: (rows + 2) * size, : (cols + 2) * size].astype(float)
    inside = (x >= size) & (x <= (cols + 1) * size) & (y >= size) & (y <= (rows + 1) * size)
    colours = np.full((*x.shape, 3), 255, dtype=np.uint8)
    colours[inside & ((x % size == 0) | (y % size == 0))] = BLACK
    certain = np.ones(x.shape, dtype=bool)

    def paint(depth, colour):  # depth: pixels inside the shape, negative outside
        colours[depth > 0] = colour
        certain[np.abs(depth) <= 1.5] = False

    for row, col in (cell for cell in world.cells if world.tile[cell] == "T"):
        centre = (col + 1.5) * size, (row + 1.5) * size
        paint(size // 3 - np.hypot(x - centre[0], y - centre[1]), TRAP)
    for row, col in (cell for cell in world.cells if world.tile[cell] == "G"):
        u, v = x - (col + 1.5) * size, y - (row + 1.2) * size  # from the tip; it widens by 0.3 over 0.6
        sides = [(v - 2 * abs(u)) / 5**0.5, 0.6 * size - v]
        paint(np.minimum(*sides), GOAL)
    row, col = world.cells[state]
    left, top, side = (col + 1.2) * size, (row + 1.2) * size, 0.6 * size
    paint(np.minimum.reduce([x - left, left + side - x, y - top, top + side - y]), AGENT)
    return colours, certain


@pytest.mark.parametrize("state", [0, 5, 17, 24])
@pytest.mark.parametrize("size", [100, 40, 37, 8])
def test_every_pixel_of_the_default_world(state, size):
    frame = frame_of(DEFAULT_ROWS, state, size)
    assert frame.dtype == np.uint8
    assert frame.shape == (7 * size, 8 * size, 3)
    colours, certain = expected(World(DEFAULT_ROWS), state, size)
    assert certain.mean() > (0.98 if size == 100 else 0.8)
    assert np.array_equal(frame[certain], colours[certain])
    places = np.array([2**16, 2**8, 1])
    shown = np.unique(frame @ places)
    assert np.array_equal(shown, np.unique([WHITE, BLACK, TRAP, GOAL, AGENT] @ places))


def test_walls_and_cliffs_fill_their_cells_in_colours_of_their_own():
    frame = frame_of(TRICKY, 0)
    [wall] = np.unique(frame[101:200, 301:400].reshape(-1, 3), axis=0)
    assert (frame[301:400, 101:200] == wall).all()
    colours, certain = expected(World(TRICKY), 0, 100)
    certain &= (frame != wall).any(axis=2)
    assert np.array_equal(frame[certain], colours[certain])
    frame = frame_of(("S...", ".#C.", "C..G"), 0)
    [same], [cliff] = (np.unique(frame[201:300, x : x + 99].reshape(-1, 3), axis=0) for x in (201, 301))
    assert tuple(same) == tuple(wall)
    assert len({WHITE, BLACK, TRAP, GOAL, AGENT, tuple(wall), tuple(cliff)}) == 7
    assert (frame[301:400, 101:200] == cliff).all()


def test_a_frame_is_a_fresh_array_and_without_a_mode_there_is_none():
    env = GridWorldEnv(render_mode="rgb_array")
    env.reset()
    first, second = env.render(), env.render()
    first[:] = 0
    assert np.array_equal(second, env.render())
    with pytest.warns(UserWarning, match="render_mode"):
        assert GridWorldEnv().render() is None


@pytest.mark.parametrize(
    ("rows", "state", "shown"),
    [(TRICKY, 9, "S.#T .GT. #A.S"), (TRICKY, 5, "S.#T .AT. #..S"), (("S.#", "C.G"), 0, "A.# C.G")],
)
def test_the_map_as_text(rows, state, shown):
    env = GridWorldEnv(render_mode="ansi", layout=parse("\n".join(rows), "map"))
    env.reset()
    env.state = state
    assert env.render().split() == shown.split()


def test_a_frame_that_would_be_too_large_is_refused():
    layout = Layout("vast", 100, 100, starts=((0, 0),), goals=((99, 99),))
    for mode in ("rgb_array", "human"):
        with pytest.raises(InputError, match=r"vast.*10200 x 10200.*cell_size"):
            GridWorldEnv(render_mode=mode, layout=layout).render()
    small = GridWorldEnv(render_mode="rgb_array", layout=layout, cell_size=10)
    assert small.render().shape == (1020, 1020, 3)


def python(*words, **environment):
    """What a Python without a display prints."""
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "XDG_RUNTIME_DIR")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-W", "error", *words]
    done = subprocess.run(command, capture_output=True, text=True, env={**kept, **environment}, timeout=180)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_rgb_array_needs_no_display_and_opens_no_window():
    done = python(
        "-c",
        "from gridworld import GridWorldEnv; env = GridWorldEnv(render_mode='rgb_array'); env.reset();"
        "frame = env.render(); import pygame, zlib;"
        "print(frame.shape, pygame.display.get_init(), env.window, zlib.crc32(frame.tobytes()))",
    )
    same = zlib.crc32(frame_of(DEFAULT_ROWS, 0))
    assert done == f"(700, 800, 3) False None {same}\n"


def test_importing_the_package_and_its_environments_loads_nothing_heavy():
    heavy = "{'torch', 'stable_baselines3', 'hydra', 'omegaconf', 'pygame', 'scipy'}"
    code = f"import gridworld, sys; print(*({heavy} | {{'gymnasium', 'numpy'}}) & set(sys.modules));"
    code += f"import gridworld.envs.env, gridworld.envs.vector_env; print(*{heavy} & set(sys.modules))"
    assert python("-c", code).split() == []


# ---- a window, at its pace, until somebody closes it -------------------------------------------------------

UP, RIGHT, DOWN, LEFT = range(4)
SHORTEST = (*[RIGHT] * 5, DOWN, DOWN, LEFT)


@pytest.fixture
def window_env():
    env = GridWorldEnv(render_mode="human", delay=0)
    yield env
    env.close()


def test_one_window_is_opened_and_draws_what_rgb_array_draws(window_env):
    picture = GridWorldEnv(render_mode="rgb_array")
    assert window_env.window is None
    window_env.reset()
    window, clock = window_env.window, window_env.clock
    assert window is pygame.display.get_surface()
    assert window.get_size() == (800, 700)
    assert clock is not None
    for action in (None, *SHORTEST):
        if action is not None:
            picture.state, *_ = window_env.step(action)
        assert np.array_equal(pygame.surfarray.array3d(window).swapaxes(0, 1), picture.render())
    assert window_env.render() is None
    assert (window_env.window, window_env.clock) == (window, clock)


def test_human_mode_keeps_its_pace():
    def seconds(delay):
        env = GridWorldEnv(render_mode="human", delay=delay)
        env.reset()
        begin = time.perf_counter()
        for _ in range(4):
            env.step(UP)
        env.close()
        return time.perf_counter() - begin

    assert seconds(delay=0) > 4 / 20 * 0.9  # render_fps
    assert seconds(delay=0.1) > 4 * 0.1


def test_closing_the_window_ends_the_program(window_env):
    window_env.reset()
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    with pytest.raises(SystemExit):
        window_env.step(RIGHT)
    assert not pygame.get_init()
    assert not pygame.display.get_init()
    window_env.close()
    window_env.reset()
    assert window_env.window is pygame.display.get_surface()


def test_close_may_be_called_twice(window_env):
    for env in (GridWorldEnv(), GridWorldEnv(render_mode="human")):  # nothing was opened
        env.close()
        env.close()
    window_env.reset()
    for _ in range(2):
        window_env.close()
        assert not pygame.display.get_init()
        assert window_env.window is None


def test_the_module_plays_one_random_episode():
    world, cell = World(DEFAULT_ROWS), (0, 0)
    lines = python("-m", "gridworld.envs.env", SDL_VIDEODRIVER="dummy").splitlines()
    for number, line in enumerate(lines, start=1):
        action, state, reward, ended = re.search(
            r"action\D*(\d).*state\D*(\d+).*reward\D*?(-?[\d.]+).*(True|False)", line
        ).groups()
        [(_, cell, expected, terminal)] = world.outcomes(cell, int(action))
        assert (int(state), float(reward)) == (world.state(cell), expected)
        assert (ended == "True") == terminal == (number == len(lines))
    assert world.ends(cell)
