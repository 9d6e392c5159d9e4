"""Presets: plain numbers for stochastic and for large worlds, chosen by one rule, named and stored."""

import json
from pathlib import Path

import pytest
from cases import table
from helpers.support import CONF, NO_FILES, configure, script, train_in

import gridworld
from gridworld.agents.sb3.settings import REPLAY_COUNTS
from gridworld.config.train import TrainConfig
from gridworld.training.setup import check_settings, notes


def test_one_rule_chooses() -> None:
    for words, recipe, preset in table("config/cases.txt", "presets"):
        config = configure(*words.split())
        assert (str(config.recipe), config.preset) == (recipe, preset), words


def test_the_numbers_of_a_preset_pass_the_checks() -> None:
    for file in sorted((CONF / "preset" / "settings").glob("*.yaml")):
        agent, _, preset = file.stem.rpartition("_")
        config = configure(f"agent={agent}", f"preset={preset}")
        check_settings(config)
        assert config.preset == preset
        assert config != configure(f"agent={agent}", "preset=none")


def test_what_the_command_line_says_goes_before_a_preset() -> None:
    config = configure("agent=dqn", "env.slip=0.1", "agent.batch_size=4096", "exploring_starts=0.25")
    agent = vars(config.agent)
    assert (agent["batch_size"], config.exploring_starts) == (4096, 0.25)
    assert (agent["replay_buffer_class"], config.stratified_draws) == (REPLAY_COUNTS, True)


def test_a_preset_is_chosen_alike_from_python_and_by_the_command(tmp_path: Path) -> None:
    by_call = gridworld.compose("agent=dqn", {"env.slip": 0.1})
    assert by_call == configure("agent=dqn", "env.slip=0.1")
    shown = script("train.py", "--cfg", "job", "agent=ppo", "env.slip=0.1", cwd=tmp_path).stdout
    assert "${" not in shown
    assert "preset: stochastic" in shown
    assert "total_timesteps: 24000000" in shown
    (tmp_path / "mine" / "env").mkdir(parents=True)
    (tmp_path / "mine" / "env" / "icy.yaml").write_text("slip: 0.1")
    shown = script("train.py", "--cfg", "job", "--config-dir", "mine", "env=icy", cwd=tmp_path).stdout
    assert "preset: stochastic" in shown


def test_each_job_of_a_sweep_has_its_own_preset_and_a_line_says_so(tmp_path: Path) -> None:
    words = ["agent=q_learning", "-m", "env.slip=0,0.1", "seed=1", f"hydra.sweep.dir={tmp_path}/s"]
    done = script("train.py", *words, *NO_FILES[:-1], cwd=tmp_path)
    files = sorted((tmp_path / "s").glob("*/manifest.json"))
    manifests = [json.loads(file.read_text()) for file in files]
    found = {(each["config"]["env"]["slip"], each["config"]["preset"]) for each in manifests}
    assert found == {(0.0, "auto"), (0.1, "stochastic")}
    assert [file.parent.name for file in files] == [f"env.slip={slip}" for slip in ("0", "0.1")]
    assert "classic is stochastic: preset=stochastic, " in done.stderr
    assert "(1 of 2 jobs)" in done.stderr
    again = script("train.py", *words, *NO_FILES[:-1], cwd=tmp_path)  # finds its jobs again
    assert "2 jobs: 2 done; 0 to run" in again.stderr


def lines(config: TrainConfig) -> list[str]:
    return notes(config, check_settings(config))


def test_the_line_before_training() -> None:
    assert lines(configure("agent=dqn")) == []
    assert lines(configure("agent=dqn", "env=cliff")) == [
        "recipe cliff_dqn: 80,000 steps; tuned=none keeps the agent's own settings"
    ]
    assert lines(configure("agent=dqn", "env.slip=0.1")) == [
        "classic is stochastic: preset=stochastic, 12,800,000 steps; "
        "preset=none keeps the agent's own settings"
    ]
    [line] = lines(configure("agent=ppo_sb3_defaults", "env.num_rows=4"))
    assert line.startswith("agent=ppo_sb3_defaults is known to fail: certified on none of 20")


def test_what_is_seen_changes_the_features_alone() -> None:
    for agent in ("dqn", "ppo", "a2c", "trpo", "qrdqn"):
        plain = configure(f"agent={agent}")
        for kind, features in (("coordinates", "FourierFeatures"), ("image", "PixelCNN")):
            other = configure(f"agent={agent}", f"observation={kind}")
            assert other.observation.features == f"gridworld.agents.sb3.features.{features}"
            other.observation = plain.observation
            assert other == plain


@pytest.mark.slow
def test_a_small_stochastic_world_is_certified(tmp_path: Path) -> None:
    world = ["env.num_rows=4", "env.num_cols=4", "env.slip=0.1", "env.step_reward=-0.1"]
    summary = train_in(tmp_path, "agent=q_learning", *world, *NO_FILES)
    assert (summary["certified"], summary["preset"]) == (True, "stochastic")
    assert summary["privileges"] == ["starts anywhere", "stratified draws"]
