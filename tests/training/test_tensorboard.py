"""What a real TensorBoard serves of a run and of a sweep."""

import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from helpers.support import SHORT, script, train_in

from gridworld.training.learning_curve import CHARTS

PAIRS = [(agent, rate) for agent in ("q_learning", "sarsa") for rate in (0.1, 0.5)]
SWEPT = {f"agent={agent},agent.learning_rate={rate},seed={seed}" for agent, rate in PAIRS for seed in (0, 1)}
OVER_SEEDS = {f"_over_seeds/{agent} (learning_rate={rate}) on classic" for agent, rate in PAIRS}
SHOWN = {agent: SHORT[agent] for agent in ("dqn", "ppo", "q_learning", "value_iteration")}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a TensorBoard over a short run of every agent."""
    logs = tmp_path_factory.mktemp("logs")
    for agent, overrides in SHOWN.items():
        train_in(logs / f"{agent}_run", *overrides)
    with tensorboard(logs) as address:
        yield address


@pytest.fixture(scope="module")
def served_sweep(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a TensorBoard over a sweep."""
    logs = tmp_path_factory.mktemp("logs")
    words = ("-m", "agent=q_learning,sarsa", "agent.learning_rate=0.1,0.5", "seed=0,1", "total_timesteps=500")
    done = script("train.py", *words, "evaluation.every=200", "hydra.sweep.dir=sweep", cwd=logs)
    assert done.returncode == 0, done.stderr
    with tensorboard(logs / "sweep") as address:
        yield address


@contextmanager
def tensorboard(logs: Path) -> Iterator[str]:
    """The address of one that runs."""
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", str(logs), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        address = None
        for line in process.stderr:
            if address := re.search(r"http://\S+", line):
                break
        assert address is not None
        yield address.group().replace("localhost", "127.0.0.1")
        process.terminate()


def ask(address: str, path: str, **question: Any) -> Any:
    request = urllib.request.Request(
        address + path,
        data=json.dumps(question).encode() if question else None,
        headers={"Content-Type": "application/json"},
    )
    with urllib.request.urlopen(request, timeout=180) as answer:
        return json.load(answer)


@pytest.mark.slow
def test_scalars_stand_beside_their_optimum(served: str) -> None:
    tags = ask(served, "data/plugin/scalars/tags")
    assert tags.keys() == {f"{agent}_run" for agent in SHOWN}
    for run, names in tags.items():
        assert [name for name in sorted(names) if name.startswith("eval")][:8] == [
            *("eval/mean_ep_length", "eval/mean_reward", "eval/regret", "eval/success_rate", "eval/value"),
            *("eval_more/certified", "eval_more/timeout_probability", "eval_more/trap_probability"),
        ]
        for tag in ("value", "regret", "goal_probability", "length", "certified"):
            assert f"eval_sampled/{tag}" in names
        for tag in ("value", "goal_probability", "length"):
            assert f"optimal/{tag}" in names
        own = {"train/loss", "rollout/ep_rew_mean", "rollout/ep_len_mean", "online/return"}
        assert own <= names.keys() or run == "value_iteration_run", run
    read = ask(served, "data/plugin/text/text?run=dqn_run&tag=run%2Fhow_to_read")
    assert "Smoothing" in read[0]["text"]
    points = ask(served, "data/plugin/scalars/scalars?run=dqn_run&tag=optimal%2Fvalue")
    assert [point[1] for point in points] == [0, 512, 1024, 1536, 2048]
    assert {round(point[2], 6) for point in points} == {round(0.99**7, 6)}


def test_the_policy_develops_and_the_episode_moves(served: str) -> None:
    tags = ask(served, "data/plugin/images/tags")
    others = [f"pictures_rest/{name}" for name in ("episode", "learning", "q_error", "visits")]
    assert sorted(tags["dqn_run"]) == ["pictures/policy", *others]  # as TensorBoard sorts them
    images = ask(served, "data/plugin/images/images?run=dqn_run&tag=pictures%2Fpolicy&sample=0")
    assert [image["step"] for image in images] == [0, 2048]
    for tag in others[:2]:
        (image,) = ask(served, f"data/plugin/images/images?run=dqn_run&tag={quote(tag)}&sample=0")
        address = f"{served}data/plugin/images/individualImage?{image['query']}"
        with urllib.request.urlopen(address, timeout=180) as answer:
            assert answer.read(6) == b"GIF89a"


RESULTS = [f"eval/{name}" for name in ("mean_ep_length", "mean_reward", "regret", "success_rate", "value")]


def hparams_table(address: str) -> list[dict[str, Any]]:
    question = {
        "colParams": [{"metric": {"tag": tag}} for tag in RESULTS],
        "allowedStatuses": ["STATUS_SUCCESS"],
        "startIndex": 0,
        "sliceSize": 100,
    }
    answer = ask(address, "data/plugin/hparams/session_groups", **question)
    groups: list[dict[str, Any]] = answer["sessionGroups"]
    return groups


def test_the_hparams_table_has_settings_and_metrics(served: str) -> None:
    groups = hparams_table(served)
    assert {group["hparams"]["agent.name"] for group in groups} == set(SHOWN)
    for group in groups:
        assert group["hparams"]["env.layout"] == "classic"
        assert {value["name"]["tag"] for value in group["metricValues"]} >= set(RESULTS)
    (category,) = ask(served, "data/plugin/custom_scalars/layout")["category"]
    assert {chart["title"]: chart["multiline"]["tag"] for chart in category["chart"]} == CHARTS


@pytest.mark.slow
def test_the_hparams_table_opens_with_what_varies_and_the_results(served_sweep: str) -> None:
    table = ask(served_sweep, "data/plugin/hparams/experiment", includeMetrics=True)
    differing = {info["name"] for info in table["hparamInfos"] if info["differs"]}
    assert {"agent.learning_rate", "seed"} <= differing
    assert {info["name"] for info in table["hparamInfos"][: len(differing)]} == differing
    assert [info["name"]["tag"] for info in table["metricInfos"]][: len(RESULTS)] == RESULTS


@pytest.mark.slow
def test_a_sweep_has_every_run_by_its_name_with_its_metrics(served_sweep: str) -> None:
    assert ask(served_sweep, "data/plugin/scalars/tags").keys() == SWEPT | OVER_SEEDS
    groups = hparams_table(served_sweep)
    assert {session["name"] for group in groups for session in group["sessions"]} == SWEPT
    for group in groups:
        assert {value["name"]["tag"] for value in group["metricValues"]} >= set(RESULTS)
    bands, curves = ask(served_sweep, "data/plugin/custom_scalars/layout")["category"]
    assert {chart["title"] for chart in bands["chart"]} == {"regret", "value", "online_return", "certified"}
    assert {chart["title"]: chart["multiline"]["tag"] for chart in curves["chart"]} == CHARTS
