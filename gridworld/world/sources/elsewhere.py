"""Whether an environment is the same world in other processes, where sets and `hash` come in another order.

Each of them has a fixed hash seed, makes the environment by its name, compiles it, and prints what it found.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.base.errors import InputError
from gridworld.base.user_input import called_from, users_folder
from gridworld.world.door.beliefs import summed
from gridworld.world.mdp import ELSEWHERE, Mdp, leaves_of
from gridworld.world.sources.environment import compile_id

_SEEDS, _LARGE = 4, 2_000  # processes; states of a world for which there is one
_LONGER = 10  # times as long as in this process may it take there, and this many seconds besides
_COMPARED: dict[str, int] = {}  # worlds of this process, by what makes them and what they are


def same_elsewhere(mdp: Mdp, env_id: str, kwargs: Mapping[str, Any], seconds: float, **bounds: Any) -> Mdp:
    """The same world, whose `truth` says if other processes have found the same; InputError: it is another.

    Gymnasium's own are taken as the same, and what can only be made in this process is not compared.
    """
    spec = gym.registry.get(env_id)
    if spec is not None and str(spec.entry_point).startswith("gymnasium.envs."):
        return mdp
    asked = json.dumps([env_id, dict(kwargs), bounds], default=str)
    key = asked + mdp.shown_digest()
    if key not in _COMPARED:
        _COMPARED[key] = _processes(mdp, env_id, asked, _LONGER * (1 + seconds))
    if not (count := _COMPARED[key]):
        return mdp
    return replace(mdp, truth=f"{mdp.truth}, {ELSEWHERE} {count} other process{'es' * (count > 1)}")


def _processes(mdp: Mdp, env_id: str, asked: str, seconds: float) -> int:
    """How many other processes have found the same world; 0 where it cannot be made there."""
    content = json.dumps([asked, sys.path, str(users_folder())])
    seeds = range(_SEEDS if mdp.num_states <= _LARGE else 1)
    running = [_started({**os.environ, "PYTHONHASHSEED": str(seed)}) for seed in seeds]
    try:
        found = [each.communicate(content, timeout=seconds)[0].split()[-2:] for each in running]
    except subprocess.TimeoutExpired:
        return 0
    finally:
        for each in running:
            each.kill()
            each.wait()
    if not all(found):
        return 0
    for seed, (digest, by_content) in enumerate(found):
        if digest != mdp.shown_digest() and by_content != content_digest(mdp):
            raise InputError(
                f"env.id={env_id}: is another world in another process (with PYTHONHASHSEED={seed}), so it "
                "cannot be solved exactly; something in it follows the order of a set, or hash()"
            )
    return len(found)


def _started(environment: Mapping[str, str]) -> subprocess.Popen[str]:
    command, pipe = [sys.executable, "-m", __name__], subprocess.PIPE
    return subprocess.Popen(
        command, text=True, env=environment, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL
    )


def content_digest(mdp: Mdp) -> str:
    """A digest that is the same however the states are numbered: of what they show, pay and lead to."""
    states = np.flatnonzero(mdp.reachable).tolist()
    shown = list(leaves_of(mdp.own_observation)) or [mdp.number]
    labels: dict[int, bytes] = {
        state: _hash(bool(mdp.terminal[state]), *(each[state].tobytes() for each in shown))
        for state in states
    }
    size = 0
    while size < (size := len(set(labels.values()))):  # until no two alike are told apart
        labels = {
            state: _hash(labels[state], *(_row(mdp, labels, state, a) for a in range(mdp.num_actions)))
            for state in states
        }
    starts = _shares((labels[state], mdp.start[state]) for state in mdp.start_states.tolist())
    return _hash(sorted(labels.values()), starts).hex()


def _row(mdp: Mdp, labels: Mapping[int, bytes], state: int, action: int) -> list[Any]:
    outcomes = (table[state, action] for table in (mdp.next_state, mdp.probability, mdp.reward))
    return _shares(
        ((labels[following], float(paid)), chance)
        for following, chance, paid in zip(*outcomes, strict=True)
        if chance > 0
    )


def _shares(parts: Iterable[tuple[Any, float]]) -> list[Any]:
    return sorted((key, round(float(share), 12)) for key, share in summed(parts).items())


def _hash(*parts: Any) -> bytes:
    return hashlib.blake2b(repr(parts).encode(), digest_size=16).digest()


def _main() -> None:
    asked, path, folder = json.load(sys.stdin)
    sys.path[:] = path
    env_id, kwargs, bounds = json.loads(asked)
    with called_from(Path(folder)):
        mdp = compile_id(env_id, kwargs, compares=False, **bounds)  # which the first process does
    print(mdp.shown_digest(), content_digest(mdp))


if __name__ == "__main__":
    _main()
