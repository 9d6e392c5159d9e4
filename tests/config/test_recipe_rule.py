"""Which recipe goes into a run: one rule, by names and the world; named and stored."""

import json
from pathlib import Path

import pytest
from cases import table
from helpers.support import CONF, NO_FILES, configure, script, train_in

import gridworld
from gridworld.agents.sb3.settings import REPLAY_COUNTS
from gridworld.base.errors import InputError
from gridworld.config.compose import compose
from gridworld.config.recipes import is_world
from gridworld.config.train import TrainConfig
from gridworld.training.setup import check_settings, notes

OF_CLASSES = sorted(file for name in ("stochastic", "large") for file in CONF.glob(f"tuned/*/{name}.yaml"))


@pytest.mark.slow
def test_one_rule_chooses() -> None:
    for words, recipe in table("config/cases.txt", "recipes by the rule"):
        assert configure(*words.split()).recipe == recipe, words


@pytest.mark.slow
def test_the_recipes_of_classes_pass_the_checks() -> None:
    for file in OF_CLASSES:
        agent, name = file.parent.name, f"{file.parent.name}/{file.stem}"
        config = configure(f"agent={agent}", f"tuned={name}")
        check_settings(config)
        assert config.recipe == name
        assert config == configure(f"agent={agent}", f"preset={file.stem}")  # as earlier versions had it
        assert config != configure(f"agent={agent}", "tuned=none")


def test_a_label_chooses_nothing() -> None:
    for words in (["agent=dqn", "env.slip=0.1"], ["agent=ppo", "env=cliff"], ["agent=sarsa"]):
        plain, labelled = configure(*words), configure(*words, "agent.name=big")
        plain.agent.name = "big"
        assert labelled == plain


def test_a_recipe_that_is_given_takes_the_place_of_the_pairs_own() -> None:
    """Never parts of both."""
    words = ["agent=dqn", "env=cliff", "env.slip=0.1"]
    assert (
        configure(*words, "preset=stochastic")
        == configure(*words, "tuned=dqn/stochastic")
        == configure(*words)
    )
    given = configure("agent=dqn", "env=cliff", "tuned=dqn/maze")
    assert (given.recipe, given.total_timesteps) == (
        "dqn/maze",
        configure("agent=dqn", "env=maze").total_timesteps,
    )


def test_words_of_earlier_versions() -> None:
    assert configure("agent=dqn", "tuned=cliff_dqn").recipe == "dqn/cliff"
    assert configure("agent=dqn", "tuned=stochastic").recipe == "dqn/stochastic"
    assert configure("agent=dqn", "preset=auto") == configure("agent=dqn")
    assert configure("preset=none", "tuned=none").recipe == "dqn"
    for words in (["preset=none"], ["preset=large", "tuned=cliff_dqn"], ["preset=slippery"]):
        with pytest.raises(InputError, match="a preset is a recipe now; write tuned=none"):
            configure(*words)


@pytest.mark.slow
def test_the_world_is_known_before_a_recipe_is_chosen() -> None:
    """Whether its tables are read or searched for."""
    by_table, searched = (configure("agent=dqn", f"env={kind}", "env.id=FrozenLake-v1") for kind in SAME)
    assert by_table.recipe == searched.recipe == "dqn/stochastic"


SAME = ("gymnasium", "enumerated")


@pytest.mark.slow
def test_a_recipe_of_ones_own(tmp_path: Path) -> None:
    """In a run and in a sweep alike."""
    for name in ("tuned/q_learning/icy", "tuned/q_learning/cliff"):
        file = tmp_path / "mine" / f"{name}.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("# @package _global_\ntotal_timesteps: 320\n")
    (tmp_path / "mine" / "env").mkdir()
    (tmp_path / "mine" / "env" / "icy.yaml").write_text("slip: 0.1")
    own = ["--config-dir", str(tmp_path / "mine")]
    for words, recipe in (
        (["env=icy"], "q_learning/icy"),
        (["env=icy", "env.slip=0.2"], "q_learning/stochastic"),
        (["env=cliff", "tuned=q_learning/icy"], "q_learning/icy"),
        (["agent=dqn", "env=icy"], "dqn/stochastic"),
    ):
        assert compose(["agent=q_learning", *words, *own]).recipe == recipe
    many = [
        "-m",
        "agent=q_learning",
        "env=icy",
        "tuned=q_learning/icy",
        "seed=0,1",
        "hydra.sweep.dir=s",
        *own,
    ]
    done = script("train.py", *many, *NO_FILES, cwd=tmp_path)
    assert "2 of 2" in done.stderr + done.stdout or done.returncode == 0
    manifests = [json.loads(file.read_text()) for file in (tmp_path / "s").glob("*/manifest.json")]
    assert [(each["config"]["recipe"], each["config"]["total_timesteps"]) for each in manifests] == [
        ("q_learning/icy", 320),
        ("q_learning/icy", 320),
    ]
    old = tmp_path / "mine" / "tuned" / "classic_q_learning.yaml"
    old.write_text("# @package _global_\ntotal_timesteps: 320\n")
    with pytest.raises(InputError, match=r"move it to .*tuned/q_learning/classic\.yaml"):
        compose(["agent=q_learning", *own])


def test_what_the_command_line_says_goes_before_a_recipe() -> None:
    config = configure("agent=dqn", "env.slip=0.1", "agent.batch_size=4096", "exploring_starts=0.25")
    agent = vars(config.agent)
    assert (agent["batch_size"], config.exploring_starts) == (4096, 0.25)
    assert (agent["replay_buffer_class"], config.stratified_draws) == (REPLAY_COUNTS, True)


def test_a_recipe_is_chosen_alike_from_python_and_by_the_command(tmp_path: Path) -> None:
    by_call = gridworld.compose("agent=dqn", {"env.slip": 0.1})
    assert by_call == configure("agent=dqn", "env.slip=0.1")
    shown = script("train.py", "--cfg", "job", "agent=ppo", "env.slip=0.1", cwd=tmp_path).stdout
    assert "${" not in shown
    assert "total_timesteps: 24000000" in shown
    (tmp_path / "mine" / "env").mkdir(parents=True)
    (tmp_path / "mine" / "env" / "icy.yaml").write_text("slip: 0.1")
    shown = script("train.py", "--cfg", "job", "--config-dir", "mine", "env=icy", cwd=tmp_path).stdout
    assert "total_timesteps: 12800000" in shown


@pytest.mark.slow
def test_each_job_of_a_sweep_has_its_own_recipe_and_a_line_says_so(tmp_path: Path) -> None:
    words = ["agent=q_learning", "-m", "env.slip=0,0.1", "seed=1", f"hydra.sweep.dir={tmp_path}/s"]
    done = script("train.py", *words, *NO_FILES[:-1], cwd=tmp_path)
    files = sorted((tmp_path / "s").glob("*/manifest.json"))
    manifests = [json.loads(file.read_text()) for file in files]
    found = {(each["config"]["env"]["slip"], each["config"]["recipe"]) for each in manifests}
    assert found == {(0.0, "q_learning"), (0.1, "q_learning/stochastic")}
    assert [file.parent.name for file in files] == [f"env.slip={slip}" for slip in ("0", "0.1")]
    assert "recipe q_learning/stochastic, since classic is stochastic: " in done.stderr
    assert "(1 of 2 jobs)" in done.stderr
    again = script("train.py", *words, *NO_FILES[:-1], cwd=tmp_path)  # finds its jobs again
    assert "2 jobs: 2 done; 0 to run" in again.stderr


def lines(config: TrainConfig) -> list[str]:
    return notes(config, check_settings(config))


def test_the_line_before_training() -> None:
    assert lines(configure("agent=dqn")) == []
    assert lines(configure("agent=dqn", "env=cliff")) == [
        "recipe dqn/cliff: 80,000 steps; tuned=none keeps the agent's own settings"
    ]
    assert lines(configure("agent=dqn", "env.slip=0.1")) == [
        "recipe dqn/stochastic, since classic is stochastic: 12,800,000 steps; "
        "tuned=none keeps the agent's own settings"
    ]
    [line] = lines(configure("agent=dqn", "env.slip=0.1", "total_timesteps=1000", "agent.gamma=0.99"))
    assert line == "classic is stochastic; for settings that suit it, add tuned=dqn/stochastic"
    for words, reason in (
        (["agent=dqn", "env=maze", "tuned=dqn/cliff"], ", tuned for another world:"),
        (["agent=sarsa", "env=maze", "tuned=expected_sarsa/cliff"], ", tuned for another agent and world:"),
        (["agent=sarsa", "env=maze", "tuned=expected_sarsa/maze"], ", tuned for another agent:"),
        (["agent=dqn", "env=frozen_lake_v1"], "recipe dqn/frozen_lake_4x4: "),
    ):
        assert reason in lines(configure(*words))[0]


def test_what_is_known_to_fail_is_said_of_that_alone() -> None:
    [line] = lines(configure("agent=ppo_sb3_defaults", "seed=3", "recording.gif=false"))
    assert line.startswith("agent=ppo_sb3_defaults is known to fail: certified on none of 20")
    assert configure("agent=trpo", "env=frozen_lake_8x8_v1").known_failure is not None
    for words in (
        ["agent=ppo_sb3_defaults", "agent.gamma=0.9"],
        ["agent=ppo_sb3_defaults", "env=cliff"],
        ["agent=ppo_sb3_defaults", "env.num_rows=4"],
        ["agent=trpo", "env=taxi_v4", "total_timesteps=1000000"],
        ["agent=trpo", "env=maze", "tuned=trpo/taxi_v4"],
    ):
        assert configure(*words).known_failure is None, words


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
    assert (summary["certified"], summary["recipe"]) == (True, "q_learning/stochastic")
    assert summary["privileges"] == ["starts anywhere", "stratified draws"]


@pytest.mark.slow
def test_each_world_is_its_own_file_and_no_other() -> None:
    """Where settings of another kind of world are missing, too."""
    files = sorted(file.stem for file in CONF.glob("env/*.yaml"))
    worlds = [name for name in files if name not in ("arrays", "built", "enumerated", "gymnasium")]
    assert len(worlds) > 15
    for name in worlds:
        env = compose([f"env={name}"]).env
        assert [file for file in files if is_world(env, file)] == [name]
