"""What a real TensorBoard serves of a run, and what a real browser shows of it."""

import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import chromium
from support import SHORT, train_in

from gridworld.curve import CHARTS
from gridworld.training import HPARAM_METRICS

# Walks through the shadow roots that TensorBoard's components hide behind.
PAGE_TEXT = """
const texts = [];
const walk = node => {
  if (node.nodeType === Node.TEXT_NODE) texts.push(node.textContent);
  if (node.shadowRoot) walk(node.shadowRoot);
  node.childNodes.forEach(walk);
};
walk(document.body);
return texts.join(" ");
"""

SHOWN = {agent: SHORT[agent] for agent in ("dqn", "ppo", "q_learning", "value_iteration")}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a TensorBoard over a short run of every agent."""
    logs = tmp_path_factory.mktemp("logs")
    for agent, overrides in SHOWN.items():
        train_in(logs / f"{agent}_run", *overrides)
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
    with urllib.request.urlopen(request, timeout=30) as answer:
        return json.load(answer)


def test_scalars_stand_beside_their_optimum(served: str) -> None:
    tags = ask(served, "data/plugin/scalars/tags")
    assert tags.keys() == {f"{agent}_run" for agent in SHOWN}
    for run, names in tags.items():
        for tag in ("value", "regret", "goal_probability", "length", "certified"):
            assert f"eval/{tag}" in names
            assert f"eval_sampled/{tag}" in names
        for tag in ("optimal_value", "optimal_goal_probability", "optimal_length"):
            assert f"eval/{tag}" in names
        own = {"train/loss", "rollout/ep_rew_mean", "rollout/ep_len_mean", "online/return"}
        assert own <= names.keys() or run == "value_iteration_run", run
    points = ask(served, "data/plugin/scalars/scalars?run=dqn_run&tag=eval%2Foptimal_value")
    assert [point[1] for point in points] == [0, 512, 1024, 1536, 2048]
    assert {round(point[2], 6) for point in points} == {round(0.99**7, 6)}


def test_the_policy_develops_and_the_episode_moves(served: str) -> None:
    tags = ask(served, "data/plugin/images/tags")
    assert tags["dqn_run"].keys() == {"policy", "q_error", "visits", "learning", "episode"}
    images = ask(served, "data/plugin/images/images?run=dqn_run&tag=policy&sample=0")
    assert [image["step"] for image in images] == [0, 2048]
    for tag in ("episode", "learning"):
        query = ask(served, f"data/plugin/images/images?run=dqn_run&tag={tag}&sample=0")[0]["query"]
        address = f"{served}data/plugin/images/individualImage?{query}"
        with urllib.request.urlopen(address, timeout=30) as answer:
            assert answer.read(6) == b"GIF89a"


def test_the_hparams_table_has_settings_and_metrics(served: str) -> None:
    groups = ask(
        served,
        "data/plugin/hparams/session_groups",
        colParams=[{"metric": {"tag": tag}} for tag in HPARAM_METRICS],
        allowedStatuses=["STATUS_SUCCESS"],
        startIndex=0,
        sliceSize=10,
    )["sessionGroups"]
    assert {group["hparams"]["agent.name"] for group in groups} == set(SHOWN)
    for group in groups:
        assert group["hparams"]["env.layout"] == "classic"
        assert {value["name"]["tag"] for value in group["metricValues"]} == set(HPARAM_METRICS)


def test_custom_scalars_group_the_curves(served: str) -> None:
    layout = ask(served, "data/plugin/custom_scalars/layout")
    charts = layout["category"][0]["chart"]
    assert {chart["title"]: chart["multiline"]["tag"] for chart in charts} == CHARTS


def test_a_browser_shows_it(served: str, tmp_path: Path) -> None:
    with chromium(tmp_path / "profile") as browser:
        from selenium.webdriver.support.ui import WebDriverWait

        for page, expected in (
            ("timeseries", ["dqn_run", "ppo_run", "/goal_probability", "/optimal_goal_probability"]),
            ("images", ["dqn_run", "policy", "q_error", "visits", "learning", "episode"]),
            ("hparams", ["agent.name", "env.layout", "eval/regret"]),
        ):
            browser.get(f"{served}#{page}")
            WebDriverWait(browser, 30).until(
                lambda b, words=expected: all(word in b.execute_script(PAGE_TEXT) for word in words)
            )
            browser.save_screenshot(str(tmp_path / f"{page}.png"))
