"""Human mode shows the world in one window, at its pace, until somebody closes it."""

import os
import re
import subprocess
import sys
import time

import numpy as np
import pygame
import pytest
from helpers.oracle import DEFAULT_ROWS, World

from gridworld import GridWorldEnv

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
    command = [sys.executable, "-W", "error", "-m", "gridworld.envs.env"]
    environment = {**os.environ, "SDL_VIDEODRIVER": "dummy"}
    played = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
    assert (played.returncode, played.stderr) == (0, "")
    world, cell = World(DEFAULT_ROWS), (0, 0)
    lines = played.stdout.splitlines()
    for number, line in enumerate(lines, start=1):
        action, state, reward, ended = re.search(
            r"action\D*(\d).*state\D*(\d+).*reward\D*?(-?[\d.]+).*(True|False)", line
        ).groups()
        [(_, cell, expected, terminal)] = world.outcomes(cell, int(action))
        assert (int(state), float(reward)) == (world.state(cell), expected)
        assert (ended == "True") == terminal == (number == len(lines))
    assert world.ends(cell)
