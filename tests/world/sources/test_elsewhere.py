"""What is another world in another process is found out; what is found in another order is the same."""

import re
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from gridworld.api.worlds import compile_env
from gridworld.base.errors import InputError
from gridworld.config.compose import named_world
from gridworld.examining.examine import examine
from gridworld.world.evaluation import Evaluator
from gridworld.world.mdp import BY_CONSTRUCTION
from gridworld.world.sources.arrays import mdp_from_arrays
from gridworld.world.sources.elsewhere import content_digest
from gridworld.world.sources.environment import compile_id

MODULE = '''
import gymnasium as gym
from gymnasium import spaces


class Names(gym.Env):
    observation_space, action_space = spaces.MultiDiscrete([9, 2]), spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = 0
        return [0, 0], {}

    def step(self, action):
        self.at = min(8, max(0, self.at + self.moves(action)))
        return [self.at, 0], float(self.at == 8), self.at == 8, False, {}


class MeansTheOrder(Names):
    """What an action does follows the order of a set."""

    def moves(self, action):
        return {"back": -1, "stay": 0, "ahead": 1}[list({"back", "stay", "ahead"})[action]]


class DrawsInOrder(Names):
    """It draws among a set in its order, which makes no difference."""

    def moves(self, action):
        names = list({"back1", "ahead1", "ahead2", "ahead3"})
        name = names[int(self.np_random.integers(4))]
        return int(name[-1]) * (1 if name[0] == "a" else -1) if action else 0
'''


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "ordered.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield
    sys.modules.pop("ordered", None)


def test_another_world_in_another_process_is_refused(here: None) -> None:
    with pytest.raises(InputError, match="MeansTheOrder: is another world in another process"):
        named_world("ordered:MeansTheOrder")
    found = examine("ordered:MeansTheOrder").findings
    assert any(each.topic == "process" and "another world" in each.evidence for each in found)


@pytest.mark.slow
def test_the_same_world_in_another_order_is_the_same(here: None) -> None:
    mdp = named_world("ordered:DrawsInOrder")
    assert mdp.truth == "enumerated, 9 states, the same in 4 other processes"
    assert mdp.scope == f"{mdp.truth}: as far as its attributes and np_random determine it"
    assert examine("ordered:DrawsInOrder").passed


def test_what_can_be_made_here_alone_says_so() -> None:
    class Here(gym.Env[int, int]):
        observation_space, action_space = spaces.Discrete(2), spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            return 0, {}

        def step(self, action: int) -> Any:
            return int(action), float(action), bool(action), False, {}

    gym.register("Here-v0", Here, max_episode_steps=9)
    try:
        scope = named_world("Here-v0").scope
    finally:
        del gym.registry["Here-v0"]
    assert (
        scope == "enumerated, 2 states, in this process: as far as its attributes and np_random determine it"
    )


def test_the_scope_goes_with_the_verdict() -> None:
    lake = compile_id("FrozenLake-v1")
    assert lake.scope == "by its table P, which its steps follow exactly"
    policy = np.eye(4)[[1] * lake.num_states]
    score = Evaluator(lake, 0.99, 100).score(policy)
    assert score.scope == lake.scope
    assert f"scope='{lake.scope}'" in repr(score)
    assert Evaluator(named_world("classic"), 0.99, 100).score(np.eye(4)[[1] * 30]).scope == BY_CONSTRUCTION


def test_a_digest_of_the_content_is_that_of_any_order() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        size, actions, outcomes = rng.integers(2, 9), rng.integers(1, 4), rng.integers(1, 4)
        tables: dict[str, Any] = {
            "next_state": rng.integers(size, size=(size, actions, outcomes)),
            "probability": rng.dirichlet(np.ones(outcomes), (size, actions)),
            "reward": rng.integers(3, size=(size, actions, outcomes)).astype(float),
            "terminated": rng.random((size, actions, outcomes)) < 0.2,
            "start": rng.dirichlet(np.ones(size)),
        }
        order = rng.permutation(size)  # the new number of each
        back = np.argsort(order)
        moved = {key: table[back] for key, table in tables.items()} | {
            "next_state": order[tables["next_state"]][back]
        }
        shown = rng.integers(3, size=size)
        one = shows(mdp_from_arrays("one", tables, "one"), shown)
        other = shows(mdp_from_arrays("other", moved, "other"), shown[back])
        assert content_digest(one) == content_digest(other)
        reward = tables["reward"].copy()
        met = np.argwhere((one.probability[:size] > 0) & one.reachable[:size, None, None])
        state, action, outcome = met[rng.integers(len(met))]
        reward[state, action, outcome] += 1
        changed = shows(mdp_from_arrays("one", tables | {"reward": reward}, "one"), shown)
        assert content_digest(changed) != content_digest(one) or one.terminal[state]


def shows(mdp: Any, shown: Any) -> Any:
    """The world in which states show these numbers, several the same."""
    return replace(mdp, own_observation=shown[mdp.number])


def test_reading_the_clock_is_named() -> None:
    class Slow(gym.Env[int, int]):
        observation_space, action_space = spaces.Discrete(2), spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            super().reset(seed=seed)
            time.sleep(0)
            return 0, {}

        def step(self, action: int) -> Any:
            self.drawn = time.time() > 0
            return int(action), float(action), bool(action), False, {}

    before = time.time
    truth = compile_env(Slow()).truth
    assert time.time is before
    assert re.fullmatch(r"enumerated, 2 states; the clock is read \(test_elsewhere.py:\d+\)", truth)
