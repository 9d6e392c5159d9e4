"""Environments as people have them become exact worlds: wrappers, memory, Dicts, clocks, batches, classes."""

import enum
import itertools
import linecache
import math
import re
import threading
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium import spaces, wrappers
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv
from gymnasium.utils import seeding
from gymnasium.vector import SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import gridworld
from gridworld.base.errors import InputError
from gridworld.world.door import budget, known
from gridworld.world.door.world import enumerated
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp, backup

GAMMA = 0.99
Result = tuple[Any, float, bool, bool, dict[str, Any]]


def optimum(env: Any, gamma: float = GAMMA) -> float:
    mdp = gridworld.compile_env(env)
    return Evaluator(mdp, gamma, mdp.max_episode_steps or 100).optimal_value


class Line(gym.Env[Any, int]):
    """Four places; action 1 goes right, 0 left; the last one pays and ends."""

    observation_space: gym.Space[Any] = spaces.Discrete(4)
    action_space: gym.Space[Any] = spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = 0
        return self.shown(), {}

    def shown(self) -> Any:
        return self.at

    def step(self, action: int) -> Result:
        self.at = min(max(self.at + (1 if action else -1), 0), 3)
        return self.shown(), float(self.at == 3), self.at == 3, False, {}


class Middle(Line):
    """Starts in the middle of five places, both ends of which end it; the right one pays."""

    observation_space = spaces.Discrete(5)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at = 2
        return self.shown(), {}

    def step(self, action: int) -> Result:
        self.at += 1 if action else -1
        return self.shown(), float(self.at == 4), self.at in (0, 4), False, {}


class OneHot(Middle):
    observation_space = spaces.Box(0.0, 1.0, (5,), np.float32)

    def shown(self) -> Any:
        return np.eye(5, dtype=np.float32)[self.at]


class LastAction(Line):
    """Notes the last action, as for drawing; a reset may forget to clear it."""

    clears = True

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        if self.clears or not hasattr(self, "last"):
            self.last: int | None = None
        return super().reset(**given)

    def step(self, action: int) -> Result:
        self.last = int(action)
        return super().step(action)


class Forgetful(LastAction):
    clears = False


class Clocked(Line):
    def __init__(self) -> None:
        self.clock, self.surface = pygame.time.Clock(), pygame.Surface((2, 2))


class Moved(Line):
    """Its place is a pygame rectangle."""

    def __init__(self) -> None:
        self.rect = pygame.Rect(0, 0, 1, 1)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.rect.x = 0
        return super().reset(seed=seed)

    def step(self, action: int) -> Result:
        self.rect.x = min(max(self.rect.x + (1 if action else -1), 0), 3)
        return self.rect.x, float(self.rect.x == 3), self.rect.x == 3, False, {}


class Room:
    def __init__(self, number: int) -> None:
        self.number, self.next = number, self


class Rooms(Line):
    """The room is one of a list, told by identity; the list is large enough to be left in place."""

    def __init__(self, count: int = 4) -> None:
        self.rooms = [Room(number) for number in range(count)]
        for one, other in zip(self.rooms, self.rooms[1:], strict=False):
            one.next = other
        self.goal = self.rooms[-1]
        self.observation_space = spaces.Discrete(count)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        gym.Env.reset(self, seed=seed)
        self.room = self.rooms[0]
        return 0, {}

    def step(self, action: int) -> Result:
        self.room = self.room.next if action else self.room
        return self.room.number, float(self.room is self.goal), self.room is self.goal, False, {}


class SeededInInit(Line):
    """The old habit: a generator made in __init__."""

    def __init__(self) -> None:
        self.np_random, _ = seeding.np_random(None)

    def step(self, action: int) -> Result:
        return super().step(1 if self.np_random.random() < (0.75 if action else 0.5) else 0)


class SeededInReset(SeededInInit):
    """A new generator in each reset, with the seed if one is given."""

    def __init__(self) -> None:
        pass

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.np_random, _ = seeding.np_random(seed)
        return super().reset(seed=None)


class SeededByDefault(SeededInReset):
    """The same, but learners always give it `seed=None`."""

    def reset(self, seed: int | None = 42, options: Any = None) -> tuple[Any, dict[str, Any]]:  # type: ignore[override]
        return super().reset(seed=seed)


class OfNumpyInReset(SeededInReset):
    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.np_random = np.random.default_rng(seed)
        return Line.reset(self, seed=None)


class Proxy:
    """Stands for what it holds; while it is copied and holds nothing yet, it cannot be asked anything."""

    def __init__(self, held: Any) -> None:
        self.held = held

    def __getattr__(self, name: str) -> Any:
        return getattr(self.held, name)


class ByProxy(Line):
    """What it holds has its place."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.places = Proxy(np.zeros(4))
        return super().reset(seed=seed)

    def step(self, action: int) -> Result:
        shown, reward, *rest = super().step(action)
        self.places.held[self.at] = 1
        return shown, reward * self.places.sum(), *rest


class Views(Line):
    """What is written into one array is read from another that shows the same memory."""

    def __init__(self) -> None:
        self.memory = np.zeros((2, 3))
        self.writing, self.reading = self.memory[1], self.memory.T[2]

    def step(self, action: int) -> Result:
        self.writing[2], before = action, self.reading[1]
        shown, reward, over, cut, info = super().step(action)
        return shown, reward - 0.25 * float(before), over, cut, info

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.memory[:] = 0
        return super().reset(seed=seed)


class SampleOfSpace(Line):
    def step(self, action: int) -> Result:
        return super().step(self.action_space.sample() if self.np_random.integers(10) == 0 else action)


class Target(gym.Env[Any, int]):
    """Gymnasium's tutorial: a Dict, and a target that is drawn again until it is elsewhere."""

    def __init__(self, size: int = 5) -> None:
        self.size = size
        self._agent, self._target = np.array([-1, -1], np.int32), np.array([-1, -1], np.int32)
        place = spaces.Box(0, size - 1, (2,), dtype=int)
        self.observation_space = spaces.Dict(
            {"agent": place, "target": spaces.Box(0, size - 1, (2,), dtype=int)}
        )
        self.action_space = spaces.Discrete(4)

    def _shown(self) -> dict[str, Any]:
        return {"agent": self._agent, "target": self._target}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._agent = self.np_random.integers(0, self.size, size=2, dtype=int)
        self._target = self._agent
        while np.array_equal(self._target, self._agent):
            self._target = self.np_random.integers(0, self.size, size=2, dtype=int)
        return self._shown(), {}

    def step(self, action: Any) -> Result:
        move = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[action]
        self._agent = np.clip(self._agent + move, 0, self.size - 1)
        over = np.array_equal(self._agent, self._target)
        return self._shown(), 1 if over else 0, over, False, {}


def of_target(size: int) -> float:
    cells = [np.array(divmod(number, size)) for number in range(size * size)]
    ways = [np.abs(one - other).sum() for one in cells for other in cells if (one != other).any()]
    return float(np.mean([GAMMA ** (steps - 1) for steps in ways]))


def coin() -> float:
    """Of SeededInInit, by the equations of its three places."""
    matrix, right = np.eye(3), np.zeros(3)
    for at in range(3):
        for chance, to in ((0.75, at + 1), (0.25, max(at - 1, 0))):
            if to == 3:
                right[at] += chance
            else:
                matrix[at, to] -= GAMMA * chance
    return float(np.linalg.solve(matrix, right)[0])


def slipping(share: float) -> float:
    """Of a Line on which a step to the right goes left with this chance."""
    matrix, right = np.eye(3), np.zeros(3)
    for at in range(3):
        for chance, to in ((1 - share, at + 1), (share, max(at - 1, 0))):
            if to == 3:
                right[at] += chance
            else:
                matrix[at, to] -= GAMMA * chance
    return float(np.linalg.solve(matrix, right)[0])


TRUTH: dict[str, tuple[Callable[[], Any], float]] = {
    "plain": (Line, GAMMA**2),
    "a start in the middle": (Middle, GAMMA),
    "one-hot vectors of its own": (OneHot, GAMMA),
    "a last action": (LastAction, GAMMA**2),
    "a last action that no reset clears": (Forgetful, GAMMA**2),
    "a clock and a surface": (Clocked, GAMMA**2),
    "a rectangle": (Moved, GAMMA**2),
    "rooms by identity": (Rooms, GAMMA**2),
    "many rooms by identity": (lambda: Rooms(40), GAMMA**38),
    "so many rooms that they are left in place": (lambda: Rooms(80), GAMMA**78),
    "a generator made in __init__": (SeededInInit, coin()),
    "a generator made in reset": (SeededInReset, coin()),
    "a seed of its own": (SeededByDefault, coin()),
    "a wrapped seed of its own": (lambda: wrappers.OrderEnforcing(SeededByDefault()), coin()),
    "a generator of numpy's made in reset": (OfNumpyInReset, coin()),
    "a proxy": (ByProxy, 4 * GAMMA**3),  # it stays once, and then has been everywhere
    "views of one array": (Views, GAMMA**2 - 0.25 * (GAMMA + GAMMA**2)),
    "a sample of its actions": (SampleOfSpace, slipping(0.05)),
    "the tutorial": (lambda: Target(3), of_target(3)),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", TRUTH)
def test_environments_as_people_have_them(what: str) -> None:
    make, truth = TRUTH[what]
    assert optimum(make()) == pytest.approx(truth, abs=1e-12)
    assert optimum(make) == pytest.approx(truth, abs=1e-12)  # a class or a function
    assert optimum(wrappers.TimeLimit(make(), 200)) == pytest.approx(truth, abs=1e-12)


# ---- wrappers ----------------------------------------------------------------------------------------------


class Sticky(gym.Wrapper[Any, Any, Any, Any]):
    """Repeats the last action with a chance of 1/4."""

    last = 0

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        self.last = 0
        return self.env.reset(**given)

    def step(self, action: Any) -> Any:
        if self.unwrapped.np_random.random() < 0.25:
            action = self.last
        self.last = int(action)
        return self.env.step(action)


class Later(gym.RewardWrapper[Any, Any]):
    """Pays the opposite from the third step on, by a count in a slot."""

    __slots__ = ("count",)

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        self.count = 0
        return super().reset(**given)

    def reward(self, reward: Any) -> float:
        self.count += 1
        return float(reward) if self.count < 3 else -float(reward)


class Toll(gym.Wrapper[Any, Any, Any, Any]):
    """Pays for being cut: a wrapper that reads the time limit below it."""

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward + 0.5 * truncated, terminated, truncated, info


class OwnMonitor(gym.RewardWrapper[Any, Any]):
    """Not SB3's, whatever it is called."""

    def reward(self, reward: Any) -> float:
        return float(reward) / 2


OwnMonitor.__name__ = OwnMonitor.__qualname__ = "Monitor"


def grid(**given: Any) -> Any:
    return gym.make("gridworld:GridWorld-v0", **given)


WRAPPED: dict[str, tuple[Callable[[], Any], float]] = {
    "sticky actions": (lambda: Sticky(grid()), 0.9180564357388),
    "half the reward": (lambda: wrappers.TransformReward(grid(), lambda r: r / 2), GAMMA**7 / 2),
    "a stack of frames": (lambda: wrappers.FrameStackObservation(grid(), 2), GAMMA**7),
    "the time": (lambda: wrappers.TimeAwareObservation(grid(max_episode_steps=20)), GAMMA**7),
    "a count in a slot": (lambda: Later(wrappers.TimeLimit(Line(), 9)), 0.0),
    "a toll for being cut": (lambda: Toll(wrappers.TimeLimit(Line(), 5)), 1.5 * GAMMA**4),
    "a wrapper that is called Monitor": (lambda: OwnMonitor(grid()), GAMMA**7 / 2),
    "each action twice": (lambda: wrappers.MaxAndSkipObservation(Rooms(5), 2), GAMMA),
    "SB3's monitor": (lambda: Monitor(Line()), GAMMA**2),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", WRAPPED)
def test_wrappers_belong_to_the_world(what: str) -> None:
    make, truth = WRAPPED[what]
    assert optimum(make()) == pytest.approx(truth, abs=1e-10)


def test_a_toll_is_taken_at_the_limit_of_whoever_waits() -> None:
    """Without discount, waiting for the cut after five steps pays half."""
    mdp = gridworld.compile_env(Toll(wrappers.TimeLimit(Line(), 5)))
    left = np.zeros((mdp.num_states, 2))
    left[:, 0] = 1
    score = Evaluator(mdp, 1.0, mdp.max_episode_steps or 5).score(left)
    assert score.value == 0.5


def test_neutral_is_what_runs_a_neutral_step() -> None:
    assert known.is_neutral(Monitor(Line()))
    assert not known.is_neutral(OwnMonitor(Line()))
    assert not known.is_neutral(type("Monitor", (Monitor,), {"step": lambda self, action: None})(Line()))
    replaced = Monitor(Line())
    replaced.step = lambda action: None  # type: ignore[assignment, method-assign, return-value]
    assert not known.is_neutral(replaced)


@pytest.mark.parametrize(
    "make",
    [
        grid,
        lambda: grid(slip=0.2, step_reward=-0.1),
        lambda: grid(layout="four_rooms"),
        lambda: grid(layout="cliff"),
        lambda: gym.make("FrozenLake-v1"),
        lambda: gym.make("FrozenLake-v1", is_slippery=False),
        lambda: gym.make("CliffWalking-v1"),
    ],
)
def test_shortcuts_are_what_trying_every_action_finds(make: Callable[[], Any]) -> None:
    short, slow = gridworld.compile_env(make()), enumerated("env", make()).mdp
    assert short.max_episode_steps in (slow.max_episode_steps, None)
    reached = np.flatnonzero(short.reachable & ~short.terminal)
    outcomes = [
        [
            {
                key: sum(float(p) for p, *other in row if tuple(other) == key)
                for key in {tuple(other) for p, *other in row if p > 0}
            }
            for row in rows_of(mdp, reached)
        ]
        for mdp in (short, slow)
    ]
    for one, other in zip(*outcomes, strict=True):
        assert one == pytest.approx(other, abs=1e-15)


def rows_of(mdp: Mdp, numbers: Any) -> list[list[tuple[float, int, float, bool]]]:
    """(probability, number that follows, reward, end) of each of these numbers' states and each action."""
    states = [int(np.flatnonzero((mdp.number == number) & ~mdp.terminal)[0]) for number in numbers]
    return [
        [
            (float(p), int(mdp.number[t]), float(r), bool(mdp.terminal[t]))
            for p, t, r in zip(
                mdp.probability[state, action],
                mdp.next_state[state, action],
                mdp.reward[state, action],
                strict=True,
            )
        ]
        for state in states
        for action in range(mdp.num_actions)
    ]


# ---- what is asked of it -----------------------------------------------------------------------------------


def test_tables_are_by_the_environments_own_numbers() -> None:
    assert gridworld.evaluate([1] * 5, Middle()).certified
    assert gridworld.evaluate([0, 0, 1, 1, 1], Middle()).certified  # of other places it may hold anything
    assert not gridworld.evaluate([1, 1, 0, 1, 1], Middle()).certified
    with pytest.raises(InputError, match=r"shows Box.*by which no table has rows"):
        gridworld.evaluate([1] * 5, OneHot())
    fewer = wrappers.TransformObservation(grid(), lambda state: state // 6, spaces.Discrete(5))
    with pytest.raises(InputError, match=r"has 30 rows; .* Discrete\(5\)"):
        gridworld.evaluate([1] * 30, fewer)


@pytest.mark.slow
def test_the_environment_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "_SLOW", -1.0)  # what keeps growing is looked for at once
    monkeypatch.setattr(budget, "_FIRST", -1.0)
    env = Sticky(wrappers.TimeLimit(Target(3), 20))
    env.reset(seed=3)
    env.action_space.seed(5)
    env.step(1)
    layers = [env, env.env, env.unwrapped]
    before = [(dict(vars(layer)), repr(vars(layer))) for layer in layers]
    state = env.unwrapped.np_random.bit_generator.state
    gridworld.compile_env(env)
    for layer, (held, text) in zip(layers, before, strict=True):
        assert [name for name, value in held.items() if vars(layer).get(name) is not value] == []
        assert repr(vars(layer)) == text
    assert env.unwrapped.np_random.bit_generator.state == state


def test_batches_are_one_task_or_refused() -> None:
    batches = [DummyVecEnv([Middle, Middle]), SyncVectorEnv([Middle, Middle])]
    for batch in batches:
        assert optimum(batch) == pytest.approx(GAMMA)
    with pytest.raises(InputError, match="environment 1 of the DummyVecEnv is a different task"):
        gridworld.compile_env(DummyVecEnv([lambda: Rooms(4), lambda: Rooms(5)]))


class Tired(FrozenLakeEnv):
    """Has a table, and pays for the fifth time that it goes from 4 to 8 after 0 to 4."""

    def reset(self, **given: Any) -> Any:
        self.n = 0
        return super().reset(**given)

    def step(self, action: Any) -> Any:
        before = self.s
        observation, reward, *rest = super().step(action)
        self.n += before == 0 and observation == 4
        return observation, reward + 9.0 * (before == 4 and observation == 8 and self.n >= 5), *rest


class Fuel(FrozenLakeEnv):
    """Has a table, and ends when its fuel is used up."""

    def reset(self, **given: Any) -> Any:
        self.fuel = 8
        return super().reset(**given)

    def step(self, action: Any) -> Any:
        observation, reward, over, *rest = super().step(action)
        self.fuel -= 1
        return observation, reward, over or self.fuel == 0, *rest


@pytest.mark.slow
def test_a_table_is_a_shortcut_only_where_it_is_all_of_the_state() -> None:
    tired = gridworld.compile_env(wrappers.TimeLimit(Tired(is_slippery=False), 12))
    assert Evaluator(tired, 0.95, 12).optimal_value >= 9 * 0.95**9
    fuel = gridworld.compile_env(Fuel(is_slippery=False))
    assert Evaluator(fuel, 0.95, 100).optimal_value == pytest.approx(0.95**5)


class Twins(Line):
    """Shows two equal numbers, which are one object or two; what is paid depends on which."""

    observation_space: gym.Space[Any] = spaces.Sequence(spaces.Discrete(100_000))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        gym.Env.reset(self, seed=seed)
        self.coin, number = int(self.np_random.integers(2)), np.int64(70_000)
        return (number, number if self.coin else np.int64(70_000)), {}

    def step(self, action: int) -> Result:
        return (np.int64(1),), float(action == self.coin), True, False, {}


def test_equal_observations_are_one_whatever_they_are_made_of() -> None:
    assert optimum(Twins()) == 0.5


class Sparse(gym.Wrapper[Any, Any, Any, Any]):
    """Pays what a recording below it has summed up."""

    def step(self, action: Any) -> Any:
        observation, _, *over, info = self.env.step(action)
        return observation, float(info["episode"]["r"]) if "episode" in info else 0.0, *over, info


class Noticing(gym.Wrapper[Any, Any, Any, Any]):
    """Pays by what a recording below it says, as `reads` has it."""

    def __init__(self, env: Any, reads: Callable[[dict[str, Any]], Any]) -> None:
        super().__init__(env)
        self.reads = reads

    def step(self, action: Any) -> Any:
        observation, reward, *over, info = self.env.step(action)
        return observation, float(reward) + float(self.reads(info)), *over, info


def test_that_a_recording_ends_may_be_seen_and_no_more() -> None:
    seen = Noticing(Monitor(Line()), lambda info: "episode" in info)
    assert optimum(seen) == pytest.approx(2 * GAMMA**2, abs=1e-12)
    for reads in (
        lambda info: info.get("episode", {}).get("r", 0.0),
        lambda info: bool(info.get("episode")),
        lambda info: len(list(info.get("episode", []))),
    ):
        with pytest.raises(InputError, match=r"reads info\['episode'\] of a recording"):
            gridworld.compile_env(Noticing(Monitor(Line()), reads))


class IntOnly(Line):
    def step(self, action: int) -> Result:
        return super().step(1 if type(action) is int and action else 0)


class Shaped(Line):
    def step(self, action: int) -> Result:
        observation, reward, *rest = super().step(action)
        return observation, np.array([reward]), *rest  # type: ignore[return-value]


class OldReset(Line):
    def reset(self, **given: Any) -> Any:
        return super().reset(**given)[0]


class OldStep(Line):
    def step(self, action: int) -> Any:
        observation, reward, over, _, info = super().step(action)
        return observation, reward, over, info


class Painted(Line):
    """What it shows is drawn when it is made."""

    def __init__(self) -> None:
        self.paint = np.random.RandomState().permutation(4)

    def shown(self) -> Any:
        return int(self.paint[self.at])


class Endless(Line):
    def step(self, action: int) -> Result:
        self.count = getattr(self, "count", 0) + 1
        return super().step(action if self.count > 0 else 0)


REFUSED: dict[str, tuple[Any, str]] = {
    "an int that is not an int": (IntOnly, "an action that is an int in another way than np.int64"),
    "a reward with a shape": (Shaped, r"pays \[.*\]; must be a finite number, and no array"),
    "a reset of the old Gym": (
        OldReset,
        r"reset\(\) returns 0, as in the old Gym: .* must return \(observation",
    ),
    "a step of the old Gym": (
        OldStep,
        r"step\(\) returns .* as in the old Gym: .* \(observation, reward, termin",
    ),
    "a count without end": (Endless, "count"),
    "colours that are drawn when it is made": (Painted, "is another world each time it is made"),
    "a recording that is read": (lambda: Sparse(Monitor(Line())), r"reads info\['episode'\] of a recording"),
    "no environment": (lambda: 3, "int is not an environment; must be a gymnasium.Env"),
    "a failing constructor": (lambda: 1 / 0, r"cannot make an environment \(ZeroDivisionError"),
    "nothing at all": (3, "int is not an environment"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_world_is_refused_in_a_sentence(what: str) -> None:
    env, told = REFUSED[what]
    with pytest.raises(InputError, match=f"^env: .*{told}") as refused:
        gridworld.compile_env(env)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_plain_sb3_on_the_tutorials_world() -> None:
    """A Dict and a random target, given as an object, in a batch, and to the callback."""
    venv = DummyVecEnv([lambda: Monitor(wrappers.TimeLimit(Target(2), 20))])
    callback = gridworld.ExactEvalCallback(wrappers.TimeLimit(Target(2), 20), every=512)
    model = PPO("MultiInputPolicy", venv, n_steps=256, seed=0, device="cpu")
    model.learn(1024, callback=callback)
    score = gridworld.evaluate(model, wrappers.TimeLimit(Target(2), 20))
    assert score.regret == pytest.approx(float(callback.evaluations["regret"][-1]), abs=1e-12)
    assert callback.evaluator is not None
    assert callback.evaluator.optimal_value == pytest.approx(of_target(2), abs=1e-12)
    env, total = Target(2), 0.0
    for seed in range(300):
        observation, _ = env.reset(seed=seed)
        for step in range(20):
            action, _ = model.predict(observation, deterministic=True)
            observation, reward, over, *_ = env.step(action)
            total += GAMMA**step * float(reward)
            if over:
                break
    assert total / 300 == pytest.approx(score.value, abs=0.1)


class Counted(gym.RewardWrapper[Any, Any]):
    """Pays the opposite from the fifth step of its life on, which no reset ends."""

    count = 0

    def reward(self, reward: Any) -> float:
        self.count += 1
        return float(reward) if self.count < 5 else -float(reward)


def test_a_count_beyond_the_step_limit_that_no_reset_ends_is_named() -> None:
    with pytest.raises(InputError, match=r"a reset does not always lead to the same state \(in count\)"):
        gridworld.compile_env(Counted(wrappers.TimeLimit(Line(), 20)))


class Tiger(gym.Env[int, int]):
    """A tiger behind one of two doors; who listens hears it behind the right one in 17 of 20 cases."""

    observation_space, action_space = spaces.Discrete(3), spaces.Discrete(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.tiger = int(self.np_random.integers(2))
        return 2, {}

    def step(self, action: int) -> Any:
        if action < 2:
            return 2, (-100.0 if action == self.tiger else 10.0), True, False, {}
        is_right = self.np_random.random() < 0.85
        return self.tiger if is_right else 1 - self.tiger, -1.0, False, False, {}


@pytest.mark.parametrize("limit", [1, 2, 3, 7])
def test_beliefs_without_end_end_at_the_step_limit(limit: int) -> None:
    with pytest.raises(InputError, match="what histories say of it has no end"):
        gridworld.compile_env(Tiger())
    mdp = gridworld.compile_env(wrappers.TimeLimit(Tiger(), limit))

    def best(left: int, heard: int) -> float:  # by how much more often it was heard behind a door
        if not left:
            return 0.0
        sure = 0.85**heard / (0.85**heard + 0.15**heard)
        again = sure * 0.85 + (1 - sure) * 0.15
        closer = best(left - 1, abs(heard - 1)) if heard else best(left - 1, 1)
        return max(
            10 * sure - 100 * (1 - sure), -1 + again * best(left - 1, heard + 1) + (1 - again) * closer
        )

    value = np.zeros(mdp.num_states)
    for _ in range(limit):
        value = backup(mdp, value, 1.0).max(axis=1)
    assert value @ mdp.start == pytest.approx(best(limit, 0), abs=1e-9)


# ---- what is not copied ----------------------------------------------------------------------------------


class Tile:
    """A kind of cell, which is compared by identity."""

    def __init__(self, pays: float) -> None:
        self.pays = pays


EMPTY, COIN, NOTHING = Tile(0.0), Tile(1.0), object()
HELD: dict[str, Any] = {}


class Coins(gym.Env[int, int]):
    """Three cells in a row; who takes what is in a cell leaves it empty."""

    observation_space, action_space = spaces.Discrete(3), spaces.Discrete(2)
    taken: list[int] = []  # noqa: RUF012
    size = 3

    def __init__(self) -> None:
        self.cells: Any = [EMPTY, EMPTY, COIN]

    def pay(self) -> float:
        cell, self.cells[self.at] = self.cells[self.at], EMPTY
        return float(cell is COIN)

    def begin(self) -> None:
        self.cells = [EMPTY, EMPTY, COIN]

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.at = 0
        self.begin()
        return 0, {}

    def step(self, action: int) -> Any:
        self.at = min(self.at + int(action), self.size - 1)
        pays = self.pay() if action == 0 else 0.0
        return self.at, pays, pays > 0, False, {}


class Sentinel(Coins):
    """The coin is what is not the one object of its module."""

    def begin(self) -> None:
        self.cells = [NOTHING, NOTHING, "coin"]

    def pay(self) -> float:
        cell, self.cells[self.at] = self.cells[self.at], NOTHING
        return float(cell is not NOTHING)


class Grid(Coins):
    """A large array, changed in place, which a reset puts back in place; the coin is far away."""

    observation_space, size = spaces.Discrete(40), 40

    def __init__(self) -> None:
        self.template = np.zeros((40, 40))
        self.template[0, 25:27] = -1, 1  # where a fine is left over that is paid once
        self.grid = self.template.copy()

    def begin(self) -> None:
        self.grid[:] = self.template

    def pay(self) -> float:
        pays, self.grid[0, self.at] = self.grid[0, self.at], 0
        return float(pays)


class InClass(Coins):
    def begin(self) -> None:
        type(self).taken.clear()

    def pay(self) -> float:
        is_new = self.at == 2 and not self.taken
        type(self).taken.append(self.at)
        return float(is_new)


class InModule(Coins):
    def begin(self) -> None:
        HELD.clear()

    def pay(self) -> float:
        first = HELD.setdefault("at", self.at)
        return float(self.at == first == 2)


class InClosure(Coins):
    def __init__(self) -> None:
        taken = [0]
        self.taken, self.has_taken = taken, lambda: taken[0]

    def begin(self) -> None:
        self.taken[0] = 0

    def pay(self) -> float:
        before, self.taken[0] = self.has_taken(), 1
        return float(self.at == 2 and not before)


@pytest.mark.parametrize("make", [Coins, Sentinel, Grid])
def test_objects_of_its_module_and_large_arrays(make: Callable[[], Any]) -> None:
    env = make()
    steps = 26 if make is Grid else 2
    assert optimum(env) == pytest.approx(0.99**steps, abs=1e-12)
    before = EMPTY.pays, COIN.pays
    assert gridworld.compile_env(make).num_states >= 3
    assert (EMPTY.pays, COIN.pays) == before


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (InClass, "none of the outcomes that it has from a copy of its state, so it depends on more"),
        (InModule, "none of the outcomes that it has from a copy of its state, so it depends on more"),
        (InClosure, "its attribute has_taken is a function that holds an object of another attribute"),
    ],
)
def test_what_it_keeps_elsewhere_is_met_in_episodes(make: Callable[[], Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        gridworld.compile_env(make())


class Skipping(gym.Wrapper[int, int, int, int]):
    def step(self, action: int) -> Any:
        self.env.step(action)
        return self.env.step(action)


class Passing(gym.Wrapper[int, int, int, int]):
    def step(self, action: int) -> Any:
        return self.env.step(action)


class Raising(Coins):
    def __getattr__(self, name: str) -> Any:
        return HELD[name]


class Locking(Coins):
    def begin(self) -> None:
        self.lock = threading.Lock()


class Spaceless(Raising):
    """It does not say what it shows."""

    @property
    def observation_space(self) -> Any:  # type: ignore[override]
        return self.shown_space


def test_two_limits_around_a_wrapper_that_skips() -> None:
    env = Passing(wrappers.TimeLimit(Skipping(wrappers.TimeLimit(Coins(), 4)), 4))
    assert gridworld.compile_env(env).max_episode_steps == 2


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (Raising, "__getattr__ raises KeyError"),
        (Locking, "its attribute lock cannot be copied"),
        (Spaceless, "its observation_space is not a gymnasium space"),
    ],
)
def test_what_cannot_be_asked_or_copied_is_refused(make: Callable[[], Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        gridworld.compile_env(make())


class Way(enum.Enum):
    LEFT = -1
    RIGHT = 1


class Ways(enum.IntFlag):
    NONE = 0
    TURNED = 1


class Turning(Coins):
    """It holds members of enumerations: which way it faces, and whether it has turned."""

    def __init__(self) -> None:
        super().__init__()
        self.way, self.turned = Way.RIGHT, Ways.NONE

    def begin(self) -> None:
        self.way, self.turned = Way.LEFT, Ways.NONE

    def step(self, action: int) -> Any:
        if action == 0:
            self.way, self.turned = Way(-self.way.value), Ways.TURNED
        else:
            self.at = max(0, min(self.at + self.way.value, 2))
        is_there = self.at == 2 and self.way is Way.RIGHT and bool(self.turned & Ways.TURNED)
        return self.at, float(is_there), is_there, False, {}


def test_members_of_enumerations_are_state() -> None:
    assert optimum(Turning()) == pytest.approx(0.99**2, abs=1e-12)


DRAWING = np.random.default_rng(0)


class Counting(Line):
    """Counts and sums up, for `info` alone; `uses` may do more with a number than that."""

    def __init__(self, uses: Callable[["Counting"], float] = lambda env: 0.0) -> None:
        self.resets, self.steps, self.paid, self.uses = 0, 0, 0.0, uses

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        self.resets, self.paid, self.lately = self.resets + 1, 0.0, np.float32(0)
        return super().reset(**given)

    def step(self, action: int) -> Result:
        shown, reward, over, cut, _ = super().step(action)
        self.steps += 1
        self.paid = self.paid + reward
        self.lately = np.float64(0.9) * self.lately + np.float32(reward)
        reward += self.uses(self)
        return shown, reward, over, cut, {"steps": self.steps, "sums": [self.paid, self.lately]}


def test_what_is_only_counted_is_no_state() -> None:
    env = Counting()
    mdp = gridworld.compile_env(env)
    assert mdp.digest() == gridworld.compile_env(Line()).digest()
    assert (env.resets, env.steps) == (0, 0)
    assert gridworld.compile_env(wrappers.TimeLimit(Counting(), 9)).max_episode_steps == 9


# fmt: off
USES: dict[str, Callable[[Counting], float]] = {
    "compared": lambda env: float(env.steps > 12),
    "compared seldom": lambda env: float(env.at == 2 and env.paid > 3),  # it is never more than 1
    "as a truth": lambda env: 0.0 if env.steps else 1.0,
    "as an index": lambda env: [0.0, 1.0][env.steps % 2],
    "by numpy": lambda env: float(np.sqrt(env.steps)),
    "in an array": lambda env: float(np.array([env.steps, 1.0]).sum()),
    "by math": lambda env: math.sqrt(env.steps),
    "as a float": lambda env: 0.1 * env.lately,
    "as text": lambda env: float(len(f"{env.steps}")),
    "by its type": lambda env: float(isinstance(env.steps, int)) * env.resets,
    "in a set": lambda env: float(env.steps in {1, 2}),
    "where it fails": lambda env: float("9"[env.steps - 1 if env.steps > 0 else 0 :] == "9"),
}
# fmt: on


@pytest.mark.parametrize("use", USES)
def test_a_count_that_is_read_is_state(use: str) -> None:
    class Ending(wrappers.TimeLimit):  # of this class, so that its count is state
        pass

    def make() -> Any:
        env = Counting(USES[use])
        reset = env.reset

        def anew(**given: Any) -> Any:
            env.resets = env.steps = 0
            return reset(**given)

        env.reset = anew  # type: ignore[method-assign]
        return Ending(env, 5)

    mdp = gridworld.compile_env(make())
    played, numbers = make(), np.random.default_rng(0)
    for _ in range(30):
        played.reset()
        state, over = int(mdp.start_states[0]), False
        while not over:
            action = int(numbers.integers(2))
            _, reward, terminated, truncated, _ = played.step(action)
            assert mdp.reward[state, action, 0] == pytest.approx(float(reward), abs=1e-12)
            state, over = int(mdp.next_state[state, action, 0]), terminated or truncated


class Global(Coins):
    """It draws from its module's generator, in the last cell only."""

    def pay(self) -> float:
        return float(self.at == 2 and DRAWING.random() < 0.5)


class FarKey(Coins):
    """Its class knows whether it has the key, which is at the far end."""

    observation_space, size, key = spaces.Discrete(12), 12, False

    def begin(self) -> None:
        type(self).key = False

    def step(self, action: int) -> Any:
        self.at = max(0, min(self.at + (1 if action else -1), 11))
        if self.at == 10:
            type(self).key = True
        opens = self.at == 0 and type(self).key
        return self.at, float(opens), opens, False, {}


@pytest.mark.parametrize("make", [Global, FarKey])
def test_what_is_far_away_is_met_too(make: Callable[[], Any]) -> None:
    with pytest.raises(InputError, match=r"another generator|depends on more"):
        gridworld.compile_env(make())


class Retries(gym.Env):
    """A goal is drawn again until it fits, at most fifty times."""

    observation_space, action_space = gym.spaces.MultiDiscrete([6, 6]), gym.spaces.Discrete(2)

    def _cell(self):
        return tuple(self.np_random.integers(0, 6, size=2).tolist())

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        tries, self.goal = 0, self._cell()
        while sum(self.goal) < 3 and tries < 50:
            self.goal, tries = self._cell(), tries + 1
        return self.goal, {}

    def step(self, action):
        return self.goal, 0.0, True, False, {}


class Scattered(Retries):
    """Seven different cells, each drawn until it is new."""

    def reset(self, *, seed=None, options=None):
        super(Retries, self).reset(seed=seed)
        self.taken = set()
        for _ in range(7):
            self.goal = self._cell()
            while self.goal in self.taken:
                self.goal = self._cell()
            self.taken.add(self.goal)
        return self.goal, {}


@pytest.mark.parametrize("env", [Retries, Scattered])
def test_a_reset_with_too_many_outcomes_is_refused_within_its_time(env):
    with pytest.raises(InputError, match="more random outcomes than can be tried in the time allowed: after"):
        gridworld.compile_env(env, most_seconds=0.5)


class Wanders(gym.Env):
    """Every step goes on by one or two, at one of fifty places: few outcomes, and no end of states."""

    observation_space, action_space = gym.spaces.Box(0, 2**40, (2,), np.int64), gym.spaces.Discrete(30)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = [int(self.np_random.integers(50)), 0]
        return np.array(self.place), {}

    def step(self, action):
        self.place[1] = self.place[1] * 30 + int(action) + int(self.np_random.integers(2))
        return np.array(self.place), 0.0, False, False, {}


def test_a_search_whose_time_is_over_says_how_to_give_it_more(monkeypatch):
    looks = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: next(looks) / 1000)  # however busy the machine is
    with pytest.raises(InputError, match=r"after 1 s it .* new states .*; most_seconds=2 allows more\)"):
        gridworld.compile_env(Wanders, most_seconds=1)


class Hurries(gym.Env):
    """Two places on a ring of ten are drawn; to bring one to the other pays less, the later it is."""

    observation_space, action_space = gym.spaces.MultiDiscrete([10, 10]), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.goal = self.np_random.choice(10, 2, replace=False).tolist()
        self.count = 0
        return (self.place, self.goal), {}

    def step(self, action):
        self.place, self.count = (self.place + 2 * int(action) - 1) % 10, self.count + 1
        is_over = self.place == self.goal
        return (self.place, self.goal), 10 - 0.1 * self.count if is_over else 0.0, is_over, False, {}


def test_a_search_with_too_many_states_names_what_has_ever_more_values():
    with pytest.raises(InputError, match=r"more than 800 states .* since its count keeps changing"):
        gridworld.compile_env(Hurries, most_states=800)


class Fined(Hurries):
    """A thousand goals, and a fine where time is over: each state is met at each of a hundred times."""

    observation_space = gym.spaces.MultiDiscrete([10, 1000])

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        self.place, self.goal, self.count = 0, int(self.np_random.integers(1000)), 0
        return (self.place, self.goal), {}

    def step(self, action):
        self.place, self.count = (self.place + 2 * int(action) - 1) % 10, self.count + 1
        is_late = self.count == 100
        return (self.place, self.goal), -1.0 if is_late else 0.0, self.place == self.goal, is_late, {}


def test_a_search_with_too_many_states_names_the_count_that_multiplies_them():
    with pytest.raises(InputError, match=r"more than 25,000 states .* since its count keeps changing"):
        gridworld.compile_env(Fined, most_states=25_000)


class Sampled(Wanders):
    """A draw that cannot be enumerated, made by a space."""

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}  # the line that is to be found


def test_a_draw_that_a_space_makes_is_found_where_the_environment_asks_for_it():
    with pytest.raises(InputError) as error:
        gridworld.compile_env(Sampled)
    path, line = re.search(r"\((\S+):(\d+)\)", str(error.value)).groups()
    assert "the line that is to be found" in linecache.getline(path, int(line))


class Optional(gym.Env):
    """Its own default for `options` is not the one that Gymnasium's wrappers hand down."""

    observation_space, action_space = gym.spaces.Discrete(4), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options={}):  # noqa: B006
        super().reset(seed=seed)
        self.place = 0 if options is None else options["start"]
        return self.place, {}

    def step(self, action):
        self.place = min(max(self.place + (1 if action else -1), 0), 3)
        return self.place, float(self.place == 3), self.place == 3, False, {}


def test_a_reset_is_called_as_the_wrapper_around_it_does():
    assert gridworld.compile_env(lambda: wrappers.TimeLimit(Optional(), 20)).num_states == 4
    with pytest.raises(InputError, match="a reset fails: KeyError: 'start'"):
        gridworld.compile_env(Optional)
