"""What schemas declare at their fields, and who goes by it: bounds, privileges, and what a text is."""

import dataclasses
import math
import re
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
from cases import table
from helpers.support import CONF, NO_FILES, configure, train_in

from gridworld.base.bounds import Bounds, Rate
from gridworld.base.errors import InputError
from gridworld.commands.report import main as report
from gridworld.config.fields import Text, declared
from gridworld.config.recipe_file import with_recipe
from gridworld.config.settings import agent_schemas, foreign, privileges, settings_of_a_run
from gridworld.config.sweep import TuneConfig
from gridworld.config.train import TrainConfig, check_bounds
from gridworld.config.worlds import SOURCES
from gridworld.run.console import summary_text

SECTIONS = (TrainConfig, TuneConfig, *agent_schemas().values(), *SOURCES.values())
SECTIONS += tuple(type(each) for each in vars(TrainConfig()).values() if dataclasses.is_dataclass(each))
BOUNDED = [
    (schema, name, found[Bounds], isinstance(found[Bounds], Rate))
    for schema in SECTIONS
    for name, found in declared(schema).items()
    if Bounds in found
]
AGENTS = sorted(file.stem for file in (CONF / "agent").glob("*.yaml"))
PLANS = "plans with the tables"


def outside(limits: Bounds) -> list[float]:
    found = [math.nan, math.inf]
    if limits.low > -math.inf:
        found.append(limits.low if limits.above else limits.low - 1 - abs(limits.low) / 100)
    if limits.high < math.inf:
        found.append(limits.high * 1.01 + 1)
    return found + ([limits.least / 10, -limits.least / 10] if limits.least else [])


def test_a_number_outside_its_bounds_is_refused_and_one_inside_is_not() -> None:
    for schema, field, limits, is_rate in BOUNDED:
        section = schema()
        check_bounds(section)
        for value in (limits.low + 1e-9 if limits.above else limits.low, limits.high):
            if math.isfinite(value):
                check_bounds(dataclasses.replace(section, **{field: value}), "x.")
        for value in outside(limits):
            for written in (value, f"lin_{value}") if is_rate else (value,):
                with pytest.raises(InputError, match="^" + re.escape(f"x.{field}={written}: must be ")):
                    check_bounds(dataclasses.replace(section, **{field: written}), "x.")


def used(*words: str) -> list[str]:
    return privileges(dataclasses.asdict(configure(*words)))


def test_privileges_are_those_that_are_declared() -> None:
    for agent in AGENTS:
        plans = [PLANS] if agent == "value_iteration" else []
        assert used(f"agent={agent}") == used(f"agent={agent}", "env.slip=0.1", "tuned=none") == plans
        exploring = used(f"agent={agent}", "exploring_starts=0.1", "stratified_draws=true")
        assert exploring == ["starts anywhere", "stratified draws", *plans]


def test_settings_from_a_manifest_may_be_anything() -> None:
    assert privileges({}) == privileges({"agent": 3, "exploring_starts": None}) == []
    for schema in agent_schemas().values():
        assert privileges({"agent": {"algorithm": schema.algorithm}}) in ([], [PLANS])


def test_a_result_and_a_report_name_privileges(tmp_path: Path) -> None:
    for name, words in (("with", ["exploring_starts=0.5"]), ("without", ["exploring_starts=0"])):
        own = ["agent=q_learning", "total_timesteps=300", "evaluation.every=100", f"agent.name={name}"]
        summary = train_in(tmp_path / "runs" / name, *own, *words, *NO_FILES)
        lines = [line for line in summary_text(summary, "x").splitlines() if "privileges" in line]
        assert lines == (["  privileges: starts anywhere"] if name == "with" else [])
    report([str(tmp_path / "runs"), "--formats"])
    table = (tmp_path / "runs" / "report" / "tables" / "results.md").read_text("utf-8")
    rows = [[cell.strip() for cell in line.split("|")] for line in table.splitlines() if line.startswith("|")]
    column = rows[0].index("privileges")
    assert {row[2]: row[column] for row in rows[2:]} == {"with": "starts anywhere", "without": ""}


def parts_of(hint: Any) -> tuple[Any, ...]:
    """The types in a type, without that of a dictionary's keys."""
    return get_args(hint)[1:] if get_origin(hint) is dict else get_args(hint)


def is_silent(hint: Any) -> bool:
    """Whether a part of a type that may be a text does not declare what it is."""
    if any(isinstance(each, Text) for each in getattr(hint, "__metadata__", ())):
        return False
    parts = parts_of(hint)
    return any(map(is_silent, parts)) if parts else hint not in (int, float, bool, type(None))


def test_every_text_says_what_it_is() -> None:
    """It is annotated with one of those of gridworld.config.fields."""
    silent = [name for name, hints in settings_of_a_run().items() if any(map(is_silent, hints))]
    assert silent == []
    assert all(map(is_silent, (str, Any, dict[str, Any], list[str], str | None, int | str, bytes)))
    assert not any(map(is_silent, (int, float | None, list[int], dict[str, bool])))


def recipe(tmp_path: Path, content: str) -> list[str]:
    path = tmp_path / "winner.yaml"
    path.write_text(content)
    return [f"recipe={path}"]


GYM = "defaults: [{override /env: gymnasium}]\nenv: "
HOSTILE = dict(table("config/cases.txt", "recipes for trust"))
HOSTILE['env: {layout: "a\\0b"}'] = "env.layout=a\\x00b leads out"


@pytest.mark.parametrize("content", HOSTILE, ids=range(len(HOSTILE)))
def test_a_recipe_that_would_run_code_or_read_files_needs_trust(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to("/etc")
    words = recipe(tmp_path, content)
    with pytest.raises(InputError) as refused:
        with_recipe(words)
    sentence = str(refused.value)
    assert HOSTILE[content] in sentence
    assert sentence.endswith("; add trust=true if you trust its author")
    assert "\n" not in sentence
    assert with_recipe([*words, "trust=true"])  # words for Hydra, which makes nothing of them yet


def test_what_does_no_harm_needs_no_trust(tmp_path: Path) -> None:
    lake = "{id: FrozenLake-v1, kwargs: {desc: [SFF, FHG], is_slippery: false, success_rate: 0.5}}"
    assert configure(*with_recipe(recipe(tmp_path, GYM + lake))).env.kwargs["desc"] == ["SFF", "FHG"]
    harmless = {
        "env": {"layout": "maps/mine.txt", "path": "tables/..x.npz"},
        "agent": {
            "name": "it's mine: a/b.c",
            "policy": "MlpPolicy",
            "learning_rate": "lin_3e-4",
            "replay_buffer_class": "gridworld.agents.sb3.replay_counts.ReplayCounts",
            "arguments": {"ent_coef": "quad_0.01", "policy_kwargs": {"activation_fn": "torch.nn.ReLU"}},
        },
    }
    assert not list(foreign(harmless))
    assert [name for name, _, _ in foreign({"new": {"setting": "x"}})] == ["new.setting"]  # till it says
