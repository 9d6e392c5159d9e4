"""A run's folder is data: nothing that a stranger puts into one is run, leaks, or writes elsewhere.

Every entry of the catalogue in hostile.py meets every command that reads a run. CI takes a third of it, each
with one of the READERS in turn:
GRIDWORLD_HOSTILE=all python -m pytest tests/commands/test_hostile_runs.py
takes all.
"""

import os
import re
import shutil
from pathlib import Path

import pytest
from helpers import forks
from helpers.hostile import CATALOGUE, FINE, SECRET, Hostile
from helpers.support import ROOT, SHORT, train_in
from PIL import Image

WORDS = {
    "evaluate": ["run", "--episodes", "20"],
    "verify": ["run", "--out", "certificate.json"],
    "record": ["run", "--format", "png", "gif", "policy", "visits", "--cell-size", "20"],
    "report": ["run", "--formats", "--readme", "table.md"],
    "export": ["run", "--to", "hub", "--out", "hub"],
    "diagnose": ["run"],
    "reproduce": ["run"],
    "play": ["--agent", "run"],
    "playground": ["run", "--out", "page.html"],
    "resume": ["resume=run", "total_timesteps=2500"],  # last, since it writes there
}
SCRIPTS = {command: f"{command}.py" for command in WORDS} | {"resume": "train.py"}
AWAY = {"SDL_VIDEODRIVER": "", "DISPLAY": "", "WAYLAND_DISPLAY": "", "GRIDWORLD_SECRET": SECRET}
NO_DISPLAY = "there is no display to open a window on"
MOST_SECONDS = 20  # of processor time

# One of each kind at least; the rest has the same behind other doors.
FIRST = {
    *("pickle_where_sb3_would_read_one", "pickle_in_torchs_own_file", "zip_bomb"),
    "weights_that_are_no_numbers",
    *("one_weight_changed_and_not_sealed", "model_that_never_ends", "pickle_in_a_table", "pickle_as_visits"),
    *("target_among_an_optimisers_arguments", "interpolation_in_names", "algorithm_of_ones_own"),
    *("class_that_opens_a_file", "map_file_that_is_the_secret", "settings_nested_as_deep_as_json_goes"),
    *("manifest_that_is_the_secret", "names_that_act_on_the_terminal", "names_that_are_scripts"),
    *("picture_that_is_the_secret", "frames_that_lead_outside", "files_that_lead_outside"),
    *("mark_of_a_curve_outside", "mark_of_events_outside", "checkpoints_that_lead_outside"),
    *("curve_that_waits_for_a_writer", "checkpoint_that_is_a_folder", "checkpoint_that_acts_on_the_terminal"),
    *("continuations_without_a_step", "numbers_that_json_has_not"),
    *("ten_million_quantiles", "images_of_cells_of_400_pixels", "sixteen_layers_of_4096"),
    *("checkpoint_of_seven_gigabytes", "a_replay_of_gigabytes", "event_of_many_empty_values"),
    *("map_file_elsewhere_that_is_the_secret", "environment_of_a_module", "environment_that_opens_a_file"),
    *("environment_of_four_million_cells", "environment_that_a_command_builds", "world_that_is_the_secret"),
    *("world_of_450_megabytes", "world_with_another_digit", "films_that_are_the_secret"),
    *("report_that_leads_outside", "yaml_that_runs_and_grows", "event_of_an_exabyte"),
}
RUNS = SHORT | {"lake": [*SHORT["q_learning"], "env=frozen_lake_v1", "n_envs=4"]}  # which has tables
ALL = os.environ.get("GRIDWORLD_HOSTILE") == "all"
CASES = [case for case in CATALOGUE if ALL or case.name in FIRST]
READERS = ("verify", "export", "diagnose", "reproduce", "play", "playground")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of every agent that the catalogue spoils."""
    folder = tmp_path_factory.mktemp("good")
    for agent in sorted({case.agent for case in CASES}):
        train_in(folder / agent, *RUNS[agent], "recording.frames=false", "recording.gif=false")
    return folder


def test_the_first_are_of_the_catalogue() -> None:
    assert {case.name for case in CATALOGUE} >= FIRST
    assert len(FIRST) >= 40
    assert len(CATALOGUE) >= 50


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_nothing_of_a_hostile_run_gets_out(case: Hostile, good: Path, tmp_path: Path) -> None:
    base = tmp_path / "base"
    outside = base / "outside"
    outside.mkdir(parents=True)
    (outside / "kept").write_text("kept")
    (base / "evil.py").write_text(f"open({str(base / 'canary')!r}, 'w')\nclass Agent: pass\n")
    (base / "secret.txt").write_text(f"S{SECRET}G\n")
    (base / "secret.json").write_text(f'{{"status": "{SECRET}", "timesteps": "{SECRET}"}}')
    Image.new("RGB", (16, 16), "red").save(base / "secret.png")
    place = base / "place"  # commands may write here
    place.mkdir()
    (place / "table.md").write_text("before\n<!-- results -->\n<!-- /results -->\nafter\n")
    shutil.copytree(good / case.agent, place / "run")
    case.spoil(place / "run", base)
    before = contents(outside)
    assert not (base / "canary").exists()

    looked_at = -1
    one = READERS[CASES.index(case) % len(READERS)]
    for command, words in WORDS.items():
        if command in READERS and command != one and not ALL:
            continue
        variables = {**AWAY, "PYTHONPATH": f"{ROOT}{os.pathsep}{base}"}
        ended = forks.run(
            SCRIPTS[command], *words, cwd=place, secret=base / "secret", environment=variables, timeout=300
        )
        where = f"{command}: {ended.output[-2000:]}"
        assert ended.deeds == [], where
        assert not (base / "canary").exists(), where
        assert SECRET not in ended.output, where
        assert ended.code in ((0, 1, 2) if command in ("report", "reproduce", "verify") else (0, 2)), where
        assert "Traceback" not in ended.output, where
        assert ended.seconds < MOST_SECONDS, where
        assert ended.megabytes < case.megabytes, (ended.megabytes, where)
        assert re.fullmatch(r"[^\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]*", ended.output), where
        assert len(ended.output) < 10_000, where
        if command == "evaluate":
            assert case.words in ended.output, where
            assert ended.code == (0 if FINE in case.words or "policy of" in case.words else 2), where
        if command == "play":
            # The window is all that is missing where a run can be looked at.
            assert (NO_DISPLAY in ended.output) == (looked_at == 0), where
        if command == "evaluate":
            looked_at = ended.code

    assert contents(outside) == before
    assert [path for path in place.rglob("*") if holds_the_secret(path)] == []
    check_report(place)


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def holds_the_secret(path: Path) -> bool:
    """A small file does; none that is written is larger."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size > 2**26:
        return False
    return SECRET.encode() in path.read_bytes()


def check_report(place: Path) -> None:
    """What the report says is text: no element, no link, no end of the place it stands in."""
    page = place / "run" / "report" / "report.html"
    if page.is_file():
        text = page.read_text("utf-8")
        assert "<script" not in text
        assert "<img src=x" not in text
    for card in place.glob("hub/*/README.md"):
        assert "<" not in card.read_text("utf-8")
        links = re.findall(r"\]\(([^)]*)\)", card.read_text("utf-8"))
        assert all(re.fullmatch(r"[\w.]+\.(png|gif)", link) for link in links)
    table = (place / "table.md").read_text("utf-8")
    assert table.startswith("before\n")
    assert table.endswith("<!-- /results -->\nafter\n")
    assert not re.search(r"<(?!!-- /?results -->)", table)
    assert "](" not in table
