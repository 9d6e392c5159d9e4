"""From run folders to a report: grouping, bad input, and what is written."""

import csv
import io
import itertools
import json
import logging
import math
import os
import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from helpers.colours import check_words
from helpers.hostile import seal
from helpers.runs_folder import Maker, sweep, write_study
from helpers.support import train_in
from matplotlib.colors import to_rgba
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2

from gridworld.base.console import plain
from gridworld.base.errors import InputError
from gridworld.base.safe_read import sealed
from gridworld.commands import report as command
from gridworld.config.train import PICTURES
from gridworld.report import tables
from gridworld.report.agent_charts import overall_charts, task_charts
from gridworld.report.analysis import Overall, Reason, Report, TaskAnalysis, gather, on_grid, online_return
from gridworld.report.chart import Chart, short_names, styles
from gridworld.report.evidence import Evidence, read
from gridworld.report.grouping import labels
from gridworld.report.setting_charts import sweep_charts, sweeps
from gridworld.report.statistics import Interval
from gridworld.report.tuning_study import find_tunings
from gridworld.report.writer import BANDS, MARKERS, render
from gridworld.world.evaluation import Evaluator

FORMATS = ("png", "pdf", "svg")  # more words of `--formats`


@pytest.fixture(scope="module")
def maker() -> Maker:
    return Maker("agent=ppo")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of a small study, one run of which failed."""
    runs = sweep(tmp_path_factory.mktemp("study") / "runs", 5)
    in_json(runs / "ppo,classic,4", "manifest.json", status="failed", error="InputError: training diverged")
    return report_of(runs, code=1, options=FORMATS)


@pytest.fixture(scope="module")
def study(written: Path) -> Report:
    return gather([written.parent])


def report_of(*paths: Path, code: int = 0, options: tuple[str, ...] = ()) -> Path:
    """Run the command in this process, without figure files, and return the report's folder."""
    arguments = [*map(str, paths), "--formats", *options]
    if code:
        with pytest.raises(SystemExit) as ended:
            command.main(arguments)
        assert ended.value.code == code
    else:
        command.main(arguments)
    return paths[0] / "report"


def rows_of(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as opened:
        return list(csv.DictReader(opened))


def group_sizes(report: Report) -> dict[tuple[str, str], int]:
    return {(group.agent, group.task): len(group.runs) for group in report.study.groups}


def change(folder: Path, name: str, text: str) -> None:
    """Whatever can be sealed again, is."""
    (folder / name).write_text(text)
    if name != "manifest.json":
        seal(folder, name)


def in_json(folder: Path, name: str, **values: object) -> None:
    change(folder, name, json.dumps(sealed(json.loads((folder / name).read_text()) | values)))


def figures_of(task: TaskAnalysis) -> dict[str, Chart]:
    names = styles([result.group.agent for result in task.results])
    return {chart.name: chart for chart in task_charts(task, names)}


# ---- what is counted -----------------------------------------------------------------------------------


def test_real_runs_are_reported(tmp_path: Path) -> None:
    short = ("agent=q_learning", "total_timesteps=200", "evaluation.every=100", "recording.frames=false")
    for seed in (0, 1):
        train_in(tmp_path / "runs" / f"{seed}", *short, f"seed={seed}")
    folder = report_of(tmp_path / "runs")
    (result,) = rows_of(folder / "tables" / "results.csv")
    assert (result["task"], result["agent"], result["seeds certified of"]) == ("classic", "q_learning", "2")
    assert result["why not"] == "too few steps (2 of 2)"
    for row in rows_of(folder / "tables" / "runs.csv"):
        summary = json.loads((tmp_path / "runs" / row["seed"] / "summary.json").read_text())
        assert float(row["regret"]) == pytest.approx(summary["regret"])
        assert row["proven regret"] == str(summary["proven_regret"] or "")
        assert row["first certificate"] == str(summary["first_certified_step"] or "")
        assert row["certified since"] == str(summary["certified_since_step"] or "")
    page = (folder / "report.html").read_text()
    assert page.count('src="data:image/png;base64,') == 3  # the maps of the median seed
    why = rows_of(folder / "tables" / "not_certified.csv")
    assert {row["seed"] for row in why} == {"0", "1"}
    assert all(int(row["to try"].removeprefix("total_timesteps=")) >= 2000 for row in why)
    assert "Why runs are not certified" in page


def test_agents_are_ranked_by_since_when_they_are_certified_for_good(maker: Maker, tmp_path: Path) -> None:
    """The early agent is certified at step 2,000, loses it at once, and has it again at 16,000."""
    for seed in range(4):
        maker.write(tmp_path / f"steady,{seed}", seed, 8000, agent__name="steady")
        early = maker.write(tmp_path / f"early,{seed}", seed, 16000, agent__name="early")
        rows = list(csv.DictReader(io.StringIO((early / "curve.csv").read_text())))
        rows[2] |= {name: rows[16][name] for name in rows[2] if name != "step"}
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        change(early, "curve.csv", text.getvalue())
        in_json(early, "summary.json", first_certified_step=2000)
    report = gather([tmp_path])
    (task,) = report.tasks
    assert [result.group.agent for result in task.ranked] == ["steady", "early"]
    assert task.comparisons["steps", "steady", "early"].point == 1
    for table in (tables.results_table(report), tables.task_table(task)):
        for row in table.rows:
            cells = {key: tables.texts(cell)[0] for key, cell in zip(table.columns, row, strict=True)}
            early = cells["agent"] == "early"
            assert cells["steps until certified for good, median"] == ("16,000" if early else "8,000")
            assert cells["steps until the first certificate, median"] == ("2,000" if early else "8,000")
    page = (report_of(tmp_path) / "report.html").read_text()
    assert "steady is certified optimal on all 4 seeds, for good since step 8,000" in page
    assert "early is certified optimal on all 4 seeds, for good since step 16,000" in page
    assert "Steps until certified for good" in page


def test_reasons_are_asked_of_each_cell_before_the_second_of_any(
    maker: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in range(4):
        maker.write(tmp_path / f"a{seed}", seed, 1000 if seed == 0 else math.inf)
        maker.write(tmp_path / f"b{seed}", seed, math.inf, agent__learning_rate=0.001)
    report = gather([tmp_path])
    asked: list[str] = []

    def ask(folder: Path) -> Reason | None:
        asked.append(folder.name)
        if folder.name == "a2":
            raise InputError("a2/visits.npy: is another")
        return None if folder.name == "b0" else Reason(f"cause {folder.name > 'a1'}", "seed=1")

    monkeypatch.setattr(command, "_reason", ask)
    found, problems = command.reasons(report.study.groups, 5)
    assert problems == [f"{tmp_path / 'a2'}: is not diagnosed; a2/visits.npy: is another"]
    assert (sorted(asked[:2]), sorted(asked)) == (["a1", "b0"], ["a1", "a2", "b0", "b1", "b2"])
    report = replace(report, reasons=found)
    table = tables.results_table(report)
    assert table.columns[-1] == "why not"
    assert [row[-1] for row in table.rows] == ["cause True (2 of 2)", "cause False (1 of 1)"]
    assert "; 4 more were not diagnosed" in tables.reasons_table(report).caption


def test_runs_that_differ_are_reported_apart_and_the_report_says_so(tmp_path: Path) -> None:
    maker = Maker("agent=ppo", "agent.learning_rate=0.005", "agent.n_epochs=5")
    for seed in range(3):
        maker.write(tmp_path / f"a{seed}", seed, 3000)
        maker.write(tmp_path / f"b{seed}", seed, 5000, agent__learning_rate=0.001)
        maker.write(tmp_path / f"c{seed}", seed, 5000, agent__learning_rate=0.001, agent__n_epochs=9)
    # What does not touch learning does not split.
    maker.write(tmp_path / "a3", 3, 3000, device="cuda", threads=2, logging__progress=False, recording__fps=9)
    report = gather([tmp_path])
    assert group_sizes(report) == {
        ("ppo (learning_rate=0.001, n_epochs=5)", "classic"): 3,
        ("ppo (learning_rate=0.001, n_epochs=9)", "classic"): 3,
        ("ppo (learning_rate=0.005, n_epochs=5)", "classic"): 4,
    }
    assert report.study.notes == (
        "ppo on classic was run with 3 different configurations, reported separately; they differ in "
        "agent.learning_rate, agent.n_epochs.",
    )
    assert not report.sentences()
    features = "agent.policy_kwargs.features_extractor_class"  # it follows from the observation
    seen = [{features: f"features.{kind}", "observation.kind": kind} for kind in ("coordinates", "image")]
    assert labels([("ppo", each) for each in seen]) == [
        f"ppo (observation.kind={kind})" for kind in ("coordinates", "image")
    ]


def test_a_task_is_its_world_and_its_discount(maker: Maker, tmp_path: Path) -> None:
    maker.write(tmp_path / "plain", 0, 3000)
    maker.write(tmp_path / "slippery", 0, 3000, env__slip=0.25)
    maker.write(tmp_path / "short-sighted", 0, 3000, evaluation__gamma=0.9)
    report = gather([tmp_path])
    plainly, slippery, short = (
        f"classic (evaluation.gamma={gamma}, slip={slip})"
        for gamma, slip in ((0.99, 0.0), (0.99, 0.25), (0.9, 0.0))
    )
    assert {task for _, task in group_sizes(report)} == {plainly, slippery, short}
    # The made-up runs have the plain world's optimum; solving their world again finds that out.
    assert [task.task for task in report.tasks if task.world.problem] == [short, slippery]


def test_estimates_are_those_of_the_runs(tmp_path: Path) -> None:
    cliff = Maker("agent=ppo", "env=cliff")
    regrets, ends = [1.0, 2.0, 4.0, 8.0, 16.0, 0.0], [math.inf] * 5 + [4000]
    for seed, (regret, at) in enumerate(zip(regrets, ends, strict=True)):
        online = [None, *([-50.0] * 10), None, *([-30.0] * 9)]
        cliff.write(tmp_path / str(seed), seed, at, online, regret or 70.0)
    (task,) = gather([tmp_path]).tasks
    (result,) = task.results
    assert (result.certified.count, result.certified.total) == (1, 6)
    assert result.estimates["regret", "iqm"].point == (1 + 2 + 4 + 8) / 4
    assert result.estimates["regret", "median"].point == 3.0
    assert result.estimates["steps", "median"].point == math.inf
    assert result.estimates["online_return", "mean"].point == pytest.approx((10 * -50 + 9 * -30) / 19)
    assert result.estimates["online_return_end", "mean"].point == -30.0
    uniform = np.full((48, 4), 0.25)
    worst = Evaluator(cliff.evaluator.mdp, 0.99, 100).score(uniform).value
    scale = cliff.evaluator.optimal_value - worst
    expected = [1 - regret / scale for regret in sorted(regrets)[1:5]]
    assert result.estimates["optimality", "iqm"].point == pytest.approx(sum(expected) / 4)
    table = (report_of(tmp_path) / "tables" / "results.md").read_text()
    assert "> 20,000" in table


def test_an_endless_walk_that_costs_infinitely_much_is_shown(tmp_path: Path) -> None:
    """At γ = 1 with a cost for every step, standing still is worth -inf."""
    maker = Maker("agent=ppo", "env=aima_4x3", "evaluation.gamma=1")
    for seed, at in enumerate((3000, 5000, math.inf, math.inf)):
        maker.write(tmp_path / str(seed), seed, at, regret=math.inf)
        in_json(tmp_path / str(seed), "summary.json", regret=0.0 if at < math.inf else None)
    (task,) = gather([tmp_path]).tasks
    estimates = task.results[0].estimates
    assert estimates["regret", "iqm"].point == estimates["regret", "median"].point == math.inf
    assert estimates["value", "mean"].point == -math.inf
    assert task.results[0].regret.point[0] == math.inf
    tables = report_of(tmp_path) / "tables"
    assert ",inf," in (tables / "results.csv").read_text()
    assert (tables / "steps.csv").read_text().splitlines()[1:] == ["ppo,inf"]
    maker.write(tmp_path / "4", 4, 2000)  # three of five: the median is the last of them
    assert (report_of(tmp_path) / "tables" / "steps.csv").read_text().splitlines()[1:] == ["ppo,5000"]


@pytest.mark.slow
def test_agents_are_compared_on_each_task_and_on_those_that_they_share(study: Report) -> None:
    assert {len(group.runs) for group in study.study.groups} == {4, 5}
    of_tasks = {task.task: task.comparisons for task in study.tasks}
    assert of_tasks["cliff"]["online_return_end", "sarsa", "q_learning"].point == 1.0
    assert of_tasks["cliff"]["online_return_end", "q_learning", "sarsa"].point == 0.0
    q_learning, sarsa = next(task.results for task in study.tasks if task.task == "cliff")
    assert (q_learning.certified.count, sarsa.certified.count) == (5, 0)
    assert q_learning.estimates["online_return", "mean"].high < sarsa.estimates["online_return", "mean"].low
    assert study.overall is not None
    counts = {agent: count for agent, (count, _) in study.overall.optimality.items()}
    assert counts == {"a2c": 2, "dqn": 2, "ppo": 2}
    for key, found in study.overall.comparisons.items():
        points = [of_tasks[task][key].point for task in ("classic", "four_rooms")]
        assert found.point == pytest.approx(sum(points) / 2)
        assert found.low <= found.point <= found.high


def test_the_last_observation_is_carried_forward(maker: Maker, tmp_path: Path) -> None:
    run = read(maker.write(tmp_path / "short", 0, 3000, evaluations=6))
    assert isinstance(run, Evidence)
    grid = np.array([0.0, 1.0, 999.0, 2999.0, 3000.0, 3500.0, 5000.0, 20000.0])
    newest = [np.flatnonzero(run.curve["step"] <= step)[-1] for step in grid]
    assert on_grid(run, "regret", grid).tolist() == run.curve["regret"][newest].tolist()
    assert math.isnan(online_return(run))
    maker.write(tmp_path / "long", 1, 9000)
    band = gather([tmp_path]).tasks[0].results[0].regret
    assert (band.whole_until, band.steps[-1]) == (5000, 20000)  # beyond, the short run keeps its last value


# ---- bad input -----------------------------------------------------------------------------------------

# (file, what is done to it, words): entries of JSON, a replacement, the whole content; None: it is removed.
DAMAGES: list[tuple[str, Any, str]] = [
    ("manifest.json", {"status": "running"}, "'running', not finished: it is still running or was killed"),
    (
        "manifest.json",
        {"status": "interrupted", "error": "by SIGINT"},
        "not finished: by SIGINT (last evaluated after 20,000 steps, according to the unverified curve.csv)",
    ),
    ("manifest.json", {"status": "failed", "error": "InputError: diverged"}, "not finished: InputError: div"),
    ("manifest.json", "", "is not JSON"),
    ("manifest.json", "[" * 200_000, "is not JSON"),
    ("manifest.json", "[]", "must be a JSON object"),
    ("manifest.json", {"config": 3}, "config must be the run's settings"),
    ("manifest.json", {"layout": "S.G"}, "layout must be a list"),
    ("manifest.json", None, "has no manifest.json"),
    ("summary.json", None, "has no summary.json"),
    ("summary.json", {"train_seconds": 10**400}, "is too large a number"),
    ("summary.json", {"optimal_value": None}, "optimal_value=None must be a number"),
    ("summary.json", {"env": " "}, "env=' ' must be a name"),
    ("summary.json", {"certified": 1}, "certified=1 must be true or false"),
    ("summary.json", {"certified_since_step": True}, "certified_since_step=True must be a number of steps"),
    ("summary.json", {"first_certified_step": -1}, "first_certified_step=-1 must be a number of steps"),
    ("curve.csv", None, "has no curve.csv"),
    ("curve.csv", "", "curve.csv: has no rows"),
    ("curve.csv", b"\xff\xfe\x00", "is not UTF-8 text"),
    ("curve.csv", (",[^,]*$", ""), "line 22 has 16 of 17 columns; it was cut off"),
    ("curve.csv", ("\n5000,[^,]+", "\n5000,nan"), "value is NaN"),
    ("curve.csv", ("\n5000,", "\n5000,x"), "value: could not convert string to float"),
    ("curve.csv", ("\n5000,", "\n500,"), "the steps do not increase"),
    ("curve.csv", ("\n0,[^\n]*", ""), "the steps do not increase from 0"),
    ("curve.csv", ("regret", "lack"), "has no column regret; was it written by another version?"),
    ("curve.csv", ("(\n5000,[^,]+,[^,]+),0,", r"\1,2,"), "certified must be 0 or 1 in every row"),
]


def test_runs_that_cannot_be_used_are_named_and_the_rest_reported(
    maker: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maker.write(tmp_path / "good", 0, 8000)
    for number, (name, harm, _) in enumerate(DAMAGES):
        run = maker.write(tmp_path / f"{number:02}", 1 + number, 8000)
        if harm is None:
            (run / name).unlink()
        elif isinstance(harm, dict):
            in_json(run, name, **harm)
        elif isinstance(harm, bytes):
            seal(run, name, harm)
        else:
            text = (run / name).read_text()
            change(run, name, harm if isinstance(harm, str) else re.sub(*harm, text, count=1))
    folder = report_of(tmp_path, code=1)
    assert [row["seed"] for row in rows_of(folder / "tables" / "runs.csv")] == ["0"]
    assert f"{len(DAMAGES)} runs are not in the statistics" in (folder / "report.html").read_text()
    for number, (row, (_, _, words)) in enumerate(
        zip(rows_of(folder / "tables" / "not_counted.csv"), DAMAGES, strict=True)
    ):
        assert row["reason"].startswith(str(tmp_path / f"{number:02}"))
        assert words in row["reason"]
    warnings = capsys.readouterr().err.splitlines()
    assert warnings[-1] == f"warning: and {len(DAMAGES) - 20} more, all in the report"
    assert all(line.startswith(f"warning: {tmp_path}") for line in warnings[:-1])


def test_another_version_is_named_and_its_settings_stay_as_they_are(maker: Maker, tmp_path: Path) -> None:
    maker.write(tmp_path / "old", 0, 3000)
    maker.write(tmp_path / "new", 0, 3000, env__wind=3, evaluation__mode="fast")
    in_json(tmp_path / "new", "manifest.json", versions={"gridworld": "9.9"})
    report = gather([tmp_path])
    assert len(report.study.groups) == 2  # a world with wind is a different task
    assert report.notes == (f"1 run was written by gridworld 9.9, this is 0.1.0: {tmp_path / 'new'}.",)
    (problem,) = [task.world.problem for task in report.tasks if task.world.problem]
    assert "env.wind is unknown to this version" in problem


def test_two_runs_of_one_seed_are_counted_once(
    maker: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    maker.write(tmp_path / "first", 0, 3000)
    maker.write(tmp_path / "same", 0, 3000, recording__fps=7)
    report_of(tmp_path)
    same = f"{tmp_path / 'same'} has the same settings and seed as {tmp_path / 'first'}, and the same curve"
    assert same in capsys.readouterr().err
    maker.write(tmp_path / "z-other", 0)
    folder = report_of(tmp_path, code=1)
    assert "but a DIFFERENT curve (final regret 0.932065, not 0)" in capsys.readouterr().err
    assert [row["folder"] for row in rows_of(folder / "tables" / "runs.csv")] == [str(tmp_path / "first")]


def test_paths_without_runs(maker: Maker, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.txt").write_text("S.G")
    sentences = {
        tmp_path / "empty": "contains no run: no manifest.json in it or below it",
        tmp_path / "file.txt": "is a file; give the folder of a run",
        tmp_path / "missing": "no such folder; give the folder of a run",
    }
    for path, words in sentences.items():
        with pytest.raises(InputError, match=f"^nothing to report: {path}: {words}"):
            command.main([str(path), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
    maker.write(tmp_path / "runs" / "one", 0, 3000)
    report_of(tmp_path / "runs", *sentences, code=1)
    told = capsys.readouterr().err
    assert all(f"{path}: {words}" in told for path, words in sentences.items())


def test_a_link_that_is_named_is_followed_and_others_are_not(maker: Maker, tmp_path: Path) -> None:
    run = maker.write(tmp_path / "runs" / "deep" / "one", 0, 3000)
    maker.write(tmp_path / "mine" / "two", 1, 3000)
    (run / "all").symlink_to("/")
    (tmp_path / "runs" / "mine").symlink_to(tmp_path / "mine")
    (tmp_path / "runs" / "itself").symlink_to(tmp_path / "runs" / "itself")
    (tmp_path / "linked").symlink_to(tmp_path / "runs")
    for paths in ([tmp_path / "linked"], [tmp_path / "runs", run], [run, tmp_path / "linked"]):
        report = gather(paths)
        assert [found.seed for found in report.runs] == [0]
        assert not report.sentences()
    assert len(gather([tmp_path / "runs" / "mine"]).runs) == 1
    for study in ("mine", "runs/deep"):
        (tmp_path / study / "study.json").write_text("{}")
    _, problems = find_tunings([tmp_path / "runs", tmp_path / "runs" / "mine"])
    named = [problem.split("/study.json: has format None")[0] for problem in problems]
    assert named == [str(tmp_path / "runs" / name) for name in ("deep", "mine")]


def test_a_search_for_runs_ends_and_names_what_may_not_be_read(
    maker: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maker.write(tmp_path / "0" / "run", 0, 3000)
    for number in range(100):
        (tmp_path / "1" / str(number)).mkdir(parents=True)
    scandir = os.scandir

    def refuse(folder: Path) -> object:
        if Path(folder).name == "1":
            raise PermissionError(13, "Permission denied", str(folder))
        return scandir(folder)

    with monkeypatch.context() as patch:
        patch.setattr("gridworld.report.evidence.os.scandir", refuse)
        locked = f"{tmp_path / '1'}: cannot be searched (Permission denied)"
        assert gather([tmp_path]).problems == (locked,)
    monkeypatch.setattr("gridworld.report.evidence.MOST_ENTRIES", 50)
    (problem,) = gather([tmp_path]).problems
    assert problem.startswith(
        f"{tmp_path}: contains more than 50 files and folders; the rest was not searched"
    )


# ---- figures -------------------------------------------------------------------------------------------


def test_swept_settings_are_a_line_or_a_heatmap_and_the_opening_is_short(
    maker: Maker, tmp_path: Path
) -> None:
    for rate, depth, seed in itertools.product((0.01, 0.002, 0.1), (3, 10, 20), (0, 1)):
        at = math.inf if rate == 0.1 else 1000 * depth * (1 + seed)
        name = f"{rate} {depth} {seed}"
        maker.write(tmp_path / name, seed, at, agent__learning_rate=rate, agent__n_epochs=depth)
    report = gather([tmp_path])
    (task,) = report.tasks
    (swept,) = sweeps(task.results)
    assert swept.keys == ("agent.learning_rate", "agent.n_epochs")
    assert swept.values == (("0.002", "0.01", "0.1"), ("3", "10", "20"))
    assert swept.results["0.002", "20"].group.agent == "ppo (learning_rate=0.002, n_epochs=20)"
    drawn, keys = figures_of(task), "learning_rate and n_epochs"
    words = [text.get_text() for text in drawn[f"classic ppo certified by {keys}"].figure.axes[0].texts]
    # With 3 and 10 epochs at the two smaller rates; with 20, one seed at step 20,000, the other not.
    assert [words.count(f"{count}/2") for count in (2, 0, 1)] == [4, 3, 2]
    mesh = drawn[f"classic ppo steps by {keys}"].figure.axes[0].collections[0]
    cells = [tuple(colour) for colour in mesh.to_rgba(mesh.get_array()).reshape(-1, 4).tolist()]
    assert cells.count(to_rgba("#c6c6c6")) == 5  # half of their seeds or more are never certified
    assert len(set(cells)) == 3  # 3 epochs, 10, never: the worst finite number has another colour
    assert drawn[f"classic ppo steps by {keys}"].caption.endswith("grey: no finite value.")
    assert "the best 7 of 9" in drawn["classic regret"].caption
    (only,) = sweeps([result for result in task.results if "n_epochs=3)" in result.group.agent])
    assert next(sweep_charts(only, "classic")).title == "Seeds certified by learning_rate"
    assert not list(sweep_charts(replace(swept, keys=(*swept.keys, "agent.gamma")), "classic"))
    assert not sweeps(task.results[:2])  # two are a comparison
    first, second = (swept.results[rate, "3"] for rate in ("0.002", "0.01"))
    assert task.best == [first, second]  # in the same steps; others took more, or were not certified
    others = [result for result in task.results if result is not first]
    assert replace(task, results=tuple(others)).best == [second]
    page = render(report, {task.task: [], "": []})
    for words in (
        "18 runs, 1 agent, 9 configurations, 1 task",
        "On classic, ppo by learning_rate and n_epochs: all seeds are certified with "
        + ", ".join(f"learning_rate={rate} n_epochs={depth}" for rate in (0.002, 0.01) for depth in (3, 10)),
        "; none with learning_rate=0.1 n_epochs=3, learning_rate=0.1 n_epochs=10, learning_rate=0.1 n_epochs",
        "; 2 tie for best, as no interval separates them, among them: ppo (learning_rate=0.002, n_epochs",
        "<h1>ppo on classic</h1>",
        "<title>9 agents on classic, gridworld</title>",
        '<th scope="col">ppo (learning_<wbr>rate=<wbr>0.1, n_<wbr>epochs=<wbr>3)</th>',
    ):
        assert words in page


def test_steps_are_logarithmic_where_one_agent_is_ten_times_slower(maker: Maker, tmp_path: Path) -> None:
    def scale(**options: bool) -> str:
        (task,) = gather([tmp_path], **options).tasks
        drawn = figures_of(task)["classic certified"].figure.axes[0].get_xscale()
        assert (drawn == "log") == task.log_steps
        return str(drawn)

    for name, at in (("fast", 1000), ("slow", 9000)):
        maker.write(tmp_path / name, 0, at, agent__name=name)
    assert (scale(), scale(log_steps=True)) == ("linear", "log")
    maker.write(tmp_path / "slower", 0, 10_000, agent__name="slower")
    assert scale() == "log"
    steps = gather([tmp_path]).tasks[0].results[0].regret.steps
    assert (steps[0], steps[-1]) == (0, 20000)
    assert (np.diff(np.log(steps[1:])) < 0.16).all()  # as fine at the beginning as at the end


def test_no_figure_has_only_zeros_and_labels_are_whole(maker: Maker, tmp_path: Path) -> None:
    varied = [(g, r, t) for g in (0.8, 0.9) for r in (0.3, 0.5) for t in (1000, 2000)][:6]
    for index, (gamma, rate, steps) in enumerate(varied):
        settings = {"agent__gamma": gamma, "agent__learning_rate": rate, "total_timesteps": steps}
        maker.write(tmp_path / f"{index}", 0, **settings)
    maker.write(tmp_path / "dqn", 0, agent__name="dqn")
    (task,) = gather([tmp_path]).tasks
    agents = {result.group.agent for result in task.results}
    drawn = figures_of(task)  # nobody is ever certified
    assert set(drawn) == {"classic regret", "classic final regret", "classic steps until certified for good"}
    assert "ppo (gamma=0.9, learning_rate=0.3, total_timesteps=1000)" in agents

    def rows(chart: Chart) -> set[str]:
        return {each.get_text().replace("\n", " ") for each in chart.figure.axes[0].get_yticklabels()}

    assert rows(drawn["classic final regret"]) == agents
    assert drawn["classic regret"].caption.endswith("exact; one seed, so no interval; 0 is optimal.")
    pairs = {("regret", "dqn", agent): Interval(0.9, 0.8, 1) for agent in agents - {"dqn"}}
    look = styles(sorted(agents))
    _, improvement = overall_charts(Overall(2, {}, pairs, np.linspace(0, 1, 5), {}), look)
    assert rows(improvement) == {f"dqn > {agent}" for agent in agents - {"dqn"}}
    assert short_names(["ppo (a=1)", "ppo (a=2)"], 25) == ["a=1", "a=2"]
    assert short_names(["ppo (a=1)", "dqn"], 25) == ["ppo (a=1)", "dqn"]
    assert short_names(["_" * 600], 25)[0].count("\n") == 5


NAMES = (
    "$\\frac{1}{",  # no formula, and no half of one
    r"$\alpha$ \input{/etc/passwd} %",
    "]]><script>alert(1)</script><!-- & ' \"",
    "fill: #0072b2; url(http://x)",
    "\N{CJK UNIFIED IDEOGRAPH-4E2D}\N{PILE OF POO}",
    "\x1b[31m\x00\n\u202e\ud800",
    "_" * 300,
)


@pytest.mark.parametrize("names", [NAMES[:3], NAMES[3:6], NAMES[6:]], ids=range(3))
def test_names_in_figures_are_text(names: tuple[str, ...], study: Report) -> None:
    task = study.tasks[0]
    named = [
        replace(each, group=replace(each.group, agent=name))
        for each, name in zip(task.results, names, strict=False)
    ]
    charts = list(task_charts(replace(task, results=tuple(named), task=names[-1]), styles(names)))
    assert len(charts) == 4
    assert charts[0].saved_as("png").startswith(b"\x89PNG")
    assert charts[0].saved_as("pdf").startswith(b"%PDF-")
    for chart in charts:
        svg = chart.saved_as("svg").decode()
        tags = ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
        found = [each.text or "" for each in tags]
        assert all(any(plain(name)[:4] in text for text in found) for name in names)
        assert "<script" not in svg
        assert not re.search(r"[\x00-\x09\x0b-\x1f\u202e\ud800]", svg)


def test_a_users_matplotlib_settings_do_not_matter(study: Report) -> None:
    def drawn() -> list[bytes]:
        chart = next(task_charts(study.tasks[1], styles(study.study.agents)))
        return [chart.saved_as(kind) for kind in FORMATS]

    usual = drawn()
    with matplotlib.rc_context({"text.usetex": True, "font.size": 30, "axes.facecolor": "red"}):
        before = dict(matplotlib.rcParams)
        assert drawn() == usual
        assert dict(matplotlib.rcParams) == before


# ---- what is written -----------------------------------------------------------------------------------


def test_the_page_needs_nothing_else(written: Path) -> None:
    page = (written / "report.html").read_text()
    assert not re.search(r"<(script|link|iframe|object|embed|base)\b|\son\w+=|url\(|@import|https?://", page)
    links = re.findall(r'(?:src|href|srcset)="([^"]*)"', page)
    assert all(link.startswith(("#", "data:image/svg+xml;base64,", "playground.html#map=")) for link in links)
    assert (written / "playground.html").is_file()
    for anchor in (link[1:] for link in links if link.startswith("#")):
        assert f'id="{anchor}"' in page
    for tag in ("section", "table", "tr", "td", "figure", "details", "div", "p", "ul", "li", "span"):
        assert len(re.findall(f"<{tag}[ >]", page)) == page.count(f"</{tag}>")
    assert page.count('class="chart"') == 2 * 4 + 7 + 3  # over all tasks, a profile and two metrics
    for words in ("Statistical Precipice", "Interquartile mean", "Mann", "Wilson", "training diverged"):
        assert words in page


def test_figures_and_tables_are_files_too(written: Path) -> None:
    figures, of_tables = (sorted((written / name).iterdir()) for name in ("figures", "tables"))
    names = {path.stem for path in figures}
    assert {"classic_regret", "cliff_online_return", "all_tasks_profiles"} <= names
    assert not [path.stem for path in (*figures, *of_tables) if re.search("[ ,()]", path.stem)]
    assert {path.name for path in figures} == {f"{n}.{kind}" for n in names for kind in FORMATS}
    for path in figures:
        content = path.read_bytes()
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert image.width == 880
                assert len(image.getcolors(100_000) or []) > 10
                check_words(np.asarray(image)[:40, :400])  # the heading
        elif path.suffix == ".pdf":
            assert content.startswith(b"%PDF-")
            assert b"/Type3" not in content  # fonts that publishers refuse
        else:
            root = ElementTree.fromstring(content)
            assert root.get("width") == "440pt"
            assert "on classic" in "".join(root.itertext()) or "classic" not in path.stem
    assert {path.name for path in of_tables} == {
        f"{path.stem}.{kind}" for path in of_tables for kind in ("csv", "md")
    }
    header = (written / "tables" / "results.csv").read_text().splitlines()[0]
    assert header.startswith("task,agent,seeds certified,seeds certified of,seeds certified low,seeds certif")
    assert "| classic | dqn | 5 / 5 [57 %, 100 %] |" in (written / "tables" / "results.md").read_text()


@pytest.mark.slow
def test_the_same_runs_give_the_same_bytes(written: Path, study: Report) -> None:
    runs = written.parent
    before = {path: path.read_bytes() for path in (*written.glob("*.html"), *written.glob("tables/*"))}
    assert len(before) > 10
    report_of(runs, code=1)
    assert before == {path: path.read_bytes() for path in before}
    overall = gather([runs], seed=1).overall
    assert overall is not None
    assert study.overall is not None
    assert overall.comparisons != study.overall.comparisons
    assert len(list(written.glob("tensorboard/*/events*"))) == 8  # none is left over from the report before
    assert sorted(path.name for path in runs.iterdir() if path.name.startswith(".")) == []


def test_tensorboard_has_bands(written: Path) -> None:
    events = EventAccumulator(str(written / "tensorboard" / "sarsa on cliff"), size_guidance={"scalars": 0})
    events.Reload()
    for name, tags in BANDS.items():
        points = [{event.step: event.value for event in events.Scalars(tag)} for tag in tags]
        assert points[0].keys() == points[1].keys() == points[2].keys(), name
        assert all(points[1][step] <= points[0][step] <= points[2][step] for step in points[0]), name
    assert max(event.step for event in events.Scalars("eval/regret")) == 20000
    layout = layout_pb2.Layout.FromString(
        events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0]
    )
    charts = {chart.title: chart.margin.series[0] for chart in layout.category[0].chart}
    assert {name: (s.value, s.lower, s.upper) for name, s in charts.items()} == BANDS


def test_a_studys_page_has_its_own_title_and_explains_its_medians(maker: Maker, tmp_path: Path) -> None:
    write_study(tmp_path / "mine")
    for seed in (0, 1):
        maker.write(tmp_path / "mine" / f"winner{seed}", seed, 3000)
    report = gather([tmp_path / "mine"])
    (tuning,) = report.tunings
    report = replace(report, tunings=(replace(tuning, sentence="by step 3 in the median"),))
    page = render(report, defaultdict(list))
    assert "<title>Tuning dqn on classic, gridworld</title>" in page
    assert "<h1>Tuning dqn on classic</h1>" in page
    assert "half of the runs were certified for good" in page
    maker.write(tmp_path / "other", 5, 3000)
    assert "<h1>ppo on classic</h1>" in render(gather([tmp_path]), defaultdict(list))


def test_a_readmes_table_is_replaced(maker: Maker, tmp_path: Path) -> None:
    maker.write(tmp_path / "runs" / "one", 0, 3000)
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n\n{MARKERS[0]}\nold\n{MARKERS[1]}\n\nafter\n")
    report_of(tmp_path / "runs", options=("--readme", str(readme)))
    once = readme.read_text()
    matrix = "| agent | classic |\n| --- | --- |\n| ppo | \N{LARGE GREEN SQUARE} 1 / 1 |\n"
    assert once.startswith(f"before\n\n{MARKERS[0]}\n{matrix}\n| task | agent | seeds certified |")
    assert "\n| classic | ppo | 1 / 1 " in once
    assert once.endswith(f" |\n{MARKERS[1]}\n\nafter\n")
    report_of(tmp_path / "runs", options=("--readme", str(readme)))
    assert readme.read_text() == once
    for text in ("no markers", MARKERS[0], f"{MARKERS[1]}{MARKERS[0]}", f"{once}{once}"):
        readme.write_text(text)
        with pytest.raises(InputError, match="must have one line <!-- results --> and, after it"):
            command.main([str(tmp_path / "runs"), "--readme", str(readme)])
        assert readme.read_text() == text
    with pytest.raises(InputError, match="no such file"):
        command.main([str(tmp_path / "runs"), "--readme", str(tmp_path / "missing.md")])


def test_only_a_report_is_replaced(
    maker: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    (tmp_path / "file").write_text("")
    for out, words in (
        ("mine", "holds thesis.tex, which is not part of a report"),
        ("file", "is not a folder"),
        ("file/below", "file is a file; choose another --out"),
    ):
        with pytest.raises(InputError, match=words):
            command.main([str(tmp_path), "--out", str(tmp_path / out)])
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "years of work"
    with pytest.raises(InputError, match=r"--seed: -1: must be at least 0; see .*report --help"):
        command.main([str(tmp_path), "--seed", "-1"])
    for folder in ("a", "b"):
        maker.write(tmp_path / folder / "one", ord(folder), 3000)
    monkeypatch.chdir(tmp_path)  # of two folders the report is in neither
    monkeypatch.setattr(command.webbrowser, "open", lambda uri: not uri.endswith("runs/report/report.html"))
    command.main(["a", "b", "--open", "--formats"])
    told = capsys.readouterr()
    assert (told.out, told.err[:35]) == ("runs/report/report.html\n", "--open: no browser found here; open")
    assert logging.getLogger("matplotlib").handlers  # it says nothing on standard error


def test_pictures_are_embedded_within_bounds(maker: Maker, tmp_path: Path) -> None:
    for seed in range(3):
        maker.write(tmp_path / str(seed), seed, 3000)
    median = tmp_path / "1"
    Image.new("RGB", (900, 500), (40, 90, 160)).save(median / "policy.png")
    Image.new("RGB", (3000, 3000)).save(median / "q_error.png")  # too many pixels
    (median / "visits.png").write_bytes((median / "policy.png").read_bytes()[:200])  # cut off
    frames = [Image.new("P", (40, 30), index) for index in (0, 1)]
    frames[0].save(median / "learning.gif", save_all=True, append_images=frames[1:])
    for picture in PICTURES.values():
        if picture.caption:
            seal(median, picture.file)
    Image.new("RGB", (90, 50)).save(tmp_path / "0" / "policy.png")  # of another run
    page = (report_of(tmp_path) / "report.html").read_text()
    pattern = r'<img src="data:image/(\w+);base64,\S+ width="(\d+)" height="(\d+)" alt="([^"]*)"'
    assert re.findall(pattern, page) == [
        ("png", "900", "500", "ppo, seed 1, certified optimal: policy"),
        ("gif", "40", "30", "ppo, seed 1, certified optimal: policy while it learned"),
    ]
