"""What training did is counted step by step, as a naive tally of the same walk has it."""

import csv
from pathlib import Path

import numpy as np
import pytest
from helpers.support import SHORT, train_in

from gridworld.engine.environments import Environments
from gridworld.envs.training_env import TrainingVectorEnv
from gridworld.envs.vector_env import GridWorldVectorEnv


@pytest.mark.parametrize(("dtype", "bonus"), [(np.int64, 0.0), (np.int32, 0.0), (np.uint8, 0.7)])
@pytest.mark.parametrize(
    "settings",
    [{"slip": 0.3, "step_reward": -0.1}, {"layout": "maze", "max_episode_steps": 7, "step_reward": -1}],
    ids=["slippery", "cut"],
)
def test_visits_and_returns_are_those_of_a_naive_tally(settings: dict, dtype: type, bonus: float) -> None:
    num_envs, steps = 5, 400
    counted = TrainingVectorEnv(num_envs, exploration_bonus=bonus, **settings)
    plain = GridWorldVectorEnv(num_envs, autoreset_mode="SameStep", **settings)
    counted.reset(seed=3)
    states, _ = plain.reset(seed=3)
    visits = np.zeros((plain.mdp.num_states, 4), dtype=int)
    under_way, length, ended = [0.0] * num_envs, [0] * num_envs, []
    actions = np.random.default_rng(0).integers(4, size=(steps, num_envs)).astype(dtype)
    for chosen in actions:
        for state, action in zip(states, chosen, strict=True):
            visits[state, action] += 1
        pairs = list(zip(states, chosen, strict=True))
        states, rewards, terminated, truncated, _ = plain.step(chosen)
        paid = [reward + bonus / visits[pair] ** 0.5 for reward, pair in zip(rewards, pairs, strict=True)]
        over = []
        for index in range(num_envs):
            under_way[index] += rewards[index]
            length[index] += 1
            if terminated[index] or truncated[index]:
                ended.append(under_way[index])
                over.append((index, under_way[index], length[index]))
                under_way[index], length[index] = 0.0, 0
        step = counted.advance(chosen)
        assert np.array_equal(step.states, states)  # counting changes nothing
        assert np.allclose(step.rewards, paid, rtol=1e-12, atol=0)  # but the bonus, which is in no return
        assert over == list(zip(step.which, step.returns, step.lengths, strict=True))
    assert len(ended) > 20
    assert np.array_equal(counted.visits, visits)
    assert counted.take_returns().mean == pytest.approx(np.mean(ended))
    assert counted.take_returns().mean is None


@pytest.mark.parametrize("bonus", [0.0, 0.7])
def test_a_rollout_counted_in_blocks_is_that_counted_step_by_step(bonus: float) -> None:
    """To the last bit: whether an evaluation comes in the middle of a rollout changes no run."""
    settings: dict = {"slip": 0.3, "step_reward": -0.1, "max_episode_steps": 9}
    rolling, stepping = (TrainingVectorEnv(6, exploration_bonus=bonus, **settings) for _ in range(2))
    for envs in (rolling, stepping):
        envs.reset(seed=3)
    environments = Environments([rolling])
    uniform = np.full((1, rolling.mdp.num_states, 4), 0.25)
    for draws in np.random.default_rng(0).random((2, 40, 6)).astype(np.float32):
        rolled = environments.roll(uniform, draws)
        pairs, rewards = rolled.pairs[:, 0], rolled.rewards[:, 0]
        steps, returns, _ = rolled.ended[0]
        for first, end in ((0, 7), (7, 8), (8, 39), (39, 40)):  # after so many steps somebody looks
            rolling.count(pairs[first:end], rewards[first:end])
            a, b = np.searchsorted(steps, (first, end))
            rolling.add_returns(steps[a:b], returns[a:b])
            paid = [stepping.advance(actions % 4)[1] for actions in pairs[first:end]]
            assert np.array_equal(rewards[first:end], paid)
            assert np.array_equal(rolling.visits, stepping.visits)
            assert rolling.take_returns() == stepping.take_returns()
    environments.put_back()
    assert rolling.visits.sum() == 480
    assert np.array_equal(rolling.states, stepping.states)


def test_an_episode_given_up_is_not_one_that_ended() -> None:
    envs = TrainingVectorEnv(2, step_reward=-1, max_episode_steps=3)
    envs.reset()
    envs.step(np.array([0, 0]))
    envs.reset(options={"reset_mask": np.array([True, False])})
    envs.step(np.array([0, 0]))
    envs.step(np.array([0, 0]))  # the second environment's third step
    assert envs.take_returns().mean == -3
    envs.step(np.array([0, 0]))  # the first one's
    assert envs.take_returns().mean == -3


@pytest.mark.parametrize("agent", ["dqn", "ppo", "qrdqn", "q_learning"])
def test_a_run_tells_what_training_brought_and_where_it_was(agent: str, tmp_path: Path) -> None:
    rewards = ["env.step_reward=-1", "env.trap_reward=0", "env.goal_reward=0"]
    overrides = ["total_timesteps=2000", "env.max_episode_steps=40", *rewards]
    summary = train_in(
        tmp_path, *SHORT[agent], "evaluation.every=32", "n_envs=16", *overrides, "total_timesteps=2000"
    )
    visits = np.load(tmp_path / "visits.npy", allow_pickle=False)
    assert visits.shape == (30, 4)
    assert visits.sum() == summary["timesteps"]
    assert not visits[[16, 22, 15, 10]].any()  # nobody acts where it is over

    with (tmp_path / "curve.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["online_return"] == ""  # before the first step, no episode has ended
    told = [float(row["online_return"]) for row in rows if row["online_return"]]
    assert len(told) > 5
    assert all(-40 <= value <= -1 for value in told)  # minus the episode's length
