"""What is printed below a verdict that is not "certified": commands that run as they stand, and why."""

import shlex
from pathlib import Path

import pytest
from helpers.support import NO_FILES, ROOT, script, train_in

from gridworld.run.console import circles_text
from gridworld.run.reader import REQUIRED, RunReader
from gridworld.training.advice import _still_falls, advice

SHORT = ["total_timesteps=200", "evaluation.every=20", *NO_FILES]


@pytest.mark.parametrize(
    ("words", "reason", "command"),
    [
        (["env=cliff", "tuned=none"], "its recipe:", "train agent=q_learning env=cliff"),
        (["env.layout=four_rooms"], "its recipe:", "train agent=q_learning env=four_rooms"),
        (["env.slip=0.1", "seed=3"], "for stochastic worlds:", "train agent=q_learning env.slip=0.1 seed=3"),
        (["env.num_rows=9"], "for large worlds:", "train agent=q_learning env.num_rows=9"),
    ],
)
def test_the_recipe_comes_first(words: list[str], reason: str, command: str, tmp_path: Path) -> None:
    found = "\n".join(f"{line}" for line in _lines(tmp_path / "a run", "agent=q_learning", *words, *SHORT))
    assert reason in found
    assert command in found
    assert f"diagnose {shlex.quote(str(tmp_path / 'a run'))}" in found


def _lines(folder: Path, *words: str) -> list[str]:
    assert not train_in(folder, *words)["certified"]
    return advice(folder)


def test_more_steps_where_the_regret_still_falls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["agent=q_learning", "total_timesteps=200", "evaluation.every=20", *NO_FILES]
    _lines(tmp_path / "run", *words)
    for regret, falls in (([0.9] * 8, False), ([0.9] * 6 + [0.5, 0.4], True), ([0.9, 0.1], False)):
        rows = [",".join(REQUIRED), *(f"{step},0,{each},0,0,0" for step, each in enumerate(regret))]
        content = "\n".join(rows).encode()
        monkeypatch.setattr(RunReader, "read", lambda self, path, most, content=content: content)
        assert _still_falls(RunReader(tmp_path / "run", {})) == falls


def test_a_run_that_nobody_can_read_gets_none(tmp_path: Path) -> None:
    assert advice(tmp_path) == []


def test_it_is_printed_and_a_certified_run_has_none(tmp_path: Path) -> None:
    failed = script("train.py", "agent=q_learning", "hydra.run.dir=a", *SHORT[:2], *NO_FILES, cwd=tmp_path)
    assert "  try:\n" in failed.stdout
    assert f"python {ROOT}/scripts/diagnose.py a" in failed.stdout
    done = script("train.py", "agent=q_learning", "hydra.run.dir=b", *NO_FILES, cwd=tmp_path)
    assert "certified optimal" in done.stdout
    assert "try:" not in done.stdout


def test_five_states_are_named_at_most() -> None:
    names = [f"row 1, column {n}" for n in range(1, 6)]
    assert circles_text(5, names, 1) == (
        f"; it moves between {'; '.join(names[:4])} and {names[4]} until the step limit"
    )
    assert circles_text(158, names, 0.25).endswith(
        "row 1, column 5 and 153 more states until the step limit (probability 0.25)"
    )
    assert circles_text(1, names[:1], 1) == "; it stays in row 1, column 1 until the step limit"
    assert circles_text(0, [], 0) == ""
