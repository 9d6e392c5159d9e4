"""Damaged files of runs: each is named, and the rest is reported."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.support import SHORT, train_in

from gridworld.base.errors import InputError
from gridworld.commands import report as command
from gridworld.report.analysis import gather
from gridworld.report.evidence import Evidence, Unusable, read
from gridworld.report.writer import write_over_seeds
from gridworld.run.folder import RESULTS, WORLD
from gridworld.run.reader import read_run
from gridworld.sweeps.console import results_lines
from gridworld.sweeps.folder import DONE, JobRow

AGENTS = ("sarsa", "q_learning")
SEEDS = range(2)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two agents on a world of tables, two seeds each, with event files."""
    folder = tmp_path_factory.mktemp("damaged")
    own = ("env=river_swim", "logging.tensorboard=true", "recording.gif=false", "total_timesteps=600")
    for agent in AGENTS:
        for seed in SEEDS:
            train_in(folder / f"{agent}{seed}", *SHORT[agent], *own, f"seed={seed}")
    return folder


@pytest.fixture
def runs(trained: Path, tmp_path: Path) -> Path:
    shutil.copytree(trained, tmp_path / "runs")
    return tmp_path / "runs"


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def replaced(put: Callable[[Path], object]) -> Callable[[Path], None]:
    def harm(file: Path) -> None:
        file.unlink()
        put(file)

    return harm


ANOTHER = "is not the file that the run wrote: its checksum differs from manifest.json"
DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut off": (lambda file: os.truncate(file, file.stat().st_size // 2), ANOTHER),
    "a bit": (flip, ANOTHER),
    "empty": (lambda file: os.truncate(file, 0), ANOTHER),
    "gone": (lambda file: file.unlink(), "has no "),
    "a folder": (replaced(lambda file: file.mkdir()), "is not an ordinary file"),
    "a link": (replaced(lambda file: file.symlink_to("/etc/hostname")), "is a symbolic link"),
    "a pipe": (replaced(os.mkfifo), "is not an ordinary file"),
    "huge": (lambda file: os.truncate(file, 2**40), "is larger than "),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_each_damaged_file_is_named(damage: str, runs: Path) -> None:
    harm, words = DAMAGES[damage]
    run = runs / "sarsa1"
    listed = [name for name in read_run(run).manifest["sha256"] if not name.endswith(".gif")]
    assert {*RESULTS, WORLD} <= set(listed)
    for name in listed:
        shutil.copy2(run / name, runs / "kept")
        harm(run / name)
        found = read(run)
        (told,) = found.damage if isinstance(found, Evidence) else found.reasons
        assert all(part in told for part in (words, str(run), name)), (name, told)
        assert isinstance(found, Unusable) == (name in ("curve.csv", "summary.json")), name
        shutil.rmtree(run / name) if damage == "a folder" else (run / name).unlink(missing_ok=True)
        (runs / "kept").rename(run / name)
    for name in listed:
        harm(run / name)
    found = read(run)
    assert isinstance(found, Unusable)
    assert len(found.reasons) == len(listed)


def test_what_leaves_the_numbers_whole_is_named_and_the_run_counted(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs / "q_learning1", runs / "a copy")  # the whole one counts
    damaged = [runs / name for name in ("sarsa0/visits.npy", "a copy/visits.npy", "q_learning0/world.npz")]
    for file in damaged:
        flip(file)
    with pytest.raises(SystemExit, match="1"):
        command.main([str(runs), "--out", str(runs.parent / "out"), "--formats"])
    page, told = (runs.parent / "out" / "report.html").read_text(), capsys.readouterr().err
    for file in damaged:
        assert f"warning: {file}" in told
        assert f"<li>{file}" in page
    assert f"note: {runs / 'sarsa0'}: is not diagnosed; {damaged[0]}: is not the file" in told
    assert "cannot be rebuilt" not in page  # another run has the same world
    rows = (runs.parent / "out" / "tables" / "runs.csv").read_text().splitlines()[1:]
    assert len(rows) == len(AGENTS) * len(SEEDS)
    assert not any("a copy" in row for row in rows)


def test_curves_over_seeds_are_of_the_runs_that_are_left(
    runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.truncate(runs / "q_learning1" / "curve.csv", 9)
    flip(runs / "sarsa0" / "best_model.zip")
    folder = write_over_seeds(runs, runs)
    assert folder is not None
    assert [path.name for path in folder.iterdir()] == ["sarsa on RiverSwim 6"]  # of the other, one is left
    warnings = capsys.readouterr().err.splitlines()
    files = ("sarsa0/best_model.zip", "q_learning1/curve.csv")
    assert [line.partition(": ")[0] for line in warnings] == [str(runs / file) for file in files]
    shutil.rmtree(folder)
    for run in runs.iterdir():
        os.truncate(run / "summary.json", 1)
    assert write_over_seeds(runs, runs) is None
    assert "_over_seeds: cannot be written, nothing to report: " in capsys.readouterr().err
    with pytest.raises(InputError, match=r"nothing to report: .*0/summary.json: .*sarsa1/summary.json: "):
        gather([runs])


def test_a_sweeps_table_names_what_it_leaves_out(runs: Path) -> None:
    flip(runs / "sarsa1" / "summary.json")
    lines = results_lines(runs, [JobRow(f"sarsa{seed}", "", DONE) for seed in SEEDS])
    assert lines[-1] == "1 of 2 jobs are not counted: sarsa1"
    assert "of 1 [" in lines[1]


def test_a_mistake_of_this_program_is_not_taken_for_damage(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(evidence: object) -> None:
        raise AttributeError("a bug")

    monkeypatch.setattr("gridworld.diagnosis.verdict.diagnose", broken)
    with pytest.raises(AttributeError, match="a bug"):
        command.main([str(runs), "--out", str(runs.parent / "out"), "--formats"])
