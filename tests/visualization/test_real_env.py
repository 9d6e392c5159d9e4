"""Frames of an episode, rendered by the environment that a world was made from."""

import itertools
import os

import gymnasium as gym
import numpy as np
import pytest

from gridworld.base.errors import InputError
from gridworld.config.worlds import GymnasiumConfig
from gridworld.envs.rendering import board_of
from gridworld.visualization.episode import rendered_frames
from gridworld.world.mdp import Mdp
from gridworld.world.sources.enumerated import enumerate_env

FROZEN_LAKE = GymnasiumConfig(id="FrozenLake-v1").compile()
DRY_LAKE = GymnasiumConfig(id="FrozenLake-v1", kwargs={"is_slippery": False}).compile()


def frames_of(env_id: str, states: list[int], mdp: Mdp | None = None, most_pixels: int = 512 * 512, **kwargs):
    config = GymnasiumConfig(id=env_id, kwargs=kwargs)
    return rendered_frames(config, mdp or config.compile(), [states], most_pixels)


@pytest.mark.parametrize(
    ("env_id", "states", "size"),
    [
        ("FrozenLake-v1", [0, 4, 8, 4], (256, 256)),
        ("CliffWalking-v1", [36, 24, 25, 24], (256, 768)),
        ("Taxi-v4", [1, 101, 201, 101], (456, 536)),
    ],
)
def test_an_environment_with_a_table_is_put_into_each_state(env_id, states, size):
    before = dict(os.environ)
    frames = frames_of(env_id, states)
    assert [frame.shape for frame in frames] == [(*size, 3)] * 4
    assert frames[0].dtype == np.uint8
    assert np.array_equal(frames[1], frames[3])
    changed = [(one != other).any(axis=2) for one, other in itertools.pairwise(frames)]
    assert all(0 < each.mean() < 0.15 for each in changed)  # the agent, and no more
    assert {name: value for name, value in os.environ.items() if "SDL" in name} == {
        name: value for name, value in before.items() if "SDL" in name
    }


def test_an_enumerated_environment_takes_the_same_walk():
    name, short = "MiniGrid-Empty-5x5-v0", {"max_steps": 12}
    mdp = enumerate_env(name, short)
    env = gym.make(name, render_mode="rgb_array", **short)
    env.reset(seed=5)
    states, expected = [int(mdp.start_states[0])], [env.render()]
    for action in (2, 1, 5, 2, 0, 0, 1, 2, 2):
        env.step(action)
        states.append(int(mdp.next_state[states[-1], action, 0]))
        expected.append(env.render())
    env.close()
    assert np.array_equal(frames_of(name, states, mdp, **short), expected)
    assert {*mdp.panel_names} == {f"facing {way}" for way in ("right", "down", "left", "up")}
    assert mdp.places is not None
    assert mdp.places.max(axis=0).tolist() == [3, 2, 2]  # 3 x 3 cells, once for each direction
    facing_right = (mdp.places == 0).all(axis=1)  # at the start, at all steps from 0 to 12
    assert (board_of(mdp).summed(np.ones(mdp.num_states))[facing_right] == facing_right.sum()).all()
    assert facing_right.sum() > 2
    with pytest.raises(
        InputError, match="no action leads from row 2, column 2, facing right, step 0 to row 2, column 2"
    ):
        frames_of(name, [0, 0], mdp, **short)


def test_large_frames_are_made_smaller():
    frame, *_ = frames_of("CliffWalking-v1", [36], most_pixels=30_000)
    assert frame.shape == (100, 300, 3)


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("NoSuchWorld-v0", "is not registered with Gymnasium .*doesn't exist"),
        ("Pendulum-v1", r"cannot be rendered: [^\n]*$"),
        ("Blackjack-v1", "its steps are random, so it cannot be led"),
    ],
)
def test_what_cannot_be_rendered_is_one_sentence(env_id, words):
    is_random = env_id == "Blackjack-v1"
    with pytest.raises(InputError, match=f"^env.id={env_id}: {words}"):
        frames_of(env_id, [0, 1, 2], FROZEN_LAKE if is_random else DRY_LAKE)
