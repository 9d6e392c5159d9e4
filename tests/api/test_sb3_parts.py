"""`ExactEvalCallback` and `make_vec_env` in plain SB3 code."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import gridworld
from gridworld import InputError
from gridworld.world.layout import parse
from gridworld.world.metrics import METRICS

ENV = "GridWorld-v0"


def model_of(algorithm: Any, **settings: Any) -> Any:
    small = {"buffer_size": 500, "learning_starts": 50} if algorithm is DQN else {"n_steps": 64}
    return algorithm("MlpPolicy", gridworld.OneHotObservation(gym.make(ENV)), seed=0, **small, **settings)


class Scores(BaseCallback):
    """What `Evaluator` says of the actions that `predict` gives, every `every` steps."""

    def __init__(self, every: int) -> None:
        super().__init__()
        self.every = every
        self.found: dict[int, gridworld.Score] = {}
        self.evaluator = gridworld.Evaluator(gridworld.GridWorldEnv().mdp, 0.99, 100)

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            actions, _ = self.model.predict(np.eye(30, dtype=np.float32), deterministic=True)
            self.found[self.num_timesteps] = self.evaluator.score(np.eye(4)[actions])
        return True


@pytest.mark.parametrize("algorithm", [DQN, PPO])
def test_its_scores_are_those_of_the_evaluator_and_training_goes_on_as_without_it(
    algorithm: Any, tmp_path: Path
) -> None:
    model = model_of(algorithm)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    exact, asked = gridworld.ExactEvalCallback(every=100), Scores(100)
    model.learn(640, callback=[exact, asked])
    found = exact.evaluations
    assert found["step"].tolist() == [0, 100, 200, 300, 400, 500, 600, 640]
    for index, step in enumerate(found["step"][1:-1], start=1):
        score = asked.found[step]
        for metric in METRICS:
            assert found[metric.name][index] == metric.of(score), (metric.name, step)
    assert found["regret"][-1] == gridworld.evaluate(model).regret

    model.logger.close()
    logged = np.genfromtxt(tmp_path / "progress.csv", delimiter=",", names=True, deletechars="", dtype=float)
    by_step = logged[~np.isnan(logged["eval/regret"])]
    assert np.allclose(by_step["eval/regret"], found["regret"])
    assert np.allclose(by_step["eval/mean_reward"], found["return"])
    assert np.allclose(by_step["eval/mean_ep_length"], found["length"])
    assert np.allclose(by_step["eval/success_rate"], found["goal_probability"])
    without = model_of(algorithm).learn(640)
    for one, other in zip(model.policy.parameters(), without.policy.parameters(), strict=True):
        assert bool((one == other).all())


def certifying(**settings: Any) -> tuple[Any, gridworld.ExactEvalCallback]:
    """A model and a callback in a world where one rollout of PPO is enough."""
    envs = gridworld.make_vec_env(parse("S..\n...\n..G", "small"), n_envs=32)
    model = PPO("MlpPolicy", envs, n_steps=32, batch_size=256, learning_rate=0.01, gamma=0.9, seed=0)
    return model, gridworld.ExactEvalCallback(every=1024, **settings)


def test_it_keeps_the_best_model_and_stops_at_certificates(tmp_path: Path) -> None:
    model, callback = certifying(best_model_save_path=tmp_path / "best", log_path=tmp_path, stop_after=2)
    model.learn(60_000, callback=callback)
    found = callback.evaluations
    assert found["certified"][-2:].all()
    assert callback.stopped_at == found["step"][-1] < 60_000
    best = PPO.load(tmp_path / "best" / "best_model.zip")
    score = gridworld.evaluate(best, model.get_env())
    assert max(score.regret, 0) == callback.best_regret == np.maximum(found["regret"], 0).min()

    kept = np.load(tmp_path / "evaluations.npz")
    assert np.array_equal(kept["timesteps"], found["step"])
    assert np.array_equal(kept["results"], found["return"][:, None])
    assert np.array_equal(kept["ep_lengths"], found["length"][:, None])
    assert np.array_equal(kept["regret"], found["regret"])


def normalised(kind: str = "coordinates") -> VecNormalize:
    if kind == "dict":
        return VecNormalize(DummyVecEnv([AsDict]), norm_reward=False)
    return VecNormalize(gridworld.make_vec_env("classic", n_envs=4, observation=kind))


class AsDict(gym.ObservationWrapper[Any, Any, Any]):
    """The coordinates as an entry of a Dict."""

    def __init__(self) -> None:
        super().__init__(gridworld.CoordinateObservation(gym.make(ENV)))
        self.observation_space = gym.spaces.Dict({"place": self.env.observation_space})

    def observation(self, observation: Any) -> Any:
        return {"place": observation}


@pytest.mark.parametrize("kind", ["coordinates", "dict"])
def test_statistics_of_vec_normalize_belong_to_the_model(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    envs = normalised(kind)
    callback = gridworld.ExactEvalCallback(every=64, best_model_save_path=tmp_path)
    model = PPO("MultiInputPolicy" if kind == "dict" else "MlpPolicy", envs, n_steps=64, seed=0)
    model.learn(256, callback=callback)
    for other in (envs.venv, normalised(kind)):
        with pytest.raises(InputError, match="VecNormalize, whose statistics the environment does not"):
            gridworld.evaluate(model, other)
        with pytest.raises((InputError, AssertionError), match="VecNormalize"):
            model.learn(64, callback=gridworld.ExactEvalCallback(envs.venv))
    assert gridworld.evaluate(model).regret == callback.evaluations["regret"][-1]

    best = PPO.load(tmp_path / "best_model.zip")
    capsys.readouterr()
    again = VecNormalize.load(str(tmp_path / "vecnormalize.pkl"), normalised(kind).venv)
    assert max(gridworld.evaluate(best, again).regret, 0) == callback.best_regret
    assert not capsys.readouterr().err
    model.save(tmp_path / "last.zip")
    gridworld.evaluate(PPO.load(tmp_path / "last.zip"), envs.venv)
    assert "if it was trained under VecNormalize, give env=VecNormalize.load(" in capsys.readouterr().err


def test_rewards_alone_are_normalised_without_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    envs = VecNormalize(gridworld.make_vec_env("classic", n_envs=4), norm_obs=False)
    model = PPO("MlpPolicy", envs, n_steps=32, seed=0).learn(128)
    assert gridworld.evaluate(model, "classic") == gridworld.evaluate(model)
    assert not capsys.readouterr().err


def test_a_second_learn_goes_on_in_the_same_evaluations() -> None:
    model, callback = model_of(PPO), gridworld.ExactEvalCallback(every=64)
    model.learn(128, callback=callback)
    model.learn(128, callback=callback, reset_num_timesteps=False)
    assert callback.evaluations["step"].tolist() == [0, 64, 128, 192, 256]


def test_another_world_to_evaluate_on() -> None:
    slippery = gridworld.compile_mdp(gridworld.load("classic"), slip=0.3)
    callback = gridworld.ExactEvalCallback(env=slippery, max_episode_steps=20)
    model = model_of(PPO)
    model.learn(64, callback=callback)
    score = gridworld.evaluate(model, slippery, max_episode_steps=20)
    assert callback.evaluations["value"][-1] == score.value
    assert callback.evaluations["length"][-1] == score.outcome.expected_length <= 20


def test_what_it_refuses() -> None:
    for wrong in ({"every": 0}, {"stop_after": 0}, {"gamma": 1.5}, {"env": 3}, {"env": "nowhere"}):
        with pytest.raises(InputError):
            gridworld.ExactEvalCallback(**wrong)
    memory = RecurrentPPO("MlpLstmPolicy", gridworld.OneHotObservation(gym.make(ENV)), n_steps=128)
    with pytest.raises(InputError, match="keeps memory"):
        memory.learn(100, callback=gridworld.ExactEvalCallback())
    with pytest.raises(InputError, match="its states are continuous"):
        PPO("MlpPolicy", "CartPole-v1", n_steps=64).learn(64, callback=gridworld.ExactEvalCallback())


def test_the_batch_is_one_for_sb3() -> None:
    envs = gridworld.make_vec_env("aima_4x3", n_envs=3, observation="coordinates", slip=0.2, seed=5)
    assert isinstance(envs, VecEnv)
    assert envs.reset().shape == (3, 2)
    assert (envs.envs.mdp.slip, envs.num_envs) == (0.2, 3)
    assert gridworld.make_vec_env(observation="image", cell_size=7).observation_space.shape == (3, 49, 56)

    def walk(seed: int) -> list[float]:
        batch = gridworld.make_vec_env(layout="frozen_lake_8x8", n_envs=4, slip=2 / 3, seed=seed)
        batch.reset()
        return [float(batch.step(np.full(4, 1))[0].argmax()) for _ in range(30)]

    assert walk(1) == walk(1) != walk(2)
