"""What commands print: columns in line, nothing that acts on a terminal or is markup; and their budget.

A name may come out of a folder, a manifest, a job or a study of somebody else's.
"""

import contextlib
import json
import logging
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.hostile import manifest
from helpers.support import SHORT, train_in
from hypothesis import given
from hypothesis import strategies as st

from gridworld.base import console as base_console
from gridworld.base.console import aligned, prepare, printable, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.safe_read import as_object, as_table, sealed
from gridworld.base.serialization import decode, encode
from gridworld.base.user_input import VARIABLE, BudgetError, check_memory, is_limited, limited
from gridworld.commands import evaluate, jobs, report, reproduce, run
from gridworld.commands import train as train_command
from gridworld.config.train import TrainConfig
from gridworld.report.tables import Table, to_captioned_markdown, to_csv, to_markdown
from gridworld.report.tuning_study import find_tunings
from gridworld.run.console import summary_text
from gridworld.sweeps import console, folder
from gridworld.sweeps.folder import FAILED, JobRow, SweepFolder
from gridworld.sweeps.plan import Job

EVIL = "x\x1b[2J\x1b]0;owned\x07\n\r\u202e<b onclick=x>|[a](javascript:x)\udcff"
SHOWN = r"x\x1b[2J\x1b]0;owned\x07\n\r\u202e"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("good") / EVIL.replace("/", "")
    train_in(place, *SHORT["sarsa"], "total_timesteps=300", "recording.frames=false", "recording.gif=false")
    return place


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


# ---- columns -----------------------------------------------------------------------------------------------

WORDS = st.text("ab-.0", min_size=1, max_size=30)
USUAL = {
    "recipe": None, "privileges": [], "agent": "dqn", "env": "classic", "seed": 0,
    "timesteps": 30208, "train_seconds": 0.8, "max_episode_steps": 100,
    "value": 0.93207, "goal_probability": 1.0, "length": 8.0, "regret": 0.0,
    "optimal_value": 0.93207, "optimal_goal_probability": 1.0, "optimal_length": 8.0,
    "sampled": {"value": 0.8786, "goal_probability": 0.9737, "length": 8.392, "regret": 0.0535},
    "certified": True, "certified_since_step": 12032,
}  # fmt: skip


@given(st.lists(st.tuples(WORDS, WORDS, WORDS), max_size=5), st.integers(0, 12))
def test_cells_are_found_again_in_line_and_a_blank_apart(
    rows: list[tuple[str, str, str]], least: int
) -> None:
    lines = aligned(rows, (f"<{least}", f">{least}", "<0"))
    assert [line.split() for line in lines] == [list(row) for row in rows]
    places = [[match.span() for match in re.finditer(r"\S+", line)] for line in lines]
    assert len({place[0][0] for place in places} | {0}) == 1  # words begin in line
    assert len({place[1][1] for place in places}) <= 1  # numbers end in line
    assert len({place[2][0] for place in places}) <= 1
    assert all(place[1][1] - place[0][0] > least for place in places)
    assert all(line == line.rstrip() for line in lines)


def test_the_table_at_the_end_of_a_usual_run() -> None:
    assert summary_text(USUAL, "runs/a").splitlines()[2:9] == [
        "                           greedy   sampled   optimum",
        "  without a step limit:",
        "  value                    0.9321    0.8786    0.9321",
        "  regret                        0    0.0535         0",
        "  within 100 steps:",
        "  goal probability              1    0.9737         1",
        "  episode length                8     8.392         8",
    ]


def test_a_goal_that_is_reached_more_often_for_less_is_explained() -> None:
    """A policy may keep away from the fastest way, and be sure of the goal."""
    summary = USUAL | {"certified": False, "endless_cells": [], "endless_states": []}
    summary |= {"timeout_probability": 0.0, "optimal_goal_probability": 0.9863}
    [line] = [line for line in summary_text(summary, "x").splitlines() if "goal probability" in line]
    assert line.endswith("0.9863   more often than the optimum, but worth less")


@pytest.mark.parametrize("length", [8.0, 100.0])
def test_a_loop_is_a_reason_unless_the_optimum_never_ends_either(length: float) -> None:
    summary = USUAL | {"certified": False, "regret": 0.5, "endless_cells": [[0, 0]]}
    summary |= {"endless_states": ["state 0"], "timeout_probability": 1.0, "optimal_length": length}
    assert ("until the step limit" in summary_text(summary, "x")) == (length < 100)


def test_a_regret_that_is_small_by_floats_alone_is_not_called_one() -> None:
    summary = USUAL | {"certified": False, "proven_regret": 7332.4, "endless_cells": []}
    summary |= {"endless_states": [], "timeout_probability": 0.0}
    assert "not proven optimal: regret 0 by floating point, and at most 7.4e+3 by proof" in summary_text(
        summary, "x"
    )


def test_the_list_of_a_sweeps_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        JobRow("seed=0", "", "interrupted", "12345678.90", "", "it was stopped"),
        JobRow("seed=1,agent=dqn", "", "done", "0.10", "-1e-300", ""),  # rounding
        JobRow("seed=2", "", "pending", "", "", ""),
    ]
    entries = [{"job": row.job, "hash": row.job, "overrides": []} for row in rows]
    content = {"asked": [{"overrides": []}], "jobs": entries}
    (tmp_path / "sweep.json").write_text(json.dumps(sealed(content)))
    named = {row.job: row for row in rows}
    monkeypatch.setattr(folder, "job_row", lambda path, entry: named[path.name])
    jobs.main([str(tmp_path)])
    assert capsys.readouterr().out.splitlines() == [
        "seed=0            interrupted 12345678.90 s  it was stopped",
        "seed=1,agent=dqn  done               0.10 s  regret 0",
        "seed=2            pending",
        "3 jobs: 1 pending, 1 done, 1 interrupted",
    ]


def test_what_is_printed_cannot_act_on_the_terminal() -> None:
    assert printable("plain ä 日本") == "plain ä 日本"
    assert printable("\x1b[2J\r\n\x07\u202e\ud800") == "\\x1b[2J\\r\\n\\x07\\u202e\\ud800"
    assert len(printable("x" * 10**6)) < 2100


# ---- the budget of memory, and what takes long -------------------------------------------------------------


def test_the_sentence_says_what_it_would_take_the_budget_and_how_to_raise_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check_memory("a model", 1e30)  # without a limit nothing is refused
    with limited():
        check_memory("a model", 10**9)
        with pytest.raises(BudgetError) as refused:
            check_memory("a model", 14.8e9)
    assert str(refused.value) == (
        "a model: would take about 14.8 GB of memory, but the budget is 1 GB; if you trust it and have the "
        "memory, set GRIDWORLD_BUDGET=15GB"
    )
    monkeypatch.setenv(VARIABLE, "15GB")
    with limited():
        check_memory("a model", 14.8e9)


@pytest.mark.parametrize("text", ["8", "-1GB", "0GB", "1e3GB", "8TB", "99999999999GB", "\x1b[2J"])
def test_a_budget_that_is_none_is_refused(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(InputError, match=VARIABLE), limited():
        pass


def test_files_are_refused_by_what_they_come_to_before_they_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "20MB")
    state = encode({"a": np.zeros(5_000_000)}, compress=True)
    assert len(state) < 200_000
    assert decode(state)["a"].size == 5_000_000
    with limited():
        assert as_table(b"ab\n" * 1000, Path("x.csv"))
        with pytest.raises(BudgetError, match=r"x\.csv: would take about"):
            as_table(b"ab\n" * 200_000, Path("x.csv"))
        with pytest.raises(BudgetError, match=r"x\.json: would take about"):
            as_object(b'{"a":[' + b"[]," * 300_000 + b"[]]}", Path("x.json"))
        with pytest.raises(BudgetError, match="this one: would take about 120 MB"):
            decode(state, "this one")


def test_what_takes_long_says_so_until_it_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(base_console, "_SECONDS_BETWEEN_LINES", 0.01)
    with telling_if_slow("training"):  # of one's own
        time.sleep(0.05)
    with limited(), telling_if_slow("reading\x1b"), telling_if_slow("a part of it"):
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 2
    assert all(re.fullmatch(r"reading\S+: \d+ s so far; Ctrl-C ends it", line) for line in lines)


def test_a_command_is_limited_while_it_is_at_work(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate.main([str(good), "--episodes", "5"])
    assert not is_limited()
    monkeypatch.setenv(VARIABLE, "much")
    with pytest.raises(InputError, match="GRIDWORLD_BUDGET=much"):
        evaluate.main([str(good), "--episodes", "5"])
