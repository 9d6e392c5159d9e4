"""What users of Hydra expect of the commands: a job's own folder, `--cfg`, the mistakes of other programs."""

from pathlib import Path

import pytest
from helpers.support import ROOT, script

from gridworld.base.errors import InputError
from gridworld.commands.tune import main as tune


def test_a_job_in_its_own_folder_speaks_of_the_users(tmp_path: Path) -> None:
    """And reads the user's map. What it prints can be typed where the command was typed."""
    (tmp_path / "map.txt").write_text("S..\n.#G\n")
    words = ["agent=q_learning", "env.layout=map.txt", "total_timesteps=300", "hydra.run.dir=runs/own"]
    quiet = ["recording.frames=false", "recording.gif=false", "recording.learning=false"]
    done = script("train.py", *words, *quiet, "hydra.job.chdir=true", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "  files: runs/own\n  curves: tensorboard --logdir runs\n" in done.stdout
    again = script("train.py", *words, "hydra.job.chdir=true", cwd=tmp_path)
    assert f"python {ROOT}/scripts/train.py resume=runs/own total_timesteps=" in again.stderr


def test_tune_shows_what_train_would_run(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["agent=q_learning", "total_timesteps=1e3", "tune.trials=1e1"]

    def shows(*more: str) -> str:
        tune(more)
        return capsys.readouterr().out

    job = shows(*words, "--cfg", "job")
    assert job == script("train.py", *words[:2], "--cfg", "job", cwd=tmp_path).stdout
    whole = shows("--cfg", *words)
    assert whole == shows(*words, "-c", "all") == shows(*words, "--cfg")
    assert whole.startswith(job)
    assert "\n  trials: 10\n" in whole
    assert shows(*words, "-c", "job", "-p", "agent.gamma") == "# @package agent.gamma\n0.9\n"
    assert shows(*words, "--cfg", "--package", "env").startswith(
        "# @package env\nmax_episode_steps: 100\nlayout: classic\n"
    )
    for more, told in (
        (["--cfg", "--package", "nowhere"], "--package nowhere: no such part of the configuration"),
        (["-p", "env"], "--package env: shows a part of the configuration; use it with --cfg"),
    ):
        with pytest.raises(InputError, match=told):
            shows(*words, *more)
    with pytest.raises(SystemExit):
        shows(*words, "--cfg", "hydra")
    assert "invalid choice: 'hydra'" in capsys.readouterr().err
