"""The compiled tables say what the rules say, for every state and action."""

import dataclasses
import math

import numpy as np
import pytest
from helpers.oracle import MOVES, worlds
from hypothesis import given

from gridworld import InputError
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes


@given(worlds())
def test_the_tables_equal_the_rules(world):
    mdp = compile_mdp(parse(world.text, "map"), **world.settings)
    for cell in world.cells:
        for action in MOVES:
            row = world.state(cell), action
            table = {}
            for p, state, reward in zip(
                mdp.probability[row], mdp.next_state[row].tolist(), mdp.reward[row].tolist(), strict=True
            ):
                if p > 0:
                    table[state, reward] = table.get((state, reward), 0.0) + p
            rules = {(world.state(to), reward): p for p, to, reward, _ in world.outcomes(cell, action)}
            assert table == pytest.approx(rules, abs=1e-12)
            assert mdp.neighbour[row] == world.state(world.moved(cell, action)) or world.tile[cell] == "#"
    tiles = [world.tile[cell] for cell in world.cells]
    for name, kinds in (("terminal", "GT"), ("goal", "G"), ("trap", "T"), ("wall", "#"), ("cliff", "C")):
        assert getattr(mdp, name).tolist() == [tile in kinds for tile in tiles]
    assert mdp.start.tolist() == [(tile == "S") / len(world.starts) for tile in tiles]
    assert mdp.start_states.tolist() == [world.state(cell) for cell in world.starts]


@given(worlds())
def test_predecessors_are_the_origins_of_all_outcomes(world):
    mdp = compile_mdp(parse(world.text, "map"), **world.settings)
    for state in range(mdp.num_states):
        origins = (mdp.next_state == state).any(axis=(1, 2))
        assert np.unique(mdp.predecessors(np.array([state]))).tolist() == np.flatnonzero(origins).tolist()
    everything = mdp.predecessors(np.arange(mdp.num_states)[::-1])
    assert np.bincount(everything).tolist() == [mdp.next_state[0].size] * mdp.num_states
    assert mdp.predecessors(np.array([], dtype=np.int32)).size == 0


@pytest.mark.parametrize("slip", [0.0, 0.2])
def test_a_world_is_immutable(slip):
    mdp = compile_mdp(load("classic"), slip=slip)
    for name in ("layout", "slip", "reward"):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(mdp, name, None)
    tables = [
        field.name for field in dataclasses.fields(mdp) if isinstance(getattr(mdp, field.name), np.ndarray)
    ]
    for name in [*tables, "trap", "start_states", "acting", "steps_away"]:
        table = getattr(mdp, name)
        with pytest.raises(ValueError, match="read-only"):
            table[0] = table[-1]


NO_NUMBERS = [math.nan, math.inf, -math.inf, True, np.False_, "0.1", None, [0.1], 0.1j, np.zeros(3), 10**400]


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_settings_are_finite_numbers(value):
    for name in ("slip", "step_reward", "goal_reward", "trap_reward"):
        with pytest.raises(InputError, match=f"{name}="):
            compile_mdp(load("classic"), **{name: value})


@pytest.mark.parametrize("value", [-0.1, 1.1, 2, -1e-12])
def test_a_slip_is_a_probability(value):
    with pytest.raises(InputError, match="slip="):
        compile_mdp(load("classic"), slip=value)


@pytest.mark.parametrize("value", [0, 1, np.float32(0.5), np.int64(1), np.float64(0.1)])
def test_numbers_of_any_kind_will_do(value):
    mdp = compile_mdp(load("classic"), slip=value, step_reward=value)
    assert (mdp.slip, mdp.step_reward) == (float(value), float(value))
    assert type(mdp.slip) is type(mdp.step_reward) is float


def test_a_cliff_that_pays_is_refused():
    cliff = parse("SCG\n...", "map")
    with pytest.raises(InputError, match=r"trap_reward=0.5: must be at most 0 on maps with a cliff"):
        compile_mdp(cliff, trap_reward=0.5)
    assert compile_mdp(cliff, trap_reward=0).reward.max() == 1


@pytest.mark.parametrize("pays_at_the_end", [0.0, -1.0])
def test_an_episode_that_begins_at_its_end_makes_no_goal_of_its_own(pays_at_the_end: float) -> None:
    """The 4x4 of Sutton and Barto (example 4.1) as courses have it: starts anywhere, two ends, -1 a step."""
    shape, row, column = (16, 4, 1), *np.divmod(np.arange(16), 4)
    moves = [(-1, 0), (0, 1), (1, 0), (0, -1)]
    following = [4 * np.clip(row + down, 0, 3) + np.clip(column + right, 0, 3) for down, right in moves]
    next_state, over = np.stack(following, axis=1)[..., None], np.isin(np.arange(16), [0, 15])
    next_state[over] = np.array([0, 15])[:, None, None]
    reward = np.where(over[:, None, None], pays_at_the_end, np.full(shape, -1.0))
    terminated = over[next_state]
    outcomes = Outcomes(
        next_state=next_state,
        probability=np.ones(shape),
        reward=reward,
        terminated=terminated,
        start=np.full(16, 1 / 16),
    )
    found = Evaluator(mdp_from_outcomes("4x4", outcomes), 1.0, 100).optimum
    assert (found.goal, found.trap) == (1, 0)
    assert found.expected_length == pytest.approx((2 * 1 + 4 * 1 + 6 * 2 + 4 * 3) / 16)
