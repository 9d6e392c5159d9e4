"""The recipes: found by themselves, each runs, the command line has the last word; and the studies."""

import csv
import inspect
import json
import re
import statistics
from pathlib import Path

import pytest
import stable_baselines3
import yaml
from helpers.support import CONF, NO_FILES, configure, script, train_in

from gridworld.agents.sb3.factory import algorithm_and_arguments
from gridworld.commands.manual import manual
from gridworld.config.train import check
from gridworld.config.words import pairs

RECIPES = sorted(
    (file.stem, file.parent.name)
    for file in (CONF / "tuned").glob("*/*.yaml")
    if file.stem not in ("stochastic", "large")
)
STUDIES = sorted(file.stem for file in (CONF / "experiment").glob("*.yaml"))
# One for each agent, in a small world.
TRAINED = {agent: env for env, agent in RECIPES if env in ("aima_4x3", "four_rooms")}


@pytest.mark.slow
def test_an_agent_in_a_world_brings_its_recipe() -> None:
    assert {(env, agent) for env, agent in RECIPES} <= set(pairs().values())
    for env, agent in RECIPES:
        config = configure(f"env={env}", f"agent={agent}")
        check(config)
        config.agent.check(config)
        assert (config.recipe, config.agent.name) == (f"{agent}/{env}", agent)
        text = (CONF / "tuned" / agent / f"{env}.yaml").read_text("utf-8")
        assert text.startswith("# @package _global_\n# certified on ")


def test_no_recipe_repeats_another() -> None:
    """What several worlds have in common is said in `recipes_of`."""
    contents = [
        (agent, yaml.safe_load((CONF / "tuned" / agent / f"{env}.yaml").read_text("utf-8")))
        for env, agent in RECIPES
    ]
    assert [each for place, each in enumerate(contents) if each in contents[:place]] == []


@pytest.mark.parametrize(("agent", "env"), TRAINED.items())
def test_a_recipe_trains(agent: str, env: str, tmp_path: Path) -> None:
    """Long enough for a first update: past learning_starts, and through a rollout."""
    summary = train_in(tmp_path, f"experiment={env}_{agent}", "total_timesteps=200", *NO_FILES)
    assert summary["recipe"] == f"{agent}/{env}"
    assert int(summary["timesteps"]) >= 200
    assert configure(f"experiment={env}_{agent}") == configure(f"env={env}", f"agent={agent}")
    assert configure(f"env={env}", f"agent={agent}", "tuned=none").recipe == agent


def test_settings_are_plain_values() -> None:
    """What is left of interpolations names files and folders, in train.yaml and for Hydra."""
    groups = ("agent", "env", "observation", "tuned")
    files = [file for group in groups for file in (CONF / group).rglob("*.yaml")]
    assert [file for file in files if "${" in file.read_text("utf-8")] == []


def test_the_command_line_beats_the_recipe_and_the_recipe_the_agent() -> None:
    plain, recipe = configure("agent=dqn"), configure("env=cliff", "agent=dqn")
    assert (plain.agent.gamma, recipe.agent.gamma) == (0.9, 0.99)
    for words in (["env=cliff", "agent.gamma=0.5"], ["agent.gamma=0.5", "experiment=cliff_dqn"]):
        assert configure(*words).agent.gamma == 0.5
    assert recipe.total_timesteps != plain.total_timesteps
    assert recipe.agent.learning_rate == plain.agent.learning_rate  # it says nothing of that
    config = configure("experiment=cliff_q_learning", "agent=sarsa", "env=maze")
    assert (config.agent.name, config.env.layout, config.recipe) == ("sarsa", "maze", "sarsa/maze")
    assert configure("experiment=cliff_dqn", "observation=coordinates").observation.kind == "coordinates"
    assert configure("experiment=cliff_q_learning").observation.kind == "none"  # as the agent chooses
    for study in STUDIES:  # these leave recipes out
        config = configure(f"experiment={study}")
        check(config)
        config.agent.check(config)
        assert "/" not in str(config.recipe)
    assert configure("~experiment") == configure()


def test_each_job_of_a_sweep_has_the_recipe_of_its_pair(tmp_path: Path) -> None:
    sweep = ["-m", "agent=q_learning,sarsa", "env=cliff,classic", f"hydra.sweep.dir={tmp_path}/sweep"]
    script("train.py", *sweep, "total_timesteps=100", *NO_FILES, cwd=tmp_path)
    summaries = [json.loads(file.read_text()) for file in (tmp_path / "sweep").glob("*/summary.json")]
    found = {(each["agent"], each["env"], each["recipe"]) for each in summaries}
    assert found == {
        *(("q_learning", "cliff", "q_learning/cliff"), ("sarsa", "cliff", "sarsa/cliff")),
        *(("q_learning", "classic", None), ("sarsa", "classic", None)),
    }


def test_the_manual_has_a_line_per_agent() -> None:
    _, shown = manual().split("tuned=...\n", 1)
    shown = shown.split("\n\n", 1)[0]
    assert max(map(len, shown.splitlines())) <= 110
    found, agent = set(), ""
    for word in shown.split("    Known to fail: ")[0].replace(",", "").split():
        if word.endswith("/..."):
            agent = word.removesuffix("/...")
        elif agent:
            found.add((word, agent))
    assert found == {(file.stem, file.parent.name) for file in (CONF / "tuned").glob("*/*.yaml")}


@pytest.mark.parametrize("name", ["dqn", "ppo", "a2c"])
def test_the_default_settings_are_the_librarys_own(name: str) -> None:
    config = configure(f"agent={name}_sb3_defaults")
    arguments = algorithm_and_arguments(config.agent)[1]
    parameters = inspect.signature(getattr(stable_baselines3, name.upper()).__init__).parameters
    for key, value in arguments.items():
        if key not in ("policy", "policy_kwargs", "optimize_memory_usage"):
            assert value == parameters[key].default or not value, key
    assert config.n_envs == 1


@pytest.mark.slow
def test_the_librarys_own_curves_have_tens_of_points() -> None:
    for env, agent in pairs().values():
        on_policy = re.fullmatch("(a2c|ppo|trpo)(_sb3_defaults)?", agent)
        if on_policy and ((env, agent) in RECIPES or env == "classic"):
            config = configure(f"env={env}", f"agent={agent}")
            algorithm, arguments = algorithm_and_arguments(config.agent)
            default = inspect.signature(algorithm.__init__).parameters["n_steps"].default
            iterations = config.total_timesteps // (arguments.get("n_steps", default) * config.n_envs)
            assert 20 <= iterations // config.agent.log_interval <= 200, (env, agent)


@pytest.mark.parametrize("task", ["cliff", "four_rooms"])
def test_q_learning_is_certified(task: str, tmp_path: Path) -> None:
    summary = train_in(tmp_path, f"env={task}", "agent=q_learning", "seed=1", *NO_FILES)
    assert summary["certified"]
    assert int(summary["certified_since_step"]) < int(summary["total_timesteps"])


@pytest.mark.slow
def test_on_the_cliff_sarsa_earns_more_while_q_learning_finds_the_optimum(tmp_path: Path) -> None:
    """Sutton & Barto, example 6.6: what episodes bring in the second half of training."""
    earned = {}
    for agent in ("q_learning", "sarsa"):
        summary = train_in(tmp_path / agent, f"experiment=cliff_{agent}_textbook", *NO_FILES)
        assert summary["certified"] == (agent == "q_learning")
        with (tmp_path / agent / "curve.csv").open() as file:
            rows = list(csv.DictReader(file))
        late = [float(row["online_return"]) for row in rows[len(rows) // 2 :] if row["online_return"]]
        earned[agent] = statistics.median(late)  # now and then SARSA's values lead it astray for long
    assert earned["sarsa"] == pytest.approx(-25, abs=4)  # as in the book's figure
    assert earned["q_learning"] == pytest.approx(-50, abs=4)
