"""Step limits that environments count by themselves, and truncations that are none."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces, wrappers

import gridworld
from gridworld.base.errors import InputError
from gridworld.world.door import checks
from gridworld.world.door import search as door_search
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import Mdp

Result = tuple[Any, float, bool, bool, dict[str, Any]]


class Windy(gym.Env[Any, int]):
    """Nine cells in a square; the last one pays and ends; with a chance of 1/10 a step goes another way."""

    observation_space: gym.Space[Any] = spaces.Discrete(9)
    action_space: gym.Space[Any] = spaces.Discrete(4)

    def __init__(self, cuts: Callable[["Windy"], bool] = lambda env: False, most: int = 60) -> None:
        self.cuts, self.most = cuts, most

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.at, self.steps, self.left, self.clock = 0, 0, self.most, np.int64(10)
        return 0, {}

    def step(self, action: int) -> Result:
        if self.np_random.random() < 0.1:
            action = (action + 1) % 4
        row, column = divmod(self.at, 3)
        row = min(max(row + (-1, 0, 1, 0)[action], 0), 2)
        column = min(max(column + (0, 1, 0, -1)[action], 0), 2)
        self.at, self.before = 3 * row + column, self.steps
        self.steps, self.left, self.clock = self.steps + 1, self.left - 1, self.clock + 2
        return self.at, float(self.at == 8), self.at == 8, bool(self.cuts(self)), {"steps": self.steps}


LIMITS: dict[str, Callable[[Windy], bool]] = {
    "at least": lambda env: env.steps >= env.most,
    "more than": lambda env: env.steps > env.most - 1,
    "just": lambda env: env.steps == env.most,
    "not less": lambda env: not env.steps < env.most,
    "the other way round": lambda env: env.most <= env.steps,
    "what is left": lambda env: env.left <= 0,
    "a difference": lambda env: env.most - env.steps < 1,
    "a step later": lambda env: env.steps + 1 >= env.most + 1,
    "by numpy": lambda env: bool(np.greater_equal(env.steps, env.most)),
    "numpy's own numbers": lambda env: bool(env.clock >= np.int64(10 + 2 * env.most)),
    "by a half": lambda env: env.steps >= env.most - 0.5,
    "not at an end": lambda env: env.steps >= env.most and env.at != 8,
    "in a billion": lambda env: env.steps > 10**9,
}


@pytest.mark.parametrize("how", LIMITS)
def test_a_counter_that_only_cuts_episodes_is_a_step_limit(how: str) -> None:
    mdp = gridworld.compile_env(Windy(LIMITS[how]))
    limit = 10**9 + 1 if how == "in a billion" else 60
    assert mdp.max_episode_steps == limit
    assert mdp.digest() == gridworld.compile_env(Windy()).digest()
    assert mdp.num_states == 9
    longest = gridworld.compile_env(wrappers.TimeLimit(Windy(LIMITS[how]), 200))
    assert (longest.max_episode_steps, longest.num_states) == (min(limit, 200), 9)


class Counting(gym.Wrapper[Any, Any, Any, Any]):
    """A time limit of one's own, around what it wraps."""

    def reset(self, **given: Any) -> Any:
        self.count = 0
        return super().reset(**given)

    def step(self, action: Any) -> Any:
        shown, reward, over, cut, info = super().step(action)
        self.count += 1
        return shown, reward, over, cut or self.count >= 25, info


def test_a_wrapper_that_counts_is_a_step_limit() -> None:
    mdp = gridworld.compile_env(Counting(Windy()))
    assert (mdp.max_episode_steps, mdp.num_states) == (25, 9)
    assert gridworld.compile_env(Counting(Windy(LIMITS["at least"]))).max_episode_steps == 25


class Warmed(gym.Wrapper[Any, Any, Any, Any]):
    """Takes two steps in each reset, which a time limit below it counts."""

    def reset(self, **given: Any) -> Any:
        shown, info = super().reset(**given)
        for _ in range(2):
            shown, *_ = self.env.step(3)
        return shown, info


class Hurried(gym.RewardWrapper[Any, Any]):
    """Pays for the last step in time, by the count of the time limit below it."""

    def reward(self, reward: Any) -> float:
        return float(reward) - (self.get_wrapper_attr("_elapsed_steps") >= 4)


def test_a_time_limit_counts_what_it_sees_and_may_be_read() -> None:
    inside = Warmed(wrappers.TimeLimit(Windy(), 20))
    assert gridworld.compile_env(inside).max_episode_steps == 18
    assert gridworld.compile_env(wrappers.TimeLimit(Warmed(Windy()), 20)).max_episode_steps == 20
    hurried = Hurried(wrappers.TimeLimit(Windy(), 4))
    played(hurried, gridworld.compile_env(hurried))


def worst(env: Windy) -> float:
    """What the last step in time pays less."""
    return -1.0 if env.steps >= env.most else 0.0


class Paying(Windy):
    def __init__(self, pays: Callable[[Windy], float], cuts: Callable[[Windy], bool]) -> None:
        super().__init__(cuts, most=4)
        self.pays = pays

    def step(self, action: int) -> Result:
        shown, reward, over, cut, info = super().step(action)
        return shown, reward + self.pays(self), over, cut, info


CUT = LIMITS["at least"]
STATE: dict[str, tuple[Callable[[Windy], float], Callable[[Windy], bool]]] = {
    "the cut costs": (worst, CUT),
    "a bonus in time": (lambda env: float(env.steps == 2), CUT),
    "a bonus for haste": (lambda env: float(env.at == 8) * (4 - env.steps), CUT),
    "two moments": (lambda env: 0.0, lambda env: env.steps >= env.most or (env.at == 4 and env.steps >= 3)),
    "what it was before": (lambda env: float(env.before == 2), CUT),
    "late in a cell": (lambda env: float(env.at == 4 and env.steps > 2), CUT),
    "early or late in a cell": (lambda env: float(env.at == 1 and not 1 < env.steps < 4), CUT),
}


def played(env: Any, mdp: Mdp, episodes: int = 60) -> None:
    """Each step is one of the outcomes in the tables, and an episode ends where they say."""
    numbers = np.random.default_rng(0)
    for seed in range(episodes):
        shown, _ = env.reset(seed=seed)
        states, over, took = set(mdp.start_states.tolist()), False, 0
        while not over:
            action, took = int(numbers.integers(4)), took + 1
            shown, reward, terminated, truncated, _ = env.step(action)
            over = terminated or truncated
            following = set()
            for state in states:
                for place in np.flatnonzero(mdp.probability[state, action] > 0):
                    to = int(mdp.next_state[state, action, place])
                    fits = mdp.number[to] == shown if mdp.num_numbers == 9 else True
                    if fits and abs(mdp.reward[state, action, place] - reward) < 1e-12:
                        following.add(to)
            states = following
            assert states
            assert over or took == mdp.max_episode_steps or not all(mdp.terminal[state] for state in states)
        assert took == mdp.max_episode_steps or any(mdp.terminal[state] for state in states)


@pytest.mark.parametrize("what", STATE)
def test_a_counter_that_does_more_than_cut_is_state(what: str) -> None:
    mdp = gridworld.compile_env(Paying(*STATE[what]))
    assert mdp.num_states > 9
    played(Paying(*STATE[what]), mdp)


def test_steps_in_which_nothing_reads_the_clock_are_made_at_one_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 4,000 and more that a search at each time would make; the reward for haste is read in two cells."""
    monkeypatch.setattr(checks, "_STEPS", 0)
    made = []

    class Hasty(Windy):
        def step(self, action: int) -> Result:
            made.append(action)
            shown, reward, over, cut, info = super().step(action)
            return shown, reward and float(self.most - self.steps), over, cut, info

    mdp = gridworld.compile_env(Hasty(CUT))
    assert len(made) < 3_000
    assert mdp.num_states > 400
    assert mdp.max_episode_steps == 60
    best = Evaluator(mdp, 1.0, 60).optimal_value
    monkeypatch.setattr(door_search.Counter, "holds", lambda *_: False)  # each step at each time
    slow = gridworld.compile_env(Hasty(CUT))
    assert slow.digest() == mdp.digest()
    assert best > 50


def never(env: Windy) -> bool:
    return False


EVENTS: dict[str, tuple[Callable[[Windy], bool], Callable[[Windy], bool]]] = {
    "in a cell": (lambda env: env.at == 4, never),
    "in a cell, or in time": (lambda env: env.at == 4, CUT),
    "by chance": (lambda env: bool(env.np_random.random() < 0.25), never),
}


@pytest.mark.parametrize("what", EVENTS)
def test_a_truncation_by_the_state_is_an_end(what: str) -> None:
    event, cut = EVENTS[what]

    class Ending(Windy):
        def step(self, action: int) -> Result:
            shown, reward, over, cut, info = super().step(action)
            return shown, reward, bool(over or event(self)), cut, info

    def cutting() -> Windy:
        return Windy(lambda env: event(env) or cut(env))

    mdp, ending = gridworld.compile_env(cutting()), gridworld.compile_env(Ending(cut))
    assert mdp.max_episode_steps == ending.max_episode_steps == (60 if cut is CUT else None)
    assert "what it truncates, other than by a step limit, is an end" in mdp.truth
    assert "truncates" not in ending.truth
    value = Evaluator(mdp, 0.99, 60).optimal_value
    assert value == pytest.approx(Evaluator(ending, 0.99, 60).optimal_value, abs=1e-12)
    played(cutting(), mdp)


def test_a_limit_that_changes_behind_its_back_is_refused() -> None:
    most = [50]

    class Shorter(Windy):
        def step(self, action: int) -> Result:
            most[0] = max(most[0] - 1, 5)
            return super().step(action)

    with pytest.raises(InputError, match=r"none of the outcomes|does not repeat|otherwise"):
        gridworld.compile_env(Shorter(lambda env: env.steps >= most[0]))
