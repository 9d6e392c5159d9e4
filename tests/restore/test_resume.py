"""A run that was stopped or killed anywhere goes on and ends as if nothing had happened, to the last bit.

More kills: GRIDWORLD_RUN_KILLS=1000 GRIDWORLD_POINT_KILLS=3 python -m pytest tests/restore/test_resume.py
"""

import json
import os
import random
import shutil
import signal
import time
import zipfile
from pathlib import Path
from typing import Any

import pytest
from helpers.resuming import (
    Crash,
    at_call,
    begin,
    begin_or_go_on,
    crash,
    crashing_after,
    differences,
    go_on,
    in_a_process,
    kill,
    left_behind,
    stopped_after,
)
from helpers.support import SHORT

from gridworld.base import atomic_write as files
from gridworld.base.atomic_write import AppendLog
from gridworld.run import checkpoints as checkpoint
from gridworld.run.checkpoints import Checkpoints
from gridworld.training import train
from gridworld.training.pictures import Pictures

KILLS = int(os.environ.get("GRIDWORLD_RUN_KILLS", "10"))
ROUNDS = int(os.environ.get("GRIDWORLD_POINT_KILLS", "1"))
CASES = {
    "dqn": [*SHORT["dqn"], "agent.learning_rate=lin_0.003"],
    **{
        f"dqn that counts{stock}": [
            *(*SHORT["dqn"], "agent.replay_buffer_class=gridworld.agents.sb3.replay_counts.ReplayCounts"),
            *("agent.engine=stock", "agent.gradient_steps=4")[: 2 * bool(stock)],
        ]
        for stock in ("", " stock")
    },
    "dqn stock": [
        *(*SHORT["dqn"], "agent.engine=stock", "n_envs=8", "agent.buffer_size=600"),
        *("agent.gradient_steps=2", "total_timesteps=800"),
    ],
    "dqn stock that stores an observation once": [
        *(*SHORT["dqn"], "agent.engine=stock", "n_envs=8", "agent.optimize_memory_usage=true"),
        *("+agent.replay_buffer_kwargs.handle_timeout_termination=false", "agent.gradient_steps=1"),
        "total_timesteps=800",
    ],
    "ppo": [
        *(*SHORT["ppo"], "agent.ent_coef=quad_0.5", "agent.gae_lambda=lin_0.5"),
        *("agent.learning_rate=sqrt_0.01", "stratified_draws=true", "env.slip=0.1"),
    ],
    "ppo stock": [
        *(*SHORT["ppo"], "agent.engine=stock", "agent.log_interval=2", "n_envs=8"),
        "total_timesteps=1200",
    ],
    "ppo stock with settings that fall": [
        *(*SHORT["ppo"], "agent.engine=stock", "agent.ent_coef=quad_0.5", "agent.gae_lambda=lin_0.5"),
        *("agent.learning_rate=sqrt_0.01", "agent.clip_range=lin_0.3"),
    ],
    "dqn stock with a rate that falls": [
        *(*SHORT["dqn"], "agent.engine=stock", "agent.learning_rate=sqrt_0.01", "n_envs=8"),
        *("agent.gradient_steps=1", "total_timesteps=800"),
    ],
    **{f"{name} stock": [*SHORT[name], "agent.engine=stock"] for name in ("a2c", "qrdqn")},
    **{name: SHORT[name] for name in ("a2c", "qrdqn", "trpo", "q_learning", "sarsa", "expected_sarsa")},
}
LESS = ["recording.frames=false", "recording.gif=false", "env.slip=0.1", "exploration_bonus=0.1"]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_every_agent_goes_on_to_the_bit(case: str, tmp_path: Path) -> None:
    """After its process has died at the first checkpoint, and again some later."""
    words = [*CASES[case], *LESS]
    begin(tmp_path / "calm", *words)
    stopped_after(1, tmp_path / "run", *words, "checkpoint.every=150")
    with crashing_after(2):
        go_on(tmp_path / "run")
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


def members(path: Path) -> dict[str, Any]:
    """Everything in a model file, except the time when it began, and what is pickled, by its text alone."""
    with zipfile.ZipFile(path) as archive:
        found: dict[str, Any] = {name: archive.read(name) for name in archive.namelist()}
    if "data" in found:
        found["data"] = json.loads(found["data"])
        del found["data"]["start_time"]
        for value in found["data"].values():
            if isinstance(value, dict):
                value.pop(":serialized:", None)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("case", [*CASES, "value_iteration"])
def test_a_run_that_dies_after_its_last_checkpoint_writes_the_same_model(case: str, tmp_path: Path) -> None:
    """Whatever is in the file: the optimiser's rate, what is left of training, counters."""
    words = [*CASES.get(case, SHORT["value_iteration"]), "recording.frames=false", "recording.gif=false"]
    begin(tmp_path / "calm", *words)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(train, "summarise", crash)
        with pytest.raises(Crash):
            begin(tmp_path / "run", *words)
    go_on(tmp_path / "run")
    for name in ("model.zip", "best_model.zip"):
        assert differences(members(tmp_path / "run" / name), members(tmp_path / "calm" / name)) == [], name
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


SAVED = ["recording.frames=false", "recording.gif=false", "logging.progress=false", "checkpoint.every=100"]
RUNS = {name: [*CASES[name], *SAVED] for name in ("dqn", "dqn stock", "ppo", "q_learning")}


def is_done(folder: Path) -> bool:
    manifest = folder / "manifest.json"
    return manifest.exists() and '"status": "finished"' in manifest.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_run_that_is_killed_ends_as_if_it_was_not(name: str, tmp_path: Path) -> None:
    words, folder = RUNS[name], tmp_path / "run"
    started = time.monotonic()
    begin(tmp_path / "calm", *words)
    longest = min(time.monotonic() - started, 1.0)  # the first one imports, too
    calm = left_behind(tmp_path / "calm")
    chance, wanted = random.Random(name), -(-KILLS // len(RUNS))
    kills = 0
    while kills < wanted:
        code = in_a_process(lambda: begin_or_go_on(folder, *words), chance.uniform(0, 1.2 * longest))
        assert code in (0, -signal.SIGKILL)
        kills += code != 0
        if is_done(folder):
            assert differences(left_behind(folder), calm) == []
            shutil.rmtree(folder)
    if folder.exists():
        assert in_a_process(lambda: begin_or_go_on(folder, *words)) == 0
        assert differences(left_behind(folder), calm) == []
        assert list(folder.rglob(".*.part")) == []


# Where to die: before or after this function's n-th call.
POINTS: list[tuple[Any, str, bool, int]] = [
    (AppendLog, "append", False, 9),
    (AppendLog, "append", True, 12),
    (AppendLog, "sync", True, 3),
    (checkpoint, "encode", False, 2),
    (files.os, "replace", False, 5),
    (files.os, "fsync", True, 7),
    (files, "sync_folder", False, 3),
    (Checkpoints, "keep", False, 4),
    (train, "write_bytes", True, 1),
    (train, "write_json", False, 1),
    (Pictures, "finish", False, 1),
]


@pytest.mark.slow
def test_a_run_that_is_killed_at_a_point_ends_as_if_it_was_not(tmp_path: Path) -> None:
    words, folder = RUNS["q_learning"], tmp_path / "run"
    begin(tmp_path / "calm", *words)
    calm = left_behind(tmp_path / "calm")
    for turn in range(ROUNDS):
        for owner, name, after, number in POINTS:
            at = max(1, number - turn)  # an earlier call in every round; later ones need not come

            def die(owner: Any = owner, name: str = name, after: bool = after, at: int = at) -> None:
                setattr(owner, name, at_call(at, kill, getattr(owner, name), after))
                begin_or_go_on(folder, *words)

            assert in_a_process(die) == -signal.SIGKILL, name
            assert in_a_process(lambda: begin_or_go_on(folder, *words)) == 0, name
            assert differences(left_behind(folder), calm) == [], name
            shutil.rmtree(folder)
