"""`gridworld.evaluate` on tables and on models of plain SB3 code, against asking their `predict`."""

import re
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.support import SHORT
from sb3_contrib import QRDQN, TRPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

import gridworld
from gridworld import InputError, compile_mdp, load

WORLD = compile_mdp(load("aima_4x3"), slip=0.2, step_reward=-0.04)
RAW = "GridWorld-v0"
SMALL: dict[type, dict[str, Any]] = {
    DQN: {"buffer_size": 500, "learning_starts": 20},
    QRDQN: {"buffer_size": 500, "learning_starts": 20},
    PPO: {"n_steps": 64},
    TRPO: {"n_steps": 128},
    A2C: {},
}
WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "none": lambda env: env,
    "one_hot": gridworld.OneHotObservation,
    "coordinates": gridworld.CoordinateObservation,
}


def expected(policy: Any, **others: Any) -> gridworld.Score:
    return gridworld.Evaluator(WORLD, others.get("gamma", 0.99), others.get("limit", 100)).score(policy)


def trained(algorithm: Any, env: Any, policy: str = "MlpPolicy", **settings: Any) -> Any:
    return algorithm(policy, env, seed=0, **SMALL[algorithm], **settings).learn(200)


def by_predict(model: Any, observations: Any) -> list[int]:
    return [int(model.predict(each, deterministic=True)[0]) for each in observations]


def test_tables() -> None:
    actions = np.arange(12) % 4
    table = np.eye(4)[actions]
    assert gridworld.evaluate(actions, WORLD) == expected(table)
    assert gridworld.evaluate(actions.tolist(), WORLD, gamma=0.9) == expected(table, gamma=0.9)
    uniform = np.full((12, 4), 0.25)
    assert gridworld.evaluate(uniform, WORLD, max_episode_steps=7) == expected(uniform, limit=7)
    best = gridworld.Evaluator(WORLD, 0.99, 100).solution.q
    assert gridworld.evaluate(q=best, env=WORLD).certified
    assert gridworld.evaluate(q=table, env=WORLD) == expected(table)


@pytest.mark.parametrize(
    ("algorithm", "kind"),
    [
        *[(PPO, kind) for kind in WRAPPERS],
        *[(DQN, "none"), (QRDQN, "one_hot"), (TRPO, "coordinates"), (A2C, "none")],
    ],
)
def test_models_of_plain_sb3(algorithm: Any, kind: str) -> None:
    env = WRAPPERS[kind](gym.make(RAW, mdp=WORLD))
    model = trained(algorithm, env)
    rows = gridworld.make_vec_env(observation=kind, mdp=WORLD).observation.table()
    score = gridworld.evaluate(by_predict(model, rows), WORLD)
    assert gridworld.evaluate(model) == gridworld.evaluate(model, env) == score
    assert gridworld.evaluate(model, WORLD) == gridworld.evaluate(model.policy, WORLD) == score
    random = gridworld.evaluate(model, deterministic=False)
    assert random != score
    assert 0 < random.outcome.goal < 1


@pytest.mark.parametrize("agent", ["dqn", "ppo"])
def test_a_run_scores_as_its_own_summary(agent: str) -> None:
    run = gridworld.train(*SHORT[agent], progress=False)
    for deterministic, summary in ((True, run.summary), (False, run.summary["sampled"])):
        score = gridworld.evaluate(run.model, deterministic=deterministic)
        assert score.value == pytest.approx(summary["value"], abs=1e-6)
        assert score.outcome.goal == pytest.approx(summary["goal_probability"], abs=1e-6)
    assert gridworld.evaluate(run.policy.sampled, "classic").value == run.summary["sampled"]["value"]


def refused(*given: Any, **named: Any) -> str:
    with pytest.raises(InputError) as told:
        gridworld.evaluate(*given, **named)
    assert "\n" not in str(told.value)
    return str(told.value)


@pytest.mark.parametrize(
    ("given", "named", "sentence"),
    [
        (([1] * 29, "classic"), {}, "has shape (29,); classic has 30 states and 4 actions"),
        (([4] * 30, "classic"), {}, "state 0 has the action 4; must be 0 (up)"),
        (([0.5] * 30, "classic"), {}, "state 0 has the action 0.5"),
        ((np.ones((30, 4)), "classic"), {}, "not probability distributions; give Q values as q="),
        (
            (),
            {"q": [1] * 30, "env": "classic"},
            "q: has shape (30,); classic has 30 states and 4 actions, so it must be (30, 4)",
        ),
        ((), {"q": np.full((30, 4), np.nan), "env": "classic"}, "q: contains NaN"),
        ((), {"env": "classic"}, "give either a model or table"),
        (("abc", "classic"), {}, "str is neither a model, an opened run nor a table of numbers"),
        (([1] * 30,), {}, "env: is required"),
        (([1] * 30, "nope"), {}, "env=nope: no such world"),
        (([1] * 30, 3), {}, "env: int contains neither a GridWorld"),
        (([1] * 30, "classic"), {"gamma": 2}, "gamma=2: must be from 0 to 1"),
        (([1] * 30, "classic"), {"max_episode_steps": 0}, "max_episode_steps"),
    ],
)
def test_refused_tables(given: tuple[Any, ...], named: dict[str, Any], sentence: str) -> None:
    assert re.search(re.escape(sentence), refused(*given, **named))


def test_refused_models() -> None:
    one_hot = gridworld.OneHotObservation(gym.make(RAW))
    model = PPO("MlpPolicy", one_hot, n_steps=64)
    assert "which no observation of this world (121 states) has" in refused(model, "four_rooms")
    assert "contains neither a GridWorld" in refused(model, gym.make("CartPole-v1"))
    other = PPO("MlpPolicy", "CartPole-v1", n_steps=64)
    assert "acts in Discrete(2)" in refused(other, "classic")
    assert "contains neither a GridWorld" in refused(other)
    memory = RecurrentPPO("MlpLstmPolicy", one_hot, n_steps=128)
    assert "keeps memory between steps" in refused(memory)
    for stateful in (
        gym.wrappers.TimeAwareObservation(one_hot),
        gym.wrappers.FrameStackObservation(one_hot, 2),
        gym.wrappers.NormalizeObservation(one_hot),
    ):
        assert "makes observations that depend on more than the state" in refused(model, stateful)
    stacked = VecFrameStack(DummyVecEnv([lambda: gridworld.CoordinateObservation(gym.make(RAW))]), 3)
    assert "VecFrameStack makes observations that depend on more" in refused(
        PPO("MlpPolicy", stacked, n_steps=64)
    )
