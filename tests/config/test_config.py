"""Every yaml composes, the schema covers SB3's constructors, a manifest reads back what was configured."""

import dataclasses
import inspect
import json
import re
from pathlib import Path

import numpy as np
import pytest
import stable_baselines3
from cases import table
from helpers.support import CONF, DEEP, configure

import gridworld
from gridworld.base.errors import InputError
from gridworld.config.settings import agent_schemas, foreign, read_config
from gridworld.config.train import TrainConfig, check
from gridworld.config.words import prepared, refuse_unclear
from gridworld.config.worlds import SOURCES
from gridworld.envs.observations import make_observation
from gridworld.world.layout import shipped_layouts

ELSEWHERE = {"tune", "tuned", "experiment"}  # for recipes and studies see test_recipes.py
GROUPS = sorted(folder.name for folder in CONF.iterdir() if folder.is_dir() and folder.name not in ELSEWHERE)
CHOICES = [(group, file.stem) for group in GROUPS for file in sorted((CONF / group).glob("*.yaml"))]
AGENTS = {choice for group, choice in CHOICES if group == "agent"}
COMPLETED = {  # choices that leave something to say
    "gymnasium": ["env.id=FrozenLake-v1"],
    "enumerated": ["env.id=MiniGrid-Empty-5x5-v0", "env.kwargs={max_steps: 10}"],
    "arrays": ["env.path=two_rooms.npz"],
    "built": ["env.builder=gridworld.world.sources.classics.river_swim"],
    "own": ["env=enumerated", "env.id=MiniGrid-Empty-5x5-v0", "env.kwargs={max_steps: 10}"],
}
FROM_ELSEWHERE = {"self", "env", "seed", "device", "tensorboard_log", "verbose", "_init_setup_model"}


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS)
def test_every_choice_composes_and_could_train(
    group: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez(
        "two_rooms.npz",
        next_state=[[0, 1]] * 2,
        reward=[[0, 0], [0, 1.0]],
        terminated=np.zeros(1) < [[0, 0], [0, 1]],
        start=[1.0, 0],
    )
    for choice in (choice for of, choice in CHOICES if of == group):
        config = configure(f"{group}={choice}", *COMPLETED.get(choice, []))
        check(config)
        config.agent.check(config)
        for part in dataclasses.fields(TrainConfig):
            assert not isinstance(getattr(config, part.name), dict)
        if choice in COMPLETED.keys() - {"enumerated"}:  # `own` is of it; others: api/test_worlds.py
            mdp = config.env.compile()
            assert make_observation(mdp, config.observation.kind).num_states == mdp.num_states


def test_there_is_a_yaml_for_every_layout_and_every_agent() -> None:
    worlds = {choice for group, choice in CHOICES if group == "env"}
    assert worlds >= set(shipped_layouts()) | (set(SOURCES) - {"map"})
    assert set(agent_schemas()) - {"sb3"} <= AGENTS


@pytest.mark.parametrize("name", DEEP)
def test_the_schema_has_every_parameter_of_the_library_with_its_default(name: str) -> None:
    config, algorithm = agent_schemas()[name](), getattr(stable_baselines3, name.upper())
    parameters = inspect.signature(algorithm.__init__).parameters
    settable = {key: parameter.default for key, parameter in parameters.items() if key not in FROM_ELSEWHERE}
    own = {"name", "family", "algorithm", "engine", "log_interval", "reward_scale"}
    assert settable.keys() == {field.name for field in dataclasses.fields(config)} - own
    for key, default in settable.items():
        if key not in ("policy", "policy_kwargs"):
            assert getattr(config, key) == ({} if key.endswith("_buffer_kwargs") else default), key
    known = {field.name for field in dataclasses.fields(config.policy_kwargs)}
    for policy in ("MlpPolicy", "CnnPolicy"):
        parameters = inspect.signature(algorithm.policy_aliases[policy]).parameters
        assert known == set(parameters) - {"observation_space", "action_space", "lr_schedule"}


@pytest.mark.parametrize(
    "overrides",
    [
        ["env=frozen_lake_v1", "env.kwargs.is_slippery=false"],
        ["env=built", "env.builder=a.b", "env.kwargs.size=3"],
        ["env=deep_sea", "env.size=5"],
        ["agent=ppo", "env=cliff", "agent.policy_kwargs.net_arch=[8,8]", "agent.clip_range=lin_0.3"],
        *([f"agent={name}"] for name in sorted(AGENTS)),
    ],
    ids=lambda overrides: overrides[0],
)
def test_a_manifest_reads_back_the_very_settings(overrides: list[str]) -> None:
    config = configure(*overrides)
    content = json.loads(json.dumps(dataclasses.asdict(config)))
    assert read_config(content, "manifest") == config


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("seed",), "1", "config.seed='1': must be int"),
        (("seed",), True, "config.seed=True: must be int"),
        (("env", "slip"), None, "config.env.slip=None: must be float"),
        (("agent", "algorithm"), "q_learning", "config.agent: has an unknown key batch_size"),
        (("agent", "algorithm"), 3, "config.agent.algorithm=3: must be str"),
        (("agent", "surprise"), 1, "config.agent: has an unknown key surprise"),
        (("agent",), [], "config.agent.algorithm=None is unknown"),
        (("evaluation",), 3, "config.evaluation: must be a mapping, is 3"),
    ],
)
def test_a_strangers_manifest_is_checked_field_by_field(
    path: tuple[str, ...], value: object, words: str
) -> None:
    content = dataclasses.asdict(configure())
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(InputError) as mistake:
        read_config(content, "manifest.json")
    assert words in str(mistake.value)


@pytest.mark.parametrize("path", ["os.system", "evil:Mark", "evil.py:Mark"])
def test_a_strangers_class_in_place_of_a_known_one_needs_trust(path: str) -> None:
    """It is read with the settings of the class that it may be derived from; a table has no such class."""
    for agent in ("dqn", "ppo", "a2c"):
        content = dataclasses.asdict(configure(f"agent={agent}"))
        content["agent"]["algorithm"] = path
        assert read_config(content, "manifest.json").agent.algorithm == path
        assert [name for name, *_ in foreign(content)] == ["agent.algorithm"]
    content = dataclasses.asdict(configure("agent=sarsa"))
    content["agent"]["algorithm"] = path
    with pytest.raises(InputError, match="is unknown"):
        read_config(content, "manifest.json")


@pytest.mark.parametrize("setting", ["recording.visits", "logging.tensorboard", "recording", "checkpoint"])
def test_a_run_from_before_there_was_a_setting_of_its_files(setting: str) -> None:
    """It is read with the setting's default; one that the result depends on is not guessed."""
    config = configure("agent=dqn")
    content = dataclasses.asdict(config)
    section, _, name = setting.rpartition(".")
    del (content[section] if section else content)[name]
    assert read_config(content, "manifest") == config
    del content["evaluation"]["gamma"]
    with pytest.raises(InputError, match="evaluation: lacks gamma"):
        read_config(content, "manifest")


# ---- what people write on a command line: numbers such as 1e5, dashes, a plus ------------------------------


@pytest.mark.parametrize(("word", "read"), table("config/cases.txt", "whole numbers"))
def test_a_whole_number_may_be_written_as_a_float(word: str, read: str) -> None:
    assert prepared([word]) == [read]


def test_every_way_into_a_run_takes_whole_numbers(tmp_path: Path) -> None:
    """But for a yaml that Hydra reads, where the sentence says how to write one."""
    plain = gridworld.compose("agent=q_learning", total_timesteps=100_000, n_envs=8)
    (tmp_path / "experiment").mkdir()
    mine = tmp_path / "experiment" / "mine.yaml"
    mine.write_text("defaults: [{override /agent: q_learning}]\ntotal_timesteps: 1e5\nn_envs: 8.0\n")
    for words in (["agent=q_learning", "total_timesteps=1e5", {"n_envs": 8.0}], [f"recipe={mine}"]):
        config = gridworld.compose(*words)
        assert config == plain
        assert (type(config.total_timesteps), type(config.n_envs)) == (int, int)
    assert configure("agent=q_learning", "total_timesteps=1e5", "n_envs=8") == plain
    mine.write_text("# @package _global_\ntotal_timesteps: 1e5\n")
    with pytest.raises(InputError, match="write whole numbers without a decimal point or exponent"):
        gridworld.compose("experiment=mine", f"hydra.searchpath=[file://{tmp_path}]")
    mine.write_text("agent: {policy_kwargs: {net_arch: {pi: [1e1], vf: [8.0, 4]}}}\n")
    for word in (f"recipe={mine}", "agent.policy_kwargs.net_arch={pi:[1e1],vf:[8.0,4]}"):
        arch = gridworld.compose("agent=ppo", word).agent.policy_kwargs.net_arch
        assert repr(arch) == "{'pi': [10], 'vf': [8, 4]}"
    for word in ("1.5e0", "1e30"):
        with pytest.raises(InputError, match="could not be converted"):
            gridworld.compose(f"total_timesteps={word}")


def test_options_have_dashes_and_no_word_is_empty() -> None:
    """What else is refused is in commands/bad_input.txt."""
    refuse_unclear([])
    refuse_unclear(["-m", "--cfg", "job", "--config-dir=a", "--frobnicate", "--help", "agent.gamma=--seed"])
    with pytest.raises(InputError, match=r"^an empty word: is not a setting; a setting is written key=value"):
        refuse_unclear(["-m", ""])
    for words, right in (
        (["env.ignore=[a,", "b]"], "env.ignore=[a,b]"),
        (["seed=0,", "1,", "2"], "-m seed=0,1,2"),
    ):
        with pytest.raises(InputError, match=re.escape(f"has blanks; write {right}") + "$"):
            refuse_unclear(["agent=dqn", *words])
