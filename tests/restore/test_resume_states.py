"""What a checkpoint holds: all that matters, nothing damaged, and nothing else is let in."""

import contextlib
import copy
import io
import os
import random
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.hostile import damaged
from helpers.resuming import begin, differences, go_on, last_state, left_behind, stopped_after
from helpers.support import SHORT, configure

from gridworld.base.errors import InputError
from gridworld.base.serialization import State, StateError, decode, encode
from gridworld.run.checkpoints import Checkpoints, Pace
from gridworld.run.provenance import identity
from gridworld.training.resume import _why_not

CORRUPTIONS = int(os.environ.get("GRIDWORLD_CORRUPTIONS", "200"))
LESS = [*("recording.frames=false", "recording.gif=false", "env.slip=0.1", "logging.policy_map_every=0")]


def test_no_damaged_checkpoint_is_accepted(tmp_path: Path) -> None:
    begin(tmp_path, *SHORT["dqn"], *LESS)
    data = Checkpoints(tmp_path).files()[0].read_bytes()
    whole = decode(data)
    for number in range(CORRUPTIONS):
        with contextlib.suppress(StateError):
            found = decode(damaged(random.Random(number), data))
            assert differences(found, whole) == [], number  # a zip has bits that mean nothing


def test_a_hostile_state_is_refused() -> None:
    """Its checksums are right: what somebody with bad intentions would make."""
    for tree in (
        *("", "[]", "nonsense", '{"a": {"@": 0}}', '{"a": {"@": "y"}}', '{"a": {"@": "x", "b": 1}}'),
        *('{"a": {"@": "text"}}', '{"a": {"@": ["x"]}}', '{"a": ' + "[" * 100_000 + "]" * 100_000 + "}"),
        '{"a": {"@": "pickled"}}',
    ):
        content = io.BytesIO()
        np.savez(content, x=np.zeros(1), pickled=np.array([{}]))
        with zipfile.ZipFile(content, "a") as archive:
            archive.writestr("state.json", tree)
            archive.writestr("text", "no array")
        with pytest.raises(StateError):
            decode(content.getvalue())


# What may be anything, since it follows from the rest or is not looked at again; all else must be missed.
DERIVED = {
    "agent.seconds": "the clock's",
    "agent.logged": "told to TensorBoard only, which is off here",
    "agent.recent_episodes": "told to TensorBoard only, which is off here",
    "agent.action_generator.uinteger": "only looked at where has_uint32 says so",
    "agent.exploration_rate": "set again after the first step, before which a run of this test draws no coin",
}


def leaves(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of all values."""
    if isinstance(node, dict) and node:
        for key, value in node.items():
            yield from leaves(value, (*path, key))
    else:
        yield path


def at(node: Any, path: tuple[str, ...]) -> Any:
    for key in path:
        node = node[key]
    return node


def changed(state: State, path: tuple[str, ...], *value: Any) -> State:
    """With another value there, or none."""
    wrong = copy.copy(state)
    node = wrong
    for key in path[:-1]:
        node[key] = copy.copy(node[key])
        node = node[key]
    if value:
        node[path[-1]] = value[0]
    else:
        del node[path[-1]]
    return wrong


def ends(folder: Path, copied: Path, state: State) -> dict[str, Any] | None:
    """What comes of going on from this state; None: it is refused."""
    shutil.copytree(folder, copied)
    Checkpoints(copied).files()[0].write_bytes(encode(state))
    try:
        go_on(copied)
    except InputError:
        return None
    else:
        return left_behind(copied)
    finally:
        shutil.rmtree(copied)


RUNS = {
    "dqn": [*SHORT["dqn"], "agent.learning_starts=100", "n_envs=32", "total_timesteps=800"],
    "ppo": [*SHORT["ppo"], "total_timesteps=1100"],
    "q_learning": SHORT["q_learning"],
}
PLAIN = [
    *("logging.tensorboard=false", "recording.learning=false", "env.max_episode_steps=30"),
    *("recording.policy_map=false", "recording.q_error=false", "recording.visits=false"),
]


@pytest.mark.slow
@pytest.mark.parametrize("agent", RUNS)
def test_what_is_left_out_is_missed(agent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Item by item, with what a new run begins with in its place: the run ends otherwise, or is refused."""
    words = [*RUNS[agent], *LESS, *PLAIN]
    begin(tmp_path / "calm", *words)
    calm = left_behind(tmp_path / "calm")
    with monkeypatch.context() as patched:
        patched.setattr(Pace, "is_due", lambda self, steps: True)
        stopped_after(1, tmp_path / "start", *words)
    stopped_after(1, tmp_path / "run", *words, "checkpoint.every=600")
    first, whole = (decode(Checkpoints(tmp_path / name).files()[0].read_bytes()) for name in ("start", "run"))
    assert differences(ends(tmp_path / "run", tmp_path / "copy", whole), calm) == []
    missed, not_missed = 0, []
    for path in leaves(whole["agent"]):
        name = ".".join(("agent", *path))
        try:
            began_with = at(first["agent"], path)
        except KeyError:
            continue
        if differences(began_with, at(whole["agent"], path)) == []:
            continue
        outcome = ends(tmp_path / "run", tmp_path / "copy", changed(whole, ("agent", *path), began_with))
        if outcome is None or differences(outcome, calm):
            missed += 1
        else:
            not_missed.append(name)
    assert missed >= {"dqn": 20, "ppo": 12, "q_learning": 8}[agent]
    assert [name for name in not_missed if name not in DERIVED] == []


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["ppo", "q_learning"])
def test_what_is_taken_out_is_refused(agent: str, tmp_path: Path) -> None:
    """Item by item: there is no default that could hide a loss."""
    stopped_after(1, tmp_path / "run", *RUNS[agent], *LESS, "checkpoint.every=600")
    file = Checkpoints(tmp_path / "run").files()[0]
    whole = decode(file.read_bytes())
    own = identity(configure(*RUNS[agent], *LESS), "S.....\n....T.\n...TG.\n....T.\n......")
    entries, accepted = 0, []
    for path in leaves(whole):
        wrong, entries = changed(whole, path), entries + 1
        refused = _why_not(file, wrong, tmp_path / "run", own) is not None
        if not refused and ends(tmp_path / "run", tmp_path / "copy", wrong) is not None:
            accepted.append(".".join(path))
    assert entries > 25
    assert accepted == []


def test_equal_runs_on_images_have_equal_states(tmp_path: Path) -> None:
    """SB3 shows a network for images a random one, from a generator that nobody else seeds."""
    words = ["agent=a2c", "observation=image", "agent.policy=CnnPolicy", "total_timesteps=40", "n_envs=4"]
    for name in ("one", "other"):
        begin(tmp_path / name, *words, *LESS)
    assert differences(last_state(tmp_path / "one"), last_state(tmp_path / "other")) == []
