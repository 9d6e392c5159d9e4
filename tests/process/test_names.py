"""A name out of a folder, a manifest, a job or a study acts on no terminal and is no markup in a report."""

import contextlib
import json
import logging
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.hostile import manifest
from helpers.support import SHORT, train_in

from gridworld.base.console import prepare
from gridworld.base.safe_read import sealed
from gridworld.commands import evaluate, jobs, report, reproduce, run
from gridworld.commands import train as train_command
from gridworld.config.train import TrainConfig
from gridworld.report.tables import Table, to_captioned_markdown, to_csv, to_markdown
from gridworld.report.tuning_study import find_tunings
from gridworld.sweeps import console
from gridworld.sweeps.folder import FAILED, JobRow, SweepFolder
from gridworld.sweeps.plan import Job

EVIL = "x\x1b[2J\x1b]0;owned\x07\n\r\u202e<b onclick=x>|[a](javascript:x)\udcff"
SHOWN = r"x\x1b[2J\x1b]0;owned\x07\n\r\u202e"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("good") / EVIL.replace("/", "")
    train_in(folder, *SHORT["sarsa"], "total_timesteps=300", "recording.frames=false", "recording.gif=false")
    return folder


def told(main: Callable[..., None], capsys: pytest.CaptureFixture[str], *words: object) -> list[str]:
    """The lines that a command prints, both streams."""
    with pytest.MonkeyPatch.context() as patched, contextlib.suppress(SystemExit):
        patched.setattr("sys.argv", ["command", *map(str, words)])
        patched.setattr("gridworld.commands.prepare", lambda: None)
        run(main)
    out, err = capsys.readouterr()
    for sign in out + err:
        assert sign == "\n" or sign.isprintable(), (out, err)
    return (out + err).splitlines()


def test_what_commands_and_reports_say_of_a_run(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / EVIL
    shutil.copytree(good, runs / "good")
    place = runs / EVIL
    shutil.copytree(good, place)
    assert SHOWN in told(evaluate.main, capsys, place, "--episodes", 5)[0]
    assert SHOWN in told(reproduce.main, capsys, place)[0]
    (line,) = told(train_command.resume, capsys, f"resume={place}")
    assert line.startswith("error: ")
    manifest(place, lambda content: content.update(status="failed", error=EVIL))
    (line,) = told(evaluate.main, capsys, place)
    assert "this run is 'failed'" in line
    line, warning = told(report.main, capsys, runs)
    assert line.endswith("/report/report.html")
    assert "this run is 'failed'" in warning
    files = [path for path in (runs / "report").rglob("*") if path.suffix in (".md", ".csv", ".html")]
    assert len(files) > 10
    for path in files:
        text = path.read_text("utf-8")
        assert re.fullmatch(r"[^\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]*", text), path
        assert "<b onclick" not in text or path.suffix == ".csv"
        assert "](" not in text or path.suffix in (".csv", ".html")


def test_heads_and_captions_are_text() -> None:
    table = Table("x", f"<img src=x> {EVIL}", ["<b>|", "https://a.b www.c.d"], [["<i>", EVIL]])
    text = to_captioned_markdown(table)
    assert not re.search(r"[<>\[\]\x1b\r]|://|www\.", text.replace("| --- | --- |", ""))
    assert len(text.splitlines()) == 5
    assert text.endswith(to_markdown(table))
    assert to_csv(table).isascii()
    assert "\x1b" not in to_csv(table)


def test_names_in_a_study_are_text(tmp_path: Path) -> None:
    study = {
        "study": EVIL, "agent": EVIL, "env": EVIL, "confirmation": {"sentence": EVIL}, "began_from": None,
        "winner": {"trial": 1, "values": {}}, "finalists": [], "importances": {}, "space": {},
    }  # fmt: skip
    (tmp_path / "study.json").write_text(json.dumps(sealed(study)))
    (tmp_path / "trials.csv").write_text("trial,status,score\n")
    (found,), problems = find_tunings([tmp_path])
    assert not problems
    assert (found.title + found.name + found.sentence).isprintable()


def test_what_is_said_of_a_sweeps_jobs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = SweepFolder(tmp_path / EVIL)
    with sweep.at_work():
        sweep.add([Job((f"env={EVIL}",), (EVIL,), "1" * 32, None, TrainConfig())], [EVIL])
    (entry,) = sweep.entries.values()
    (sweep.path / entry.job).mkdir()
    (sweep.path / entry.job / "error.txt").write_text(EVIL, errors="replace")
    row, total = told(jobs.main, capsys, sweep.path)
    assert row.isprintable()
    assert "owned" in row
    assert total == "1 job: 1 failed"
    raw = (sweep.path / "sweep.json").read_text()
    content = json.loads(raw)
    for name in (EVIL, "..", "a/b", ".hidden", "", "x\x00", 1):
        content["jobs"][0]["job"] = name
        (sweep.path / "sweep.json").write_text(json.dumps(sealed(content)))
        (line,) = told(jobs.main, capsys, sweep.path)
        assert "is not a job's folder" in line
    console.tell_end(sweep.path, [JobRow("x", EVIL, FAILED, error=EVIL)], 1, "stopped", ())
    out, err = capsys.readouterr()
    assert all(sign == "\n" or sign.isprintable() for sign in out + err)


def test_what_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    prepare()
    logging.getLogger("gridworld").warning("%s: was deleted", EVIL)
    assert caplog.records[-1].getMessage().isprintable()
    assert caplog.records[-1].getMessage().endswith(": was deleted")
