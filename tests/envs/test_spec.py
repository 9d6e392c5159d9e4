"""The default world keeps every line of its specification."""

import inspect

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium import spaces
from helpers.oracle import DEFAULT_ROWS, MOVES, World

from gridworld import GridWorldEnv, InputError

WORLD = World(DEFAULT_ROWS)
UP, RIGHT, DOWN, LEFT = range(4)


@pytest.fixture
def env():
    return GridWorldEnv()


def test_the_table_of_the_world(env):
    assert (env.num_rows, env.num_cols) == (5, 6)
    assert (env.gold_cell, env.gold_state) == ((2, 4), 16)
    assert list(env.trap_cells) == [(3, 4), (2, 3), (1, 4)]
    assert list(env.trap_states) == [22, 15, 10]
    assert list(env.terminal_states) == [16, 22, 15, 10]
    assert env.action_space == spaces.Discrete(4)
    assert env.observation_space == spaces.Discrete(30)
    assert env.state == 0


def test_the_constructor():
    parameters = list(inspect.signature(GridWorldEnv).parameters.values())
    first = [(p.name, p.default) for p in parameters[:4]]
    assert first == [("num_rows", 5), ("num_cols", 6), ("delay", 0.05), ("render_mode", None)]
    assert all(p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters[:4])
    assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in parameters[4:])
    env = GridWorldEnv(4, 7, 0.25, "rgb_array")
    assert (env.num_rows, env.num_cols, env.delay, env.render_mode) == (4, 7, 0.25, "rgb_array")


def test_the_tutorials_attributes(env):
    assert env.grid2state == {(row, col): row * 6 + col for row in range(5) for col in range(6)}
    assert env.state2grid == {state: cell for cell, state in env.grid2state.items()}
    assert (env.delay, env.render_mode, env.window, env.clock) == (0.05, None, None, None)
    assert set(env.action_defs) == {UP, RIGHT, DOWN, LEFT}
    for cell in WORLD.cells:
        assert {action: move(*cell) for action, move in env.action_defs.items()} == {
            action: WORLD.moved(cell, action) for action in MOVES
        }


def test_reset_returns_the_corner(env):
    parameters = inspect.signature(env.reset).parameters
    assert {name: (p.kind, p.default) for name, p in parameters.items()} == {
        "seed": (inspect.Parameter.KEYWORD_ONLY, None),
        "options": (inspect.Parameter.KEYWORD_ONLY, None),
    }
    for arguments in ({}, {"seed": 3}, {"options": {}}, {"seed": 3, "options": {"any": 1}}):
        env.state = 5
        observation, info = env.reset(**arguments)
        assert (observation, info) == (0, {})
        assert type(observation) is int


def test_every_step_has_the_rewards_and_types_of_the_table(env):
    env.reset()
    for cell in WORLD.cells:
        for action in MOVES:
            [(_, target, reward, terminal)] = WORLD.outcomes(cell, action)
            env.state = WORLD.state(cell)
            result = env.step(action)
            assert result == (WORLD.state(target), reward, terminal, False, {})
            assert [type(value) for value in result] == [int, float, bool, bool, dict]


@pytest.mark.parametrize("state", [16, 22, 15, 10])
def test_stepping_on_after_the_end_changes_nothing_and_draws_nothing(state):
    env = GridWorldEnv(slip=0.3)
    env.reset(seed=0)
    env.state = state
    before = env.np_random.bit_generator.state
    for action in MOVES:
        result = env.step(action)
        assert result == (state, 0.0, True, False, {})
        assert [type(value) for value in result] == [int, float, bool, bool, dict]
    assert (env.state, env.np_random.bit_generator.state) == (state, before)


@pytest.mark.parametrize("state", [-1, 30, 1.0, "3", None, True])
def test_state_refuses_what_is_no_cell(env, state):
    with pytest.raises(InputError, match="state"):
        env.state = state
    assert env.state == 0
    with pytest.raises(InputError, match=r"state=5.*wall"):
        GridWorldEnv(layout="aima_4x3").state = 5


def test_the_registered_id_truncates_after_100_steps_and_the_class_never():
    env = gym.make("GridWorld-v0")
    assert env.spec.max_episode_steps == 100
    assert env.reset() == (0, {})
    assert [env.step(UP)[3] for _ in range(100)] == [False] * 99 + [True]
    assert [env.unwrapped.step(UP) for _ in range(1000)] == [(0, 0.0, False, False, {})] * 1000


def test_get_coords(env):
    assert env.get_coords(1, 3, "center") == env.get_coords(1, 3, loc="center") == (450, 250)
    assert list(env.get_coords(1, 3, "interior_corners")) == [(410, 210), (490, 210), (490, 290), (410, 290)]
    assert list(env.get_coords(1, 3, "interior_triangle")) == [(450, 283), (483, 217), (417, 217)]
    with pytest.raises(InputError, match="loc"):
        env.get_coords(0, 0, "middle")


def test_draw_object(env):
    def drawn(points):
        screen = pygame.Surface((800, 700))
        screen.fill((255, 255, 255))
        env.draw_object(screen, points)
        return (pygame.surfarray.array3d(screen) != 255).any(axis=2)  # [x, y]

    disc = drawn([env.get_coords(1, 3, "center")])
    assert disc.sum() == pytest.approx(np.pi * 45**2, rel=0.03)
    assert disc[450, 250]
    assert not disc[:404].any()
    assert not disc[496:].any()
    triangle = drawn(env.get_coords(1, 3, "interior_triangle"))
    assert triangle.sum() == pytest.approx(66 * 66 / 2, rel=0.07)  # pygame-ce draws its edges wider
    assert triangle[450, 280]
    assert not triangle[430, 280]
    square = drawn(env.get_coords(1, 3, "interior_corners"))
    assert square.sum() == pytest.approx(80 * 80, rel=0.03)
    assert square[412:489, 212:289].all()


@pytest.mark.parametrize(
    "action",
    [-1, 4, 1.7, 1.0, "1", float("nan"), None, True, np.True_, np.float64(1), np.int64(4), np.array([1, 2])],
)
@pytest.mark.parametrize("state", [0, 16])
def test_what_is_no_action_is_refused(env, action, state):
    env.reset()
    env.state = state
    with pytest.raises(InputError, match="action"):
        env.step(action)
    assert env.state == state


@pytest.mark.parametrize("kind", [int, np.int64, np.int8, np.uint64, np.array])
def test_whole_numbers_of_any_kind_are_actions(env, kind):
    env.reset()
    assert env.step(kind(1)) == (1, 0.0, False, False, {})
