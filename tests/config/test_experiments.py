"""The recipes: one for every agent on every task, each of them runs, the command line has the last word."""

import csv
import inspect
import re
import statistics
from pathlib import Path

import pytest
import stable_baselines3
from helpers.support import CONF, configure, train_in
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from gridworld.agents import family
from gridworld.agents.sb3.settings.constructor_arguments import algorithm_and_arguments
from gridworld.commands.shell.help import manual
from gridworld.config.composition.recipe_file import with_recipe
from gridworld.config.train import check

AGENTS = sorted(file.stem for file in (CONF / "agent").glob("*.yaml"))
EVERY = {agent for agent in AGENTS if not agent.endswith("_sb3_defaults")}
OF_OTHER_SOURCES = {"q_learning", "sarsa", "expected_sarsa", "dqn", "ppo"}
TASKS = {
    **dict.fromkeys(("aima_4x3", "classic", "cliff", "four_rooms", "frozen_lake_4x4", "maze"), EVERY),
    **dict.fromkeys(("frozen_lake_v1", "frozen_lake_v1_dry", "cliff_walking_v1"), OF_OTHER_SOURCES),
    **dict.fromkeys(("taxi_v4", "deep_sea", "river_swim"), OF_OTHER_SOURCES),
}
RECIPES = sorted(file.stem for file in (CONF / "experiment").glob("*.yaml"))
# Not those of larger worlds, whose runs take seconds; the others have every one of their settings.
TRAINED = [recipe for recipe in RECIPES if not re.match("frozen_lake_v1|cliff_walking_v1|taxi|deep", recipe)]
NO_FILES = (
    *("recording.frames=false", "recording.gif=false", "recording.policy_map=false"),
    *("recording.learning=false", "recording.q_error=false", "recording.visits=false"),
    *("logging.tensorboard=false", "logging.progress=false"),
)


@pytest.mark.parametrize("task", TASKS)
def test_every_agent_has_a_recipe_for_the_task(task: str) -> None:
    assert {f"{task}_{agent}" for agent in TASKS[task]} <= set(RECIPES)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_is_what_its_name_says_and_trains(recipe: str, tmp_path: Path) -> None:
    """Long enough for a first update: past learning_starts, and through a rollout."""
    config = configure(f"experiment={recipe}")
    check(config)
    family(config.agent).check(config)
    task = recipe.removesuffix(f"_{config.agent.name}")
    # The textbook's recipes are of its own rule for the same task.
    world = "cliff_walking" if config.agent.name.endswith("_textbook") else task
    assert recipe == f"{task}_{config.agent.name}"
    assert config.env == configure(f"env={world}").env
    if "textbook" not in recipe:  # those have an interpolation
        path = CONF / "experiment" / f"{recipe}.yaml"
        assert configure(*with_recipe([f"recipe={path}"])) == config  # it is the same as data
    if recipe in TRAINED:
        summary = train_in(tmp_path, f"experiment={recipe}", "total_timesteps=200", *NO_FILES)
        assert summary["timesteps"] == 0 or int(summary["timesteps"]) >= 200


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_tells_what_comes_of_it(recipe: str) -> None:
    header, result, *_ = (CONF / "experiment" / f"{recipe}.yaml").read_text("utf-8").splitlines()
    assert header == "# @package _global_"
    assert result.startswith("# ")
    assert any(word in result for word in ("certified", "regret"))


def test_the_command_line_beats_the_recipe_and_the_recipe_the_agent() -> None:
    recipe = configure("experiment=cliff_dqn")
    assert configure("agent=dqn").agent.gamma == 0.9
    assert recipe.agent.gamma == 0.99
    assert configure("experiment=cliff_dqn", "agent.gamma=0.5").agent.gamma == 0.5
    assert configure("agent.gamma=0.5", "experiment=cliff_dqn").agent.gamma == 0.5
    assert configure("experiment=cliff_dqn", "env.slip=0.25").env.slip == 0.25
    assert recipe.total_timesteps != configure("agent=dqn").total_timesteps
    assert recipe.agent.learning_rate == configure("agent=dqn").agent.learning_rate  # it says nothing of that


def test_the_command_line_chooses_over_the_recipe() -> None:
    config = configure("experiment=cliff_q_learning", "agent=sarsa", "env=maze")
    assert (config.agent.name, config.env.layout) == ("sarsa", "maze")
    assert config.agent.initial_value == 0  # its values stay
    assert configure("experiment=cliff_dqn", "observation=coordinates").observation.kind == "coordinates"
    assert configure("experiment=cliff_q_learning").observation.kind == "none"  # as the agent chooses


def test_no_recipe_is_the_default() -> None:
    assert configure("~experiment") == configure()


def test_the_manual_has_a_line_per_task() -> None:
    _, shown = manual(CONF).split("experiment=...\n", 1)
    shown = re.split(r"^  \S+=\.\.\.$", shown, flags=re.MULTILINE)[0]
    shown, failing = shown.split("    These fail:\n")
    assert max(map(len, shown.splitlines())) <= 100
    found = set()
    for word in shown.replace(",", "").split():
        if word.endswith("_..."):
            task = word.removesuffix("...")
        else:
            found.add(task + word)
    assert found == set(RECIPES)
    comments = {name: (CONF / "experiment" / f"{name}.yaml").read_text("utf-8") for name in RECIPES}
    expected = [name for name, text in comments.items() if re.search("^# .*(on none of| 0 of)", text, re.M)]
    lines = [line.split(maxsplit=1) for line in failing.splitlines()]
    assert [name for name, _ in lines] == expected
    for name, about in lines:
        assert about.startswith("does not solve its task: ")
        assert f"\n# {about}\n" in comments[name]


@pytest.mark.parametrize("name", ["dqn", "ppo", "a2c"])
def test_the_default_settings_are_the_librarys_own(name: str) -> None:
    config = configure(f"experiment=classic_{name}_sb3_defaults")
    arguments = algorithm_and_arguments(config.agent)[1]
    parameters = inspect.signature(getattr(stable_baselines3, name.upper()).__init__).parameters
    for key, value in arguments.items():
        if key not in ("policy", "policy_kwargs", "optimize_memory_usage"):
            assert value == parameters[key].default or not value, key
    assert config.n_envs == 1


ON_POLICY = [recipe for recipe in RECIPES if re.search("_(a2c|ppo|trpo)(_sb3_defaults)?$", recipe)]


@pytest.mark.parametrize("recipe", ON_POLICY)
def test_the_librarys_own_curves_have_tens_of_points(recipe: str) -> None:
    config = configure(f"experiment={recipe}")
    algorithm, arguments = algorithm_and_arguments(config.agent)
    n_steps = arguments.get("n_steps", inspect.signature(algorithm.__init__).parameters["n_steps"].default)
    iterations = config.total_timesteps // (n_steps * config.n_envs)
    assert 20 <= iterations // config.agent.log_interval <= 200


@pytest.mark.parametrize("agent", ["q_learning", "sarsa", "expected_sarsa"])
def test_a_tables_own_curves_have_tens_of_points(agent: str, tmp_path: Path) -> None:
    train_in(tmp_path, f"agent={agent}", *NO_FILES, "logging.tensorboard=true")
    events = EventAccumulator(str(tmp_path), size_guidance={"scalars": 0})
    events.Reload()
    assert 15 <= len(events.Scalars("rollout/ep_rew_mean")) <= 200


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("task", ["cliff", "four_rooms"])
def test_q_learning_is_certified(task: str, seed: int, tmp_path: Path) -> None:
    summary = train_in(tmp_path, f"experiment={task}_q_learning", f"seed={seed}", *NO_FILES)
    assert summary["certified"]
    assert int(summary["certified_since_step"]) < int(summary["total_timesteps"])


@pytest.mark.slow
def test_on_the_cliff_sarsa_earns_more_while_q_learning_finds_the_optimum(tmp_path: Path) -> None:
    """Sutton & Barto, example 6.6: what episodes bring in the second half of training."""
    earned: dict[str, list[float]] = {"q_learning": [], "sarsa": []}
    for agent, returns in earned.items():
        for seed in range(3):
            folder = tmp_path / f"{agent}{seed}"
            summary = train_in(
                folder,
                *(f"experiment=cliff_{agent}_textbook", f"seed={seed}", *NO_FILES),
            )
            assert summary["certified"] == (agent == "q_learning")
            with (folder / "curve.csv").open() as file:
                rows = list(csv.DictReader(file))
            late = [float(row["online_return"]) for row in rows[len(rows) // 2 :] if row["online_return"]]
            returns.append(statistics.median(late))  # now and then SARSA's values lead it astray for long
    assert statistics.mean(earned["sarsa"]) == pytest.approx(-25, abs=3)  # as in the book's figure
    assert statistics.mean(earned["q_learning"]) == pytest.approx(-50, abs=3)
    assert min(earned["sarsa"]) > max(earned["q_learning"])
