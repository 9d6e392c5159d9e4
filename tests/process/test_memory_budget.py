"""The budget of memory that commands have for what they read, and the lines that tell of what takes long."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.support import SHORT, train_in

from gridworld.base import console
from gridworld.base.console import telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.safe_read import as_object, as_table
from gridworld.base.serialization import decode, encode
from gridworld.base.user_input import VARIABLE, BudgetError, check_memory, is_limited, limited
from gridworld.commands import evaluate


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
    monkeypatch.setattr(console, "_SECONDS_BETWEEN_LINES", 0.01)
    with telling_if_slow("training"):  # of one's own
        time.sleep(0.05)
    with limited(), telling_if_slow("reading\x1b"), telling_if_slow("a part of it"):
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 2
    assert all(re.fullmatch(r"reading\S+: \d+ s so far; Ctrl-C ends it", line) for line in lines)


def test_a_command_is_limited_while_it_is_at_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train_in(tmp_path, *SHORT["sarsa"], "recording.frames=false", "recording.gif=false")
    evaluate.main([str(tmp_path), "--episodes", "5"])
    assert not is_limited()
    monkeypatch.setenv(VARIABLE, "much")
    with pytest.raises(InputError, match="GRIDWORLD_BUDGET=much"):
        evaluate.main([str(tmp_path), "--episodes", "5"])
