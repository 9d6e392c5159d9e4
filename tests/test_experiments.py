"""The recipes: one for every agent on every task, each of them runs, and the command line has the last word."""

from pathlib import Path

import pytest
from support import CONF, configure, train_in

from gridworld.manual import manual

TASKS = ("aima_4x3", "classic", "cliff", "four_rooms", "frozen_lake_4x4", "maze")
AGENTS = sorted(file.stem for file in (CONF / "agent").glob("*.yaml"))
RECIPES = sorted(file.stem for file in (CONF / "experiment").glob("*.yaml"))
NO_FILES = (
    *("recording.frames=false", "recording.gif=false", "recording.policy_map=false"),
    *("logging.tensorboard=false", "logging.progress=false"),
)


@pytest.mark.parametrize("task", TASKS)
def test_every_agent_has_a_recipe_for_the_task(task: str) -> None:
    everywhere = [agent for agent in AGENTS if not agent.endswith("_sb3_defaults")]
    assert {f"{task}_{agent}" for agent in everywhere} <= set(RECIPES)


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_trains_as_its_name_says(recipe: str, tmp_path: Path) -> None:
    """Long enough for a first update: past learning_starts, and through a rollout."""
    summary = train_in(tmp_path, f"experiment={recipe}", "total_timesteps=200", *NO_FILES)
    config = configure(f"experiment={recipe}")
    assert recipe == f"{config.env.layout}_{config.agent.name}"
    assert summary["timesteps"] == 0 or int(summary["timesteps"]) >= 200


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_recipe_tells_what_comes_of_it(recipe: str) -> None:
    header, result, *_ = (CONF / "experiment" / f"{recipe}.yaml").read_text("utf-8").splitlines()
    assert header == "# @package _global_"
    assert result.startswith("# ")
    assert any(word in result for word in ("certified", "regret"))
