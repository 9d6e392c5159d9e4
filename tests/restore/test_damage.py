"""One digit that was changed somewhere is never silent: a command tells it, or says what it said before.

Every file that is read of a run, a sweep and a study is damaged, in each some digits, and read again by what
the commands read it with.
"""

import contextlib
import csv
import dataclasses
import io
import json
import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.resuming import go_on, stopped_after
from helpers.runs_folder import Maker, write_study, write_sweep
from helpers.support import SHORT, train_in

from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.base.serialization import decode, encode
from gridworld.commands import jobs as jobs_command
from gridworld.config.train import PICTURES
from gridworld.report import tuning_study as tuning
from gridworld.report.analysis import gather
from gridworld.report.writer import charts, render
from gridworld.run.reader import read_run
from gridworld.sweeps.folder import SweepFolder
from gridworld.sweeps.tune.confirmation import certified_since
from gridworld.sweeps.tune.study import is_claimed
from gridworld.training.reproduce import check_whole
from gridworld.training.resume import open_unfinished
from gridworld.training.saved_run import SavedRun, read_visits

Telling = Callable[[Path], str]  # all that a command makes of a folder; raises `InputError`


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a run, a sweep of three jobs and a study."""
    folder = tmp_path_factory.mktemp("good")
    train_in(folder / "run", *SHORT["sarsa"], "recording.frames=false", "recording.gif=false")
    write_sweep(folder / "sweep", folder / "run")
    write_study(folder / "study")
    return folder


def reported(folder: Path) -> str:
    report = gather([folder / "run"])
    if found := report.sentences():
        raise InputError(found[0])
    return render(report, charts(report))


def evaluated(folder: Path) -> str:
    saved = SavedRun(folder / "run")
    return f"{saved.evaluator().optimal_value} {dataclasses.astuple(saved.config)} {vars(saved.snapshot())}"


def recorded(folder: Path) -> str:
    saved = SavedRun(folder / "run")
    visits = read_visits(saved.run, saved.mdp.neighbour.shape)
    return f"{saved.steps()} {visits}"


def gone_on(folder: Path) -> str:
    unfinished = open_unfinished(folder / "run")
    return f"{unfinished.run.manifest} {unfinished.config} {unfinished.mdp.text()}"


def reproduced(folder: Path) -> str:
    saved = SavedRun(folder / "run")
    check_whole(saved.run, saved.config)
    return str(saved.run.manifest)


def confirmed(folder: Path) -> str:
    return str(certified_since(folder / "run"))


def listed(folder: Path) -> str:
    rows = SweepFolder(folder / "sweep").rows().values()
    if any("changed" in row.error for row in rows):
        raise InputError(str(rows))
    return str(rows)


def tuned(folder: Path) -> str:
    found, problems = tuning.find_tunings([folder / "study"])
    if problems:
        raise InputError(problems[0])
    return str([vars(study) for study in found])


def claimed(folder: Path) -> str:
    return str(is_claimed(folder / "study", "mine"))


OF_A_RUN = (reported, evaluated, recorded, gone_on, reproduced, confirmed)
CASES: list[tuple[str, int, tuple[Telling, ...]]] = [
    ("run/manifest.json", 120, OF_A_RUN),
    ("run/curve.csv", 80, (reported, reproduced)),
    ("run/summary.json", 50, (reported, recorded, reproduced, confirmed)),
    ("run/model.zip", 30, (evaluated, reproduced)),
    ("run/visits.npy", 20, (recorded, reproduced)),
    *((f"run/{picture.file}", 5, (reported,)) for picture in PICTURES if picture.caption),
    ("sweep/sweep.json", 20, (listed,)),
    ("sweep/seed=0/manifest.json", 20, (listed,)),
    ("sweep/seed=0/summary.json", 10, (listed,)),
    ("study/study.json", 20, (tuned,)),
    ("study/trials.csv", 20, (tuned,)),
    ("study/search.json", 20, (claimed,)),
]


@pytest.mark.parametrize(
    ("name", "count", "tellings"), CASES, ids=lambda value: value if type(value) is str else ""
)
def test_a_changed_digit_is_told_or_changes_nothing(
    name: str, count: int, tellings: tuple[Telling, ...], good: Path, tmp_path: Path
) -> None:
    shutil.copytree(good, tmp_path / "x", symlinks=True)
    folder = tmp_path / "x"
    good_ones = {telling: telling(folder).replace(str(folder), "") for telling in tellings}
    chance, raw = random.Random(name), (folder / name).read_bytes()
    told = 0
    for place in chance.sample(places(raw), count):
        changed = bytearray(raw)
        changed[place] = chance.choice([digit for digit in b"0123456789" if digit != raw[place]])
        (folder / name).write_bytes(changed)
        for telling in tellings:
            where = f"{telling.__name__}: byte {place}, {raw[place - 30 : place + 30]!r}"
            said, mistake = outcome(telling, folder)
            told += mistake != ""
            assert said == good_ones[telling] or Path(name).name in mistake, (where, mistake)
    assert told > count / 2


def outcome(telling: Telling, folder: Path) -> tuple[str, str]:
    """(what it says, what is wrong)."""
    warnings = io.StringIO()
    try:
        with contextlib.redirect_stderr(warnings):
            return telling(folder).replace(str(folder), ""), warnings.getvalue()
    except InputError as error:
        return "", str(error)


def places(raw: bytes) -> list[int]:
    """Of its digits; of a file that is no text, of all its bytes."""
    found = [place for place, byte in enumerate(raw) if byte in b"0123456789"]
    return found if raw.isascii() else list(range(len(raw)))


@pytest.mark.parametrize("format", [0, 3, "2", None, True, 1])
def test_a_format_that_is_not_the_seals_is_told(format: Any, good: Path, tmp_path: Path) -> None:
    shutil.copytree(good / "run", tmp_path / "run")
    content = json.loads((tmp_path / "run" / "manifest.json").read_text())
    (tmp_path / "run" / "manifest.json").write_text(json.dumps(content | {"format": format}))
    with pytest.raises(
        InputError,
        match=r"manifest.json: has format .* reads 2; was it made by an older version\?",
    ):
        read_run(tmp_path / "run")


def test_a_damaged_run_is_left_out_and_the_rest_reported(tmp_path: Path) -> None:
    maker = Maker("agent=ppo")
    for seed in range(3):
        maker.write(tmp_path / f"run{seed}", seed, 8000)
    path = tmp_path / "run1" / "curve.csv"
    rows = list(csv.reader(path.read_text().splitlines()))
    rows[5][1] = "0.125"
    path.write_text("\n".join(map(",".join, rows)) + "\n")
    report = gather([tmp_path])
    assert [run.seed for group in report.study.groups for run in group.runs] == [0, 2]
    (sentence,) = report.sentences()
    assert sentence.startswith(f"{path}: is not the file that the run wrote")


def test_how_far_an_unfinished_run_came_is_told_as_not_verified(tmp_path: Path) -> None:
    maker = Maker("agent=ppo")
    maker.write(tmp_path / "done", 0, 8000)
    run = maker.write(tmp_path / "begun", 1, 8000)
    content = json.loads((run / "manifest.json").read_text()) | {"status": "interrupted"}
    (run / "manifest.json").write_text(json.dumps(sealed(content)))
    (sentence,) = gather([tmp_path]).sentences()
    assert "last evaluated after 20,000 steps, according to the unverified curve.csv" in sentence


def in_json(path: Path, **values: object) -> None:
    path.write_text(json.dumps(sealed(json.loads(path.read_text()) | values)))


def pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


JOB = {"job": "seed=0", "hash": "1" * 32, "overrides": ["seed=0"]}
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "sweep.json is a pipe": (lambda sweep: pipe(sweep / "sweep.json"), "error: .*is not an ordinary file"),
    "overrides are numbers": (
        lambda sweep: in_json(sweep / "sweep.json", jobs=[JOB | {"overrides": [1]}]),
        r"error: .*sweep.json: damaged \(overrides must be a command line.s words\)",
    ),
    "jobs of one folder": (
        lambda sweep: in_json(sweep / "sweep.json", jobs=[JOB, JOB | {"hash": "2"}]),
        r"error: .*sweep.json: damaged \(two jobs have the same folder or hash\)",
    ),
    "jobs.csv is a pipe": (lambda sweep: pipe(sweep / "jobs.csv"), "3 jobs: 1 pending, 1 done, 1 failed"),
    "jobs.csv is huge": (
        lambda sweep: (sweep / "jobs.csv").write_text('job,overrides\n"' + 10**6 * "x"),
        "3 jobs: 1 pending, 1 done, 1 failed",
    ),
    "summary.json is a pipe": (
        lambda sweep: pipe(sweep / "seed=0" / "summary.json"),
        "failed .*summary.json: is not an ordinary file",
    ),
    "a status that is a list": (
        lambda sweep: in_json(sweep / "seed=0" / "manifest.json", status=[]),
        "failed .*manifest.json: status must be a word",
    ),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_sweep_that_was_altered_is_listed_or_refused_in_a_sentence(
    what: str, good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(good / "sweep", tmp_path / "sweep")
    harm, words = HOSTILE[what]
    harm(tmp_path / "sweep")
    try:
        jobs_command.main([str(tmp_path / "sweep")])
        told = capsys.readouterr().out
    except InputError as error:
        told = f"error: {error}"
    assert re.search(words, told), told


@pytest.mark.parametrize(
    ("key", "value"), [("steps", 10**30), ("steps", -1), ("steps", 401), ("seconds", 1e999)]
)
def test_a_checkpoint_of_an_impossible_number_is_passed_over(
    key: str, value: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["checkpoint.every=400", "recording.frames=false", "recording.gif=false"]
    stopped_after(1, tmp_path / "run", *SHORT["sarsa"], *words)
    (path,) = (tmp_path / "run" / "checkpoints").glob("*.state")
    path.write_bytes(encode(decode(path.read_bytes()) | {key: value}))
    if value == 10**30:
        path.rename(path.with_name(f"{value}.state"))
    go_on(tmp_path / "run")
    told = capsys.readouterr().err
    assert ".state: skipped, its " in told
    assert read_run(tmp_path / "run").is_finished


@pytest.mark.parametrize("value", ["1e999", str(10**400), str(10**19), str(-(10**30))])
def test_a_study_with_a_number_beyond_all_is_refused(value: str, good: Path, tmp_path: Path) -> None:
    shutil.copytree(good / "study", tmp_path / "study")
    for name, telling in (("study.json", tuned), ("search.json", claimed)):
        in_json(tmp_path / "study" / name, importances={"agent.gamma": 7531}, about={"objective": 7531})
        text = (tmp_path / "study" / name).read_text()
        (tmp_path / "study" / name).write_text(text.replace("7531", value))
        with pytest.raises(InputError, match=f"{name}: is not JSON, .* is too large"):
            telling(tmp_path)
