"""Environments with one fault each, beside sound ones that are otherwise the same.

`FAULTS` has for each fault the sound environment, the faulty one, the topic of its finding and words of it.
"""

import random
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete

Start = tuple[Any, dict[str, Any]]
Result = tuple[Any, float, bool, bool, dict[str, Any]]


class Walk(gym.Env[Any, Any]):
    """Six cells in a row: 0 is left, 1 right; the last cell pays 1 and ends the episode, 40 steps cut it."""

    size, limit, slip = 6, 40, 0.0
    action_space: Any = Discrete(2)

    def __init__(self) -> None:
        self.observation_space: Any = Discrete(self.size)
        self.place, self.time = 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.place, self.time = 0, 0
        return self.show(), {}

    def step(self, action: Any) -> Result:
        self.time += 1
        self.move(action)
        return self.show(), self.pay(action), self.over(), self.cut(), {}

    def move(self, action: Any) -> None:
        right = bool(action) != (self.slip > 0 and self.draw() < self.slip)
        self.place = min(max(self.place + (1 if right else -1), 0), self.size - 1)

    def draw(self) -> float:
        return float(self.np_random.random())

    def show(self) -> Any:
        return self.place

    def pay(self, action: Any) -> float:
        return float(self.over())

    def over(self) -> bool:
        return self.place == self.size - 1

    def cut(self) -> bool:
        return not self.over() and self.time >= self.limit


class Slippery(Walk):
    slip = 0.2


class LimitTerminates(Walk):
    def step(self, action: Any) -> Result:
        observation, reward, over, cut, info = super().step(action)
        return observation, reward, over or cut, False, info


class Continuing(Walk):
    """Without an end: the last cell pays at every step."""

    def pay(self, action: Any) -> float:
        return float(self.place == self.size - 1)

    def over(self) -> bool:
        return False


class Endless(Continuing):
    limit = 10**9


class GoalTruncates(Walk):
    def step(self, action: Any) -> Result:
        observation, reward, over, cut, info = super().step(action)
        return observation, reward, False, over or cut, info


class ResetsItself(Walk):
    def step(self, action: Any) -> Result:
        observation, reward, over, cut, info = super().step(action)
        return (self.reset()[0] if over else observation), reward, over, cut, info


class SharedRandom(Slippery):
    def draw(self) -> float:
        return random.random()


class SharedNumpy(Slippery):
    def draw(self) -> float:
        return float(np.random.random())


class OwnGenerator(Slippery):
    def __init__(self) -> None:
        super().__init__()
        self.rng = np.random.default_rng(7)

    def draw(self) -> float:
        return float(self.rng.random())


class Survivor(Walk):
    """Pays only where it comes further than ever before."""

    farthest = 0

    def pay(self, action: Any) -> float:
        better, self.farthest = self.place > self.farthest, max(self.place, self.farthest)
        return float(better)


class PaysProgress(Walk):
    """The same, of this episode, which the observation shows."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Discrete(self.size**2)
        self.farthest = 0

    def reset(self, **kwargs: Any) -> Start:
        self.farthest = 0
        return super().reset(**kwargs)

    def show(self) -> Any:
        self.farthest, before = max(self.place, self.farthest), self.farthest
        self.is_better = self.farthest > before
        return self.place + self.size * self.farthest

    def pay(self, action: Any) -> float:
        return float(self.is_better)


class Outside(Walk):
    def show(self) -> Any:
        return self.place + 3


class Vector(Walk):
    """Shows its place as a number from -1 to 1."""

    low, high = -1.0, 1.0

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Box(self.low, self.high, (1,), np.float32)

    def show(self) -> Any:
        share = self.place / (self.size - 1)
        return np.array([self.low + (self.high - self.low) * share], np.float32)


class InPlace(Vector):
    shown: ClassVar[Any] = np.zeros(1, np.float32)

    def show(self) -> Any:
        self.shown[:] = super().show()
        return self.shown


class Unscaled(Vector):
    low, high = 0.0, 300.0


class NotFinite(Walk):
    def pay(self, action: Any) -> float:
        return np.nan if self.place == 2 else super().pay(action)


class WrongGoal(Walk):
    """The goal is one cell further than anybody comes."""

    def over(self) -> bool:
        return self.place == self.size


class PaysByTime(Walk):
    """Pays in every other step, which it shows, whatever is done."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Discrete(2 * self.size)

    def show(self) -> Any:
        return 2 * self.place + self.time % 2

    def over(self) -> bool:
        return False

    def pay(self, action: Any) -> float:
        return float(self.time % 2)


class PaysByTimeAndPlace(PaysByTime):
    def pay(self, action: Any) -> float:
        return float(self.time % 2 * (self.place > 2))


class Huge(Walk):
    def pay(self, action: Any) -> float:
        return 1e6 * super().pay(action)


class Tiny(Walk):
    def pay(self, action: Any) -> float:
        return 1e-6 * super().pay(action)


class Deaf(Walk):
    """Compares the action with what it never is."""

    def move(self, action: Any) -> None:
        super().move(str(action) != "right")


class Push(Vector):
    """Moves right where it is pushed with more than half of the force."""

    action_space = Box(-1.0, 1.0, (1,), np.float32)
    threshold = 0.0

    def move(self, action: Any) -> None:
        super().move(bool(action[0] > self.threshold))


class WidePush(Push):
    action_space = Box(0.0, 1000.0, (1,), np.float32)
    threshold = 500.0


class Blind(Walk):
    def show(self) -> Any:
        return 0


class Hasty(Walk):
    """From its eighth step on it pays nothing, which it does not show."""

    def pay(self, action: Any) -> float:
        return float(self.over() and self.time < 8) + float(self.place == 3 and self.time % 5 == 0)


class Memory(Walk):
    """Pays for doing something else than before, which it does not show."""

    before = 0

    def reset(self, **kwargs: Any) -> Start:
        self.before = 0
        return super().reset(**kwargs)

    def pay(self, action: Any) -> float:
        is_new, self.before = action != self.before, int(action)
        return 0.5 * is_new + super().pay(action)


class TwoGoals(Walk):
    """The goal is left or right, drawn at reset; it shows which."""

    is_shown = True

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Discrete(2 * self.size)
        self.goal = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.goal, self.place = int(self.np_random.integers(2)) * (self.size - 1), self.size // 2
        return self.show(), {}

    def show(self) -> Any:
        return self.place + self.size * (self.goal > 0) * self.is_shown

    def over(self) -> bool:
        return self.place == self.goal


class HiddenGoal(TwoGoals):
    is_shown = False


class ShownCard(TwoGoals):
    """Five guesses at which of two cards was drawn at reset; it shows the card."""

    def step(self, action: Any) -> Result:
        self.place += 1
        paid = float(bool(action) == (self.goal > 0))
        return self.show(), paid, self.place == self.size - 1, False, {}

    def reset(self, **kwargs: Any) -> Start:
        super().reset(**kwargs)
        self.place = 0
        return self.show(), {}


class HiddenCard(ShownCard):
    is_shown = False


class Moody(Slippery):
    """Actions are reversed after a slip until the next one, which it does not show."""

    is_reversed, is_shown = False, False

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = Discrete(2 * self.size)

    def reset(self, **kwargs: Any) -> Start:
        self.is_reversed = False
        return super().reset(**kwargs)

    def move(self, action: Any) -> None:
        self.is_reversed ^= self.np_random.random() < 0.1
        self.place = min(max(self.place + (1 if bool(action) != self.is_reversed else -1), 0), self.size - 1)

    def show(self) -> Any:
        return self.place + self.size * self.is_reversed * self.is_shown


class OpenlyMoody(Moody):
    is_shown = True


class Cart(gym.Env[Any, Any]):
    """A cart on a line that is pushed left or right, and shows its place and velocity."""

    shown = 2
    action_space = Discrete(2)

    def __init__(self) -> None:
        self.observation_space = Box(-5.0, 5.0, (self.shown,), np.float64)
        self.state = np.zeros(2)
        self.time = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Start:
        super().reset(seed=seed)
        self.state, self.time = self.np_random.uniform(-0.5, 0.5, 2), 0
        return self.state[: self.shown].copy(), {}

    def step(self, action: Any) -> Result:
        place, velocity = self.state
        self.state = np.array([place + 0.1 * velocity, velocity + (0.05 if action else -0.05)])
        self.time += 1
        over = bool(abs(self.state[0]) > 1.0)
        return np.clip(self.state[: self.shown], -5, 5), 1.0, over, not over and self.time >= 200, {}


class Far(Walk):
    """Only right leads on; left stays. There is no limit."""

    size, limit = 400, 10**9

    def move(self, action: Any) -> None:
        self.place, self.time = self.place + bool(action), 0


class Near(Far):
    size = 20


class Lock(Walk):
    """One wrong action leads back to the start."""

    size, limit = 16, 60

    def move(self, action: Any) -> None:
        self.place = self.place + 1 if bool(action) == bool(self.place % 2) else 0


class ShortLock(Lock):
    size = 6


class OldInterface(Walk):
    def reset(self, **kwargs: Any) -> Any:
        return super().reset(**kwargs)[0]


class Raises(Walk):
    def move(self, action: Any) -> None:
        super().move(action)
        if self.place == 4:
            raise IndexError("cell 4")


FAULTS: tuple[tuple[Any, Any, str, str], ...] = (
    (Walk, LimitTerminates, "termination", "terminated=True at step 40"),
    (Continuing, Endless, "termination", "no step limit"),
    (Walk, GoalTruncates, "termination", "none is terminated"),
    (Walk, ResetsItself, "termination", "as if step() had called reset()"),
    (Slippery, SharedRandom, "seed", "the module random"),
    (Slippery, SharedNumpy, "seed", "numpy.random"),
    (Slippery, OwnGenerator, "seed", "its generator rng"),
    (PaysProgress, Survivor, "reset", "farthest is not restored"),
    (Walk, Outside, "space", "outside of Discrete(6)"),
    (Vector, InPlace, "interface", "changed by the next step"),
    (Walk, NotFinite, "reward", "not finite"),
    (Walk, WrongGoal, "reward", "pays more than 0"),
    (PaysByTimeAndPlace, PaysByTime, "reward", "do not depend on what is done"),
    (Walk, Huge, "scale", "1e+06"),
    (Walk, Tiny, "scale", "1e-06"),
    (Walk, Deaf, "actions", "no action does anything"),
    (Push, WidePush, "actions", "from 0 to 1000"),
    (Walk, Blind, "observation", "the same observation"),
    (Vector, Unscaled, "observation", "its number 0 is from 0"),
    (Walk, Hasty, "markov", "the step count"),
    (Walk, Memory, "markov", "the step before"),
    (TwoGoals, HiddenGoal, "markov", "what is drawn at reset"),
    (ShownCard, HiddenCard, "markov", "what is drawn at reset"),
    (OpenlyMoody, Moody, "markov", "the step before"),
    (Near, Far, "discount", "399 steps away"),
    (ShortLock, Lock, "exploration", "(exact)"),
    (Walk, OldInterface, "interface", "must return (observation, info)"),
    (Walk, Raises, "interface", "raises IndexError: cell 4"),
)
