"""What docs/benchmarks measures, briefly: the tables are there, and peers get the same task."""

import csv
import dataclasses
import itertools
import json
import sys
from importlib import import_module
from pathlib import Path

import pytest
from helpers.support import ROOT
from omegaconf import OmegaConf

import gridworld
from gridworld.base.errors import InputError

sys.path.append(str(ROOT / "docs"))
benchmark, measure, training, worlds, population, peers, whole = (
    import_module(f"benchmarks.{name}")
    for name in ("benchmark", "measure", "training", "worlds", "population", "peers", "end_to_end")
)


def test_the_benchmark_looks_where_it_writes_before_it_measures(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out, words in (
        (tmp_path, "is a folder; name a file in it"),
        (tmp_path / "file" / "x", "no such folder"),
    ):
        with pytest.raises(InputError, match=words):
            benchmark.main(["--quick", "--out", str(out)])


def test_the_benchmark_prints_tables_and_writes_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "benchmark.json"
    benchmark.main(["--quick", "--only", "stepping", "--out", str(out)])
    output = capsys.readouterr().out
    results = json.loads(out.read_text())["results"]
    assert {result["table"].partition(",")[0] for result in results} == {"stepping"}
    for result in results:
        assert result["name"] in output
        assert result["ours"] > 0
        if result["theirs"] is None:
            assert "not measured" in result["peer"]  # and says why
        else:
            assert result["ratio"] == pytest.approx(result["ours"] / result["theirs"])


def test_training_is_measured_on_both_sides() -> None:
    workload = dataclasses.replace(measure.QUICK, steps=256)
    found = {row.name: row for row in (*training.comparisons(workload), *worlds.comparisons(workload))}
    for name in ("DQN, 64 envs, an update of 512 per step", "FrozenLake-v1"):
        row = found[name]
        assert row.ours() > 0 < row.theirs()


def test_a_measurement_compares_pair_by_pair() -> None:
    ours, theirs = iter([1.0, 2.0, 30.0]), iter([1.0, 1.0, 10.0])
    result = measure.Comparison("t", "n", lambda: next(ours), "p", lambda: next(theirs)).measure(
        repetitions=3
    )
    assert (result.ours, result.theirs, result.ratio) == (2.0, 1.0, 2.0)


def test_rl_zoo_is_given_the_same_steps_of_the_same_world(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    executable = tmp_path / "python"  # stands in for one that has RL Zoo
    executable.write_text(f'#!/bin/sh\nprintf "%s\\n" "$PYTHONPATH" "$@" > "{tmp_path}/seen"\n')
    executable.chmod(0o755)
    monkeypatch.setenv("RL_ZOO_PYTHON", str(executable))
    [row] = [row for row in whole.comparisons(measure.QUICK) if row.peer.startswith("RL Zoo's ppo")]
    assert row.theirs is not None
    assert row.theirs() > 0
    path, *words = (tmp_path / "seen").read_text().splitlines()
    given = dict(zip(words[2::2], words[3::2], strict=True))
    assert (path, words[:2]) == (str(ROOT), ["-m", "rl_zoo3.train"])
    assert (given["--algo"], given["--env"], given["--n-timesteps"]) == ("ppo", "GridWorld-v0", "20000")
    assert "20,000 steps" in row.name
    settings = OmegaConf.load(given["--conf-file"])["GridWorld-v0"]
    assert settings["env_wrapper"] == f"gridworld.{gridworld.OneHotObservation.__name__}"


def test_the_page_of_faults_has_every_fault_and_adds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs" / "benchmarks")
    faults = import_module("faults")
    page = (ROOT / "docs" / "reference" / "faults.md").read_text("utf-8")
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines()]
    with (ROOT / "docs" / "data" / "faults.csv").open(encoding="utf-8", newline="") as file:
        every = list(csv.DictReader(file))
    for part in "AB":
        mine = [fault for fault in faults.CATALOGUE if faults.half(fault) == part]
        rows = [row for row in every if row["half"] == part]
        assert [f"{row['fault']} | {row['agent']}" for row in rows] == [fault.title for fault in mine]
        spoilt, right = (sum(int(row[name]) for row in rows) for name in ("spoilt", "right"))
        (total,) = (row for row in cells if row[:2] == ["all", part])
        assert total[5:7] == [str(spoilt), f"{right} ({right / spoilt:.0%})"]
        assert f"{right} of {spoilt}" in page.replace(f"{right} ({right / spoilt:.0%})", "")
    assert len({fault.operator for fault in faults.CATALOGUE if fault.source == "RLMutation"}) == 11
    assert len({fault.operator for fault in faults.CATALOGUE if fault.source == "muPRL"}) == 8
    programs = {fault.operator for fault in faults.CATALOGUE if fault.source == "DRLinter"}
    assert len(programs) + len(faults.NOT_EXPRESSED) == 21


def test_the_page_of_results_has_the_medians_of_its_csv() -> None:
    page = (ROOT / "docs" / "reference" / "results.md").read_text("utf-8")
    lines = [[cell.strip(" `") for cell in line.split("|")[1:-1]] for line in page.splitlines()]
    start = next(at for at, cells in enumerate(lines) if cells[:1] == ["world"])
    _, *agents = lines[start]
    table = {world: cells for world, *cells in itertools.takewhile(len, lines[start + 2 :])}
    shown = {(world, agent): cells[at] for world, cells in table.items() for at, agent in enumerate(agents)}
    with (ROOT / "docs" / "data" / "results.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    expected = {}
    for row in (row for row in rows if row["agent"] in agents):
        count, total = row["seeds certified"], row["seeds certified of"]
        text = f"{float(row['steps until certified for good, median']):,.0f}"
        world = row["task"].replace(" (kwargs.is_slippery=false)", ", not slippery")
        expected[world, row["agent"]] = text if count == total else f"{text} ({count} of {total})"
    assert {key: cell for key, cell in shown.items() if cell} == expected
