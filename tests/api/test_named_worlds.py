"""A name means the same world everywhere: the one that `env=NAME` has on a command line."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from helpers.support import ROOT
from stable_baselines3 import PPO

import gridworld
from gridworld import InputError, Mdp

NEED_MORE = {"arrays", "built", "enumerated", "gymnasium"}  # env.path, env.builder, env.id
NAMES = sorted({path.stem for path in (ROOT / "conf" / "env").glob("*.yaml")} - NEED_MORE)


def same(first: Mdp, second: Mdp) -> bool:
    arrays = ("next_state", "probability", "reward", "terminal", "start")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in arrays)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_the_world_of_the_command_line(name: str) -> None:
    env = gridworld.compose(f"env={name}").env
    wanted = env.compile()
    limit = env.step_limit(wanted)
    world, batch = gridworld.compile_env(name), gridworld.make_vec_env(name, n_envs=2, observation="none")
    assert same(world, wanted)
    assert same(batch.envs.mdp, wanted)
    assert (world.max_episode_steps, batch.envs.max_episode_steps) == (limit, limit)
    actions = np.zeros(wanted.num_states, dtype=int)
    score, exact = (
        gridworld.evaluate(actions, name),
        gridworld.evaluate(actions, wanted, max_episode_steps=limit),
    )
    assert score == exact
    callback = gridworld.ExactEvalCallback(name)
    assert callback.evaluator is not None
    assert same(callback.evaluator.mdp, wanted)
    assert callback.evaluator.max_episode_steps == limit


def test_a_run_is_scored_on_its_own_world() -> None:
    run = gridworld.train(
        "agent=q_learning", "env=cliff_walking", "evaluation.gamma=0.9", total_timesteps=500, progress=False
    )
    score = gridworld.evaluate(run.policy.greedy, run)
    assert score.value == run.summary["value"]
    assert score.outcome.timeout == pytest.approx(run.summary["timeout_probability"])
    named = gridworld.evaluate(run.policy.greedy, "cliff_walking", gamma=0.9)
    assert named == score


def test_other_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lake, down = gym.make("FrozenLake-v1"), np.ones(16, dtype=int)
    assert gridworld.evaluate(down, "FrozenLake-v1") == gridworld.evaluate(down, lake)
    monkeypatch.chdir(tmp_path)
    Path("mine.txt").write_text("S.G\n")
    assert gridworld.compile_env("mine.txt").num_states == 3
    bare = gridworld.make_vec_env(layout="cliff", n_envs=1).envs.mdp
    assert same(bare, gridworld.compile_mdp(gridworld.load("cliff")))
    assert not same(bare, gridworld.compile_env("cliff"))
    slippery = gridworld.make_vec_env("cliff", n_envs=1, slip=0.1, max_episode_steps=7).envs
    assert slippery.max_episode_steps == 7
    assert same(slippery.mdp, gridworld.compose("env=cliff", "env.slip=0.1").env.compile())
    world = gridworld.compile_mdp(gridworld.load("classic"))
    for batch in (
        gridworld.make_vec_env(world),
        gridworld.make_vec_env(mdp=world),
        gridworld.make_vec(world),
    ):
        assert getattr(batch, "envs", batch).max_episode_steps == 100
    shorter = gridworld.make_vec(gridworld.compile_env("cliff_walking"), max_episode_steps=100)
    assert gridworld.compile_env(shorter).max_episode_steps == 100
    model = PPO("MlpPolicy", gridworld.make_vec_env("river_swim", n_envs=2), n_steps=8, batch_size=16)
    assert gridworld.evaluate(model).outcome == gridworld.evaluate(model, "river_swim").outcome


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: gridworld.evaluate([1], "clif"), "env=clif: no such world; did you mean cliff"),
        (lambda: gridworld.compile_env("nowhere"), "env=nowhere: .* one of aima_4x3, "),
        (
            lambda: gridworld.make_vec_env("cliff", slop=1),
            "slop: is not a setting of env=cliff; did you mean slip",
        ),
        (lambda: gridworld.make_vec_env("river_swim", source="deep_sea"), "source: is not a setting of"),
        (lambda: gridworld.make_vec_env("taxi_v4", slip=0.1), "slip: is not a setting of env=taxi_v4"),
        (lambda: gridworld.compile_mdp("classic"), "layout='classic': must be a Layout, as from `load`"),  # type: ignore[arg-type]
        (lambda: gridworld.evaluate([1], "Nowhere-v1"), "env.id=Nowhere-v1: "),
        (lambda: gridworld.evaluate([1], "arrays"), "env.path: has no value"),
    ],
)
def test_names_that_mean_nothing(call: object, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        call()  # type: ignore[operator]
