"""Environments of a user's own, named on the command line: found, trained on as they are, gone on with."""

import json
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from helpers.resuming import stopped_after
from helpers.support import configure, script
from stable_baselines3 import A2C, DQN

import gridworld

# Gymnasium's tutorial in our words: a goal that is drawn until it is not the agent's cell; the same by one
# draw; what shows several numbers, and what shows images.
MODULE = """
import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Goals(gym.Env):
    def __init__(self, size=3):
        self.size = size
        place = spaces.Box(0, size - 1, (2,), dtype=int)
        self.observation_space = spaces.Dict({"agent": place, "target": place})
        self.action_space = spaces.Discrete(4)
        self.moves = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.agent = self.np_random.integers(0, self.size, 2)
        self.target = self.agent
        while np.array_equal(self.target, self.agent):
            self.target = self.np_random.integers(0, self.size, 2)
        return {"agent": self.agent, "target": self.target}, {}

    def step(self, action):
        self.agent = np.clip(self.agent + self.moves[action], 0, self.size - 1)
        is_there = np.array_equal(self.agent, self.target)
        return {"agent": self.agent, "target": self.target}, float(is_there), is_there, False, {}


class Corridor(gym.Env):
    action_space = spaces.Discrete(2)
    observation_space = spaces.MultiDiscrete([4, 2])

    def shown(self):
        return np.array([self.at, self.way])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.way = 0, int(self.np_random.integers(2))
        return self.shown(), {}

    def step(self, action):
        self.at = max(0, min(3, self.at + (1 if action == self.way else -1)))
        return self.shown(), float(self.at == 3), self.at == 3, False, {}


class Pixels(Corridor):
    observation_space = spaces.Box(0, 255, (8, 6, 3), np.uint8)

    def shown(self):
        pixels = np.zeros((8, 6, 3), np.uint8)
        pixels[self.at, self.way] = 255
        return pixels


class Drawn(Goals):
    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        cells = self.np_random.permutation(self.size**2)[:2]
        self.agent, self.target = (np.array(divmod(cell, self.size)) for cell in cells)
        return {"agent": self.agent, "target": self.target}, {}


def small():
    return Drawn(2)


def shortened(limit=20):
    return gym.wrappers.TimeLimit(small(), limit)


NUMBER = 3
"""
SHORT = (
    "total_timesteps=1000",
    "evaluation.every=250",
    "n_envs=16",
    "recording.gif=false",
    "recording.frames=false",
)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the user's module, which nothing else finds afterwards."""
    (tmp_path / "goals.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "states", "limit"),
    [
        (["env=goals:Goals"], 81, 100),
        (["env=goals.py:small"], 16, 100),
        (["env=goals:Drawn", "env.kwargs.size=2"], 16, 100),
        (["env=goals:shortened", "env.kwargs.limit=7"], 16, 7),
        (["env=goals:Corridor", "env.ignore=[way]"], None, None),
        (["env=FrozenLake-v1"], 16, 100),
    ],
)
def test_a_name_is_enough(words: list[str], states: int | None, limit: int | None, here: Path) -> None:
    env = configure("agent=dqn", *words).env
    if states is None:
        with pytest.raises(gridworld.InputError, match=r"depends on way, which env\.ignore leaves out"):
            env.compile()
        return
    mdp = env.compile()
    assert (mdp.num_states, env.step_limit(mdp)) == (states, limit)


@pytest.mark.slow
def test_a_file_may_have_the_name_of_another_module(here: Path) -> None:
    for name in ("gridworld.py", "json.py", "test.py"):
        (here / name).write_text(MODULE)
        assert gridworld.compile_env(f"{name}:small").num_states == 16
    assert gridworld.compile_mdp is sys.modules["gridworld"].compile_mdp


def test_bounds_and_the_users_word(here: Path) -> None:
    with pytest.raises(gridworld.InputError, match="more than 50 states can be reached"):
        gridworld.compile_env("goals:Goals", most_states=50)
    mdp = gridworld.compile_env("goals:small", state=lambda env: (env.agent.tolist(), env.target.tolist()))
    assert mdp.num_states == 16
    assert "state= says all" in mdp.truth
    with pytest.raises(gridworld.InputError, match=r"must be a list of names, \['moves'\]"):
        gridworld.compile_env("goals:Goals", ignore="moves")
    with pytest.raises(gridworld.InputError, match="classic: is a world with tables of its own"):
        gridworld.compile_env("classic", ignore=["moves"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "agent", "kind"), [("small", "dqn", DQN), ("Corridor", "a2c", A2C), ("Pixels", "dqn", DQN)]
)
def test_a_model_fits_the_environment_that_it_was_trained_on(
    name: str, agent: str, kind: Any, here: Path
) -> None:
    done = script(
        "train.py",
        f"agent={agent}",
        f"env=goals:{name}",
        "observation=own",
        "hydra.run.dir=run",
        *SHORT,
        cwd=here,
    )
    assert done.returncode == 0, done.stderr
    run = gridworld.open_run("run")
    sys.path.append(str(here))
    env: gym.Env[Any, Any] = getattr(import_module("goals"), name)()
    model = kind.load("run/model.zip", env=env)  # which compares the spaces
    own = gridworld.evaluate(model, env)
    assert own.regret == pytest.approx(run.summary["regret"], abs=1e-9)
    assert gridworld.evaluate(model, f"goals:{name}").regret == own.regret == gridworld.evaluate(run).regret
    model.learn(64)


@pytest.mark.slow
def test_a_run_on_a_dict_goes_on_as_if_it_had_not_stopped(here: Path) -> None:
    words = ("agent=dqn", "env=goals:small", "observation=own", "checkpoint.every=300", *SHORT)
    assert script("train.py", *words, "hydra.run.dir=whole", cwd=here).returncode == 0
    stopped_after(2, here / "part", *words)
    done = script("train.py", "resume=part", cwd=here)
    assert done.returncode == 0, done.stderr
    curves = [(here / name / "curve.csv").read_text() for name in ("whole", "part")]
    assert curves[0] == curves[1]
    weights = [DQN.load(here / name / "model.zip").get_parameters()["policy"] for name in ("whole", "part")]
    assert all(np.array_equal(weights[0][key], weights[1][key]) for key in weights[0])


@pytest.mark.slow
def test_a_run_of_somebody_elses_is_opened_without_its_module(here: Path) -> None:
    """The current folder is searched for names that were typed, never for those of a run."""
    words = ("agent=q_learning", "env=goals:small", "hydra.run.dir=run", *SHORT)
    assert script("train.py", *words, cwd=here).returncode == 0
    (here / "goals.py").write_text("open('was_imported', 'w').close()\n" + MODULE)
    for command in (
        ["evaluate.py", "run"],
        ["diagnose.py", "run"],
        ["record.py", "run"],
        ["train.py", "resume=run"],
    ):
        done = script(*command, cwd=here)
        assert done.returncode in (0, 2), done.stderr
        assert not (here / "was_imported").exists(), command


@pytest.mark.slow
def test_a_sweep_over_environments(here: Path) -> None:
    words = ("-m", "agent=q_learning", "env=goals:small,goals:Corridor", "hydra.sweep.dir=swept", *SHORT)
    done = script("train.py", *words, cwd=here)
    assert done.returncode == 0, done.stderr
    found = sorted(json.loads(file.read_text())["env"] for file in here.glob("swept/*/summary.json"))
    assert found == ["goals:Corridor", "goals:small"]
