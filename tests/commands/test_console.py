"""The console command `gridworld`, in the checkout and from a wheel; what both tell people to type."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from helpers.pages import check
from helpers.support import CONF, ROOT, SHORT

from gridworld import __version__
from gridworld.base import console
from gridworld.base.errors import DISTRIBUTION
from gridworld.commands import COMMANDS
from gridworld.commands import console as main
from gridworld.config.words import conf_folder
from gridworld.run.provenance import code

TEXTS = (".py", ".md", ".yaml", ".toml", ".cff", ".j2")


def test_a_command_for_each_script() -> None:
    for name in COMMANDS:
        assert f'call("{name}")' in (ROOT / "scripts" / f"{name}.py").read_text("utf-8")
    files = {path.stem for path in (ROOT / "scripts").glob("*.py")}
    assert files == {*COMMANDS, "check_certificate"}  # which needs nothing of the package
    assert conf_folder() == CONF


def test_help_version_and_words_that_are_no_command(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def told(*words: str, code: int = 0) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", ["gridworld", *words])
        ended: object = 0
        try:
            main()
        except SystemExit as end:
            ended = end.code
        assert ended == code
        return capsys.readouterr()

    monkeypatch.setenv("COLUMNS", "110")
    assert told("--version") == (f"gridworld {__version__}\n", "")
    for words in ((), ("--help",), ("-h",), ("help",)):
        out, errors = told(*words)
        for name, about in COMMANDS.items():
            assert re.search(rf"^  {name} +{re.escape(about)}$", out, re.MULTILINE)
    for name in COMMANDS:
        out, errors = told(name, "--help")
        assert f"usage: gridworld {name} " in out
        assert not re.search(r"scripts/|\b(?:train|tune|record|report|evaluate|jobs|play)\.py", out)
    for word, advice in (
        ("trian", "did you mean gridworld train?"),
        ("evaluate.py", "did you mean gridworld evaluate?"),
        ("agent=dqn", "settings come after a command: gridworld train agent=dqn"),
        ("grade", "marking is a script of the course: python docs/course/grade.py"),
        ("x\x1b[1m", f"it is one of {', '.join(COMMANDS)}"),
    ):
        out, errors = told(word, code=2)
        shown = word.replace("\x1b", "\\x1b")
        assert (out, errors) == ("", f"error: gridworld: unknown command {shown}; {advice}\n")


@pytest.mark.parametrize("name", [*COMMANDS, ""])
def test_help_fits_a_narrow_terminal_and_ends_with_an_example(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["gridworld", *name.split(), "--help"])
    monkeypatch.setenv("COLUMNS", "60")
    with contextlib.suppress(SystemExit):
        main()
    lines = capsys.readouterr().out.splitlines()
    examples = [line for line in lines if line.startswith("  gridworld ")]  # to be copied, so they stay whole
    assert [line for line in lines if len(line) > 60 and line not in examples] == []
    assert lines.index(examples[-1]) >= len(lines) - 3  # what it does may follow
    check(examples[-1].strip())
    _, _, positional = "\n".join(lines).partition("\npositional arguments:\n")
    shown = positional.partition("\n\n")[0].splitlines()
    assert all(re.match(r"  ([A-Z]+|env=NAME|key=value)  | {4}", line) for line in shown)


def test_the_help_of_train_needs_no_numbers() -> None:
    code = "from gridworld.commands.train import main; main(['--help']); import sys"
    light = f"{code}; assert not {{'numpy', 'torch', 'gymnasium'}} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", light], check=True, stdout=subprocess.DEVNULL)


def test_what_is_typed_and_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["gridworld train", "agent=dqn"])
    assert console.command("report") == console.program("report") == "gridworld report"
    assert console.as_called("python scripts/tune.py x; as for train.py") == (
        "gridworld tune x; as for gridworld train"
    )
    assert console.command_line() == ["gridworld", "train", "agent=dqn"]
    assert console.recorded_command_line() == ["gridworld", "train", "agent=dqn"]
    monkeypatch.setattr(sys, "argv", ["../scripts/train.py", "agent=dqn"])
    monkeypatch.chdir(ROOT / "docs")
    assert console.command("report") == "python ../scripts/report.py"
    assert console.program("report") == "report.py"
    assert console.command_line() == ["python", "../scripts/train.py", "agent=dqn"]
    assert console.recorded_command_line() == ["train.py", "agent=dqn"]
    monkeypatch.setattr(sys, "argv", ["notebook.py"])
    assert console.command("report") == "gridworld report"


def test_nobody_is_sent_to_the_other_project_on_pypi() -> None:
    files = [ROOT / "README.md", ROOT / "pyproject.toml"]
    for folder in ("gridworld", "conf", "docs", "scripts", "tests"):
        files += [path for path in (ROOT / folder).rglob("*") if path.suffix in TEXTS]
    wrong = re.compile(r"gridworld" + r"\[|\binstall '?gridworld(?!-sb3)\b")
    assert not [str(path) for path in files if wrong.search(path.read_text("utf-8"))]
    assert f'\nname = "{DISTRIBUTION}"' in (ROOT / "pyproject.toml").read_text()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of what it is made of."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("gridworld", "conf", "scripts"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    [file] = out.iterdir()
    return file


def test_the_wheel_holds_what_it_takes_to_train(wheel: Path) -> None:
    assert wheel.name == f"gridworld_sb3-{__version__}-py3-none-any.whl"
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"gridworld/conf/{path.relative_to(CONF).as_posix()}" for path in CONF.rglob("*.yaml")} <= names
    package = ROOT / "gridworld"
    ours = {
        path.relative_to(ROOT).as_posix()
        for suffix in ("py", "txt", "j2", "yml", "typed")
        for path in package.rglob(f"*.{suffix}")
    }
    moved = {"gridworld/sweeps/hydra_plugin.py", "gridworld/checking/pytest_plugin.py"}
    assert ours - names == moved  # where Hydra and pytest look for them:
    assert {"hydra_plugins/gridworld_sweeper.py", "pytest_gridworld.py"} <= names
    assert {name.split("/")[0] for name in names} == {
        "gridworld",
        "hydra_plugins",
        "pytest_gridworld.py",
        "gridworld_check_certificate.py",
        f"gridworld_sb3-{__version__}.dist-info",
    }


@pytest.mark.slow
def test_it_trains_from_the_wheel(wheel: Path, tmp_path: Path) -> None:
    site, here = tmp_path / "site", tmp_path / "here"
    here.mkdir()
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", str(site)]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def run(*words: str) -> str:
        done = subprocess.run(words, cwd=here, env=environment, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        return done.stdout

    about = "from gridworld.config.words import conf_folder; from gridworld.run.provenance import code"
    folder, own = run(sys.executable, "-c", f"{about}; print(conf_folder(), code(), sep='\\n')").splitlines()
    assert (folder, own) == (str(site / "gridworld" / "conf"), code())  # a run may go on in a checkout
    command = str(site / "bin" / "gridworld")
    words = [*SHORT["q_learning"], "hydra.run.dir=run"]
    run(command, "train", *words)
    manifest = json.loads((here / "run" / "manifest.json").read_text())
    assert "optimal" in run(command, "verify", "run")
    assert (manifest["git"], manifest["command"]) == (None, ["gridworld", "train", *words])
    assert manifest["versions"]["gridworld"] == __version__
    told = run(
        *(command, "train", "-m", *SHORT["q_learning"], "seed=0,1"),
        *("hydra.sweep.dir=sweep", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
    )
    assert "sweep sweep: 2 jobs: 2 done" in told
