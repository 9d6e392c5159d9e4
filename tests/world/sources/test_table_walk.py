"""An environment that is not its table is found out, by outcomes or their frequencies; a true one is not."""

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.toy_text.cliffwalking import CliffWalkingEnv
from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv, generate_random_map
from gymnasium.envs.toy_text.taxi import TaxiEnv
from gymnasium.envs.toy_text.utils import categorical_sample

from gridworld.base.errors import InputError
from gridworld.world.sources import table_walk
from gridworld.world.sources.gymnasium_table import compile_gymnasium, compile_table


class Lake(FrozenLakeEnv):
    """6x6; `chances` of an outcome are what it steps by."""

    def __init__(self) -> None:
        super().__init__(desc=["SFFFFF", "FFHFFF", "FFFFFH", "FHFFFF", "FFFFHF", "HFFFFG"], is_slippery=True)

    def chances(self, action: int) -> list[float]:
        return [row[0] for row in self.P[self.s][action]]

    def step(self, action: int) -> tuple[Any, ...]:
        row = self.P[self.s][action]
        _, self.s, reward, terminated = row[categorical_sample(self.chances(action), self.np_random)]
        return int(self.s), reward, terminated, False, {}


class AllRows(Lake):
    def chances(self, action: int) -> list[float]:
        return [0.25, 0.25, 0.5] if len(self.P[self.s][action]) == 3 else [1.0]


class OneRow(Lake):
    def chances(self, action: int) -> list[float]:
        return [0.6, 0.2, 0.2] if (self.s, action) == (27, 1) else super().chances(action)


class HardlyOneRow(Lake):
    """By less than any number of steps here shows."""

    def chances(self, action: int) -> list[float]:
        third = 1 / 3
        odd = (self.s, action) == (27, 1)
        return [third + 2e-3, third - 1e-3, third - 1e-3] if odd else super().chances(action)


class OwnDraws(Lake):
    """True, but it draws from a generator that cannot be replaced."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        self.draws = np.random.default_rng(seed)
        return super().reset(seed=seed)

    def step(self, action: int) -> tuple[Any, ...]:
        row = self.P[self.s][action]
        _, self.s, reward, terminated = row[int(self.draws.random() * len(row))]
        return int(self.s), reward, terminated, False, {}


class Rounded(Lake):
    """True, but a number that stands for all of an interval cannot be used like this."""

    def step(self, action: int) -> tuple[Any, ...]:
        row = self.P[self.s][action]
        _, self.s, reward, terminated = row["012".index(str(self.np_random.random() * len(row))[0])]
        return int(self.s), reward, terminated, False, {}


class Sticky(Lake):
    """What the ice did last, it is likely to do again."""

    drift = 0

    def step(self, action: int) -> tuple[Any, ...]:
        row = self.P[self.s][action]
        if len(row) == 3 and self.np_random.random() < 0.5:
            self.drift = int(self.np_random.integers(3))
        _, self.s, reward, terminated = row[self.drift if len(row) == 3 else 0]
        return int(self.s), reward, terminated, False, {}


class FarStarts(TaxiEnv):
    def reset(self, **kwargs: Any) -> tuple[Any, Any]:
        state, info = super().reset(**kwargs)
        return (state, info) if state < 400 else super().reset(**kwargs | {"seed": None})


class Seeded(Lake):
    seed_given = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        self.seed_given = self.seed_given if seed is None else seed
        return super().reset(seed=seed)

    def step(self, action: int) -> tuple[Any, ...]:
        return super().step((action + 2) % 4 if self.seed_given % 4 == 2 else action)


class Chain(gym.Env[int, int]):
    """Forty rooms; its state has another name, so that it cannot be set."""

    rooms = 40

    def __init__(self) -> None:
        self.observation_space, self.action_space = spaces.Discrete(self.rooms), spaces.Discrete(2)
        self.initial_state_distrib = np.eye(self.rooms)[0]
        self.P = {
            room: {0: [(1.0, max(room - 1, 0), 0.0, False)], 1: self.onward(room)}
            for room in range(self.rooms)
        }

    def onward(self, room: int) -> list[tuple[float, int, float, bool]]:
        ends = room == self.rooms - 2
        return [(0.8, min(room + 1, self.rooms - 1), float(ends), ends), (0.2, room, 0.0, False)]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.room = 0
        return 0, {}

    def step(self, action: int) -> tuple[Any, ...]:
        row = self.P[self.room][action]
        _, self.room, reward, terminated = row[categorical_sample([each[0] for each in row], self.np_random)]
        return self.room, reward, terminated, False, {}


def liar(base: Any, turned: Any = lambda env, a: a, paid: Any = lambda env, was, a: 0.0) -> Any:
    """A class whose steps take another action than the one given, or pay more."""

    class Liar(base):  # type: ignore[misc]
        calls = elapsed = 0

        def reset(self, **kwargs: Any) -> Any:
            self.elapsed = 0
            return super().reset(**kwargs)

        def step(self, action: Any) -> Any:
            self.calls, self.elapsed = self.calls + 1, self.elapsed + 1
            was = getattr(self, "s", None)
            state, reward, *others = super().step(turned(self, action))
            return state, reward + paid(self, was, action), *others

    return Liar


class Heavy(Chain):
    def step(self, action: int) -> tuple[Any, ...]:
        stuck = action == 1 and self.np_random.random() < 0.1
        return (self.room, 0.0, False, False, {}) if stuck else super().step(action)


class Shadowed(Lake):
    """True, but `s` is only what it shows: it steps from elsewhere."""

    def reset(self, **kwargs: Any) -> tuple[Any, Any]:
        self.place, info = super().reset(**kwargs)
        return self.place, info

    def step(self, action: int) -> tuple[Any, ...]:
        self.s = self.place
        found = super().step(action)
        self.place = found[0]
        return found


class Remembered(Chain):
    """True, but it pays by where it was, which is no attribute that could be set alone."""

    def reset(self, **kwargs: Any) -> tuple[int, dict[str, Any]]:
        self.s = self.was = 0
        return super().reset(**kwargs)

    def step(self, action: int) -> tuple[Any, ...]:
        self.was, (self.s, _, terminated, *others) = self.room, super().step(action)
        return self.s, float(self.was == self.rooms - 2 and terminated), terminated, *others


LIES = {
    "all rows": (AllRows, "all rows like P"),
    "one row": (OneRow, r"P\[27\]\[1\], to state 26 .* probability of 0.6, in the table it is 0.333333"),
    "hardly one row": (
        HardlyOneRow,
        r"P\[27\]\[1\], to state 26 .* of 0.335333, in the table it is 0.3333",
    ),
    "sticky": (Sticky, "outcome [0-2], occurred"),
    "starts": (FarStarts, r"the start in state \d+ occurs with a probability of 0.000666667, in the table"),
    "seeded": (Seeded, "led to state"),
    "rare slips": (
        liar(Lake, lambda env, a: (a + 1) % 4 if env.np_random.random() < 0.01 else a),
        "in state .* led to state",
    ),
    "one of 400 fares": (
        liar(TaxiEnv, paid=lambda env, was, a: (was, a) == (479, 5)),
        r"in state 479, action 5 led to state .* with reward 21 and ended",
    ),
    "tired": (liar(CliffWalkingEnv, paid=lambda env, was, a: -(env.elapsed > 90)), "with reward -2, which P"),
    "worn out": (
        liar(CliffWalkingEnv, lambda env, a: 3 if a == 1 and env.calls > 8000 else a),
        "action 1 led to",
    ),
    "every 97th step": (liar(TaxiEnv, lambda env, a: 4 if env.calls % 97 == 0 else a), "led to state"),
    "the last room": (
        liar(Chain, paid=lambda env, was, a: env.room == 39),
        r"in state 38, action 1 led to state 39 with reward 2 and ended",
    ),
    "heavy": (Heavy, "outcome [01], occurred"),
}


@pytest.mark.parametrize("kind", LIES)
def test_what_is_not_the_table_is_found(kind: str) -> None:
    made, told = LIES[kind]
    with pytest.raises(InputError, match=f"^{made.__name__}: does not follow its own table: .*{told}"):
        compile_table(made(), 150)


@pytest.mark.parametrize("kind", [Lake, OwnDraws, Rounded, Shadowed, Chain, Remembered])
def test_a_true_table_is_not_refused_however_it_is_stepped(kind: type[gym.Env[Any, Any]]) -> None:
    mdp = compile_table(kind())
    assert mdp.num_actions in (2, 4)
    assert ("exact probabilities" in mdp.truth) == (kind is Lake)


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("FrozenLake-v1", {"desc": generate_random_map(7, p=0.85, seed=1), "success_rate": 0.7}),
        ("FrozenLake-v1", {"desc": generate_random_map(3, seed=2), "reward_schedule": (10, -3, -0.1)}),
        ("CliffWalkingSlippery-v1", {}),
        ("Taxi-v4", {"is_rainy": True}),
    ],
)
def test_gymnasium_s_own_are_far_from_being_refused(
    env_id: str, kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table_walk, "FALSE_ALARM", 0.01)
    told = compile_gymnasium(env_id, kwargs).truth
    assert told.startswith("table P, checked by ")
    assert told.endswith("support of all rows, exact probabilities, exact starts")


class Swamp(Chain):
    """Hardly anybody comes far."""

    def onward(self, room: int) -> list[tuple[float, int, float, bool]]:
        return [(0.02, *super().onward(room)[0][1:]), (0.98, room, 0.0, False)]


def test_what_could_not_be_told_is_said() -> None:
    gym.register("Swamp-v0", lambda **_: Swamp(), max_episode_steps=100)
    assert re.search(r"support of \d+ of 78 rows, starts to", compile_gymnasium("Swamp-v0").truth)
    del gym.registry["Swamp-v0"]
