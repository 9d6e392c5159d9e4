"""Loops that draw again until something fits: exact shares, and no counted loop is taken for one."""

import bisect
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from gridworld.base.errors import InputError
from gridworld.world.door.world import enumerated
from gridworld.world.mdp import Mdp


class Paying(gym.Env[int, int]):
    """One step, which pays what `draw` returns."""

    observation_space, action_space = spaces.Discrete(2), spaces.Discrete(1)
    tries = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        return 1, float(self.draw()), True, False, {}

    def draw(self) -> Any:
        raise NotImplementedError


class Until(Paying):
    def draw(self) -> Any:
        die = 6
        while die == 6:
            die = int(self.np_random.integers(1, 7))
        return die


class Kept(Paying):
    """Each number that is rejected stays in a variable, so that no two tries look alike."""

    def draw(self) -> Any:
        while True:
            number = int(self.np_random.integers(25))
            if number >= 20:
                return number


class Cells(Paying):
    """Two draws a try."""

    def draw(self) -> Any:
        row, column = -1, -1
        while row == column or row + column > 3:
            row, column = self.np_random.integers(4), self.np_random.integers(4)
        return 10 * row + column


class InFor(Paying):
    """A count in an iterator, which nobody sees."""

    def draw(self) -> Any:
        for _ in [0, 0, 0]:
            if self.np_random.integers(2):
                self.last = 1
        return sum(int(self.np_random.integers(3)) for _ in range(2))


class Mapped(Paying):
    def draw(self) -> Any:
        return sum(map(self.np_random.integers, [3, 3]))


class Bisected(Paying):
    def draw(self) -> Any:
        return bisect.bisect_right((0.75, 0.875), self.np_random.random())


class Counted(Paying):
    def draw(self) -> Any:
        tries = 0
        while self.np_random.random() < 0.5 and tries < 3:
            tries += 1
        return tries


class ThrownAway(Paying):
    def draw(self) -> Any:
        while self.np_random.random() < 0.25:
            pass
        return self.np_random.integers(2)


class TwoInOne(Paying):
    def draw(self) -> Any:
        while (product := self.np_random.integers(1, 4) * self.np_random.integers(1, 4)) > 5:
            pass
        return product


class Nested(Paying):
    def draw(self) -> Any:
        while True:
            one = int(self.np_random.integers(3))
            while (other := int(self.np_random.integers(3))) == one:
                pass
            if one + other != 3:
                return 10 * one + other


class Helped(Paying):
    def one(self) -> int:
        return int(self.np_random.integers(4))

    def draw(self) -> Any:
        found = self.one()
        while found == 2:
            found = self.one()
        return found


class Restored(Paying):
    """A count that is set back before the step ends."""

    def draw(self) -> Any:
        while self.np_random.random() < 0.5 and self.tries < 3:
            self.tries += 1
        found, self.tries = self.tries, 0
        return found


class Picker:
    def __init__(self, rng: Any) -> None:
        self.rng, self.tries = rng, 0

    def pick(self) -> int:
        while self.rng.random() < 0.5 and self.tries < 3:
            self.tries += 1
        return self.tries


class OfAHelper(Paying):
    """A count in a helper's own self."""

    def draw(self) -> Any:
        return Picker(self.np_random).pick()


class OfTheClass(Paying):
    """A count in a class, which only a comparison with real draws finds."""

    count = 0

    def draw(self) -> Any:
        type(self).count = 0
        while self.np_random.random() < 0.5 and type(self).count < 3:
            type(self).count += 1
        return type(self).count


class OnTheStack(Paying):
    """Half a sum, which is nowhere but on the stack: three coins, thrown again below two heads."""

    def draw(self) -> Any:
        while (
            heads := sum(int(self.np_random.integers(2)) for _ in range(2)) + int(self.np_random.integers(2))
        ) < 2:
            heads = 0
        return heads


class Apart(Paying):
    """Two different numbers, each drawn until it is new, in a `for` loop."""

    def draw(self) -> Any:
        taken: set[int] = set()
        for _ in range(2):
            while True:
                number = int(self.np_random.integers(3))
                if number not in taken:
                    taken.add(number)
                    break
        return sum(taken)


class OneByOne(Paying):
    """The same, by a method that the loop calls."""

    def draw(self) -> Any:
        self.taken: list[int] = []
        for number in range(2):
            self.add(number)
        self.taken, total = [], sum(self.taken)
        return total

    def add(self, number: int) -> None:
        while len(self.taken) == number:
            drawn = int(self.np_random.integers(3))
            if drawn not in self.taken:
                self.taken.append(drawn)


class OverAList(Paying):
    """Nobody sees how far the iterator of a list is."""

    def draw(self) -> Any:
        for _ in [0, 0]:
            while self.np_random.random() < 0.5:
                pass
        return 1


class OverADraw(Paying):
    """How long the loop is was drawn, and is nowhere to be seen."""

    def draw(self) -> Any:
        count = 0
        for _ in range(int(self.np_random.integers(1, 4))):
            while self.np_random.random() < 0.5:
                pass
            count += 1
        return count


class SetAgain(Paying):
    """The variable of the loop is set within it."""

    def draw(self) -> Any:
        total = 0.0
        for each in range(3):
            each = 0
            while self.np_random.random() < 0.5:
                pass
            total += each
        return total


COUNTS = {0: "1/2", 1: "1/4", 2: "1/8", 3: "1/8"}
SHARES: dict[type[Paying], dict[float, str]] = {
    Until: dict.fromkeys(range(1, 6), "1/5"),
    Kept: dict.fromkeys(range(20, 25), "1/5"),
    Cells: dict.fromkeys((1, 2, 3, 10, 12, 20, 21, 30), "1/8"),
    InFor: {0: "1/9", 1: "2/9", 2: "1/3", 3: "2/9", 4: "1/9"},
    Mapped: {0: "1/9", 1: "2/9", 2: "1/3", 3: "2/9", 4: "1/9"},
    Bisected: {0: "3/4", 1: "1/8", 2: "1/8"},
    Counted: COUNTS,
    ThrownAway: {0: "1/2", 1: "1/2"},
    TwoInOne: {1: "1/6", 2: "1/3", 3: "1/3", 4: "1/6"},
    Nested: {1: "1/4", 2: "1/4", 10: "1/4", 20: "1/4"},
    Helped: {0: "1/3", 1: "1/3", 3: "1/3"},
    Restored: COUNTS,
    OfAHelper: COUNTS,
    Apart: dict.fromkeys((1, 2, 3), "1/3"),
    OneByOne: dict.fromkeys((1, 2, 3), "1/3"),
}


def found(kind: Callable[[], Paying]) -> Mdp:
    return enumerated("env", kind()).mdp


@pytest.mark.parametrize("kind", SHARES)
def test_shares_are_exact(kind: type[Paying]) -> None:
    mdp = found(kind)
    shares: dict[float, float] = {}
    start = mdp.start_states[0]
    for share, reward in zip(mdp.probability[start, 0], mdp.reward[start, 0], strict=True):
        if share:
            shares[float(reward)] = shares.get(float(reward), 0.0) + float(share)
    assert shares == pytest.approx(
        {paid: float(Fraction(text)) for paid, text in SHARES[kind].items()}, abs=1e-15
    )


@pytest.mark.parametrize("kind", [OverAList, OverADraw, SetAgain])
def test_a_loop_whose_iterator_is_not_seen_is_no_rejection(kind: type[Paying]) -> None:
    with pytest.raises(InputError, match="one step may draw more than 500 times"):
        found(kind)


@pytest.mark.parametrize("kind", [OfTheClass, OnTheStack])
def test_what_only_looks_like_a_rejection_is_compared_with_real_draws(kind: type[Paying]) -> None:
    try:
        mdp = found(kind)
    except InputError:
        return
    env = kind()
    env.reset(seed=0)
    played = np.array([env.draw() for _ in range(20_000)])
    start = mdp.start_states[0]
    mean = float((mdp.probability * mdp.reward).sum(axis=2)[start, 0])
    assert mean == pytest.approx(played.mean(), abs=5 * played.std() / 20_000**0.5)
