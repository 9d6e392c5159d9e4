"""One digit that was changed somewhere is never silent: a command tells it, or says what it said before.

Every file that is read of a run, a sweep and a study is damaged, in each some digits, and read again by what
the commands read it with.
"""

import contextlib
import dataclasses
import io
import json
import os
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.resuming import go_on, stopped_after
from helpers.runs_folder import write_study, write_sweep
from helpers.support import SHORT, train_in

from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.base.serialization import decode, encode
from gridworld.commands import jobs as jobs_command
from gridworld.commands import record
from gridworld.config.train import PICTURES
from gridworld.report import tuning_study as tuning
from gridworld.report.analysis import gather
from gridworld.report.playground.page import run_page
from gridworld.report.writer import charts, render
from gridworld.run.reader import read_run
from gridworld.sweeps.folder import SweepFolder
from gridworld.sweeps.tune.confirmation import certified_since
from gridworld.sweeps.tune.study import is_claimed
from gridworld.training.reproduce import check_whole
from gridworld.training.resume import open_unfinished
from gridworld.training.saved_run import SavedRun

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
    record.main([str(folder / "run"), "--format", "policy", "--cell-size", "20"])
    return str((folder / "run" / "recording" / "policy.png").read_bytes())


def shown(folder: Path) -> str:
    return run_page(SavedRun(folder / "run"))


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


OF_A_RUN = (reported, evaluated, recorded, shown, gone_on, reproduced, confirmed)
CASES: list[tuple[str, int, tuple[Telling, ...]]] = [
    ("run/manifest.json", 120, OF_A_RUN),
    ("run/curve.csv", 80, (reported, reproduced)),
    ("run/summary.json", 50, (reported, recorded, reproduced, confirmed)),
    ("run/model.zip", 30, (evaluated, reproduced)),
    ("run/visits.npy", 20, (recorded, shown, reproduced)),
    ("run/checkpoints/000000002000.state", 20, (shown,)),
    *((f"run/{picture.file}", 5, (reported,)) for picture in PICTURES.values() if picture.caption),
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


def test_a_format_that_is_not_the_seals_is_told(good: Path, tmp_path: Path) -> None:
    content = json.loads((good / "run" / "manifest.json").read_text())
    for wrong in (0, 3, "2", None, True, 1):
        (tmp_path / "manifest.json").write_text(json.dumps(content | {"format": wrong}))
        words = r"manifest.json: has format .* reads 2; was it made by an older version\?"
        with pytest.raises(InputError, match=words):
            read_run(tmp_path)


JOB = {"job": "seed=0", "hash": "1" * 32, "overrides": ["seed=0"]}
HOSTILE: list[tuple[str, dict[str, object] | None, str]] = [  # a file, what is changed in it, None: a pipe
    ("sweep.json", None, "error: .*is not an ordinary file"),
    ("sweep.json", {"jobs": [JOB | {"overrides": [1]}]}, r"error: .* \(overrides must be a command line"),
    ("sweep.json", {"jobs": [JOB, JOB | {"hash": "2"}]}, r"error: .* \(two jobs have the same folder"),
    ("jobs.csv", None, "3 jobs: 1 pending, 1 done, 1 failed"),
    ("seed=0/summary.json", None, "failed .*summary.json: is not an ordinary file"),
    ("seed=0/manifest.json", {"status": []}, "failed .*manifest.json: status must be a word"),
]


@pytest.mark.parametrize(("name", "changes", "words"), HOSTILE)
def test_a_sweep_that_was_altered_is_listed_or_refused_in_a_sentence(
    name: str,
    changes: dict[str, object] | None,
    words: str,
    good: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(good / "sweep", tmp_path / "sweep")
    file = tmp_path / "sweep" / name
    if changes is None:
        file.unlink(missing_ok=True)
        os.mkfifo(file)
    else:
        file.write_text(json.dumps(sealed(json.loads(file.read_text()) | changes)))
    try:
        jobs_command.main([str(tmp_path / "sweep")])
        told = capsys.readouterr().out
    except InputError as error:
        told = f"error: {error}"
    assert re.search(words, told), told


def test_checkpoints_of_impossible_numbers_are_passed_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["checkpoint.every=400", "recording.frames=false", "recording.gif=false"]
    stopped_after(1, tmp_path / "run", *SHORT["sarsa"], *words)
    (path,) = (tmp_path / "run" / "checkpoints").glob("*.state")
    whole = decode(path.read_bytes())
    numbers = (("steps", 10**30, 10**30), ("steps", -1, 402), ("steps", 401, 403), ("seconds", 1e999, 400))
    for key, value, name in numbers:
        path.with_name(f"{name}.state").write_bytes(encode(whole | {key: value}))
    path.unlink()
    go_on(tmp_path / "run")
    assert capsys.readouterr().err.count(".state: skipped, its ") == len(numbers)
    assert read_run(tmp_path / "run").is_finished
