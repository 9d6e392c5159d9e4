"""Frames of an episode, rendered by the environment that a world was made from."""

import itertools
import os

import gymnasium as gym
import numpy as np
import pytest

from gridworld.config.worlds import GymnasiumConfig
from gridworld.errors import InputError
from gridworld.visualization.episode import rendered_frames
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes, mdp_from_outcomes
from gridworld.world.sources.enumerated import enumerate_env


def frames_of(env_id: str, mdp: Mdp, states: list[int], **options: int):
    return rendered_frames(GymnasiumConfig(id=env_id), mdp, [states], **options)


def tables(env_id: str):
    """The world of a `P`, as far as frames need it: one outcome of each action."""
    env = gym.make(env_id).unwrapped
    size, actions = len(env.P), len(env.P[0])
    first = np.array([[env.P[state][action][0] for action in range(actions)] for state in range(size)])
    return mdp_from_outcomes(
        env_id,
        Outcomes(
            next_state=first[:, :, 1:2].astype(int),
            probability=np.ones((size, actions, 1)),
            reward=first[:, :, 2:3],
            terminated=first[:, :, 3:4] > 0,
            start=np.asarray(env.initial_state_distrib),
        ),
    )


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
    frames = frames_of(env_id, tables(env_id), states)
    assert [frame.shape for frame in frames] == [(*size, 3)] * 4
    assert frames[0].dtype == np.uint8
    assert np.array_equal(frames[1], frames[3])
    changed = [(one != other).any(axis=2) for one, other in itertools.pairwise(frames)]
    assert all(0 < each.mean() < 0.15 for each in changed)  # the agent, and no more
    assert {name: value for name, value in os.environ.items() if "SDL" in name} == {
        name: value for name, value in before.items() if "SDL" in name
    }


def test_an_enumerated_environment_takes_the_same_walk():
    mdp = enumerate_env("MiniGrid-Empty-5x5-v0")
    env = gym.make("MiniGrid-Empty-5x5-v0", render_mode="rgb_array")
    env.reset(seed=5)
    states, expected = [int(mdp.start_states[0])], [env.render()]
    for action in (2, 1, 5, 2, 0, 0, 1, 2, 2):
        env.step(action)
        states.append(int(mdp.next_state[states[-1], action, 0]))
        expected.append(env.render())
    env.close()
    frames = frames_of("MiniGrid-Empty-5x5-v0", mdp, states)
    assert np.array_equal(frames, expected)
    with pytest.raises(
        InputError, match="no action leads from row 2, column 2, facing right, step 0 to row 2, column 2"
    ):
        frames_of("MiniGrid-Empty-5x5-v0", mdp, [0, 0])


def test_large_frames_are_made_smaller():
    frame, *_ = frames_of("CliffWalking-v1", tables("CliffWalking-v1"), [36], most_pixels=30_000)
    assert frame.shape == (100, 300, 3)


def test_what_cannot_be_rendered_is_one_sentence():
    with pytest.raises(InputError, match=r"^env.id=NoSuchWorld-v0: is no environment .*doesn't exist"):
        frames_of("NoSuchWorld-v0", tables("FrozenLake-v1"), [0])


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1", "Blackjack-v1"])
def test_an_environment_of_another_kind_is_one_sentence(env_id):
    with pytest.raises(InputError, match=rf"^env.id={env_id}: cannot be rendered: [^\n]*$"):
        frames_of(env_id, tables("FrozenLake-v1"), [0, 4, 8])
