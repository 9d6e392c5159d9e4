"""Every shipped layout under every observation, single or batched, keeps the contract."""

import dataclasses
import warnings
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers.vector import TransformObservation
from helpers.support import configure
from stable_baselines3.common.env_checker import check_env as check_for_sb3

import gridworld
from gridworld import GridWorldEnv, InputError
from gridworld.envs.inspection import observation_like
from gridworld.envs.observations import KINDS, TableObservation, make_observation
from gridworld.training.setup import make_context
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import classic, parse
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes

LAYOUTS = gridworld.shipped_layouts()
WRAPPERS = {  # kind: (wrapper of one environment, wrapper of a batch)
    "none": (lambda env: env, lambda envs: envs),
    "one_hot": (gridworld.OneHotObservation, gridworld.VectorOneHotObservation),
    "coordinates": (gridworld.CoordinateObservation, gridworld.VectorCoordinateObservation),
    "image": (gridworld.ImageObservation, gridworld.VectorImageObservation),
}


@pytest.mark.parametrize("kind", WRAPPERS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_observation_is_the_row_of_its_state(layout, kind):
    one, batch = WRAPPERS[kind]
    env = one(gym.make("GridWorld-v0", layout=layout, slip=0.2))
    envs = batch(gym.make_vec("GridWorld-v0", num_envs=3, layout=layout, slip=0.2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_for_sb3(env)
    table = make_observation(env.unwrapped.mdp, kind).table()
    assert len(table) == env.unwrapped.mdp.num_states
    assert envs.observation_space.shape == (3, *envs.single_observation_space.shape)
    observation, observations = env.reset(seed=1)[0], envs.reset(seed=1)[0]
    for actions in np.random.default_rng(1).integers(4, size=(60, 3)):
        assert observation in env.observation_space
        assert np.array_equal(observation, table[env.unwrapped.state])
        assert observations in envs.observation_space
        assert np.array_equal(observations, table[envs.unwrapped.states])
        assert all(row in envs.single_observation_space for row in observations)
        dtypes = {np.asarray(observation).dtype, observations.dtype, table.dtype}
        assert dtypes == {env.observation_space.dtype, envs.single_observation_space.dtype}
        observation, _, terminated, truncated, _ = env.step(actions[0])
        if terminated or truncated:
            observation, _ = env.reset()
        observations, *_ = envs.step(actions)


def test_what_the_observations_show():
    mdp = GridWorldEnv(4, 5).mdp
    rows, cols = np.divmod(np.arange(20), 5)
    assert np.array_equal(make_observation(mdp, "none").table(), np.arange(20))
    assert np.array_equal(make_observation(mdp, "one_hot").table(), np.eye(20))
    assert make_observation(mdp, "coordinates").table() == pytest.approx(
        np.stack([rows / 3, cols / 4], axis=1)
    )
    pictures = make_observation(mdp, "image", cell_size=8).table()
    env = GridWorldEnv(4, 5, render_mode="rgb_array", cell_size=8)
    for state in range(20):
        env.state = state
        assert np.array_equal(pictures[state].transpose(1, 2, 0), env.render())
    for text, scaled in (("S.G", [[0, 0], [0, 0.5], [0, 1]]), ("S.\n.G", [[0, 0], [0, 1], [1, 0], [1, 1]])):
        small = GridWorldEnv(layout=parse(text, "small")).mdp
        assert make_observation(small, "coordinates").table().tolist() == scaled


@pytest.mark.parametrize("kind", WRAPPERS)
def test_observations_are_fresh(kind):
    env = WRAPPERS[kind][0](GridWorldEnv())
    table = make_observation(env.unwrapped.mdp, kind)
    before, first = table.table(), env.reset()[0]
    if kind != "none":
        first[...] = 7
        table.rows(np.arange(3))[...] = 7
    assert np.array_equal(table.table(), before)
    assert np.array_equal(env.reset()[0], before[0])


def test_wrappers_refuse_what_they_cannot_show():
    with pytest.raises(InputError, match="GridWorld"):
        gridworld.OneHotObservation(gym.make("FrozenLake-v1"))
    with pytest.raises(InputError, match="GiB"):
        gridworld.ImageObservation(GridWorldEnv(30, 30), cell_size=50)
    with pytest.raises(InputError, match="cell_size"):
        gridworld.ImageObservation(GridWorldEnv(), cell_size=0)
    with pytest.raises(InputError, match="observation kind 'pixels'"):
        make_observation(GridWorldEnv().mdp, "pixels")


@pytest.mark.parametrize("kind", ["one_hot", "coordinates", "image"])
def test_a_batch_that_resets_in_the_same_step_is_wrapped_no_more_than_gymnasium_does(kind):
    """A vector wrapper would leave `final_obs` as it is; wrap the single environment instead."""
    envs = gridworld.GridWorldVectorEnv(2, autoreset_mode="SameStep")
    for wrap in (WRAPPERS[kind][1], lambda envs: TransformObservation(envs, lambda rows: rows)):
        with pytest.raises(ValueError, match="Expected autoreset_mode to be NEXT_STEP or DISABLED"):
            wrap(envs)


@pytest.mark.parametrize(
    "wrap",
    [
        partial(gridworld.ImageObservation, cell_size=10),
        gridworld.OneHotObservation,
        *(partial(TableObservation, kind=kind) for kind in sorted(set(KINDS) - {"own"})),  # a map has none
    ],
)
def test_a_wrapped_env_can_be_made_again_from_its_spec(wrap):
    env = wrap(gym.make("GridWorld-v0", layout="cliff", slip=0.1))
    again = gym.make(env.spec)
    assert again.observation_space == env.observation_space
    assert np.array_equal(again.reset(seed=0)[0], env.reset(seed=0)[0])


@pytest.mark.parametrize("kind", ["one_hot", "coordinates", "image"])
def test_a_batch_may_write_to_one_array_over_and_over(kind):
    wrap = WRAPPERS[kind][1]
    fresh, reused = (wrap(gridworld.GridWorldVectorEnv(8), copy=copy) for copy in (True, False))
    kept = [fresh.reset(seed=0)[0]]
    first, _ = reused.reset(seed=0)
    for actions in np.random.default_rng(0).integers(4, size=(5, 8)):
        kept.append(fresh.step(actions)[0])
        again = reused.step(actions)[0]
        assert again is first
        assert np.array_equal(again, kept[-1])
    assert not np.array_equal(kept[0], kept[-1])


def test_one_hot_rows_of_a_large_world_are_written_when_asked_for():
    table = make_observation(compile_mdp(classic(60, 60)), "one_hot")
    assert table.stored is None  # no matrix of S x S
    rows = table.rows(np.array([[0, 3599], [7, 8]]))
    assert rows.shape == (2, 2, 3600)
    assert rows.sum() == 4
    assert rows[0, 1, 3599] == rows[1, 0, 7] == 1
    assert np.array_equal(table.rows(np.array([5]), out=rows[0, :1]), np.eye(3600, dtype=np.float32)[5:6])


def world(**tables: Any) -> Mdp:
    """Four states in a row, as a source without a map gives them."""
    steps = np.array([[0, 1], [0, 2], [1, 3], [3, 3]])[:, :, None]
    ends = np.zeros(steps.shape, dtype=bool)
    ends[2, 1] = True
    outcomes = Outcomes(
        next_state=steps,
        probability=np.ones(steps.shape),
        reward=ends.astype(float),
        terminated=ends,
        start=np.eye(4)[0],
    )
    return mdp_from_outcomes("row", outcomes, **tables)


def test_coordinates_are_of_the_places_that_a_world_has():
    places = np.array([[0, 0, 0], [0, 2, 1], [0, 1, 4], [-1, -1, -1]])
    table = make_observation(world(places=places), "coordinates")
    assert table.table().tolist() == [[0, 0], [1, 0.25], [0.5, 1], [-1, -1]]
    assert table.space == gym.spaces.Box(-1, 1, (2,), np.float32)
    places = np.array([[0, 0, 0], [1, 2, 1], [2, 1, 4], [0, 0, 1]])
    table = make_observation(world(places=places), "coordinates")
    assert table.table().tolist() == [[0, 0, 0], [1, 0.25, 0.5], [0.5, 1, 1], [0, 0.25, 0]]
    assert table.space == gym.spaces.Box(0, 1, (3,), np.float32)


def test_the_environments_own_observation():
    images = np.random.default_rng(0).integers(3, 9, size=(4, 7, 7, 3)).astype(np.uint8)
    table = make_observation(world(own_observation=images), "own")
    assert np.array_equal(table.table(), images)
    assert table.space == gym.spaces.Box(3, 8, (7, 7, 3), np.uint8)
    assert observation_like(world(own_observation=images), table.space).kind == "own"
    pixels = np.linspace(0, 255, 4 * 12).astype(np.uint8).reshape(4, 2, 2, 3)
    table = make_observation(world(own_observation=pixels), "own")
    assert np.array_equal(table.table(), pixels.reshape(4, 12))  # SB3 would take others for CnnPolicy's
    table = make_observation(world(own_observation=np.array([5, 0, 2, 1])), "own")
    assert table.space == gym.spaces.Discrete(6)
    assert table.table().tolist() == [5, 0, 2, 1]


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("own", "no array observation of its own"),
        ("coordinates", "no coordinates"),
        ("image", "no coordinates"),
    ],
)
def test_a_world_without_what_an_observation_shows(kind, why):
    with pytest.raises(InputError, match=f"^observation {kind}: .*row ha(s|ve) {why}") as refused:
        make_observation(world(), kind)
    assert str(refused.value).count("\n") == 0
    assert observation_like(world(), gym.spaces.Discrete(4)).kind == "none"
    with pytest.raises(InputError, match="no observation of this world"):
        observation_like(world(), gym.spaces.Box(0, 1, (2,), np.float32))


@pytest.mark.parametrize(
    ("agent", "small"),
    [("ppo", {"n_steps": 16, "n_epochs": 1}), ("dqn", {"learning_starts": 20, "buffer_size": 100})],
)
@pytest.mark.parametrize("engine", ["stock", "tabulated"])
def test_agents_train_on_the_environments_own_observation(agent, small, engine):
    images = np.repeat(np.arange(4, dtype=np.uint8), 7 * 7 * 3).reshape(4, 7, 7, 3)
    for own in (np.arange(4), images):
        mdp = world(own_observation=own)
        config = configure(f"agent={agent}", "observation=own", f"agent.engine={engine}")
        settings = dataclasses.replace(config.agent, **small)
        trained = settings.build(make_context(config, mdp))
        trained.learn(128, lambda steps: steps + 1)
        assert trained.model.num_timesteps >= 128
        assert trained.snapshot().greedy.shape == (mdp.num_states,)
