"""The picture shows what the specification says, pixel by pixel, on any machine."""

import os
import subprocess
import sys
import zlib

import numpy as np
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


def python(code, **environment):
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "XDG_RUNTIME_DIR")
    kept = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env={**kept, **environment}, timeout=180)
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split()


def test_rgb_array_needs_no_display_and_opens_no_window():
    done = python(
        "from gridworld import GridWorldEnv; env = GridWorldEnv(render_mode='rgb_array'); env.reset();"
        "frame = env.render(); import pygame, zlib;"
        "print(frame.shape, pygame.display.get_init(), env.window, zlib.crc32(frame.tobytes()))"
    )
    same = zlib.crc32(frame_of(DEFAULT_ROWS, 0))
    assert done == ["(700,", "800,", "3)", "False", "None", str(same)]


def test_importing_the_package_loads_nothing_heavy():
    heavy = "{'torch', 'stable_baselines3', 'hydra', 'omegaconf', 'pygame', 'gymnasium', 'numpy'}"
    assert python(f"import gridworld, sys; print(*{heavy} & set(sys.modules))") == []
    heavy = "{'torch', 'stable_baselines3', 'hydra', 'omegaconf', 'pygame', 'scipy'}"
    assert (
        python(
            f"import gridworld.envs.env, gridworld.envs.vector_env, sys; print(*{heavy} & set(sys.modules))"
        )
        == []
    )
