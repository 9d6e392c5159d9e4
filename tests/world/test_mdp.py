"""The compiled tables say what the rules say, for every state and action."""

import dataclasses
import math

import numpy as np
import pytest
from helpers.oracle import MOVES, worlds
from hypothesis import given

from gridworld import InputError
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse


def compiled(world):
    return compile_mdp(parse(world.text, "map"), **world.settings)


@given(worlds())
def test_the_tables_equal_the_rules(world):
    mdp = compiled(world)
    for cell in world.cells:
        for action in MOVES:
            row = world.state(cell), action
            table = {}
            for p, state, reward in zip(
                mdp.probability[row], mdp.next_state[row].tolist(), mdp.reward[row].tolist(), strict=True
            ):
                if p > 0:
                    table[state, reward] = table.get((state, reward), 0.0) + p
            rules = {
                (world.state(target), reward): p for p, target, reward, _ in world.outcomes(cell, action)
            }
            assert table == pytest.approx(rules, abs=1e-12)
            assert mdp.neighbour[row] == world.state(world.moved(cell, action)) or world.tile[cell] == "#"


@given(worlds())
def test_the_masks_and_the_start_equal_the_map(world):
    mdp = compiled(world)
    tiles = [world.tile[cell] for cell in world.cells]
    assert mdp.num_states == len(tiles)
    assert mdp.terminal.tolist() == [tile in "GT" for tile in tiles]
    assert mdp.goal.tolist() == [tile == "G" for tile in tiles]
    assert mdp.trap.tolist() == [tile == "T" for tile in tiles]
    assert mdp.wall.tolist() == [tile == "#" for tile in tiles]
    assert mdp.cliff.tolist() == [tile == "C" for tile in tiles]
    assert mdp.start.tolist() == [(tile == "S") / len(world.starts) for tile in tiles]
    assert mdp.start_states.tolist() == [world.state(cell) for cell in world.starts]


@given(worlds())
def test_predecessors_are_the_origins_of_all_outcomes(world):
    mdp = compiled(world)
    for state in range(mdp.num_states):
        origins = (mdp.next_state == state).any(axis=(1, 2))
        assert np.unique(mdp.predecessors(np.array([state]))).tolist() == np.flatnonzero(origins).tolist()
    everything = mdp.predecessors(np.arange(mdp.num_states)[::-1])
    assert np.bincount(everything).tolist() == [mdp.next_state[0].size] * mdp.num_states
    assert mdp.predecessors(np.array([], dtype=np.int32)).size == 0


@given(worlds())
def test_shapes_and_sums(world):
    mdp = compiled(world)
    outcomes = 1 if world.settings["slip"] == 0 else 3
    for table in (mdp.next_state, mdp.probability, mdp.reward):
        assert table.shape == (len(world.cells), 4, outcomes)
    assert mdp.probability.sum(axis=2) == pytest.approx(1, abs=1e-12)
    assert mdp.start.sum() == pytest.approx(1, abs=1e-12)


TABLES = ["neighbour", "next_state", "probability", "reward", "terminal", "goal", "wall", "cliff", "start"]


@pytest.mark.parametrize("name", ["layout", "slip", "reward"])
def test_a_world_is_immutable(name):
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(compile_mdp(load("classic")), name, None)


@pytest.mark.parametrize("slip", [0.0, 0.2])
@pytest.mark.parametrize("name", [*TABLES, "trap", "start_states"])
def test_every_table_is_read_only(name, slip):
    table = getattr(compile_mdp(load("classic"), slip=slip), name)
    with pytest.raises(ValueError, match="read-only"):
        table[0] = table[-1]


NO_NUMBERS = [math.nan, math.inf, -math.inf, True, np.False_, "0.1", None, [0.1], 0.1j, np.zeros(3)]


@pytest.mark.parametrize("value", [-0.1, 1.1, 2, -1e-12, *NO_NUMBERS])
def test_a_slip_is_a_probability(value):
    with pytest.raises(InputError, match="slip="):
        compile_mdp(load("classic"), slip=value)


@pytest.mark.parametrize("name", ["step_reward", "goal_reward", "trap_reward"])
@pytest.mark.parametrize("value", NO_NUMBERS)
def test_a_reward_is_a_finite_number(name, value):
    with pytest.raises(InputError, match=f"{name}="):
        compile_mdp(load("classic"), **{name: value})


def test_a_reward_too_large_for_a_float_is_refused():
    with pytest.raises(InputError, match="step_reward="):
        compile_mdp(load("classic"), step_reward=10**400)


@pytest.mark.parametrize("value", [0, 1, np.float32(0.5), np.int64(1), np.float64(0.1)])
def test_numbers_of_any_kind_will_do(value):
    mdp = compile_mdp(load("classic"), slip=value, step_reward=value)
    assert (mdp.slip, mdp.step_reward) == (float(value), float(value))
    assert type(mdp.slip) is type(mdp.step_reward) is float


def test_rewards_and_slip_by_hand():
    mdp = compile_mdp(
        parse("S.T\n.#.\n..G", "map"), slip=0.5, step_reward=-0.1, goal_reward=2, trap_reward=-3
    )
    assert mdp.next_state[1, 1].tolist() == [2, 1, 1]  # right into the trap; down is a wall, up the border
    assert mdp.probability[1, 1].tolist() == [0.5, 0.25, 0.25]
    assert mdp.reward[1, 1].tolist() == pytest.approx([-3.1, -0.1, -0.1])
    assert mdp.reward[2].tolist() == [[0.0] * 3] * 4  # it is over


def test_a_fall_by_hand():
    mdp = compile_mdp(parse("...\nSCG", "map"), slip=0.2, step_reward=-0.5, trap_reward=-3)
    assert mdp.next_state[3, 1].tolist() == [3, 3, 0]  # off the cliff and back; the border; floor
    assert mdp.reward[3, 1].tolist() == [-3.5, -0.5, -0.5]
    assert mdp.next_state[1, 2].tolist() == [3, 0, 2]
    assert mdp.reward[1, 2].tolist() == [-3.5, -0.5, -0.5]
    assert not mdp.terminal[[3, 4]].any()
    assert mdp.neighbour[3, 1] == 4  # geometry alone


def test_a_cliff_that_pays_is_refused():
    cliff = parse("SCG\n...", "map")
    with pytest.raises(InputError, match=r"trap_reward=0.5: must be at most 0 where the map has a cliff"):
        compile_mdp(cliff, trap_reward=0.5)
    assert compile_mdp(cliff, trap_reward=0).reward.max() == 1
