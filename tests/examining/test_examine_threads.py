"""`examine` names the cause in environments of public threads in which an agent did not learn, rebuilt small.

A class has the number of its issue in DLR-RM/stable-baselines3. Where a thread does not tell its cause, the
cause is what its environment shows. Issue 324 could not be read; 389 and 1874, of the same kind, are here.
"""

import random
from math import exp
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from helpers.faulty_envs import Result, Start

from gridworld.examining.examine import examine


class Shower1826(gym.Env[Any, Any]):
    """Told by its maintainers and its code: a raw temperature, an end by time, draws of the module random."""

    action_space = Discrete(3)
    observation_space = Box(0.0, 100.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.state, self.left = 38 + random.randint(-1, 1), 60
        return np.array([float(self.state)]), {}

    def step(self, action: Any) -> Result:
        self.state = min(max(self.state + int(action) - 1 + random.randint(-1, 1), 0), 100)
        self.left -= 1
        reward = 1.0 if 37 <= self.state <= 39 else -1.0
        return np.array([float(self.state)]), reward, self.left <= 0, False, {}


class Matching902(gym.Env[Any, Any]):
    """Not told; its code makes `best_found` once, and a reward for more than that falls in time by itself."""

    action_space = Discrete(8)
    observation_space = Box(0, 1, (8,), np.uint8)
    best_found = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.bits, self.time = np.zeros(8, np.uint8), 0
        return self.bits.copy(), {}

    def step(self, action: Any) -> Result:
        self.time += 1
        self.bits[action] ^= 1
        size = int(np.sum(self.bits[1:] & ~self.bits[:-1] & 1))
        reward, self.best_found = float(max(size - self.best_found, 0)), max(size, self.best_found)
        return self.bits.copy(), reward, False, self.time >= 30, {}


class Bikes672(gym.Env[Any, Any]):
    """Not told; it is done after `step_limit` steps, which it does not show, and shows raw numbers."""

    action_space = Discrete(6)
    observation_space = Box(0.0, 20.0, (4,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.bikes, self.on_board, self.time = np.array([20.0, 2.0, 11.0]), 0.0, 0
        return self.show(), {}

    def show(self) -> Any:
        return np.array([*self.bikes, self.on_board])

    def step(self, action: Any) -> Result:
        station, is_loading = divmod(int(action), 2)
        moved = min(2.0, self.bikes[station]) if is_loading else min(2.0, self.on_board)
        moved = moved if is_loading else -min(moved, 20 - self.bikes[station])
        if self.on_board + moved <= 4:
            self.bikes[station] -= moved
            self.on_board += moved
        self.time += 1
        return self.show(), -float(np.sum(self.bikes < 3)), self.time >= 20, False, {}


class JobShop1375(gym.Env[Any, Any]):
    """Not told; the reward is the utilization since the start, and so of a past that it does not show."""

    action_space = Discrete(3)
    observation_space = Box(0.0, 1.0, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.left, self.busy, self.time = [0, 0], 0, 0
        return np.zeros(2), {}

    def step(self, action: Any) -> Result:
        if action < 2 and not self.left[action]:
            self.left[action] = 2 + int(action)
        self.busy += sum(each > 0 for each in self.left)
        self.left = [max(each - 1, 0) for each in self.left]
        self.time += 1
        utilization = self.busy / (2 * self.time)
        return np.array(self.left) / 3, exp(utilization / 1.5) - 1, False, self.time >= 40, {}


class SameAction1801(gym.Env[Any, Any]):
    """Not told; it says that it fines an action like the one before, which its Dict does not show."""

    action_space = Box(-1.0, 1.0, (1,), np.float32)
    observation_space = Dict({"level": Box(0.0, 1.0, (1,), np.float64)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.level, self.before, self.time = 2, 0.0, 0
        return self.show(), {}

    def show(self) -> Any:
        return {"level": np.array([self.level / 4])}

    def step(self, action: Any) -> Result:
        is_same, self.before = abs(action[0] - self.before) < 0.1, float(action[0])
        self.level = min(max(self.level + (1 if action[0] > 0 else -1), 0), 4)
        self.time += 1
        return self.show(), float(self.level == 2) - 100.0 * is_same, False, self.time >= 50, {}


class LowerBound389(gym.Env[Any, Any]):
    """Told by its code: actions from 5 to 35, of which a Gaussian around 0 gives the lower bound."""

    action_space = Box(5.0, 35.0, (2,), np.float32)
    observation_space = Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.wanted, self.time = self.np_random.uniform(-1, 1), 0
        return np.array([self.wanted]), {}

    def step(self, action: Any) -> Result:
        reward, self.time = -abs(float(np.mean(action)) / 35 - abs(self.wanted)), self.time + 1
        self.wanted = self.np_random.uniform(-1, 1)
        return np.array([self.wanted]), reward, False, self.time >= 20, {}


class OneStep1874(gym.Env[Any, Any]):
    """Told by its code: raw numbers to 100, drawn from numpy.random."""

    action_space = Discrete(3)
    observation_space = Box(0.0, 100.0, (2,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        self.x, self.y = float(np.random.randint(0, 5)), float(np.random.randint(0, 100))
        return np.array([self.x, self.y]), {}

    def step(self, action: Any) -> Result:
        side = (0, -1, 1)[action]
        reward = side * (20 * (self.x + (1 if side < 0 else -1)) - 5 - self.y)
        return np.array([self.x, self.y]), reward, True, False, {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "causes"),
    [
        (Shower1826, {"seed": "the module random", "observation": "mean 3", "termination": "at step 60"}),
        (Matching902, {"reset": "best_found is not restored"}),
        (Bikes672, {"termination": "at step 20", "observation": "its number 0"}),
        (JobShop1375, {"markov": "more of the past"}),
        (SameAction1801, {"markov": "the step before"}),
        (LowerBound389, {"actions": "from 5 to 35"}),
        (OneStep1874, {"seed": "numpy.random", "observation": "its number 1"}),
    ],
    ids=lambda each: getattr(each, "__name__", ""),
)
def test_the_cause_is_named(env: Any, causes: dict[str, str]) -> None:
    result = examine(env, steps=4_000)
    for topic, words in causes.items():
        found = [each.evidence for each in result.findings if each.topic == topic]
        assert any(words in evidence for evidence in found), str(result)
