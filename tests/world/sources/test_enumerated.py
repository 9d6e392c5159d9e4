"""Deterministic environments become tables; whatever is not deterministic is refused with a reason."""

import itertools
import random
import threading
import uuid
from collections import deque
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pygame
import pytest
import torch
from gymnasium import spaces

from gridworld.base.errors import InputError
from gridworld.world.door.world import enumerated
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp
from gridworld.world.sources import environment
from gridworld.world.sources.environment import compile_id

CELLS = 5
MINIGRID, LIMIT = "MiniGrid-Empty-5x5-v0", 30
_of_the_process = [0]  # state where no copy of an environment has it

IMAGE = spaces.Box(0, 255, (2, 2), np.uint8)
NO_OBSERVATIONS: dict[str, tuple[gym.Space[Any], Any]] = {  # what does not fit its space
    "none": (spaces.Discrete(CELLS), None),
    "too large": (spaces.Discrete(CELLS), CELLS),
    "no pixels": (IMAGE, None),
    "flat": (IMAGE, np.zeros(4, np.uint8)),
    "ragged": (IMAGE, [[1], [2, 3]]),
    "no image": (spaces.Dict(image=IMAGE), {"picture": np.zeros((2, 2), np.uint8)}),
    "no dict": (spaces.Dict(image=IMAGE), 3),
}


def by_closure() -> Any:
    count = [0]
    return lambda: count.append(0)


class Corridor(gym.Env[Any, int]):
    """Cells 0 to 4; action 1 goes right, 0 left; the last cell ends the episode and pays 1."""

    observation_space: gym.Space[Any] = spaces.Discrete(CELLS)

    def __init__(self, render_mode: str | None = None, variant: str = "plain", limit: int = 0) -> None:
        self.action_space = spaces.Discrete(2)
        self.render_mode, self.variant, self.limit = render_mode, variant, limit
        self.cell = self.steps = self.fuel = 0
        self.past: deque[int] = deque(maxlen=2)
        if variant == "pixels":
            self.observation_space = spaces.Box(0, 255, (2, 2, 3), np.uint8)
        if variant == "text":
            self.observation_space = spaces.Text(3)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.cell = int(self.np_random.integers(3)) if self.variant == "layout" else 0
        self.steps = 0
        self.fuel = 300
        self.past = deque(maxlen=2)
        return self._observation(), {}

    def _observation(self) -> Any:
        if self.variant in NO_OBSERVATIONS:
            space, shown = NO_OBSERVATIONS[self.variant]
            self.observation_space = space
            return shown
        if self.variant == "pixels":
            return np.full((2, 2, 3), 255 * self.cell // (CELLS - 1), dtype=np.uint8)
        return str(self.cell) if self.variant == "text" else self.cell

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.variant == "fails" and self.cell == 2:
            raise RuntimeError("no third cell")
        forward = action == 1
        if self.variant == "random":
            forward = forward and self.np_random.random() < 0.999
        if self.variant == "global":
            forward = forward and random.random() < 0.999
        if self.variant == "hidden":
            _of_the_process[0] += 1
            forward = forward and _of_the_process[0] % 97 != 0
        if self.variant == "gate":  # open at even times
            forward = forward and (self.cell != 2 or self.steps % 2 == 0)
        if self.variant == "past":
            self.past.append(action)
            forward = forward and sum(self.past) == 2
        if self.variant == "fuel":
            self.fuel -= 1
            if self.fuel < 280:
                raise RuntimeError("no fuel")
        if self.variant == "double":  # steps that are not counted one by one
            self.steps += 1
        if self.variant == "endless":
            self.past = deque([*self.past, action])
        self.cell = min(self.cell + 1, CELLS - 1) if forward else max(self.cell - 1, 0)
        self.steps += 1
        terminated = self.cell == CELLS - 1
        reward = float(terminated)
        if self.variant in ("decay", "gate"):
            reward *= 0.9**self.steps
        if self.variant == "once" and self.steps == 37:
            reward += 1
        truncated = 0 < self.limit <= self.steps
        if self.variant == "both":
            truncated = truncated or terminated
        if self.variant == "toll":
            reward += 0.5 * truncated
        return self._observation(), reward, terminated, truncated, {}


@pytest.fixture(scope="module", autouse=True)
def _registered() -> Any:
    for kind in (Corridor, Counted, Ferry):
        gym.register(f"{kind.__name__}-v0", entry_point=kind)
    gym.register("ShortCorridor-v0", entry_point=Corridor, max_episode_steps=12)
    gym.register(
        "DoubledCorridor-v0",
        entry_point=Corridor,
        additional_wrappers=(
            gym.envs.registration.WrapperSpec(
                "TransformReward", "gymnasium.wrappers:TransformReward", {"func": lambda reward: 2 * reward}
            ),
        ),
    )
    yield
    for name in ("Corridor", "Counted", "Ferry", "ShortCorridor", "DoubledCorridor"):
        del gym.registry[f"{name}-v0"]


@pytest.fixture(scope="module")
def empty() -> Mdp:
    return compile_id(MINIGRID, {"max_steps": LIMIT})


def walk_beside(mdp: Mdp, env: gym.Env[Any, Any], steps: int, entry: str | None = None) -> int:
    """Random episodes in the environment and in its table; returns how many ended with a reward."""
    numbers, paid = np.random.default_rng(3), 0
    while steps > 0:
        observation, _ = env.reset(seed=int(numbers.integers(1000)))
        state, elapsed, over = int(mdp.start_states[0]), 0, False
        while not over:
            assert mdp.own_observation is not None
            shown = observation[entry] if entry else observation
            assert np.array_equal(mdp.own_observation[state], shown)
            action = int(numbers.integers(mdp.num_actions if numbers.random() < 0.3 else 3)) % mdp.num_actions
            observation, reward, terminated, truncated, _ = env.step(action)
            assert float(reward) == mdp.reward[state, action, 0]
            state, elapsed, steps = int(mdp.next_state[state, action, 0]), elapsed + 1, steps - 1
            assert terminated == mdp.terminal[state]
            assert truncated == (mdp.max_episode_steps is not None and elapsed >= mdp.max_episode_steps)
            over = terminated or truncated
        paid += bool(reward)
    env.close()
    return paid


@pytest.mark.slow
def test_minigrid_has_a_state_for_every_position_and_time(empty: Mdp) -> None:
    assert empty.action_names == ("left", "right", "forward", "pickup", "drop", "toggle", "done")
    several = "32 observations stand for several of them"  # at other times
    assert empty.truth == f"enumerated, {empty.num_states:,} states; {several}"
    assert empty.max_episode_steps == LIMIT
    # 8 cells without the goal, 4 directions, at most 31 times; a goal that is entered to the right or down.
    assert 32 * 22 < empty.num_states < 34 * (LIMIT + 1)
    assert empty.own_observation is not None
    assert empty.own_observation.shape == (empty.num_states, 7, 7, 3)
    assert empty.own_observation.dtype == np.uint8
    assert empty.goal.sum() == empty.terminal.sum() == 2
    last = empty.absorbing & ~empty.terminal  # at the step limit: truncated, not terminated
    assert last.sum() == 32
    assert walk_beside(empty, gym.make(MINIGRID, max_steps=LIMIT), 2000, "image") > 5


@pytest.mark.slow
def test_the_optimum_of_minigrid_is_the_shortest_way_by_its_formula(empty: Mdp) -> None:
    judge = Evaluator(empty, 1.0, LIMIT)
    # two ahead, a turn, two ahead
    assert judge.optimal_value == pytest.approx(1 - 0.9 * 5 / LIMIT, abs=1e-12)
    assert judge.optimum.expected_length == 5
    score = judge.score(np.eye(7)[np.full(empty.num_states, 6)])
    assert (score.value, score.outcome.timeout, score.outcome.expected_length) == (0, 1, LIMIT)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["plain", "past", "gate", "decay", "pixels"])
@pytest.mark.parametrize("limit", [0, 20])
def test_any_deterministic_environment(variant: str, limit: int) -> None:
    kwargs = {"variant": variant, "limit": limit}
    env_id = "Corridor-v0" if limit else "ShortCorridor-v0"
    mdp = compile_id(env_id, kwargs)
    assert mdp.max_episode_steps == (limit or 12)
    walk_beside(mdp, gym.make(env_id, **kwargs), 500)
    best = {"plain": 1.0, "pixels": 1.0, "past": 1.0, "gate": 0.9**4, "decay": 0.9**4}[variant]
    assert Evaluator(mdp, 1.0, limit or 12).optimal_value == pytest.approx(best)


@pytest.mark.parametrize("variant", ["plain", "pixels", "text"])
@pytest.mark.parametrize("limit", [None, 30])
def test_a_step_count_that_is_left_out(variant: str, limit: int | None) -> None:
    mdp = compile_id("Corridor-v0", {"variant": variant, "limit": limit or 0}, ignore=["steps"])
    assert (mdp.num_states, mdp.max_episode_steps, mdp.action_names) == (CELLS, limit, ("0", "1"))
    assert mdp.truth == "enumerated, 5 states without steps, as you asked"
    assert mdp.goal.tolist() == [False] * 4 + [True]
    assert mdp.next_state[:, :, 0].tolist() == [[0, 1], [0, 2], [1, 3], [2, 4], [4, 4]]
    assert (mdp.own_observation is None) == (variant == "text")


@pytest.mark.parametrize(
    ("variant", "limit", "what"),
    [("once", 60, "reward"), ("decay", 20, "reward"), ("gate", 20, "(state|reward)"), ("toll", 25, "reward")],
)
def test_what_is_left_out_must_not_matter(variant: str, limit: int, what: str) -> None:
    with pytest.raises(
        InputError, match=f"its {what} is not .* depends on steps, which env.ignore leaves out"
    ):
        compile_id("Corridor-v0", {"variant": variant, "limit": limit}, ignore=["steps"])


def test_a_reward_for_a_truncation_belongs_to_the_last_step() -> None:
    mdp = compile_id("Corridor-v0", {"variant": "toll", "limit": 9})
    assert Evaluator(mdp, 1.0, 9).optimal_value == 1.5  # it waits, and goes right with the last step
    walk_beside(mdp, gym.make("Corridor-v0", variant="toll", limit=9), 300)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["double", "fuel", "endless"])
def test_states_that_hold_the_time_end_at_the_step_limit(variant: str) -> None:
    limit = 7 if variant == "endless" else 12  # whose states are all sequences of actions
    kwargs = {"variant": variant, "max_episode_steps": limit}
    mdp = compile_id("ShortCorridor-v0", kwargs, most_states=500)
    assert mdp.max_episode_steps == limit
    assert Evaluator(mdp, 1.0, limit).optimal_value == 1
    walk_beside(mdp, gym.make("ShortCorridor-v0", **kwargs), 500)


@pytest.mark.slow
def test_states_beyond_the_step_limit_that_have_an_end_are_found() -> None:
    mdp = compile_id("ShortCorridor-v0", {"max_episode_steps": 2}, ignore=["steps"])
    assert (mdp.num_states, mdp.max_episode_steps) == (CELLS, 2)
    assert Evaluator(mdp, 1.0, 2).optimum.expected_return == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env_id", "kwargs", "reason"),
    [
        ("Corridor-v0", {"variant": "global"}, "draws from another generator"),
        ("ShortCorridor-v0", {"variant": "hidden"}, "does not repeat a walk"),
        ("Corridor-v0", {"variant": "endless"}, "more than 300 states .* since its past keeps changing"),
        ("Corridor-v0", {"variant": "decay"}, r"its steps keeps changing; .* e.g. env.ignore=\[steps\]"),
        ("Corridor-v0", {"variant": "decay", "limit": 200}, "more than 300 states .* steps keeps changing"),
        ("Corridor-v0", {"variant": "fails"}, "a step with action 0 fails: RuntimeError: no third cell"),
        ("Corridor-v0", {"size": 3}, "unexpected keyword argument 'size'"),
        ("MiniGrid-FourRooms-v0", {}, r"more than 300 states .* since its \w+(, \w+)* keeps changing"),
        ("Pendulum-v1", {}, r"its actions are Box"),
        ("NoSuchWorld-v0", {}, "doesn't exist"),
    ],
)
def test_what_cannot_be_enumerated_is_refused(env_id: str, kwargs: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=f"^env.*{env_id}.*{reason}") as refused:
        compile_id(env_id, kwargs, most_states=300)
    assert "\n" not in str(refused.value)


class Holding(Corridor):
    """Holds something, and does something with it in every step, which its state should show."""

    calls = 0
    made = use = staticmethod(lambda *_: None)

    def __init__(self, render_mode: str | None = None) -> None:
        super().__init__(limit=9)
        self.held = self.made()

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.use(self)
        return super().step(action)


# fmt: off
HELD: dict[str, tuple[Any, Any, str]] = {  # what is held, what a step does, what is said if it is refused
    "a generator": (lambda: [np.random.default_rng(0)], lambda env: env.held[0].random(), ""),
    "a closure": (by_closure, lambda env: env.held(), ""),  # which has no effect
    "a tensor": (lambda: torch.zeros(1), lambda env: env.held.add_(1), "(not always|draws otherwise)"),
    "a masked array": (lambda: np.ma.array([1]), lambda env: None, ""),
    "a lock": (threading.Lock, lambda env: None, "attribute held cannot be copied"),
    "a loop": (lambda: (n for n in range(9)), lambda env: next(env.held), "attribute held cannot be copied"),
    "Python's generator": (lambda: random.Random(1), lambda env: env.held.random(), "from another generator"),
    "a new one": (lambda: 0, lambda env: setattr(env, "held", np.random.default_rng(1)), "makes another"),
}
# fmt: on


@pytest.mark.parametrize("what", HELD)
def test_what_is_held_is_state_or_refused(what: str) -> None:
    made, use, told = HELD[what]
    members = {"made": staticmethod(made), "use": staticmethod(use)}
    gym.register("Holding-v0", entry_point=type("Held", (Holding,), members))
    try:
        if told:
            with pytest.raises(InputError, match=f"^env.id=Holding-v0: .*{told}"):
                compile_id("Holding-v0")
        else:
            assert Evaluator(compile_id("Holding-v0"), 1.0, 9).optimal_value == 1
    finally:
        del gym.registry["Holding-v0"]


@pytest.mark.parametrize("variant", NO_OBSERVATIONS)
def test_an_observation_must_fit_its_space(variant: str) -> None:
    with pytest.raises(
        InputError, match=r"^env.id=Corridor-v0: an observation is .*not in its space"
    ) as refused:
        compile_id("Corridor-v0", {"variant": variant})
    assert "\n" not in str(refused.value)


def test_an_attribute_that_is_left_out_must_be_there() -> None:
    with pytest.raises(
        InputError, match=r"env.ignore=\['step'\]: Corridor-v0 has no attribute step; it has .*steps"
    ):
        compile_id("Corridor-v0", ignore=["step"])


class Counted(Corridor):
    """It lists its episodes."""

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.episodes = (*getattr(self, "episodes", ()), 1)
        return super().reset(**kwargs)


@pytest.mark.slow
def test_what_changes_with_every_episode_is_named() -> None:
    with pytest.raises(InputError, match=r"the same state \(in episodes\).*ignore"):
        compile_id("Counted-v0", {"limit": 9})
    assert compile_id("Counted-v0", {"limit": 9}, ignore=["episodes", "steps"]).num_states == CELLS


class Lock(gym.Env[Any, int]):
    """Ten bits are entered; one code pays, and no reset forgets that it was found."""

    observation_space, action_space = spaces.Discrete(2**11), spaces.Discrete(2)

    def __init__(self) -> None:
        self.found = False

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict[str, Any]]:
        super().reset(seed=seed)
        self.code = 1
        return 1, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        self.code = 2 * self.code + int(action)
        reward = 0.0
        if self.code == 1024 + 341:
            reward, self.found = (-1.0 if self.found else 1.0), True
        return self.code, reward, self.code >= 1024, False, {}


def test_a_reset_is_tried_from_every_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(gym.registry, "Lock-v0", gym.envs.registration.EnvSpec("Lock-v0", entry_point=Lock))
    with pytest.raises(InputError, match=r"a reset does not always lead to the same state \(in found\)"):
        compile_id("Lock-v0")


class Ferry(gym.Env[Any, int]):
    """Left, right, wait or board: the pier at the end pays much from `first` to `last`, the start little."""

    observation_space: gym.Space[Any] = spaces.Discrete(100)
    action_space = spaces.Discrete(4)

    def __init__(
        self, render_mode: str | None = None, cells: int = 6, first: int = 7, last: int = 9, limit: int = 20
    ) -> None:
        self.cells, self.first, self.last, self.limit = cells, first, last, limit
        self.clock: dict[str, int] = {}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.cell, self.clock = 0, {"minutes": 0}
        return self.cell, {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time = self.clock["minutes"]
        self.clock["minutes"] = time + 1
        reward, over = 0.0, False
        if action == 3 and self.cell == self.cells and self.first <= time <= self.last:
            reward, over = 1.0, True
        if action == 3 and self.cell == 0:
            reward, over = 0.2, True
        move = {0: -1, 1: 1}.get(action, 0)
        self.cell = min(max(self.cell + move, 0), self.cells)
        return self.cell, reward, over, self.clock["minutes"] >= self.limit, {}


@pytest.mark.parametrize(
    ("cells", "first", "last"), [(4, 3, 3), (4, 5, 9), (11, 11, 11), (4, 13, 14), (11, 19, 19), (4, 20, 30)]
)
def test_what_is_there_for_a_time_only(cells: int, first: int, last: int) -> None:
    kwargs = {"cells": cells, "first": first, "last": last}
    mdp = compile_id("Ferry-v0", kwargs)
    boarded = max(cells, first)
    truth = 0.98**boarded if boarded <= min(last, 19) else 0
    assert Evaluator(mdp, 0.98, 20).optimal_value == pytest.approx(max(truth, 0.2), abs=1e-12)
    if truth and last > first:  # one moment is hardly met by chance, so it rests on the user's word
        with pytest.raises(InputError, match=r"env.ignore leaves out"):
            compile_id("Ferry-v0", kwargs, ignore=["clock"])


def test_a_wrapper_of_an_id_belongs_to_the_world() -> None:
    assert Evaluator(compile_id("DoubledCorridor-v0", {"limit": 20}), 1.0, 20).optimal_value == 2


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "minigrid", None)
    with pytest.raises(InputError, match=r"needs the package minigrid; install it with pip install"):
        compile_id(MINIGRID)


@pytest.fixture
def enumerations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """An entry for each time that an environment is enumerated."""
    found: list[int] = []
    monkeypatch.setattr(environment, "enumerated", lambda *a, **k: found.append(0) or enumerated(*a, **k))
    return found


@pytest.mark.parametrize("env_id", ["Corridor-v0", "ShortCorridor-v0", "DoubledCorridor-v0", "FrozenLake-v1"])
def test_what_is_made_the_same_each_time_is_enumerated_once(env_id: str, enumerations: list[int]) -> None:
    compile_id(env_id, by_table=False)
    assert len(enumerations) == 1


MADE: dict[str, tuple[Any, int]] = {  # what an instance holds of its own, and how often it is enumerated
    "a clock": (lambda env: pygame.time.Clock(), 1),
    "a function": (lambda env: lambda cell: cell + 1, 1),
    "a generator": (lambda env: env.np_random, 1),
    "a name": (lambda env: uuid.uuid4().hex, 3),
    "a function of a number": (lambda env: partial(max, uuid.uuid4().int), 3),
}


@pytest.mark.parametrize("what", MADE)
def test_what_instances_have_of_their_own_is_looked_at_a_few_times(
    what: str, enumerations: list[int]
) -> None:
    held, expected = MADE[what]

    def made() -> Any:
        env = Corridor()
        env.own = held(env)  # type: ignore[attr-defined]
        return gym.wrappers.TimeLimit(env, 20)

    assert environment.found_by(made).mdp.num_states == CELLS
    assert len(enumerations) == expected

    class Ends(Corridor):
        def step(self, action: int) -> Any:
            shown, reward, over, *rest = super().step(action)
            return shown, reward * self.end, over, *rest  # type: ignore[attr-defined]

    numbers = itertools.count()

    def drawn() -> Any:
        env = Ends()
        env.own, env.end = held(env), int(next(numbers) == 7)  # type: ignore[attr-defined]
        return env

    with pytest.raises(InputError, match="is another world each time it is made"):
        environment.found_by(drawn)
