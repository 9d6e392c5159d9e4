"""What commands print: columns in line, whatever numbers are in them, and nothing that acts on a terminal."""

import json
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gridworld.base.console import aligned, printable
from gridworld.base.safe_read import sealed
from gridworld.commands import jobs as jobs_command
from gridworld.run.summary import summary_text
from gridworld.sweeps import folder
from gridworld.sweeps.folder import JobRow

WORDS = st.text("ab-.0", min_size=1, max_size=30)
USUAL = {
    "recipe": None, "preset": "none", "privileges": [], "agent": "dqn", "env": "classic", "seed": 0,
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
    told = aligned(rows, (f"<{least}", f">{least}", "<0"))
    assert [line.split() for line in told] == [list(row) for row in rows]
    places = [[match.span() for match in re.finditer(r"\S+", line)] for line in told]
    assert len({place[0][0] for place in places} | {0}) == 1  # words begin in line
    assert len({place[1][1] for place in places}) <= 1  # numbers end in line
    assert len({place[2][0] for place in places}) <= 1
    assert all(place[1][1] - place[0][0] > least for place in places)
    assert all(line == line.rstrip() for line in told)


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
    assert line.endswith("0.9863   more often than the optimum, but with less value")


def test_the_list_of_a_sweeps_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [
        JobRow("seed=0", "", "interrupted", "12345678.90", "", "it was stopped"),
        JobRow("seed=1,agent=dqn", "", "done", "0.10", "-1e-300", ""),  # rounding
        JobRow("seed=2", "", "pending", "", "", ""),
    ]
    jobs = [{"job": row.job, "hash": row.job, "overrides": []} for row in rows]
    (tmp_path / "sweep.json").write_text(json.dumps(sealed({"asked": [{"overrides": []}], "jobs": jobs})))
    told = {row.job: row for row in rows}
    monkeypatch.setattr(folder, "job_row", lambda path, entry: told[path.name])
    jobs_command.main([str(tmp_path)])
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
