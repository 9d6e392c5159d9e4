"""Tab completion: what bash is told, and the shell's function in a real bash."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gridworld.commands.shell.completion import BASH, complete
from gridworld.commands.shell.console import COMMANDS


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("place")
    for name, marker in {
        "runs/mine": "manifest.json",
        "runs/sweep": "sweep.json",
        "runs/group/a": "x",
    }.items():
        (folder / name).mkdir(parents=True)
        (folder / name / marker).touch()
    (folder / "own" / "experiment").mkdir(parents=True)
    (folder / "own" / "experiment" / "grid.yaml").touch()
    return folder


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("gridworld tr", "train"),
        ("gridworld rep", "report reproduce"),
        ("gridworld train agent=dq", "agent=dqn agent=dqn_sb3_defaults"),
        ("python3 scripts/train.py -m agent=dqn,q_", "agent=dqn,q_learning"),
        ("python scripts/train.py env=four", "env=four_rooms"),
        ("gridworld train tuned=cliff_tr", "tuned=cliff_trpo"),
        ("gridworld train --config-dir own experiment=gr", "experiment=grid"),
        ("gridworld train hydra/launcher=j", "hydra/launcher=joblib"),
        ("gridworld train -m hydra/launcher=b", "hydra/launcher=basic"),
        ("gridworld train ag", "agent. agent="),
        ("gridworld train eval", "evaluation."),
        ("gridworld train tot", "total_timesteps="),
        ("gridworld train agent=ppo agent.n_", "agent.n_epochs= agent.n_steps="),
        ("gridworld train agent=q_learning agent.n_", ""),
        ("gridworld train recording.gif=", "recording.gif=false recording.gif=true"),
        ("gridworld train env.layout=ma", "env.layout=maze"),
        ("gridworld train resume=ru", "resume=runs/"),
        ("gridworld train resume=runs/", "resume=runs/group/ resume=runs/mine resume=runs/sweep"),
        ("gridworld train hydra.sw", "hydra.sweep. hydra.sweeper."),
        ("gridworld train --mu", "--multirun"),
        ("gridworld tune tune.tr", "tune.trials="),
        ("gridworld tune --c", "--cfg --config-dir"),
        ("gridworld evaluate runs/m", "runs/mine"),
        ("python scripts/evaluate.py runs/mine --pol", "--policy"),
        ("gridworld evaluate runs/mine --policy s", "sampled"),
        ("gridworld play --b", "--best"),
        ("gridworld check tr", "trpo"),
        ("gridworld check ppo --pro", "--probe --processes"),
        ("gridworld record runs/mine --be", "--best"),
        ("gridworld report runs --po", ""),
        ("gridworld play --agent runs/", "runs/group/ runs/mine runs/sweep"),
        ("python mine.py --se", ""),
        ("python ", ""),
        ("gridworld nowhere ", ""),
    ],
)
def test_words_are_completed(line: str, words: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    assert complete(line) == words.split()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_options(command: str) -> None:
    assert "--help" in complete(f"gridworld {command} --")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes(place: Path, tmp_path: Path) -> None:
    """Bash replaces only what stands after `=`; a finished word is followed by a blank."""
    program = tmp_path / "gridworld"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m gridworld "$@"\n')
    program.chmod(0o755)
    script = (
        BASH
        + """
    ask() {
        COMP_LINE=$1 COMP_POINT=${#1} COMPREPLY=()
        _gridworld_complete "${1%% *}"
        printf '<%s>' "${COMPREPLY[@]}"; echo
    }
    ask "gridworld train env=maz"; ask "gridworld train agent=dq"; ask "gridworld train resume=ru"; ask "ls x"
    ask "python other.py x"; ask "python scripts/train.py see"
    COMP_WORDBREAKS=' '; ask "gridworld train env=maz"
    complete -p gridworld python
    """
    )
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script], cwd=place, env={**os.environ, "PATH": path}, capture_output=True, text=True
    )
    lines = done.stdout.splitlines()
    assert lines[:2] == ["<maze >", "<dqn><dqn_sb3_defaults>"], done.stderr
    assert (lines[2], lines[4], lines[5], lines[6]) == ("<runs/>", "<>", "<seed=>", "<env=maze >")
    assert all("-F _gridworld_complete" in line for line in lines[7:])
