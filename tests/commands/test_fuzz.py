"""Whatever stands in a map, a setting, a manifest or a model file: it is taken, or refused in a sentence of
ours, in less than a second of processor time and 200 MB.

GRIDWORLD_FUZZ=5000 python -m pytest tests/commands/test_fuzz.py -s
tries as many instead of 150, and tells what came of them.
"""

import os
import warnings
from collections import Counter
from pathlib import Path

import pytest
from helpers.fuzzing import TARGETS, attempt
from helpers.runs_folder import write_study, write_sweep
from helpers.support import SHORT, train_in

COUNT = int(os.environ.get("GRIDWORLD_FUZZ", "150"))
SHARES = {"map": 0.25, "config": 0.4, "manifest": 0.25, "model": 0.1, "sweep": 0.25, "study": 0.25}
MOST_SECONDS, MOST_MEGABYTES = 1.0, 200.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With good runs of networks and of a table, a sweep and a study."""
    folder = tmp_path_factory.mktemp("fuzz")
    pictures = ["recording.frames=false", "recording.gif=false", "recording.learning=false"]
    for agent in ("dqn", "sarsa", "a2c"):
        train_in(folder / f"good-{agent}", *SHORT[agent], *pictures)
    write_sweep(folder / "good-sweep", folder / "good-sarsa")
    write_study(folder / "good-study")
    return folder


@pytest.mark.parametrize("name", TARGETS)
def test_only_our_own_errors_and_soon(name: str, folder: Path) -> None:
    attempt(name, -1, folder)  # what is imported is imported
    count = round(COUNT * SHARES[name])
    outcomes: Counter[str] = Counter()
    slowest, largest = (0.0, -1), (0.0, -1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a library's advice on settings that are odd is no error
        for seed in range(count):
            outcome, seconds, megabytes = attempt(name, seed, folder)
            outcomes[outcome if outcome in ("accepted", "refused") else f"{seed}: {outcome}"] += 1
            slowest, largest = max(slowest, (seconds, seed)), max(largest, (megabytes, seed))
    print(f"\n{name}: {count} tried, {dict(outcomes)}, slowest {slowest}, largest {largest}")
    assert outcomes.keys() <= {"accepted", "refused"}
    assert outcomes["refused"] > count / 10
    assert outcomes["accepted"] > 0 or name == "model"
    assert slowest[0] < MOST_SECONDS
    assert largest[0] < MOST_MEGABYTES
