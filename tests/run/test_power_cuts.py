"""Power cuts: a run, one that goes on and a sweep end as if there had been none, whenever the power goes.

At every point: GRIDWORLD_POWER_CUTS=1000000 python -m pytest tests/run/test_power_cuts.py
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.disk import Disk, Left, put_back
from helpers.resuming import begin, begin_or_go_on, differences, go_on, left_behind, stopped_after
from helpers.support import SHORT, composed, configure

from gridworld.base.errors import InputError
from gridworld.run.reader import read_run
from gridworld.sweeps.folder import DONE, FAILED, SweepFolder
from gridworld.sweeps.job import run_in_sweep
from gridworld.sweeps.plan import plan
from gridworld.training.together import run_alone

CUTS = int(os.environ.get("GRIDWORLD_POWER_CUTS", "6"))
LESS = ["recording.frames=false", "recording.gif=false", "recording.learning=false", "logging.progress=false"]
WORDS = [*SHORT["q_learning"], *LESS]
SAVED = [*WORDS, "checkpoint.every=600"]
RESULT = ("curve.csv", "visits.npy", "summary", "points")


def cuts_of(root: Path, work: Callable[[], None]) -> list[Left]:
    """What may be left below `root` of some of the points at which the power may go."""
    with pytest.MonkeyPatch.context() as patched:
        disk = Disk(root, patched)
        work()
    disk.close()
    return [*disk.cuts[:: max(1, len(disk.cuts) // CUTS)], *disk.cuts[-4:]]


def is_whole(folder: Path) -> bool:
    """Whether the run is finished; then it has its results."""
    try:
        run = read_run(folder)
    except InputError:
        return False
    if run.manifest["status"] != "finished":
        return False
    for path in run.results():
        run.verify(path)
    return True


def result(folder: Path) -> dict[str, Any]:
    """Of a run that ended; its pictures may be lost."""
    left = left_behind(folder)
    return {name: left[name] for name in RESULT}


def check_goes_on(folder: Path, words: list[str], calm: dict[str, Any]) -> None:
    if is_whole(folder):
        assert differences(result(folder), {name: calm[name] for name in RESULT}) == []
        if "checkpoint.every=null" not in words:
            go_on(folder, 2 * configure(*words).total_timesteps)
            assert is_whole(folder)
        return
    folder.mkdir(exist_ok=True)
    begin_or_go_on(folder, *words)
    assert is_whole(folder)
    assert differences(left_behind(folder), calm) == []


OTHERS = [("auto", False), ("null", False), ("600", True)]


@pytest.mark.parametrize(
    ("every", "is_resumed"),
    [("600", False), *(pytest.param(*each, marks=pytest.mark.slow) for each in OTHERS)],
)
def test_a_run_goes_on_after_a_power_cut(every: str, is_resumed: bool, tmp_path: Path) -> None:
    words, run = [*WORDS, f"checkpoint.every={every}"], tmp_path / "disk" / "run"
    begin(tmp_path / "calm", *words)
    calm = left_behind(tmp_path / "calm")
    run.parent.mkdir()
    if is_resumed:
        stopped_after(2, run, *words)
    for left in cuts_of(run.parent, lambda: begin_or_go_on(run, *words)):
        put_back(left, tmp_path / "again")
        check_goes_on(tmp_path / "again" / "run", words, calm)
        assert not is_resumed or read_run(tmp_path / "again" / "run").manifest["resumed"]
        shutil.rmtree(tmp_path / "again")


def run_sweep(folder: Path) -> None:
    """As a sweep does it, without Hydra around it."""
    asked = [([*SAVED, f"seed={seed}"], [f"seed={seed}"]) for seed in range(2)]
    jobs = plan(asked, composed)
    sweep = SweepFolder(folder)
    sweep.check(jobs, extend=False)
    with sweep.at_work():
        jobs = sweep.add(jobs, ["seed=0,1"])
        rows = sweep.rows()
        assert {row.status for row in rows.values()}.isdisjoint({FAILED})
        for job in jobs:
            if rows[job.folder.name].status != DONE:
                job.folder.mkdir(exist_ok=True)
                run_alone(run_in_sweep(job))
        sweep.write(sweep.rows())


@pytest.mark.slow
def test_a_sweep_goes_on_after_a_power_cut(tmp_path: Path) -> None:
    run_sweep(tmp_path / "calm")
    calm = {name: left_behind(tmp_path / "calm" / name) for name in ("seed=0", "seed=1")}
    (tmp_path / "disk").mkdir()
    for left in cuts_of(tmp_path / "disk", lambda: run_sweep(tmp_path / "disk" / "sweep")):
        put_back(left, tmp_path / "again")
        folder = tmp_path / "again" / "sweep"
        run_sweep(folder)
        assert {path.name for path in folder.iterdir() if path.is_dir()} == set(calm)
        for name in calm:
            assert is_whole(folder / name)
            whole = {key: calm[name][key] for key in RESULT}
            assert differences(result(folder / name), whole) == []
        assert (folder / "jobs.csv").read_text().count(f",{DONE},") == 2
        shutil.rmtree(tmp_path / "again")


def test_a_short_run_waits_for_the_disk_at_its_end_only(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patched:
        disk = Disk(tmp_path, patched)
        begin(tmp_path / "run", *WORDS)
    disk.close()
    names = [Path(path).name.split(".")[0] for path in disk.syncs if "source" not in path]
    assert names[-1] == "run"
    assert len(names) == len(set(names)) + 1 == 14  # the run's folder with its results, and with its end
