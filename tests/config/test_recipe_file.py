"""`recipe=FILE`: what tune.py found comes out as Hydra would compose it, a stranger's is only data.

Settings that would run code or read files are in test_fields.py.
"""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from cases import table
from helpers.support import CONF, configure, script

from gridworld.base.errors import InputError
from gridworld.base.safe_read import read_object
from gridworld.config.compose import compose_run, register_schemas, search_path
from gridworld.config.recipe_file import overrides, with_recipe
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import BuiltConfig
from gridworld.sweeps.tune.study import write_recipe
from gridworld.sweeps.tune.study_spec import compose_study
from gridworld.training.saved_run import words_again

WINNERS = {
    "dqn": [
        *("agent.learning_rate=lin_3e-7", "agent.policy_kwargs.net_arch=[16,8]", "agent.train_freq=[2,step]"),
        *("agent.policy_kwargs.activation_fn=torch.nn.ReLU", "agent.batch_size=64", "agent.gamma=1e-5"),
        "+agent.policy_kwargs.optimizer_kwargs={eps: 1e-8, betas: [0.5, 0.9], amsgrad: true, fused: null}",
    ],
    "ppo": [
        *("agent.policy_kwargs.net_arch={pi: [8], vf: [16, 16]}", "agent.target_kl=0.1", "env.slip=0.25"),
        *("agent.n_epochs=5", "agent.ent_coef=0.5"),  # what the rules say without slip, and not with it
    ],
    "qrdqn": [
        *("agent.arguments.policy_kwargs.n_quantiles=5", "+agent.arguments.policy_kwargs.net_arch=[4]"),
        *("+agent.arguments.tau=1", "~agent.arguments.batch_size", "+agent.arguments.batch_size=7"),
    ],
    "q_learning": ["agent.name=\"it's \\\\ {a: 'b'}, [ü]=~1e3 \"", "agent.learning_rate=1", "n_envs=3"],
}


def of_words(*words: str) -> TrainConfig:
    return configure(*with_recipe(words))


@pytest.mark.parametrize("agent", WINNERS)
def test_a_winner_is_the_same_by_hydra_and_as_data(agent: str, tmp_path: Path) -> None:
    register_schemas()
    choices = {"agent": agent, "env": "cliff", "observation": "coordinates" if agent == "ppo" else "one_hot"}
    choices |= {"tuned": f"{agent}/{'stochastic' if agent == 'ppo' else 'cliff'}"}
    words = [*(f"{group}={choice}" for group, choice in choices.items()), *WINNERS[agent]]
    path = write_recipe(tmp_path, (), choices, configure(*words), "a winner")
    by_hydra, *_ = compose_run(["experiment=winner", *search_path([tmp_path])])
    assert of_words(f"recipe={path}") == by_hydra == configure(*words)
    assert of_words(f"recipe={tmp_path}") == configure(*words)


@pytest.mark.parametrize(
    ("preset", "tuned", "recipe"),
    [("none", "cliff_dqn", "dqn/cliff"), ("stochastic", "none", "dqn/stochastic")],
)
def test_a_result_of_an_earlier_version(preset: str, tuned: str, recipe: str, tmp_path: Path) -> None:
    lines = [f"- override /preset: {preset}", f"- override /tuned: {tuned}", "seed: 7"]
    config = of_words(a_recipe(tmp_path, "dqn", "\n".join(lines)))
    assert (config.recipe, config.seed) == (recipe, 7)


def a_recipe(folder: Path, agent: str, settings: str) -> str:
    path = folder / f"{agent}.yaml"
    path.write_text(f"defaults:\n- override /agent: {agent}\n- override /env: cliff\n{settings}\n")
    return f"recipe={path}"


def test_the_command_line_goes_before_the_recipe(tmp_path: Path) -> None:
    recipe = a_recipe(tmp_path, "dqn", "total_timesteps: 80000")
    for words in (["agent.gamma=0.5", "env=maze", recipe], [recipe, "agent.gamma=0.5", "env=maze"]):
        config = of_words(*words)
        assert (config.agent.gamma, config.env.layout) == (0.5, "maze")  # type: ignore[attr-defined]
        assert config.total_timesteps == 80_000
    assert with_recipe([recipe, "-m", "seed=0,1"])[0] == "-m"
    assert with_recipe([recipe, "--config-dir", "a=b", "seed=1"])[:3] == ["--config-dir", "a=b", "agent=dqn"]
    with pytest.raises(InputError, match=r"experiment=cliff_ppo: is a second recipe after recipe="):
        of_words(recipe, "experiment=cliff_ppo")
    with pytest.raises(InputError, match=r"recipe is given twice"):
        of_words(recipe, "recipe=x")
    with pytest.raises(InputError, match=r"trust=yes: must be true or false"):
        of_words(recipe, "trust=yes")


def test_a_sweep_of_a_recipe_and_a_search_from_one(tmp_path: Path) -> None:
    recipe = a_recipe(tmp_path, "q_learning", "agent: {gamma: 0.98}")
    words = ["-m", "seed=0,1", "total_timesteps=300", "hydra.sweep.dir=sweep", "recording.gif=false"]
    done = script("train.py", recipe, *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    for seed in (0, 1):
        manifest = read_object(tmp_path / "sweep" / f"seed={seed}" / "manifest.json")
        wanted = configure("env=cliff", "agent=q_learning", "agent.gamma=0.98", f"seed={seed}")
        assert manifest["config"]["agent"] == dataclasses.asdict(wanted.agent)
        assert manifest["config"]["env"] == dataclasses.asdict(wanted.env)
    asked = compose_study([recipe, "tune.trials=3"])
    assert asked.base == configure("env=cliff", "agent=q_learning", "agent.gamma=0.98")
    assert (asked.choices["env"], asked.settings.trials) == ("cliff", 3)


BOMB = "\n".join(["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))])
CONTENTS = {
    BOMB: "line 1: has an anchor or an alias",
    "seed: 0x" + "f" * 9999: "is too large a number",
    "seed: \x07": "is not valid YAML: unacceptable character #x0007",
    "agent: {net_arch: " + "[" * 30 + "]" * 30 + "}": "is nested too deeply, more than 20 levels",
    "agent: " + "[" * 30_000: "is nested too deeply, more than 20 levels",
    **dict(table("config/cases.txt", "recipes without settings")),
}


def test_what_is_no_settings_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "winner.yaml"
    for content, expected in CONTENTS.items():
        path.write_text(content)
        with pytest.raises(InputError) as refused:
            overrides(path)
        told = str(refused.value)
        assert told.startswith(f"{path}: ")
        assert expected in told
        assert "\n" not in told
        assert len(told) < len(str(path)) + 300


def large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**30)


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "none": (lambda path: None, "has no winner.yaml"),
    "a link": (lambda path: path.symlink_to("/etc/hostname"), "winner.yaml: is a symbolic link"),
    "a device": (lambda path: path.symlink_to("/dev/zero"), "winner.yaml: is a symbolic link"),
    "a pipe": (os.mkfifo, "winner.yaml: is not an ordinary file"),
    "a folder": (Path.mkdir, "winner.yaml: is not an ordinary file"),
    "a gigabyte": (large, "winner.yaml: is larger than 65,536 bytes"),
    "no text": (lambda path: path.write_bytes(b"\xff"), "winner.yaml: cannot be read, it is not UTF-8 text"),
}


@pytest.mark.parametrize("kind", FILES)
def test_what_is_no_ordinary_file_is_refused(kind: str, tmp_path: Path) -> None:
    make, expected = FILES[kind]
    (tmp_path / "experiment").mkdir()
    make(tmp_path / "experiment" / "winner.yaml")
    with pytest.raises(InputError) as refused:
        with_recipe([f"recipe={tmp_path}"])
    assert expected in str(refused.value)


def test_a_study_whose_recipe_is_elsewhere_is_refused(tmp_path: Path) -> None:
    (tmp_path / "study").mkdir()
    (tmp_path / "study" / "experiment").symlink_to(CONF / "experiment")
    for word, told in (
        (f"recipe={tmp_path / 'study'}", "study/experiment: is a symbolic link"),
        ("recipe=", "recipe=: must be a recipe's yaml, or the folder of a study"),
        ("recipe=/dev/zero", "/dev/zero: is not an ordinary file"),
    ):
        with pytest.raises(InputError, match=told):
            with_recipe([word])


REFUSED = {
    "hydra: {run: {dir: evil}}": ("hydra.run.dir=out", "winner.yaml: has an unknown key 'hydra'"),
    "agent: {n_steps: 3}": ("-m agent=q_learning,sarsa", "agent.n_steps: no such setting of QLearning"),
    "defaults: [{override /agent: mine}]": ("seed=1", "agent=mine: no such choice"),
    "evaluation: {stop_after: often}": ("seed=1", "'often' of type 'str' could not be converted to Integer"),
    "env: {slip: {a: 1}}": ("seed=1", "slip"),
    "seed: 2020-01-01": ("n_envs=2", "'2020-01-01' of type 'str' could not be converted to Integer"),
}


@pytest.mark.parametrize("content", REFUSED)
def test_nothing_is_written_for_a_recipe_that_is_refused(
    content: str, tmp_path: Path, refusal: Callable[[str], str]
) -> None:
    (tmp_path / "winner.yaml").write_text(content)
    words, expected = REFUSED[content]
    assert expected in refusal(f"train.py recipe=winner.yaml {words}")
    assert os.listdir(tmp_path) == ["winner.yaml"]


@pytest.mark.parametrize("agent", WINNERS)
def test_a_runs_own_command_line_is_the_same_made_of_its_settings(agent: str) -> None:
    words = [f"agent={agent}", "env=cliff", "seed=7", "evaluation.stop_after=null", *WINNERS[agent]]
    config = configure(*words)
    again = list(words_again(words, config))
    assert len(again) == len(words)
    assert configure(*again) == config


STRANGERS_WORDS = [
    *("--config-dir=/tmp/evil", "-cd", "--config-name", "hydra.searchpath=[file:///tmp/evil]", "hydra/x=y"),
    *("callbacks=[{_target_: os.system, command: ls}]", "+callbacks=[os.system]", "env.builder=os.system"),
    *("+env.x=${oc.env:HOME}", "experiment=../../evil", "env=$(ls)", "recipe=evil.yaml", "trust=true"),
    *("agent@evil=dqn", "seed", "env.slip.x=1", "\x1b[2J", "seed=1\nseed=2;ls", ""),
    "+agent.algorithm=evil.A",
]


def test_a_strangers_command_line_is_not_repeated() -> None:
    config = configure("agent=dqn", "seed=3")
    config.callbacks = [{"_target_": "os.system"}]
    assert list(words_again(STRANGERS_WORDS, config)) == ["seed=3", "+agent.algorithm=DQN"]
    config.env = BuiltConfig(builder="os.system")
    assert list(words_again(["env.builder=a.b", "env=built"], config)) == ["env=built"]
