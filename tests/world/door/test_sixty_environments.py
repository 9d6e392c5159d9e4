"""Sixty environments: six rules, each packed in ten ways that people use, against a solver of the bare rules.

The ways differ in where the state is held, how an outcome is drawn and what is shown; the optimum must not.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium import spaces, wrappers
from gymnasium.utils import seeding
from gymnasium.vector import SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv

import gridworld
from gridworld.world.door import rejection
from gridworld.world.evaluation import Evaluator

GAMMA = 0.95
PARTS = 16  # every probability is a number of sixteenths, so that all ways of drawing it are exact
Outcome = tuple[int, int, float, bool]  # sixteenths, the next state, the reward, whether the episode ends
Result = tuple[Any, float, bool, bool, dict[str, Any]]


class Rules(NamedTuple):
    """What there is to pack: `size` states, the sixteenths of each start, and the outcomes of an action."""

    size: int
    actions: int
    starts: list[tuple[int, int]]
    outcomes: Callable[[int, int], list[Outcome]]


def chain(state: int, action: int) -> list[Outcome]:
    ahead, back = min(state + 1, 5), max(state - 1, 0)
    right, left = (12, 4) if action else (4, 12)
    return [(right, ahead, float(ahead == 5), ahead == 5), (left, back, 0.0, False)]


def windy(state: int, action: int) -> list[Outcome]:
    """Four columns and three rows; wind pushes up, and the bottom right corner pays."""
    row, column = divmod(state, 4)

    def cell(down: int, right: int) -> int:
        return 4 * min(max(row + down, 0), 2) + min(max(column + right, 0), 3)

    down, right = ((0, 1), (1, 0), (0, -1), (-1, 0))[action]
    moved, blown = cell(down, right), cell(down - 1, right)
    return [(11, moved, 5.0 * (moved == 11) - 0.1, moved == 11), (5, blown, -0.1, False)]


def gambler(state: int, action: int) -> list[Outcome]:
    stake = min(action + 1, state, 8 - state)
    won, lost = state + stake, state - stake
    return [(7, won, float(won == 8), won == 8), (9, lost, 0.0, lost == 0)]


def key(state: int, action: int) -> list[Outcome]:
    """Four cells, and whether the key of the first is held: the last opens with it only."""
    at, held = state % 4, state // 4
    at = min(max(at + (1, -1)[action], 0), 3) if action < 2 else at
    held = held or int(action == 2 and at == 0)
    opened = at == 3 and held == 1
    return [(16, at + 4 * held, 2.0 * opened - 0.05, opened)]


def ring(state: int, action: int) -> list[Outcome]:
    """It never ends; the third place pays, and staying slips."""
    if action == 2:
        return [(15, state, float(state == 3), False), (1, (state + 1) % 7, 0.0, False)]
    return [(16, (state + (1, -1)[action]) % 7, -0.2, False)]


def trap(state: int, action: int) -> list[Outcome]:
    """A sure little, or a sixteenth of much and a quarter of a fall."""
    if action == 0:
        return [(16, (state + 1) % 4, 0.1, state == 3)]
    return [(1, state, 10.0, True), (4, 0, -1.0, True), (11, (state + 1) % 4, 0.0, False)]


RULES = {
    "chain": Rules(6, 2, [(16, 0)], chain),
    "windy": Rules(12, 4, [(16, 8)], windy),
    "gambler": Rules(9, 3, [(4, 2), (4, 3), (8, 5)], gambler),
    "key": Rules(8, 3, [(8, 1), (8, 2)], key),
    "ring": Rules(7, 3, [(16, 0)], ring),
    "trap": Rules(4, 2, [(10, 0), (6, 2)], trap),
}


def solved(rules: Rules) -> float:
    """The optimum of the bare rules, by sweeps over a dictionary."""
    value = dict.fromkeys(range(rules.size), 0.0)
    for _ in range(2_000):
        for state in value:
            value[state] = max(
                sum(n / PARTS * (paid + GAMMA * value[s] * (not over)) for n, s, paid, over in row)
                for row in (rules.outcomes(state, action) for action in range(rules.actions))
            )
    return sum(n / PARTS * value[state] for n, state in rules.starts)


# ---- ways to draw the number of an outcome, given sixteenths that sum to 16 ----


def by_threshold(numbers: np.random.Generator, parts: list[int]) -> int:
    drawn, total = numbers.random(), 0.0
    for number, each in enumerate(parts):
        total += each / PARTS
        if drawn < total:
            return number
    raise AssertionError


def by_choice(numbers: np.random.Generator, parts: list[int]) -> int:
    return int(numbers.choice(len(parts), p=[each / PARTS for each in parts]))


def by_ticket(numbers: np.random.Generator, parts: list[int]) -> int:
    tickets = [number for number, each in enumerate(parts) for _ in range(each)]
    return tickets[numbers.integers(len(tickets))]


def by_rejection(numbers: np.random.Generator, parts: list[int]) -> int:
    ticket = numbers.integers(20)
    while ticket >= PARTS:
        ticket = numbers.integers(20)
    return [number for number, each in enumerate(parts) for _ in range(each)][ticket]


def by_counts(numbers: np.random.Generator, parts: list[int]) -> int:
    return int(numbers.multinomial(1, [each / PARTS for each in parts]).argmax())


# ---- ways to hold and show the state ----


class Plain(gym.Env[Any, Any]):
    """Holds a number and shows it."""

    def draw(self, parts: list[int]) -> int:
        return by_threshold(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self.observation_space: gym.Space[Any] = spaces.Discrete(rules.size)
        self.action_space: gym.Space[Any] = spaces.Discrete(rules.actions)
        self.state = 0

    def put(self, state: int) -> None:
        self.state = state

    def held(self) -> int:
        return self.state

    def shown(self) -> Any:
        return self.held()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.put(self.rules.starts[self.draw([n for n, _ in self.rules.starts])][1])
        return self.shown(), {}

    def step(self, action: Any) -> Result:
        row = self.rules.outcomes(self.held(), int(action))
        _, following, reward, over = row[self.draw([n for n, *_ in row])]
        self.put(following)
        return self.shown(), reward, over, False, {}


class Parts(Plain):
    """Two numbers of a dictionary, shown as a MultiDiscrete."""

    def draw(self, parts: list[int]) -> int:
        return by_choice(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules)
        self.at: dict[str, int] = {}
        self.observation_space = spaces.MultiDiscrete([4, 4])

    def put(self, state: int) -> None:
        self.at["row"], self.at["column"] = divmod(state, 4)

    def held(self) -> int:
        return 4 * self.at["row"] + self.at["column"]

    def shown(self) -> Any:
        return np.array([self.at["row"], self.at["column"]])


class Board(Plain):
    """An array that is written in place, shown as an image."""

    def draw(self, parts: list[int]) -> int:
        return by_ticket(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules)
        self.board = np.zeros((1, rules.size), np.uint8)
        self.observation_space = spaces.Box(0, 255, self.board.shape, np.uint8)

    def put(self, state: int) -> None:
        self.board[:] = 0
        self.board[0, state] = 255

    def held(self) -> int:
        return int(self.board.argmax())

    def shown(self) -> Any:
        return self.board  # the same array every time


class Place:
    __slots__ = ("ahead", "number")

    def __init__(self, number: int) -> None:
        self.number, self.ahead = number, self


class Linked(Plain):
    """An object among others that know each other, shown within a Dict."""

    def draw(self, parts: list[int]) -> int:
        return by_rejection(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules)
        self.places = [Place(number) for number in range(rules.size)]
        for before, after in itertools.pairwise([*self.places, self.places[0]]):
            before.ahead = after
        self.here = self.places[0]
        at = spaces.Discrete(rules.size, start=3)
        self.observation_space = spaces.Dict(at=at, flag=spaces.MultiBinary(2))

    def put(self, state: int) -> None:
        self.here = self.places[state - 1].ahead

    def held(self) -> int:
        return self.here.number

    def shown(self) -> Any:
        return {"at": np.int64(self.here.number + 3), "flag": np.array([self.here is self.places[0], 1])}


class Counting(Plain):
    """Counts and sums up what nobody reads, with a generator of its own from the start."""

    def draw(self, parts: list[int]) -> int:
        return by_counts(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules)
        self.np_random, _ = seeding.np_random(7)
        self.episodes, self.steps, self.paid = 0, 0, np.float64(0)

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        self.episodes, self.paid = self.episodes + 1, np.float64(0)
        return super().reset(**given)

    def step(self, action: Any) -> Result:
        self.steps += 1
        *shown, reward, over, cut, _ = super().step(action)
        self.paid = 0.5 * self.paid + reward
        return shown[0], reward, over, cut, {"steps": self.steps, "paid": self.paid}


class Drawn(Plain):
    """Holds its place as a rectangle, beside a clock and a surface."""

    def draw(self, parts: list[int]) -> int:
        return by_ticket(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules)
        self.rect, self.clock, self.window = (
            pygame.Rect(0, 0, 8, 8),
            pygame.time.Clock(),
            pygame.Surface((9, 9)),
        )

    def put(self, state: int) -> None:
        self.rect.x = 8 * state
        self.window.fill((state, 0, 0))

    def held(self) -> int:
        return self.rect.x // 8


class Remembering(Plain):
    """Keeps the last action and the place before, as for drawing, and shows one number of many floats."""

    def draw(self, parts: list[int]) -> int:
        return by_choice(self.np_random, parts)

    def __init__(self, rules: Rules) -> None:
        super().__init__(rules)
        self.observation_space = spaces.Box(-1.0, 1.0, (rules.size,))
        self.trail: tuple[int, ...] = ()

    def put(self, state: int) -> None:
        self.trail = (*self.trail, state)[-2:]

    def held(self) -> int:
        return self.trail[-1]

    def shown(self) -> Any:
        return np.eye(self.rules.size, dtype=np.float32)[self.held()]


def stacked(rules: Rules) -> Any:
    return wrappers.FrameStackObservation(Remembering(rules), 2)


def limited(rules: Rules) -> Any:
    return wrappers.TimeLimit(wrappers.OrderEnforcing(Parts(rules)), 90)


def batch(rules: Rules) -> Any:
    return SyncVectorEnv([partial(Board, rules)] * 2)


def monitored(rules: Rules) -> Any:
    return DummyVecEnv([partial(Plain, rules)])


WAYS: dict[str, Callable[[Rules], Any]] = {
    "a number": Plain,
    "a function": lambda rules: partial(Drawn, rules),
    "a dictionary below a limit": limited,
    "an array, in a batch": batch,
    "objects": Linked,
    "counters": Counting,
    "pygame": Drawn,
    "a trail": Remembering,
    "a stack of frames": stacked,
    "a batch of SB3's": monitored,
}


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", RULES)
def test_sixty_environments(name: str, way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rejection, "SAMPLES", 2_000)  # of real draws that a rejection is compared with
    rules = RULES[name]
    mdp = gridworld.compile_env(WAYS[way](rules))
    assert Evaluator(mdp, GAMMA, 100).optimal_value == pytest.approx(solved(rules), abs=1e-12)
