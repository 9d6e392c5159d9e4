"""What the page computes, in a real browser, is what Python computes: optima, scores, learners, runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import gridworld
from gridworld.agents import TrainingContext
from gridworld.agents.tabular.algorithms import ExpectedSarsaConfig, QLearningConfig, SarsaConfig
from gridworld.agents.tabular.td_control import TabularControl, TabularControlConfig
from gridworld.config.compose import named_world
from gridworld.diagnosis.evidence import split_regret
from gridworld.envs.observations import make_observation
from gridworld.report.playground.page import shipped
from gridworld.run.reader import read_columns
from gridworld.training.saved_run import SavedRun, read_visits
from gridworld.world.chain import Chain, one_hot_policy
from gridworld.world.evaluation import Evaluator
from gridworld.world.grid import GridMdp, compile_mdp
from gridworld.world.layout import Layout, parse

CLOSE = {"rtol": 1e-9, "atol": 1e-9}
# Infinite numbers go through JSON as words.
SOLVE = """
const p = playground, plain = xs => Array.from(xs, x => (Number.isFinite(x) ? x : String(x)));
return arguments[0].map(([text, settings, policies]) => {
  const world = p.compile(p.parse(text), settings), best = p.solve(world, settings.gamma);
  const scores = policies.map(each => {
    const policy = Float64Array.from(each), score = p.score(world, best, policy);
    const { goal, trap, length } = p.outcome(world, policy, 100);
    return [score.v, p.split(world, best, policy).cost, [goal, trap, length, score.regret]].map(plain);
  });
  return [plain(best.v), plain(best.q), plain(best.optimal), scores];
});
"""
LEARN = """
const [text, world, kind, settings, drawn, steps] = arguments, p = playground, tables = [];
const random = { world: () => drawn.world.shift(), agent: () => drawn.agent.shift() };
const learner = new p.Learner(p.compile(p.parse(text), world), kind, settings, random);
for (let i = 0; i < steps; i++) learner.step(), tables.push(Array.from(learner.q));
return [tables, Array.from(learner.visits), drawn];
"""


def numbers(values: Any) -> NDArray[np.float64]:
    return np.array([float(str(value).replace("Infinity", "inf")) for value in values])


def random_map(random: np.random.Generator, tiles: str, most_starts: int) -> Layout:
    while True:
        rows, cols = random.integers(3, 12, 2)
        cells = random.choice(list(tiles), size=(rows, cols))
        for tile, count in (("S", random.integers(1, most_starts + 1)), ("G", random.integers(1, 3))):
            cells[random.integers(rows, size=count), random.integers(cols, size=count)] = tile
        try:
            return parse("\n".join(map("".join, cells)), "random")
        except gridworld.InputError:
            continue


def cases() -> list[tuple[GridMdp, float]]:
    """Forty worlds: the shipped maps, and random ones with slip, cliffs, many starts and closed pockets."""
    random, found = np.random.default_rng(1), list[tuple[GridMdp, float]]()
    for name in shipped():
        mdp = named_world(name)
        assert isinstance(mdp, GridMdp)
        found += [(mdp, 0.99), (mdp, 1.0)]
    while len(found) < 40:
        layout = random_map(random, *(("......##TT", 3), ("......##TC", 1))[len(found) % 2])
        mdp = compile_mdp(
            layout,
            slip=random.choice([0.0, 0.1, 2 / 3, 1.0]),
            step_reward=random.choice([0.0, -0.04, -1.0]),
            goal_reward=random.choice([1.0, 10.0, 0.0]),
            trap_reward=random.choice([-1.0, -99.0, 0.0]),
        )
        found.append((mdp, (0.5, 0.9, 0.999999, 1.0)[len(found) % 4]))
    return found


def settings_of(mdp: GridMdp, gamma: float) -> dict[str, float]:
    names = ("slip", "step_reward", "goal_reward", "trap_reward")
    return {name: getattr(mdp, name) for name in names} | {"max_episode_steps": 100, "gamma": gamma}


@pytest.mark.slow
def test_values_optimal_actions_scores_and_regret(page: Callable[..., Any]) -> None:
    random, sent, evaluators, policies = np.random.default_rng(2), [], [], []
    for mdp, gamma in cases():
        evaluators.append(Evaluator(mdp, gamma, 100))
        one = one_hot_policy(random.integers(4, size=mdp.num_states), 4)
        policies.append([random.dirichlet(np.ones(4), mdp.num_states), one])
        sent.append([mdp.text(), settings_of(mdp, gamma), [each.ravel().tolist() for each in policies[-1]]])
    found = page().execute_script(SOLVE, sent)
    for evaluator, tried, (v, q, optimal, scores) in zip(evaluators, policies, found, strict=True):
        mdp, best = evaluator.mdp, evaluator.solution
        np.testing.assert_allclose(numbers(v), best.v, **CLOSE)
        np.testing.assert_allclose(numbers(q), best.q.ravel(), **CLOSE)
        np.testing.assert_array_equal(np.array(optimal, dtype=bool), best.optimal.ravel())
        for policy, (value, cost, rest) in zip(tried, scores, strict=True):
            split, end = split_regret(evaluator, policy), evaluator.score(policy).outcome
            np.testing.assert_allclose(numbers(value), Chain(mdp, policy).value(best.gamma), **CLOSE)
            np.testing.assert_allclose(numbers(cost), split.cost, **CLOSE)
            expected = [end.goal, end.trap, end.expected_length, split.score.regret]
            np.testing.assert_allclose(numbers(rest), expected, **CLOSE)


@pytest.mark.parametrize("schema", [QLearningConfig, SarsaConfig, ExpectedSarsaConfig])
def test_a_learner_is_the_tabular_agent_step_by_step(
    schema: type[TabularControlConfig], page: Callable[..., Any]
) -> None:
    """On the draws that the agent and its environment made, with slip, two starts and a step limit."""
    mdp = compile_mdp(parse("S..G\n.T..\nS#..", "two starts"), slip=0.3, step_reward=-0.1)
    config = schema(gamma=0.9, learning_rate=0.8, learning_rate_power=0.6, initial_value=0.5)
    config.exploration_initial_eps = config.exploration_final_eps = 0.3
    envs = gridworld.GridWorldVectorEnv(1, autoreset_mode="SameStep", mdp=mdp, max_episode_steps=9)
    agent = config.build(TrainingContext(envs, make_observation(mdp, "none"), 3, "cpu"))
    assert isinstance(agent, TabularControl)
    drawn: dict[str, list[float]] = {"world": [], "agent": []}
    tables: list[NDArray[np.float64]] = []

    def recorded(key: str, draw: Callable[..., Any]) -> Callable[..., Any]:
        def record(*arguments: Any) -> Any:
            found = draw(*arguments)
            drawn[key] += found.tolist()
            return found

        return record

    class Random:
        random = staticmethod(recorded("agent", agent._random.random))

    agent._random = Random()  # type: ignore[assignment]
    envs.draw_numbers = recorded("world", envs.draw_numbers)  # type: ignore[method-assign]
    agent.learn(400, lambda steps: tables.append(agent.q.ravel().copy()) or steps + 1)  # type: ignore[func-returns-value]
    settings = {"gamma": 0.9, "epsilon": 0.3, "rate": 0.8, "power": 0.6, "initial": 0.5}
    world = settings_of(mdp, 0.9) | {"max_episode_steps": 9}
    found = page().execute_script(LEARN, mdp.text(), world, config.name, settings, drawn, len(tables))
    np.testing.assert_allclose(found[0], tables, rtol=0, atol=1e-12)
    assert found[1:] == [agent.visits.ravel().tolist(), {"world": [], "agent": []}]


def test_what_is_watched_ends_at_the_optimum(page: Callable[..., Any]) -> None:
    browser = page("map=aima_4x3&slip=0.1")
    for mode in ("value_iteration", "policy_iteration"):
        browser.find_element("css selector", f"[value={mode}]").click()
        assert browser.find_element("id", "regret").text != "0"
        found = browser.execute_script(
            "const { app } = playground, step = document.getElementById('step');"
            "for (let i = 0; i < 500 && !app.process.done; i++) step.click();"
            "return [app.process.v, app.solution.v].map(v => Array.from(v))"
        )
        np.testing.assert_allclose(*found, **CLOSE)
        assert browser.find_element("id", "regret").text == "0"
        assert "Certified optimal" in browser.find_element("id", "verdict").text


@pytest.mark.parametrize("name", ["map", "table"])
def test_a_run_is_shown_as_its_files_have_it(name: str, page: Callable[..., Any], pages: Path) -> None:
    saved = SavedRun(pages / name)
    browser, curve, last = page(name=f"{name}.html"), read_columns(saved.run), saved.snapshot()
    data, regret = browser.execute_script(
        "return [JSON.parse(document.getElementById('data').textContent).run, playground.app.scored.regret]"
    )
    assert data["steps"] == curve["step"].tolist()
    np.testing.assert_allclose(data["regrets"], curve["regret"], **CLOSE)
    assert regret == pytest.approx(curve["regret"][-1], abs=1e-9)
    assert data["q"] == last.q.ravel().tolist()  # type: ignore[union-attr]
    assert data["greedy"][-1] == last.greedy.tolist()
    assert data["visits"] == read_visits(saved.run, last.sampled.shape).ravel().tolist()
    shown = browser.execute_script(
        "const slider = document.getElementById('moment');"
        "slider.value = 1; slider.dispatchEvent(new Event('input'));"
        "return [playground.app.scored.regret, document.getElementById('verdict').textContent]"
    )
    assert shown[0] == pytest.approx(curve["regret"][1], abs=1e-9)
    assert shown[1].startswith(f"After {curve['step'][1]:,.0f} steps.")
