"""A mistake on a command line gets one sentence, exit code 2, no traceback, and leaves nothing behind.

The command lines and their sentences are in `bad_input.txt`.
"""

import copy
import dataclasses
import json
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from cases import table
from helpers.own_class import any_class
from helpers.support import NO_FILES, ROOT, SHORT, configure, train_in
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException

from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.commands.train import FULL_ERROR
from gridworld.config.messages import sentence
from gridworld.training.train import train

YAMLS: dict[str, bytes] = {
    "agent/broken.yaml": b"a: [1\nb: 2\n",
    "agent/empty.yaml": b"",
    "agent/binary.yaml": b"\xff\xfe",
    "agent/endless.yaml": b"a: &a [*a]\n",
    "agent/mine.yaml": b"# @package _global_\ndefaults:\n  - /agent/schema/sb3@agent\n  - _self_\n"
    b"agent: {name: mine, algorithm: own_module.Mine}\n",
    "env/tagged.yaml": b"layout: !!python/object/apply:os.system [ls]\n",
    "env/misspelt.yaml": b"layuot: cliff\n",
    "tune/misspelt.yaml": b"# @package tune.space\nagent.gamma: {type: float, lo: 0, high: 1}\n",
    "tune/packless.yaml": b"agent.gamma: {type: float, low: 0, high: 1}\n",
    "own_module.py": b"1 / 0\n",
    "needy.py": b"import not_installed\n",
    "own_callbacks.py": b"from stable_baselines3.common.callbacks import BaseCallback\n"
    b"class Stirring(BaseCallback):\n    def _on_step(self): return True\n"
    b"class Failing(BaseCallback):\n    def __init__(self): raise RuntimeError('no server')\n",
}

MAPS = {
    "unknown.txt": b"S.x\n..G\n",
    "large.txt": (b"." * 1000 + b"\n") * 1100,  # for the others see world/test_layout.py
}


# What the command line itself, Hydra or a file of the user's makes of it; the rest are settings that compose.
OF_THE_COMMAND = re.compile(
    r"--|hydra\.|recipe=|\{conf\}|~|^[^=]*$|^\S+=\S+ \w+$|['\"]|=null|=\[1|env=gymnasium|seed=(1,2|-1)"
    r"|^-|^config-dir|=? = ?|= \w|^preset"
)
ANY_CLASS = " ".join(any_class("stable_baselines3.A2C"))
REFUSED = table("commands/bad_input.txt", "train.py")
OUT_OF_SIZE = "must be 0, or from"
# Of the right type, and beyond what any number here holds.
ABSURD = [
    *(
        (f"agent={agent} env.{name}={value}", f"{name}={float(value)}: {OUT_OF_SIZE} {bounds}")
        for agent, least, most, cut in (("q_learning", 1e-100, 1e100, 1), ("dqn", 1e-30, 1e15, 100))
        for name, times in (("step_reward", cut), ("goal_reward", 1), ("trap_reward", 1))
        for value in ("1e307", "-1e307", "1e-320")
        for bounds in [f"{least:g} to {most / times:g}"]
    ),
    ("agent=a2c env.goal_reward=1e20", f"env.goal_reward=1e+20: {OUT_OF_SIZE} 1e-30 to 1e+15"),
    ("agent=q_learning agent.initial_value=1e307", f"agent.initial_value=1e+307: {OUT_OF_SIZE}"),
    (f"agent.learning_rate={10**400}", "must be a number of at least 0, or lin_NUMBER"),
    (f"agent.n_steps={10**30}", "must be from 1 to 100000"),
    (f"agent=qrdqn +agent.arguments.train_freq={10**30}", "must be from 1 to 100000"),
    ("agent=qrdqn +agent.arguments.tau=1e307", "agent.arguments.tau=1e+307: must be from 0 to 1"),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps in `maps`, and in `conf` yaml files and modules of a user's own, each with a mistake."""
    folder = tmp_path_factory.mktemp("files")
    for name, content in (YAMLS | MAPS).items():
        path = folder / ("maps" if name in MAPS else "conf") / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    (folder / "run").mkdir()
    (folder / "run" / "manifest.json").touch()
    return folder


@pytest.mark.parametrize(
    ("line", "words"),
    [*(row for row in REFUSED if not OF_THE_COMMAND.search(row[0])), *ABSURD],
    ids=lambda value: value[:60],
)
def test_settings_are_refused_before_anything_is_written(
    line: str, words: str, files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(files / "conf")
    given = line.replace("{maps}", str(files / "maps")).replace("{class}", ANY_CLASS).split()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises((InputError, HydraException)) as mistake:
            train(configure(*given), tmp_path, [])
    told = sentence(mistake.value)
    assert words in told
    assert "\n" not in told
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("line", "words"), [row for row in REFUSED if OF_THE_COMMAND.search(row[0])], ids=lambda value: value[:60]
)
def test_train_refuses_before_it_writes(
    line: str,
    words: str,
    files: Path,
    tmp_path: Path,
    refusal: Callable[[str], str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(files / "conf")
    line = line.replace("{conf}", str(files / "conf")).replace("{class}", ANY_CLASS)
    assert words in refusal(f"train.py {line}")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_the_largest_rewards_are_calculated_with_without_an_overflow(tmp_path: Path) -> None:
    """The smallest, too: they are no nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for agent, size in (("q_learning", 1e100), ("q_learning", 1e-100), ("ppo", 1e15), ("ppo", 1e-30)):
            step = f"env.step_reward={-size / 100 if size > 1 else 0}"
            rewards = [f"env.goal_reward={size}", f"env.trap_reward={-size}", step]
            summary = train_in(tmp_path / f"{agent} {size}", *SHORT[agent], *rewards, *NO_FILES)
            assert summary["optimal_goal_probability"] == 1


def test_a_folder_that_cannot_be_a_runs_is_refused_and_left_alone(
    tmp_path: Path, refusal: Callable[[str], str]
) -> None:
    for name, content in (("file", ""), ("sweep/sweep.json", "{}"), ("used/checkpoints/1000.state", "")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    manifest = sealed({"status": "finished", "config": {}, "layout": []})
    (tmp_path / "used" / "manifest.json").write_text(json.dumps(manifest))
    before = sorted(tmp_path.rglob("*"))
    longer = f"make that run longer with python {ROOT}/scripts/train.py resume=used total_timesteps=..."
    for folder, told in (
        ("used", f"used: contains a run already; choose another folder, or {longer}"),
        ("file/run", "file/run: cannot be made, file is a file; choose another hydra.run.dir"),
        ("sweep", "sweep: is the folder of a sweep; choose another hydra.run.dir"),
    ):
        assert refusal(f"train.py hydra.run.dir={folder}") == f"error: {told}"
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("line", "words"), table("commands/bad_input.txt", "train.py -m"))
def test_a_sweep_is_refused_before_it_writes(
    line: str, words: str, tmp_path: Path, refusal: Callable[[str], str]
) -> None:
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "manifest.json").write_text("{}")
    assert words in refusal(f"train.py -m {line}")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["manifest.json"]


@pytest.mark.parametrize(("launcher", "package"), [("slurm", "submitit"), ("ray", "ray")])
def test_a_launcher_that_is_not_installed_names_its_extra(
    launcher: str, package: str, refusal: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    told = f"{package} is not installed; pip install -e '{ROOT}[{launcher}]'"
    line = f"train.py -m seed=0,1 hydra/launcher={launcher}"
    assert refusal(line) == f"error: hydra/launcher={launcher}: {told}"


COMMANDS = {
    "train.py -m seed=0,1": "basic, forks, joblib, ray, slurm",
    "train.py": "basic, forks, joblib, ray, slurm",
    "tune.py": "basic, forks, joblib",
}
CHOICES = {  # of a launcher that is not ours, and of a sweeper
    "launcher: submitit_slurm": "hydra_plugins.submitit.SlurmLauncher",
    "launcher: in_a_file": "my_cluster.Launcher",
    "launcher: nobody": "",
    "sweeper: basic": "hydra._internal.core_plugins.basic_sweeper.BasicSweeper",
}


@dataclasses.dataclass
class OfAPlugin:
    """What hydra-submitit registers, in short."""

    _target_: str = "hydra_plugins.submitit.SlurmLauncher"
    partition: str | None = None


def an_experiment(folder: Path, choice: str, is_sweep: bool = False) -> Path:
    """A folder for `--config-dir` whose experiment `mine` makes the choice of Hydra's group."""
    file = folder / "conf" / "experiment" / "mine.yaml"
    file.parent.mkdir(parents=True)
    sweep = "hydra: {mode: MULTIRUN}\n" if is_sweep else ""
    file.write_text(f"# @package _global_\ndefaults:\n  - override /hydra/{choice}\n{sweep}")
    return file


@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_launcher_that_would_not_be_used_is_refused_wherever_it_is_set(
    command: str, choice: str, tmp_path: Path, refusal: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ConfigStore.instance()
    monkeypatch.setattr(store, "repo", copy.deepcopy(store.repo))
    store.store(group="hydra/launcher", name="submitit_slurm", node=OfAPlugin)
    file, (kind, name) = an_experiment(tmp_path, choice, command == "tune.py"), choice.split(": ")
    own = tmp_path / "conf" / "hydra" / "launcher" / "in_a_file.yaml"
    own.parent.mkdir(parents=True)
    own.write_text("_target_: my_cluster.Launcher\n")
    word = f"hydra/{kind}={name}"
    for by, where in ((word, ""), ("experiment=mine", f", in {file}")):
        monkeypatch.delenv(FULL_ERROR, raising=False)  # which a command sets for Hydra
        told = refusal(f"{command} agent=q_learning --config-dir {tmp_path / 'conf'} {by}")
        if name == "nobody":
            assert told.startswith(f"error: {word}: no such choice; choose from basic, forks,")
        elif command == "train.py" and not where:
            assert told == f"error: {word}: applies to sweeps only; add -m, or leave it out"
        elif kind == "sweeper" and "-m" in command:  # Hydra would use it, but it cannot use our launchers
            assert told == "error: hydra/sweeper: another one needs hydra/launcher=basic, or its own"
        else:
            known = COMMANDS[command] if kind == "launcher" else "gridworld"
            assert told == f"error: {word}{where}: {CHOICES[choice]} is not used here; choose from {known}"
    assert not (tmp_path / "runs").exists()


def test_a_launcher_of_ours_is_used_wherever_it_is_set(
    tmp_path: Path, refusal: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that is not on this machine says so; a study has none but this machine."""
    file = an_experiment(tmp_path, "launcher: slurm")
    monkeypatch.setenv("PATH", str(tmp_path))
    words = f"agent=q_learning --config-dir {tmp_path / 'conf'}"
    for by, where in (("hydra/launcher=slurm", ""), ("experiment=mine", f", in {file}")):
        monkeypatch.delenv(FULL_ERROR, raising=False)
        told = refusal(f"train.py -m seed=0,1 {words} {by}")
        assert told.startswith("error: hydra/launcher=slurm: no sbatch on this machine; start")
        told = refusal(f"tune.py {words} {by}")
        module = "gridworld.sweeps.launchers.slurm"
        known = "choose from basic, forks, joblib"
        assert told == f"error: hydra/launcher=slurm{where}: {module} is not used here; {known}"


def test_a_yaml_of_ones_own_may_choose_a_launcher_of_ours(
    tmp_path: Path, refusal: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "conf" / "hydra" / "launcher" / "mine.yaml"
    own.parent.mkdir(parents=True)
    words = f"train.py -m agent=q_learning seed=0,1 total_timesteps=0 --config-dir {tmp_path / 'conf'}"
    for target, more, told in (
        ("gridworld.sweeps.launchers.forks", "n_jobs: 0", "hydra.launcher.n_jobs=0: must be the number"),
        ("gridworld.sweeps.launchers.joblib", "foo: 1", "foo: no such setting"),
        ("hydra._internal.core_plugins.basic_launcher.BasicLauncher", "", "total_timesteps=0: must be"),
    ):
        monkeypatch.delenv(FULL_ERROR, raising=False)
        own.write_text(f"_target_: {target}\n{more}\n")
        assert refusal(f"{words} hydra/launcher=mine").startswith(f"error: {told}")


def test_slurm_is_started_where_it_is(
    tmp_path: Path, refusal: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    told = refusal("train.py -m seed=0,1 hydra/launcher=slurm")
    assert told.startswith("error: hydra/launcher=slurm: no sbatch on this machine; start")


@pytest.mark.parametrize(("line", "words"), table("commands/bad_input.txt", "the other scripts"))
def test_the_other_scripts_refuse_too(
    line: str,
    words: str,
    files: Path,
    tmp_path: Path,
    refusal: Callable[[str], str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    places = {"{conf}": str(files / "conf"), "{run}": str(files / "run")}
    for name, place in places.items():
        line, words = line.replace(name, place), words.replace(name, place)
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
    assert words in refusal(line)
    assert list(tmp_path.iterdir()) == []
