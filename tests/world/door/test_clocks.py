"""Rules that read a count of steps in one way or another: optima as a recursion over copies finds them."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import gridworld

LIMIT, GAMMA = 9, 0.99


class Corridor(gym.Env[Any, Any]):
    """Four cells; the rule says what is paid in the last one, by what it knows of the time."""

    observation_space = gym.spaces.Discrete(4)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, rule: Callable[["Corridor", int], Any]) -> None:
        self.rule = rule

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[int, Any]:
        super().reset(seed=seed)
        self.x = self.t = 0
        self.held: Any = None
        return self.x, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, Any]:
        self.x = min(max(self.x + 2 * int(action) - 1, 0), 3)
        self.t += 1
        is_won = self.rule(self, int(action))
        is_end = self.x == 3
        return self.x, float(is_won) if is_end else 0.0, is_end, self.t >= LIMIT, {}


def held(value: Callable[[Corridor, int], Any], then: Callable[[Corridor], Any]) -> Any:
    """A rule that keeps something of the time, and reads it later."""

    def rule(env: Corridor, action: int) -> Any:
        env.held = value(env, action)
        return then(env)

    return rule


RULES = {
    "fades": lambda env, action: 1 / (1 + env.t),
    "odd": lambda env, action: env.t % 2,
    "window": lambda env, action: 4 <= env.t <= 6,
    "not_three": lambda env, action: env.t != 3,
    "among": lambda env, action: env.t in (5, 7),
    "by_action": lambda env, action: (env.t if action else 5) > 5,
    "left": lambda env, action: LIMIT - env.t < 3,
    "number": lambda env, action: isinstance(env.t, int) and env.t > 4,
    "numpy": lambda env, action: np.minimum(env.t, 6),
    "stage": held(lambda env, _: min(env.t, 5), lambda env: env.held == 5),
    "last_left": held(lambda env, a: env.held if a else env.t, lambda env: env.held == 2),
    "since": held(lambda env, a: (env.held or 0) if a else env.t, lambda env: env.t - env.held == 3),
    "mode": held(lambda env, _: "late" if env.t > 5 else "early", lambda env: env.held == "late"),
    "log": held(lambda env, a: (env.held or ()) + (() if a else (env.t,)), lambda env: len(env.held) == 2),
}


def best(env: Corridor) -> float:
    """The largest discounted return from here."""
    returns = []
    for action in range(2):
        after = copy.deepcopy(env)
        _, paid, *over, _ = after.step(action)
        returns.append(paid + (0.0 if any(over) else GAMMA * best(after)))
    return max(returns)


@pytest.mark.parametrize("name", RULES)
def test_a_rule_that_reads_the_time_is_followed(name: str) -> None:
    mdp = gridworld.compile_env(Corridor(RULES[name]))
    values = np.zeros(mdp.num_states)
    for _ in range(mdp.max_episode_steps or LIMIT):  # not `value_iteration`, whose episodes have no limit
        values = (mdp.probability * (mdp.reward + GAMMA * values[mdp.next_state])).sum(axis=2).max(axis=1)
        values[mdp.terminal] = 0.0
    env = Corridor(RULES[name])
    env.reset()
    assert values @ mdp.start == pytest.approx(best(env), abs=1e-12)
    assert best(env) > 0
