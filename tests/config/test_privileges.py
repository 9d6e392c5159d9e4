"""Privileges: declared at their fields, and told wherever a run that used one is shown."""

import dataclasses
from pathlib import Path

import pytest
from helpers.support import CONF, NO_FILES, configure, train_in

from gridworld.commands.report import main as report
from gridworld.config.agents import agent_schemas
from gridworld.config.settings import privileges
from gridworld.run.summary import summary_text

AGENTS = sorted(file.stem for file in (CONF / "agent").glob("*.yaml"))
PLANS = "plans with the tables"


def used(*words: str) -> list[str]:
    return privileges(dataclasses.asdict(configure(*words)))


def test_each_field_that_is_declared_is_found() -> None:
    assert used("exploring_starts=0.1", "stratified_draws=true") == ["starts anywhere", "stratified draws"]
    assert used("agent=value_iteration") == [PLANS]


@pytest.mark.parametrize("agent", AGENTS)
def test_the_default_world_and_no_preset_use_none(agent: str) -> None:
    plans = [PLANS] if agent == "value_iteration" else []
    assert used(f"agent={agent}") == used(f"agent={agent}", "env.slip=0.1", "preset=none") == plans


def test_settings_from_a_manifest_may_be_anything() -> None:
    assert privileges({}) == privileges({"agent": 3, "exploring_starts": None}) == []
    for schema in agent_schemas().values():
        assert privileges({"agent": {"algorithm": schema.algorithm}}) in ([], [PLANS])


def test_a_result_and_a_report_name_them(tmp_path: Path) -> None:
    for name, words in (("with", ["exploring_starts=0.5"]), ("without", ["exploring_starts=0"])):
        own = ["agent=q_learning", "total_timesteps=300", "evaluation.every=100", f"agent.name={name}"]
        summary = train_in(tmp_path / "runs" / name, *own, *words, *NO_FILES)
        told = [line for line in summary_text(summary, "x").splitlines() if "privileges" in line]
        assert told == (["  privileges: starts anywhere"] if name == "with" else [])
    report([str(tmp_path / "runs"), "--formats"])
    table = (tmp_path / "runs" / "report" / "tables" / "results.md").read_text("utf-8")
    rows = [[cell.strip() for cell in line.split("|")] for line in table.splitlines() if line.startswith("|")]
    column = rows[0].index("privileges")
    assert {row[2]: row[column] for row in rows[2:]} == {"with": "starts anywhere", "without": ""}
