"""Tabular agents: the textbook's algorithms, batches as if in sequence, and the exact optimum."""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.support import NO_FILES, ROOT, SHORT, train_in

from gridworld import GridWorldVectorEnv, InputError
from gridworld.agents import Agent, TrainingContext
from gridworld.agents.tabular.algorithms import (
    ExpectedSarsaConfig,
    QLearningConfig,
    SarsaConfig,
    ValueIterationConfig,
)
from gridworld.agents.tabular.td_control import (
    TabularConfig,
    TabularControl,
    TabularControlConfig,
    draw_actions,
    epsilon_greedy,
    update,
)
from gridworld.envs.observations import make_observation

CONTROL = [QLearningConfig, SarsaConfig, ExpectedSarsaConfig]


def seat_of(num_envs: int = 1, seed: int = 0, write: Any = None, **world: Any) -> TrainingContext:
    envs = GridWorldVectorEnv(num_envs, autoreset_mode="SameStep", **world)
    return TrainingContext(envs, make_observation(envs.mdp, "none"), seed, "cpu", write_scalars=write)


def trained(config: TabularControlConfig, steps: int, context: TrainingContext) -> TabularControl:
    agent = config.build(context)
    assert isinstance(agent, TabularControl)
    agent.learn(steps, lambda done: True)
    return agent


def textbook(
    config: TabularControlConfig, steps: int, seed: int, count: int, **world: Any
) -> tuple[Any, ...]:
    """Sutton & Barto's boxes of sections 6.4 to 6.6 in loops; targets are of the table before a batch.

    Returns the table, the visits, and how many episodes were terminated and cut off.
    """
    envs = GridWorldVectorEnv(count, autoreset_mode="SameStep", **world)
    random = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
    q = np.full((envs.mdp.num_states, 4), float(config.initial_value))
    visits, ends, is_sarsa = np.zeros(q.shape, dtype=int), [0, 0], config.algorithm == "sarsa"

    def policy(state: int, done: int) -> Any:
        start, end = config.exploration_initial_eps, config.exploration_final_eps
        return epsilon_greedy(
            q[state], start + (end - start) * min(done / steps / config.exploration_fraction, 1)
        )

    def choose(state: int, done: int) -> int:
        return int(np.searchsorted(policy(state, done).cumsum()[:3], random.random(), side="right"))

    def value(state: int, ahead: int, done: int) -> float:
        if config.algorithm == "q_learning":
            return float(max(q[state]))
        return float(q[state, ahead] if is_sarsa else policy(state, done) @ q[state])

    def step_size(visit: int, done: int) -> float:
        rate = config.learning_rate
        if isinstance(rate, str):
            form, number = rate.split("_")
            rate = float(number) * (1 - done / steps) ** {"lin": 1, "sqrt": 0.5, "quad": 2}[form]
        return float(rate * visit**-config.learning_rate_power)

    states, _ = envs.reset(seed=seed)
    actions = [choose(state, 0) for state in states]
    for done in range(0, steps, count):
        after = done + count
        following, rewards, terminated, truncated, infos = envs.step(np.array(actions))
        over = infos.get("_final_obs", np.zeros(count, dtype=bool))
        reached = [infos["final_obs"][env] if over[env] else following[env] for env in range(count)]
        ahead = [choose(state, after) if is_sarsa else 0 for state in reached]
        targets = [
            reward + (0.0 if is_end else config.gamma * value(state, action, after))
            for state, action, reward, is_end in zip(reached, ahead, rewards, terminated, strict=True)
        ]
        for state, action, target in zip(states, actions, targets, strict=True):
            visits[state, action] += 1
            q[state, action] += step_size(visits[state, action], done) * (target - q[state, action])
        ends[0] += int(terminated.sum())
        ends[1] += int((truncated & ~terminated).sum())
        states = following
        actions = [
            action if is_sarsa and not is_over else choose(state, after)
            for state, action, is_over in zip(states, ahead, over, strict=True)
        ]
    return q, visits, ends


@pytest.mark.parametrize("schema", CONTROL)
@pytest.mark.parametrize(
    ("count", "settings"),
    [
        (1, {"learning_rate": 0.5, "exploration_initial_eps": 0.1, "exploration_final_eps": 0.1}),
        (1, {"learning_rate": "lin_0.8", "initial_value": 1.0, "exploration_fraction": 0.5}),
        (1, {"learning_rate": "sqrt_0.8", "exploration_fraction": 0.5}),
        (1, {"learning_rate": 1.0, "learning_rate_power": 0.6, "gamma": 0.9}),
        (8, {"learning_rate": 0.3, "learning_rate_power": 0.2, "exploration_initial_eps": 0.4}),
    ],
    ids=["constant", "linear", "root", "power", "batch"],
)
def test_it_learns_as_the_textbook(
    schema: type[TabularControlConfig], count: int, settings: dict[str, Any]
) -> None:
    config, steps = schema(**settings), 1000
    world = {"layout": "frozen_lake_4x4", "slip": 0.3, "max_episode_steps": 15}
    context = seat_of(count, seed=7, **world)
    agent = trained(config, steps, context)
    q, visits, ends = textbook(config, steps, 7, count, **world)
    assert min(ends) > 10
    terminal = context.envs.mdp.terminal
    assert not agent.q[terminal].any()
    np.testing.assert_allclose(agent.q[~terminal], q[~terminal], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(agent.visits[~terminal], visits[~terminal])


@pytest.mark.parametrize(("rate", "power", "size"), [(0.1, 0.0, 2), (1.0, 0.0, 64), (1.0, 0.6, 1000)])
def test_a_batch_counts_as_its_transitions_in_sequence(rate: float, power: float, size: int) -> None:
    random = np.random.default_rng(size)
    q, visits = random.normal(size=12), random.integers(3, size=12)
    pairs, targets = random.integers(12, size=size), random.normal(size=size)
    expected, counted = q.tolist(), visits.tolist()
    errors = targets - q[pairs]
    for pair, target in zip(pairs.tolist(), targets.tolist(), strict=True):
        counted[pair] += 1
        expected[pair] += rate * counted[pair] ** -power * (target - expected[pair])
    assert update(q, visits, pairs, targets, rate, power) == pytest.approx(np.mean(errors**2))
    np.testing.assert_allclose(q, expected, rtol=0, atol=1e-12)
    assert visits.tolist() == counted


def test_epsilon_is_spread_over_all_actions_and_the_rest_over_the_best() -> None:
    q = np.array([[0.0, 1.0, 1.0, -1.0], [5.0, 0.0, 0.0, 0.0], [2.0, 2.0, 2.0, 2.0]])
    expected = [[0.05, 0.45, 0.45, 0.05], [0.85, 0.05, 0.05, 0.05], [0.25] * 4]
    np.testing.assert_allclose(epsilon_greedy(q, 0.2), expected)
    states = np.repeat(np.arange(3), 40_000)
    draws = np.random.default_rng(0).random(len(states))
    few = [draw_actions(q, 0.2, states[i : i + 2], draws[i : i + 2]) for i in range(0, len(states), 400)]
    actions = draw_actions(q, 0.2, states, draws)
    assert np.array_equal(np.concatenate(few), actions.reshape(-1, 400)[:, :2].ravel())
    shares = np.bincount(4 * states + actions, minlength=12).reshape(3, 4) / 40_000
    np.testing.assert_allclose(shares, expected, atol=0.01)


@pytest.mark.parametrize("schema", CONTROL)
def test_beliefs_are_the_table_and_the_policy_it_acts_with(schema: type[TabularControlConfig]) -> None:
    agent = schema(exploration_final_eps=0.1).build(seat_of(4))
    assert np.array_equal(agent.snapshot().sampled, np.full((30, 4), 0.25))
    seen = []
    agent.learn(4000, lambda done: seen.append(agent.snapshot()) is not None or done < 2000)
    assert len(seen) == 500  # it stops when told to
    snapshot = agent.snapshot()
    assert snapshot.q is not None
    assert np.array_equal(snapshot.sampled, epsilon_greedy(snapshot.q, 0.55))  # half way from 1 to 0.1
    assert np.array_equal(snapshot.greedy, snapshot.q.argmax(axis=1))
    followed = snapshot.sampled if schema is not QLearningConfig else np.eye(4)[snapshot.greedy]
    np.testing.assert_allclose(snapshot.values, (followed * snapshot.q).sum(axis=1), atol=1e-15)


def test_the_curves_are_means_over_the_last_episodes() -> None:
    written: list[tuple[Mapping[str, float], int]] = []
    config = QLearningConfig(stats_window_size=3, log_interval=5, learning_rate="lin_0.4")
    context = seat_of(1, write=lambda values, step: written.append((dict(values), step)), max_episode_steps=9)
    episodes: list[tuple[float, int]] = []
    advance = context.envs.advance

    def watched(actions: Any) -> Any:
        result = advance(actions)
        episodes.extend(zip(result.returns, result.lengths, strict=True))
        return result

    context.envs.advance = watched  # type: ignore[method-assign]
    trained(config, 1000, context)
    assert len(written) == len(episodes) // 5 > 10
    for number, (values, at) in enumerate(written, 1):
        mean_return, length = np.mean(episodes[5 * number - 3 : 5 * number], axis=0)
        assert values["rollout/ep_rew_mean"] == pytest.approx(mean_return)
        assert values["rollout/ep_len_mean"] == pytest.approx(length)
        assert values["rollout/exploration_rate"] == pytest.approx(1 - 0.95 * at / 1000)
        assert values["train/learning_rate"] == pytest.approx(0.4 * (1 - (at - 1) / 1000))
        assert values["train/loss"] >= 0


def test_value_iteration_is_certified_before_the_first_step(tmp_path: Path) -> None:
    summary = train_in(tmp_path, "agent=value_iteration", "env=four_rooms", *NO_FILES)
    assert summary["certified"]
    assert (summary["timesteps"], summary["first_certified_step"]) == (0, 0)
    assert float(summary["sampled"]["regret"]) == pytest.approx(0, abs=1e-6)  # type: ignore[index]


def test_value_iteration_refuses_a_discount_without_a_finite_optimum(tmp_path: Path) -> None:
    pocket = tmp_path / "pocket.txt"
    pocket.write_text("S.#.\n.G#.\n")
    config = ValueIterationConfig(gamma=1.0)
    assert np.isfinite(config.build(seat_of(layout=pocket)).snapshot().values).all()
    with pytest.raises(InputError, match=r"agent\.gamma=1\.0: no end can be reached from row 1, column 4"):
        config.build(seat_of(layout=pocket, step_reward=-1.0))
    with pytest.raises(InputError, match="may be infinite"):
        config.build(seat_of(layout=pocket, step_reward=1.0))


def saved(config: TabularConfig, path: Path) -> Agent:
    agent = config.build(seat_of(8))
    agent.learn(2000, lambda done: True)
    path.write_bytes(agent.model_file())
    return agent


@pytest.mark.parametrize("schema", [*CONTROL, ValueIterationConfig])
def test_a_model_file_gives_back_the_very_beliefs(schema: type[TabularConfig], tmp_path: Path) -> None:
    agent = saved(schema(), tmp_path / "model.zip")
    again = schema().build(seat_of(8))
    again.load(tmp_path / "model.zip")
    for name, value in vars(agent.snapshot()).items():
        assert np.array_equal(value, getattr(again.snapshot(), name)), name


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("q", np.zeros((3, 4)), r"q is float64 \(3, 4\), it must be float64 \(30, 4\)"),
        ("q", np.zeros((30, 4), dtype=np.float32), "q is float32"),
        ("q", np.full((30, 4), np.nan), "q contains numbers that are not finite"),
        ("q", np.array([{}] * 30), "Object arrays cannot be loaded"),
        ("exploration_rate", np.array(1.5), r"exploration_rate=1\.5: must be from 0 to 1"),
        ("algorithm", np.array("sarsa"), "not a model of q_learning but of sarsa"),
        ("visits", None, "visits is missing"),
    ],
)
def test_a_model_file_that_does_not_fit_is_refused(name: str, array: Any, words: str, tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    agent = saved(QLearningConfig(), path)
    with np.load(path) as archive:
        arrays = dict(archive)
    del arrays[name]
    with path.open("wb") as file:
        np.savez(file, **arrays, **({} if array is None else {name: array}))
    with pytest.raises(InputError, match=words):
        agent.load(path)


def test_whole_runs_never_import_torch(tmp_path: Path) -> None:
    script = str(ROOT / "scripts" / "train.py")
    code = (
        f"import runpy, sys; sys.argv = ['train.py', *{[*SHORT['sarsa'], 'hydra.run.dir=run']}]\n"
        f"runpy.run_path({script!r}, run_name='__main__')\n"
        "import gridworld\n"
        f"gridworld.train(*{SHORT['value_iteration']})\n"
        "assert 'tensorboard' in sys.modules\n"
        "assert not {'torch', 'stable_baselines3'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "run").glob("events.out.tfevents*"))
