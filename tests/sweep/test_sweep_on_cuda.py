"""A sweep on CUDA whose runs train at once, as asked for: their numbers depend on each other.

The processor stands in for the device, with runs side by side that do lean on each other.
"""

import contextlib
import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hostile import manifest
from helpers.pages import NO_PICTURES
from helpers.resuming import differences, go_on, left_behind, stopped_after
from helpers.stand_in_cuda import stand_in
from helpers.support import ROOT, configure, script

from gridworld.base.errors import InputError
from gridworld.base.together import mixing
from gridworld.commands import reproduce as command
from gridworld.run.reader import read_run
from gridworld.training.reproduce import population
from gridworld.training.setup import check_settings, make_context

SMALL = (
    *("agent=ppo", "device=cuda", "n_envs=16", "total_timesteps=1536", "evaluation.every=768"),
    *("agent.n_steps=32", "agent.batch_size=128", "agent.n_epochs=2", "logging.progress=false"),
    *NO_PICTURES,
)
NAMES = ["seed=0", "seed=1", "seed=2"]


def sweep(cwd: Path, name: str, *words: str) -> subprocess.CompletedProcess[str]:
    device = "+hydra.callbacks.device._target_=helpers.stand_in_cuda.StandIn"
    return script(
        *("train.py", "-m", *SMALL, "seed=range(3)", *words, f"hydra.sweep.dir={name}", device),
        cwd=cwd,
        PYTHONPATH=str(ROOT / "tests"),
    )


def manifest_of(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "manifest.json").read_text())
    return content


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one sweep that trained as asked for, one by default, and one run by run."""
    cwd = tmp_path_factory.mktemp("cuda")
    for name, size in {"asked": "3", "default": "auto", "alone": "1"}.items():
        done = sweep(cwd, name, f"hydra.sweeper.population={size}")
        assert done.returncode == 0, done.stderr
    return cwd


def test_runs_that_were_asked_for_at_once_name_each_other_and_others_are_the_run_alone(sweeps: Path) -> None:
    jobs = json.loads((sweeps / "asked" / "sweep.json").read_text())["jobs"]
    for name in NAMES:
        default, alone, asked = (left_behind(sweeps / each / name) for each in ("default", "alone", "asked"))
        assert differences(default, alone) == []
        assert differences(asked, alone) != []
        for each in ("default", "alone"):
            assert "numbers_depend_on" not in manifest_of(sweeps / each / name)
        content = manifest_of(sweeps / "asked" / name)["numbers_depend_on"]
        assert list(content.items()) == [(job["job"], job["hash"]) for job in jobs]
        assert list(content) == NAMES


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch.setattr)


def reproduce(run: Path, capsys: pytest.CaptureFixture[str], code: int = 0) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit, match=str(code)) if code else contextlib.nullcontext():
        command.main([str(run)])
    return capsys.readouterr().out


@pytest.mark.usefixtures("device")
def test_a_run_is_repeated_together_with_those_that_it_depends_on(
    sweeps: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = reproduce(sweeps / "asked" / "seed=1", capsys)
    assert "depend on all runs of its population, which train again: seed=0, seed=1, seed=2\n" in shown
    assert shown.endswith("\nidentical\n")
    assert "DIFFERENT" not in shown
    assert "depend" not in reproduce(sweeps / "alone" / "seed=1", capsys)
    monkeypatch.setattr(command, "population", lambda then: [])
    assert reproduce(sweeps / "asked" / "seed=1", capsys, code=1).endswith("\ndifferent\n")


def other_settings(run: Path) -> None:
    manifest(run, lambda content: content["config"]["agent"].update(gamma=0.5))


def went_on(run: Path) -> None:
    again = {"at": manifest_of(run)["started"], "step": 512, "command": []}
    manifest(run, lambda content: content.update(resumed=[again]))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (shutil.rmtree, r"is no longer in .*/asked; put its folder back"),
        (other_settings, r"has different settings now; put back the run that was trained with it"),
        (went_on, r"has since been resumed from a checkpoint, which cannot be repeated"),
    ],
)
def test_what_became_of_another_run_is_told_before_training(
    change: Callable[[Path], None], told: str, sweeps: Path, tmp_path: Path
) -> None:
    shutil.copytree(sweeps / "asked", tmp_path / "asked")
    change(tmp_path / "asked" / "seed=2")
    with pytest.raises(
        InputError, match=rf"asked/seed=0: its numbers depend on the run seed=2, which {told}$"
    ):
        population(read_run(tmp_path / "asked" / "seed=0"))


def test_what_another_run_did_later_is_no_matter_and_a_renamed_run_is_none_of_those(
    sweeps: Path, tmp_path: Path
) -> None:
    shutil.copytree(sweeps / "asked", tmp_path / "asked")
    longer = {"at": "9", "step": 1536, "command": [], "total_timesteps": 3072, "instead_of": 1536}
    manifest(tmp_path / "asked" / "seed=2", lambda content: content.update(resumed=[longer]))
    manifest(tmp_path / "asked" / "seed=2", lambda content: content["config"].update(total_timesteps=3072))
    members = population(read_run(tmp_path / "asked" / "seed=0"))
    assert [member.folder.name for member in members] == NAMES
    (tmp_path / "asked" / "seed=0").rename(tmp_path / "mine")
    with pytest.raises(InputError, match=r"mine: .* on the 3 runs .* its folder was renamed"):
        population(read_run(tmp_path / "mine"))


def test_a_name_that_leads_elsewhere_is_refused(sweeps: Path, tmp_path: Path) -> None:
    for name in ("../seed=1", "..", ""):
        shutil.copy(sweeps / "asked" / "seed=0" / "manifest.json", tmp_path)
        manifest(tmp_path, lambda content, name=name: content["numbers_depend_on"].update({name: ""}))
        with pytest.raises(InputError, match="numbers_depend_on must be a hash for each run"):
            read_run(tmp_path)


@pytest.mark.usefixtures("device")
def test_a_run_that_went_on_says_with_whom_and_cannot_be_repeated(tmp_path: Path) -> None:
    runs = {"run": "0", "other": "0"}
    words = [*SMALL, "checkpoint.every=512"]
    with mixing(runs):
        stopped_after(1, tmp_path / "run", *words)
        shutil.copytree(tmp_path / "run", tmp_path / "again" / "run")
        go_on(tmp_path / "again" / "run")
    go_on(tmp_path / "run")
    for folder, how in ((tmp_path / "run", "alone"), (tmp_path / "again" / "run", "together with others")):
        content = manifest_of(folder)
        assert content["numbers_depend_on"] == runs
        assert content["resumed"][0].get("numbers_depend_on") == (None if how == "alone" else runs)
        sentence = rf"it was resumed {how} after step 512, which cannot be repeated"
        with pytest.raises(InputError, match=sentence):
            population(read_run(folder))


@pytest.mark.parametrize("words", [["agent=ppo"], ["agent=dqn", "observation=coordinates"], ["agent=qrdqn"]])
def test_all_tensors_are_made_where_the_weights_are(words: list[str]) -> None:
    """A tensor that is made on torch's default device instead has no numbers here, and mixes with none."""
    config = configure(*words)
    mdp = check_settings(config)
    runs = []
    for _ in range(2):
        context = make_context(config, mdp)
        agent: Any = config.agent.build(context)
        runs.append(agent.run)
    population = type(runs[0].population)(runs, [run.population.get_state(run) for run in runs])
    networks, active = population.networks, np.ones(2, dtype=np.bool_)
    before = networks.weights.clone()
    with torch.device("meta"):
        for _ in range(2):
            networks.backward(*map(np.ones_like, networks.run()))
            assert population.optimizer.step([1e-3, 1e-3], active).all()
    assert networks.weights.device.type == "cpu"
    assert not torch.equal(networks.weights, before)


@pytest.mark.parametrize(("device", "found"), [("cpu", True), ("cuda", False), ("auto", False), ("?", True)])
def test_the_device_is_found_by_its_name(device: str, found: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert configure("agent=ppo").agent.on_processor(device) is found
    assert configure("agent=sarsa").agent.on_processor(device)
