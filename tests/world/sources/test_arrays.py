"""Worlds from tables: of outcomes that end episodes, in files, from functions, and as a run keeps them."""

import contextlib
import dataclasses
import io
import os
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridworld import InputError, compile_mdp, load
from gridworld.base.user_input import npz_bytes
from gridworld.world.chain import Chain
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes
from gridworld.world.solver import value_iteration
from gridworld.world.sources.arrays import build, load_world, world_bytes, world_from_bytes
from gridworld.world.sources.classics import river_swim

HORIZON = 7


@st.composite
def outcomes(draw):
    n, a, k = draw(st.integers(1, 5)), draw(st.integers(1, 3)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    weights = rng.integers(0, 4, (n, a, k)) + 1e-9 * (np.arange(k) == 0)
    weights[weights.sum(axis=2) < 1] = np.eye(k)[-1]
    starts = rng.integers(0, 2, n)
    starts[rng.integers(n)] += 1
    shape = (n, a, k)
    return Outcomes(
        next_state=rng.integers(n, size=shape),
        probability=weights / weights.sum(axis=2, keepdims=True),
        reward=rng.integers(-2, 3, shape).astype(float),
        terminated=rng.random(shape) < draw(st.sampled_from([0.0, 0.3, 1.0])),
        start=starts / starts.sum(),
        success=rng.random(shape) < 0.5 if draw(st.booleans()) else None,
    )


def rows(table, policy, state):
    """All that may happen in a state: (probability, next state, reward, where in the table)."""
    for action, k in np.ndindex(table.probability[state].shape):
        at = state, action, k
        if (p := policy[state, action] * table.probability[at]) > 0:
            yield p, int(table.next_state[at]), float(table.reward[at]), at


def successes(table):
    if table.success is not None:
        return table.success
    policy = np.ones(table.next_state.shape[:2])
    seen, ends, frontier = set(), [0], list(np.flatnonzero(table.start))
    while frontier:
        state = int(frontier.pop())
        if state not in seen:
            seen.add(state)
            found = list(rows(table, policy, state))
            ends += [reward for _, _, reward, at in found if table.terminated[at]]
            frontier += [target for _, target, _, at in found if not table.terminated[at]]
    return table.reward == max(ends[1:], default=0)


def walked(table, policy):
    """(probabilities of success, failure and time-out, return, length) of an episode, by its flags."""
    masses, good = dict(enumerate(table.start)), successes(table)
    totals = np.zeros(5)
    for _ in range(HORIZON):
        following = {}
        for state, mass in masses.items():
            for p, target, reward, at in rows(table, policy, state):
                totals[3:] += mass * p * reward, mass * p
                if table.terminated[at]:
                    totals[0 if good[at] else 1] += mass * p
                else:
                    following[target] = following.get(target, 0) + mass * p
        masses = following
    totals[2] = sum(masses.values())
    return totals


def valued(table, policy, gamma=0.8):
    values = np.zeros(len(table.start))
    known = [list(rows(table, policy, state)) for state in range(len(values))]
    for _ in range(120):
        going_on = np.where(table.terminated, 0.0, gamma * values[table.next_state])
        values = np.array([sum(p * (reward + going_on[at]) for p, _, reward, at in row) for row in known])
    return values


@given(outcomes(), st.integers(0, 2**32))
def test_a_world_is_worth_what_a_walk_with_flags_is(table, seed):
    policy = np.random.default_rng(seed).dirichlet(np.ones(table.next_state.shape[1]), len(table.start))
    mdp = mdp_from_outcomes("random", table)
    chain = Chain(mdp, policy[mdp.number])
    found = chain.outcome(HORIZON)
    of_ends = found.goal, found.trap, found.timeout, found.expected_return, found.expected_length
    assert np.allclose(of_ends, walked(table, policy), atol=1e-9)
    assert np.isclose(mdp.start @ chain.value(0.8), table.start @ valued(table, policy), atol=1e-9)
    assert not (mdp.start[mdp.terminal] > 0).any()
    for state in np.flatnonzero(~mdp.terminal):  # where an episode goes on, the rows are kept
        possible, leads_to = table.probability[state] > 0, mdp.next_state[state]
        assert np.array_equal(mdp.probability[state], table.probability[state])
        assert np.array_equal(mdp.reward[state][possible], table.reward[state][possible])
        assert np.array_equal(mdp.number[leads_to][possible], table.next_state[state][possible])
        assert (mdp.terminal[leads_to] | ~table.terminated[state])[possible].all()


@pytest.mark.parametrize(
    ("shape", "told"),
    [
        ((1_100_000, 2, 1), "1,100,000 states and 2 actions are too many"),
        ((100_000, 100, 20), r"would take [\d.]+ GiB of memory; at most 4 GiB"),
    ],
)
def test_worlds_that_are_too_large_are_refused_with_what_they_would_take(shape, told):
    tables = {name: np.broadcast_to(0.0, shape) for name in ("probability", "reward")}
    tables |= {"next_state": np.broadcast_to(np.int64(0), shape), "terminated": np.broadcast_to(False, shape)}
    with pytest.raises(InputError, match=told):
        mdp_from_outcomes("big", Outcomes(**tables, start=np.zeros(shape[0])))


TWO_ROOMS = {
    "next_state": [[0, 1], [0, 1]],
    "reward": [[0.0, 0.0], [0.0, 1.0]],
    "terminated": [[False, False], [False, True]],
    "start": [1.0, 0.0],
}


def written(folder, save=np.savez, **changed):
    arrays = {key: value for key, value in {**TWO_ROOMS, **changed}.items() if value is not None}
    save(folder / "rooms.npz", **arrays)
    return folder / "rooms.npz"


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_a_deterministic_world_needs_five_lines(tmp_path, save):
    mdp = load_world(written(tmp_path, save))
    assert (mdp.name, mdp.action_names, mdp.places, mdp.max_episode_steps) == (
        "rooms",
        ("0", "1"),
        None,
        None,
    )
    assert mdp.goal.tolist() == [False, False, True]
    assert value_iteration(mdp, 0.9).v.tolist() == pytest.approx([0.9, 1.0, 0.0])


def test_everything_optional(tmp_path):
    table = {
        key: np.array(value)[..., None].repeat(2, 2) for key, value in TWO_ROOMS.items() if key != "start"
    }
    path = written(
        tmp_path,
        **table,
        probability=np.broadcast_to([0.25, 0.75], (2, 2, 2)),
        success=np.arange(8).reshape(2, 2, 2) == 7,
        action_names=["back", "on"],
        places=[[0, 0], [0, 1]],
        max_episode_steps=9,
        name="two rooms",
    )
    mdp = load_world(str(path))
    assert (mdp.name, mdp.action_names, mdp.max_episode_steps) == ("two rooms", ("back", "on"), 9)
    assert mdp.places.tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1]]
    assert mdp.goal.sum() == mdp.trap.sum() == 1


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"start": None}, "has no start, must contain next_state, reward, terminated, start"),
        ({"nonsense": [1.0]}, "nonsense is not an array of a world; optional are"),
        ({"reward": [0.0, 1.0]}, r"reward has shape \(2,\), next_state has \(2, 2, 1\)"),
        ({"reward": [["a", "b"], ["a", "b"]]}, "reward is <U1 .* must be an array of numbers"),
        ({"terminated": [[0, 0], [0, 1]]}, "terminated is int64 .* must be an array of booleans"),
        ({"next_state": [[0, 2], [0, 1]]}, "next_state of state 0, action 1 is 2"),
        ({"next_state": [[[0], [1]], [[0], [1]]]}, "has no probability; without it"),
        ({"start": [0.4, 0.4]}, "start is .* must be probabilities with sum 1"),
        ({"action_names": ["a"]}, "1 action_names for 2 actions"),
        ({"places": [[0, -2, 0], [0, 0, 0]]}, "has a place below -1"),
        ({"places": [[0, 0, 0], [0, 10**9, 10**9]]}, "places are 1 panels of 1,000,000,001 rows"),
        ({"max_episode_steps": 0}, "max_episode_steps=0: must be a whole number of at least 1"),
        ({"max_episode_steps": 1.5}, "max_episode_steps=1.5: must be a whole number"),
        ({"name": "two\nlines"}, "name is .* must be 1 to 200 letters"),
    ],
)
def test_arrays_that_make_no_world_are_refused(tmp_path, changed, told):
    path = written(tmp_path, **changed)
    with pytest.raises(InputError, match=f"^{path}: .*{told}") as refused:
        load_world(path)
    assert "\n" not in str(refused.value)


def test_no_file_of_arrays(tmp_path, monkeypatch):
    (tmp_path / "text.npz").write_text("no zip")
    np.save(tmp_path / "one.npy", np.zeros(3))
    os.mkfifo(tmp_path / "pipe.npz")
    np.savez_compressed(tmp_path / "bomb.npz", **{**TWO_ROOMS, "reward": np.zeros(2**20)})
    monkeypatch.setattr("gridworld.world.sources.arrays._MOST_BYTES", 2**20)
    for path, told in (
        (tmp_path / "none.npz", "env.path=.*none.npz: cannot be read .No such file"),
        (tmp_path, "env.path=.*: cannot be read .Is a directory.; give an .npz, .mat, .MDP or .POMDP file"),
        (3, "env.path=3: must be a path"),
        (tmp_path / "text.npz", "text.npz: not an .npz file of arrays that can be read"),
        (tmp_path / "one.npy", "not an .npz file of arrays"),
        (tmp_path / "pipe.npz", "is not an ordinary file"),
        (written(tmp_path, name=np.array([{}], dtype=object)), "cannot be loaded when allow_pickle=False"),
        (tmp_path / "bomb.npz", "its arrays have 8 MiB, more than 1|too many for a world"),
    ):
        with pytest.raises(InputError, match=told):
            load_world(path)


@st.composite
def worlds(draw):
    table = draw(outcomes())
    rng, size = np.random.default_rng(draw(st.integers(0, 2**32))), len(table.start)
    mdp = mdp_from_outcomes(
        draw(st.text("abc é-", min_size=1, max_size=9)),
        dataclasses.replace(table, reward=rng.normal(size=table.reward.shape)),
        places=rng.integers(-1, 4, (size, 3)) if draw(st.booleans()) else None,
        max_episode_steps=draw(st.none() | st.integers(1, 1000)),
        own_observation=rng.normal(size=(size, 2)) if draw(st.booleans()) else None,
    )
    return dataclasses.replace(mdp, truth=draw(st.sampled_from(["exact", "enumerated"])))


def assert_comes_back(mdp):
    content = world_bytes(mdp)
    again = world_from_bytes(content, "world.npz")
    for field in dataclasses.fields(Mdp):
        mine, theirs = getattr(mdp, field.name), getattr(again, field.name)
        if isinstance(mine, np.ndarray):
            assert (mine.dtype, mine.shape, mine.tobytes()) == (theirs.dtype, theirs.shape, theirs.tobytes())
            assert not theirs.flags.writeable
        else:
            assert (type(mine), mine) == (type(theirs), theirs)
    assert world_bytes(again) == content == world_bytes(mdp)
    assert again.digest() == mdp.digest()


@given(worlds())
def test_a_world_comes_back_bit_for_bit(mdp):
    assert_comes_back(mdp)
    assert_comes_back(compile_mdp(load("classic"), slip=0.3))


BASE = river_swim(3)


def changed_world(**changed):
    """A file in which fields of a world are others; a function gets a copy of the table to write to."""
    with np.load(io.BytesIO(world_bytes(BASE))) as file:
        arrays = dict(file)
    for name, value in changed.items():
        arrays[name] = value(arrays[name].copy()) if callable(value) else value
    return npz_bytes({name: value for name, value in arrays.items() if value is not None})


def at(where, value):
    def changed(table):
        table[where] = value
        return table

    return changed


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"format": np.array("another")}, "not a world of this version"),
        ({"start": None}, "not a world, must contain"),
        ({"next_state": at((0, 0, 0), 99)}, "next_state of state 0, action 0 is 99"),
        ({"next_state": np.zeros((3, 2), np.int32)}, "next_state is int32"),
        ({"next_state": np.zeros((3, 2, 3))}, "next_state is float64"),
        ({"probability": at((0, 0, 0), 0.5)}, "probability of state 0, action 0"),
        ({"reward": at((0, 0, 0), np.nan)}, "reward of state 0, action 0=nan"),
        ({"start": at(0, 0.5)}, "start is"),
        ({"number": at(0, 99)}, "state 0 has a number"),
        ({"places": at((0, 0), -5)}, "state 0 has a place below"),
        ({"places": at((0, 1), 10**8)}, "pictures have room"),
        ({"goal": at(0, True)}, "state 0 is a goal but not terminal"),
        ({"terminal": at(0, True)}, "state 0 is terminal, but has a successor"),
        ({"action_names": np.array(["a", "b", "c"])}, "next_state is"),
        ({"action_names": np.array(["a", "\x1b[1m"])}, "action_names is"),
        ({"name": np.array(3)}, "name is '3'"),
        ({"truth": np.array("x" * 1000)}, "truth is"),
        ({"max_episode_steps": np.array(-1)}, "max_episode_steps=-1"),
        ({"own_observation": np.zeros((7, 2))}, "own_observation must be"),
    ],
)
def test_a_damaged_world_is_one_sentence(changed, told):
    with pytest.raises(InputError, match=f"^world.npz: .*{told}"):
        world_from_bytes(changed_world(**changed), "world.npz")


@given(st.integers(0, 10**6), st.integers(0, 255))
def test_a_byte_that_changed_is_found_or_harmless(position, value):
    content = bytearray(world_bytes(BASE))
    content[position % len(content)] = value
    with contextlib.suppress(InputError):
        assert isinstance(world_from_bytes(bytes(content), "world.npz"), Mdp)


def test_a_world_that_would_grow_is_refused():
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("start.npy", b"0" * 10**6)
    with pytest.raises(InputError, match="its members are larger than the file"):
        world_from_bytes(content.getvalue(), "world.npz")


def test_numbers_of_less_precision_make_the_same_world(tmp_path):
    thirds = np.full((2, 2, 3), 1 / 3)
    nowhere = np.array([[[0, 1, 1], [1, 0, 0]]] * 2)
    tables = {"next_state": nowhere, "probability": thirds, "terminated": np.zeros((2, 2, 3), dtype=bool)}
    tables |= {"reward": nowhere, "start": np.array([1, 0])}
    exact = load_world(written(tmp_path, **tables))
    for kind in (np.float32, np.float16):
        found = load_world(written(tmp_path, **tables | {"probability": thirds.astype(kind)}))
        assert found.probability.sum(axis=2) == pytest.approx(1, abs=1e-15)
        assert np.array_equal(found.reward, exact.reward)
    assert exact.reward.dtype == np.float64


def test_what_is_impossible_may_lead_anywhere(tmp_path):
    tables = {
        "next_state": np.array([[[1, -1], [0, 99]]] * 2),
        "probability": np.array([[[1.0, 0.0], [1.0, 0.0]]] * 2),
        "reward": np.array([[[0.0, np.nan], [0.0, 0.0]]] * 2),
        "terminated": np.array([[[True, False], [False, False]]] * 2),
    }
    found = load_world(written(tmp_path, **tables))
    assert found.next_state.min() >= 0
    assert np.isfinite(found.reward).all()
    assert np.array_equal(world_from_bytes(world_bytes(found), "here").next_state, found.next_state)


# what a function returns

ARRAYS = {"next_state": [[0]], "reward": [[1.0]], "terminated": [[True]], "start": [1.0]}


def two_ends(**changed):
    tables = {key: np.array(value)[..., None] for key, value in ARRAYS.items()}
    return Outcomes(**{**tables, "probability": np.ones((1, 1, 1)), "start": np.ones(1), **changed})


def arrays(**more):
    return {**ARRAYS, **more}


def slippery_map(slip=0.2):
    return compile_mdp(load("classic"), slip=slip)


def broken():
    return dataclasses.replace(river_swim(), number=np.arange(6) + 1)


def raising(text="no power"):
    raise RuntimeError(text)


def drawn(length=4, seed=None):
    return arrays(reward=[[float(np.random.default_rng(seed).integers(1, 10**9)) / length]])


def test_a_function_that_draws_its_world_needs_a_seed():
    with pytest.raises(
        InputError, match=r"^env.builder=drawn: returns a different world each time.* env.kwargs"
    ):
        build(drawn)
    assert build(drawn, {"seed": 3}).text() == build(drawn, {"seed": 3}).text()


def test_the_three_things_that_a_function_may_return():
    assert build("gridworld.world.sources.classics.river_swim", {"length": 4}).num_states == 4
    assert (build(arrays).name, build(arrays, {"name": "mine"}).name) == ("arrays", "mine")
    assert build(two_ends).name == "two_ends"
    a_map = build(slippery_map, {"slip": 0.4})
    assert type(a_map) is Mdp
    assert a_map.probability[0, 0].tolist() == [0.6, 0.2, 0.2]


@pytest.mark.parametrize(
    ("builder", "kwargs", "told"),
    [
        ("make", None, "env.builder=make: must be the import path of a function"),
        ("no_such_module.make", None, "env.builder=no_such_module.make: no module no_such_module"),
        ("gridworld.world.nothing", None, "env.builder=gridworld.world.nothing: must be the import path"),
        ("gridworld.ENV_ID", None, "env.builder=gridworld.ENV_ID: must be the import path"),
        (3, None, "env.builder=3: must be"),
        ("os.getcwd", None, "env.builder=os.getcwd: returned str, must return an Mdp, Outcomes, a mapping"),
        (raising, None, "env.builder=raising: raised RuntimeError: no power"),
        (raising, {"txt": 1}, "env.builder=raising: raised TypeError: .*unexpected keyword argument 'txt'"),
        (raising, {"text": "one\ntwo"}, "env.builder=raising: raised RuntimeError: one$"),
        (river_swim, {"length": 1}, "env.builder=river_swim: length=1: must be a whole number from 2"),
        (broken, None, "env.builder=broken: state 5 has a number"),
        (arrays, {"start": [0.5]}, "env.builder=arrays: start is"),
        (two_ends, {"start": [1.0]}, "env.builder=two_ends: start is list"),
    ],
)
def test_what_makes_no_world_is_refused(builder, kwargs, told):
    with pytest.raises(InputError, match=f"^{told}"):
        build(builder, kwargs)
