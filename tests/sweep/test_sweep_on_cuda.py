"""A sweep on CUDA whose runs train at once, as asked for: their numbers depend on each other.

The processor stands in for the device, with runs side by side that do lean on each other.
"""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hostile import manifest
from helpers.pages import NO_PICTURES
from helpers.resuming import differences, left_behind
from helpers.support import ROOT, configure, script

from gridworld.base.errors import InputError
from gridworld.run.reader import read_run
from gridworld.training.reproduce import lengths
from gridworld.training.saved_run import settings_of
from gridworld.training.setup import check_settings, make_context

SMALL = (
    *("agent=ppo", "device=cuda", "n_envs=16", "total_timesteps=1536", "evaluation.every=768"),
    *("agent.n_steps=32", "agent.batch_size=128", "agent.n_epochs=2", "logging.progress=false"),
    *NO_PICTURES,
)
NAMES = ["seed=0", "seed=1", "seed=2"]


def sweep(cwd: Path, name: str, *words: str) -> subprocess.CompletedProcess[str]:
    device = "+hydra.callbacks.device._target_=helpers.stand_in_cuda.StandIn"
    here = (device, "hydra/launcher=basic", f"hydra.sweep.dir={name}")
    path = str(ROOT / "tests")
    return script("train.py", "-m", *SMALL, "seed=range(3)", *words, *here, cwd=cwd, PYTHONPATH=path)


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


@pytest.mark.slow
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


def test_a_run_that_was_trained_at_once_with_others_is_not_repeated(sweeps: Path, tmp_path: Path) -> None:
    def reproduce(run: Path) -> subprocess.CompletedProcess[str]:
        return script("reproduce.py", str(run), cwd=sweeps, PYTHONPATH=str(ROOT / "tests"))

    sentence = "was trained on CUDA at once with other runs, on which its last bits depend"
    shutil.copytree(sweeps / "alone" / "seed=1", tmp_path / "later")
    again = {"at": "9", "step": 512, "command": [], "numbers_depend_on": {"seed=2": "0"}}
    manifest(tmp_path / "later", lambda content: content.update(resumed=[again]))
    for run in (sweeps / "asked" / "seed=1", tmp_path / "later"):
        refused = reproduce(run)
        assert (refused.returncode, refused.stdout) == (2, "")
        assert f"{run}: {sentence}" in refused.stderr
    alone = read_run(sweeps / "alone" / "seed=1")
    assert lengths(alone, settings_of(alone, False)) == [1536]


def test_a_name_that_leads_elsewhere_is_refused(sweeps: Path, tmp_path: Path) -> None:
    for name in ("../seed=1", "..", ""):
        shutil.copy(sweeps / "asked" / "seed=0" / "manifest.json", tmp_path)
        manifest(tmp_path, lambda content, name=name: content["numbers_depend_on"].update({name: ""}))
        with pytest.raises(InputError, match="numbers_depend_on must be a hash for each run"):
            read_run(tmp_path)


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
