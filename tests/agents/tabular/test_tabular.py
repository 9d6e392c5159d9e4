"""Tabular agents: the textbook's algorithms, batches as if in sequence, and the exact optimum."""

import subprocess
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.support import ROOT, SHORT, train_in

from gridworld import GridWorldEnv, GridWorldVectorEnv, InputError
from gridworld.agents import Agent, TrainingContext
from gridworld.agents.tabular import build
from gridworld.agents.tabular.algorithms import (
    ExpectedSarsaConfig,
    QLearningConfig,
    SarsaConfig,
    ValueIterationConfig,
)
from gridworld.agents.tabular.settings import TabularConfig
from gridworld.agents.tabular.td_control import (
    TabularControl,
    TabularControlConfig,
    draw_actions,
    epsilon_greedy,
    update,
)
from gridworld.envs.observations import make_observation
from gridworld.world.layout import shipped_layouts
from gridworld.world.solver import value_iteration

CONTROL = [QLearningConfig, SarsaConfig, ExpectedSarsaConfig]


def seat_of(num_envs: int = 1, seed: int = 0, write: Any = None, **world: Any) -> TrainingContext:
    envs = GridWorldVectorEnv(num_envs, autoreset_mode="SameStep", **world)
    return TrainingContext(envs, make_observation(envs.mdp, "none"), seed, "cpu", write_scalars=write)


def trained(config: TabularControlConfig, steps: int, context: TrainingContext) -> TabularControl:
    agent = build(config, context)
    assert isinstance(agent, TabularControl)
    agent.learn(steps, lambda done: True)
    return agent


class Textbook:
    """Sutton & Barto's boxes of sections 6.4 to 6.6, on one environment, with a dictionary and loops."""

    def __init__(self, config: TabularControlConfig, steps: int, seed: int, cut: int, **world: Any) -> None:
        self.config, self.steps, self.cut = config, steps, cut
        self.env = GridWorldEnv(**world)
        self.random = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
        self.q: dict[tuple[int, int], float] = {}
        self.visits: dict[tuple[int, int], int] = {}
        for state in range(self.env.num_rows * self.env.num_cols):
            for action in range(4):
                self.q[state, action] = config.initial_value
                self.visits[state, action] = 0
        self.truncations = self.terminations = 0
        self.learn(seed)

    def policy(self, state: int, done: int) -> list[float]:
        config = self.config
        progress = min(done / self.steps / config.exploration_fraction, 1.0)
        start, end = config.exploration_initial_eps, config.exploration_final_eps
        epsilon = start + (end - start) * progress
        values = [self.q[state, action] for action in range(4)]
        ties = values.count(max(values))
        return [epsilon / 4 + ((1 - epsilon) / ties if value == max(values) else 0.0) for value in values]

    def choose(self, state: int, done: int) -> int:
        draw, total = self.random.random(), 0.0
        for action, probability in enumerate(self.policy(state, done)[:3]):
            total += probability
            if draw < total:
                return action
        return 3

    def step_size(self, pair: tuple[int, int], done: int) -> float:
        rate = self.config.learning_rate
        if isinstance(rate, str):
            form, number = rate.split("_")
            rate = float(number) * (1 - done / self.steps) ** {"lin": 1, "sqrt": 0.5, "quad": 2}[form]
        self.visits[pair] += 1
        visits = np.array([self.visits[pair]], dtype=np.float64)  # numbers alone have another power function
        return rate * float((visits**-self.config.learning_rate_power)[0])

    def learn(self, seed: int) -> None:
        state, _ = self.env.reset(seed=seed)
        action, length = self.choose(state, 0), 0
        for done in range(self.steps):
            following, reward, terminated, _, _ = self.env.step(action)
            length += 1
            truncated = length == self.cut and not terminated
            ahead = self.choose(following, done + 1) if self.config.algorithm == "sarsa" else 0
            target = reward
            if not terminated:
                target = reward + self.config.gamma * self.value(following, ahead, done + 1)
            pair = state, action
            self.q[pair] += self.step_size(pair, done) * (target - self.q[pair])
            state = following
            if over := terminated or truncated:
                state, _ = self.env.reset()
                length = 0
            self.terminations += terminated
            self.truncations += truncated
            goes_on = self.config.algorithm == "sarsa" and not over
            action = ahead if goes_on else self.choose(state, done + 1)

    def value(self, state: int, ahead: int, done: int) -> float:
        values = [self.q[state, action] for action in range(4)]
        if self.config.algorithm == "q_learning":
            return max(values)
        if self.config.algorithm == "sarsa":
            return self.q[state, ahead]
        total = 0.0
        for probability, value in zip(self.policy(state, done), values, strict=True):
            total += probability * value
        return total


@pytest.mark.parametrize("schema", CONTROL)
@pytest.mark.parametrize(
    "settings",
    [
        {"learning_rate": 0.5, "exploration_initial_eps": 0.1, "exploration_final_eps": 0.1},
        {"learning_rate": "lin_0.8", "initial_value": 1.0, "exploration_fraction": 0.5},
        {"learning_rate": "sqrt_0.8", "exploration_fraction": 0.5},
        {"learning_rate": 1.0, "learning_rate_power": 0.6, "gamma": 0.9},
    ],
    ids=["constant", "linear", "root", "power"],
)
def test_one_environment_is_the_textbook(
    schema: type[TabularControlConfig], settings: dict[str, Any]
) -> None:
    config, steps, world = schema(**settings), 3000, {"layout": "frozen_lake_4x4", "slip": 0.3}
    agent = trained(config, steps, seat_of(seed=7, max_episode_steps=15, **world))
    book = Textbook(config, steps, seed=7, cut=15, **world)
    assert min(book.truncations, book.terminations) > 20
    terminal = set(book.env.terminal_states)
    for (state, action), value in book.q.items():
        if state in terminal:
            assert agent.q[state, action] == 0
        else:
            assert agent.q[state, action] == pytest.approx(value, rel=1e-9, abs=1e-12)
            assert agent.visits[state, action] == book.visits[state, action]


@pytest.mark.parametrize("power", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("rate", [0.1, 1.0])
@pytest.mark.parametrize("size", [1, 2, 64, 1000])
def test_a_batch_counts_as_its_transitions_in_sequence(rate: float, power: float, size: int) -> None:
    random = np.random.default_rng(size)
    q, visits = random.normal(size=12), random.integers(3, size=12)
    pairs, targets = random.integers(12, size=size), random.normal(size=size)
    expected, counted = q.tolist(), visits.tolist()
    errors = [target - q[pair] for pair, target in zip(pairs, targets, strict=True)]
    for pair, target in zip(pairs.tolist(), targets.tolist(), strict=True):
        counted[pair] += 1
        expected[pair] += rate * counted[pair] ** -power * (target - expected[pair])
    loss = update(q, visits, pairs, targets, rate, power)
    assert loss == pytest.approx(np.mean(np.square(errors)))
    np.testing.assert_allclose(q, expected, rtol=0, atol=1e-12)
    assert visits.tolist() == counted


@pytest.mark.parametrize("schema", CONTROL)
def test_a_batch_learns_from_every_environment(schema: type[TabularControlConfig]) -> None:
    """Against a loop over environments, in which SARSA's next action is the one that is really taken."""
    config = schema(learning_rate=0.3, learning_rate_power=0.2, exploration_initial_eps=0.4)
    steps, count = 320, 8
    world = {"slip": 0.2, "max_episode_steps": 7}
    agent = trained(config, steps, seat_of(count, seed=3, **world))

    envs = GridWorldVectorEnv(count, autoreset_mode="SameStep", **world)
    random = np.random.default_rng(np.random.SeedSequence(3).spawn(1)[0])
    q, visits = np.zeros((30, 4)), np.zeros((30, 4), dtype=int)
    states, _ = envs.reset(seed=3)
    actions = draw_actions(q, 0.4, states, random.random(count))
    for done in range(0, steps, count):
        following, rewards, terminated, _, infos = envs.step(actions)
        reached = following.copy()
        if infos:
            reached[infos["_final_obs"]] = infos["final_obs"][infos["_final_obs"]]
        epsilon = 0.4 + (0.05 - 0.4) * (done + count) / steps
        before = q.copy()
        next_actions = np.zeros(count, dtype=int)
        if config.algorithm == "sarsa":
            next_actions = draw_actions(before, epsilon, reached, random.random(count))
        for env in range(count):
            row = before[reached[env]]
            ahead = {
                "q_learning": row.max(),
                "sarsa": row[next_actions[env]],
                "expected_sarsa": float(epsilon_greedy(row, epsilon) @ row),
            }[config.algorithm]
            pair = states[env], actions[env]
            visits[pair] += 1
            target = rewards[env] + 0.99 * (0.0 if terminated[env] else ahead)
            q[pair] += 0.3 * visits[pair] ** -0.2 * (target - q[pair])
        if config.algorithm != "sarsa":
            actions = draw_actions(q, epsilon, following, random.random(count))
        else:
            actions = next_actions
            if over := infos.get("_final_obs", np.zeros(count, dtype=bool)).nonzero()[0].tolist():
                actions[over] = draw_actions(q, epsilon, following[over], random.random(len(over)))
        states = following
    assert visits.sum() == steps
    np.testing.assert_array_equal(agent.visits, visits)
    np.testing.assert_allclose(agent.q, q, rtol=0, atol=1e-12)


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
    agent = build(schema(exploration_final_eps=0.1), seat_of(4))
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


@pytest.mark.parametrize(
    ("slip", "gamma", "power", "num_envs", "steps", "bound"),
    [(0.0, 0.99, 0.6, 64, 200_000, 1e-3), (0.1, 0.9, 0.8, 1024, 4_000_000, 3e-2)],
    ids=["default", "slippery"],
)
def test_q_learning_with_a_decaying_step_size_converges_to_q_star(
    slip: float, gamma: float, power: float, num_envs: int, steps: int, bound: float
) -> None:
    config = QLearningConfig(
        gamma=gamma, learning_rate=1.0, learning_rate_power=power, exploration_final_eps=1.0
    )
    context = seat_of(num_envs, seed=0, slip=slip)
    agent = trained(config, steps, context)
    mdp = context.envs.mdp
    error = np.abs(agent.q - value_iteration(mdp, gamma).q)[~mdp.terminal]
    assert agent.visits[~mdp.terminal].min() > 0  # all of them are reachable
    assert error.max() < bound


def test_the_curves_are_means_over_the_last_episodes() -> None:
    written: list[tuple[Mapping[str, float], int]] = []
    config = QLearningConfig(stats_window_size=3, log_interval=5, learning_rate="lin_0.4")
    context = seat_of(1, write=lambda values, step: written.append((dict(values), step)), max_episode_steps=9)
    rewards: list[float] = []
    last: deque[list[float]] = deque(maxlen=3)
    ended, expected = 0, {}
    advance = context.envs.advance

    def watched(actions: Any) -> Any:
        nonlocal ended
        result = advance(actions)
        rewards.append(float(result[1][0]))
        if result[2][0] or result[3][0]:
            last.append(rewards.copy())
            rewards.clear()
            ended += 1
            if ended % 5 == 0:
                expected[len(expected)] = (
                    np.mean([sum(episode) for episode in last]),
                    np.mean([len(episode) for episode in last]),
                )
        return result

    context.envs.advance = watched  # type: ignore[method-assign]
    trained(config, 1000, context)
    assert len(written) == len(expected) > 10
    for (values, at), (mean_return, length) in zip(written, expected.values(), strict=True):
        assert values["rollout/ep_rew_mean"] == pytest.approx(mean_return)
        assert values["rollout/ep_len_mean"] == pytest.approx(length)
        assert values["rollout/exploration_rate"] == pytest.approx(1 - 0.95 * at / 1000)
        assert values["train/learning_rate"] == pytest.approx(0.4 * (1 - (at - 1) / 1000))
        assert values["train/loss"] >= 0


@pytest.mark.parametrize("layout", shipped_layouts())
def test_value_iteration_is_certified_before_the_first_step(layout: str, tmp_path: Path) -> None:
    quiet = ["recording.frames=false", "recording.gif=false"]
    summary = train_in(tmp_path, "agent=value_iteration", f"env={layout}", *quiet)
    assert summary["certified"]
    assert (summary["timesteps"], summary["first_certified_step"]) == (0, 0)
    assert float(summary["sampled"]["regret"]) == pytest.approx(0, abs=1e-6)  # type: ignore[index]


def test_value_iteration_refuses_a_discount_without_a_finite_optimum(tmp_path: Path) -> None:
    pocket = tmp_path / "pocket.txt"
    pocket.write_text("S.#.\n.G#.\n")
    config = ValueIterationConfig(gamma=1.0)
    assert np.isfinite(build(config, seat_of(layout=pocket)).snapshot().values).all()
    with pytest.raises(InputError, match=r"agent\.gamma=1\.0: from row 1, column 4 no end can be reached"):
        build(config, seat_of(layout=pocket, step_reward=-1.0))
    with pytest.raises(InputError, match="may grow without end"):
        build(config, seat_of(layout=pocket, step_reward=1.0))


def saved(config: TabularConfig, path: Path) -> Agent:
    agent = build(config, seat_of(8))
    agent.learn(2000, lambda done: True)
    path.write_bytes(agent.model_file())
    return agent


@pytest.mark.parametrize("schema", [*CONTROL, ValueIterationConfig])
def test_a_model_file_gives_back_the_very_beliefs(schema: type[TabularConfig], tmp_path: Path) -> None:
    agent = saved(schema(), tmp_path / "model.zip")
    again = build(schema(), seat_of(8))
    again.load(tmp_path / "model.zip")
    for name, value in vars(agent.snapshot()).items():
        assert np.array_equal(value, getattr(again.snapshot(), name)), name


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("q", np.zeros((3, 4)), r"q is float64 \(3, 4\); q_learning in this world has float64 \(30, 4\)"),
        ("q", np.zeros((30, 4), dtype=np.float32), "q is float32"),
        ("q", np.full((30, 4), np.nan), "q holds numbers that are not finite"),
        ("q", np.array([{}] * 30), "Object arrays cannot be loaded"),
        ("exploration_rate", np.array(1.5), r"exploration_rate=1\.5: must be from 0 to 1"),
        ("algorithm", np.array("sarsa"), "not a model of q_learning but of sarsa"),
        ("visits", None, r"must hold \['algorithm', 'exploration_rate', 'q', 'visits'\]"),
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


@pytest.mark.parametrize("agent", ["q_learning", "sarsa", "expected_sarsa", "value_iteration"])
def test_a_whole_run_never_imports_torch(agent: str, tmp_path: Path) -> None:
    code = (
        "import runpy, sys; sys.argv = ['train.py', *sys.argv[1:]];"
        f"runpy.run_path({str(ROOT / 'scripts' / 'train.py')!r}, run_name='__main__');"
        "assert 'tensorboard' in sys.modules;"
        "assert not {'torch', 'stable_baselines3'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *SHORT[agent], "hydra.run.dir=run"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "run").glob("events.out.tfevents*"))
