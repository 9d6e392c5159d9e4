"""`examine`: planted faults and those of public threads are found, and none in sound environments."""

import random
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.faulty_envs import FAULTS, Cart, Lock, Raises

from gridworld.base.errors import InputError
from gridworld.commands import examine as command
from gridworld.examining.examine import examine

STEPS = 4_000
SOUND = list(dict.fromkeys(sound for sound, *_ in FAULTS))


@pytest.mark.parametrize(
    ("faulty", "topic", "words"), [each[1:] for each in FAULTS], ids=[each[1].__name__ for each in FAULTS]
)
def test_a_planted_fault_is_found(faulty: Any, topic: str, words: str) -> None:
    result = examine(faulty, steps=STEPS)
    found = {each.topic: each.evidence for each in result.findings}
    assert any(each.topic == topic and words in each.evidence for each in result.findings), found
    assert len(found) <= 2, found  # nothing far from it


@pytest.mark.parametrize("sound", SOUND, ids=[each.__name__ for each in SOUND])
def test_a_sound_environment_has_no_findings(sound: Any) -> None:
    result = examine(sound, steps=STEPS)
    assert result.passed, str(result)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["FrozenLake-v1", "Taxi-v4", "CartPole-v1", "cliff", "river_swim"])
def test_known_environments_have_no_findings(name: str) -> None:
    assert examine(name, steps=8_000).passed


def test_mountain_car_is_found_to_be_sparse() -> None:
    assert examine("MountainCar-v0", steps=STEPS).topics == ["reward"]


def test_what_a_random_policy_reaches_is_exact_where_the_states_are_known() -> None:
    """Of a lock with 15 wheels and 60 steps the probability, by a count of steps in a row, is another way."""
    row = np.zeros(Lock.size)
    row[0], reached = 1.0, 0.0
    for _ in range(Lock.limit):
        row = np.append(row[:-1].sum() / 2, row[:-1] / 2)
        reached, row[-1] = reached + row[-1], 0.0
    (found,) = examine(Lock, steps=1_000).findings
    assert f"probability {reached:.2g} (exact); it is 15 steps away" in found.evidence


def test_an_environment_and_the_shared_generators_are_left_as_they_are() -> None:
    env = gym.wrappers.TimeLimit(Cart(), 50)
    env.reset(seed=3)
    before = env.unwrapped.np_random.bit_generator.state, random.getstate(), np.random.get_state()[1].tolist()
    assert examine(env, steps=1_000).passed
    after = env.unwrapped.np_random.bit_generator.state, random.getstate(), np.random.get_state()[1].tolist()
    assert before == after


def test_the_command_ends_with_1_where_something_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        command.main(["helpers.faulty_envs:Raises", "--steps", "200"])
    assert end.value.code == 1
    assert "raises IndexError: cell 4" in capsys.readouterr().out
    command.main(["cliff", "--steps", "1000"])
    assert "cliff: no findings" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Raises.step, "cannot be made"),
        (3, "int is not a single environment"),
        ("helpers.faulty_envs:Nobody", "has no Nobody"),
    ],
)
def test_what_is_no_environment_is_refused(env: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        examine(env)
