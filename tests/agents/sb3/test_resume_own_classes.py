"""Classes of one's own: what they remember goes on to the bit, or is refused before training."""

import importlib
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.resuming import begin, differences, go_on, left_behind, rows, stopped_after
from helpers.support import SHORT, configure
from stable_baselines3 import A2C

from gridworld.errors import InputError

LESS = ["recording.frames=false", "recording.gif=false"]

HIDING = """
import itertools
import torch as th
from stable_baselines3 import A2C

class Counting(A2C):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.numbers = itertools.count()

class OwnLoop(A2C):
    def learn(self, total_timesteps, callback=None, **options):
        memory = []
        return super().learn(total_timesteps, callback, **options)

class Closing(A2C):
    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        lines = iter("abc")
        self.next_line = lambda: next(lines)

# SB3's own loop, as somebody would copy it who has something to add.
class Loop(A2C):
    def learn(self, total_timesteps, callback=None, log_interval=1, **options):
        iteration = 0
        total_timesteps, callback = self._setup_learn(total_timesteps, callback)
        callback.on_training_start(locals(), globals())
        self.loop(callback, total_timesteps)
        callback.on_training_end()
        return self

    def once(self, callback):
        going_on = self.collect_rollouts(self.env, callback, self.rollout_buffer, self.n_steps)
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        return going_on

class OwnFunction(Loop):
    def loop(self, callback, total_timesteps):
        rounds = 0
        while self.num_timesteps < total_timesteps and self.once(callback):
            rounds += 1
            self.ent_coef = 0.01 * (rounds % 7)
            self.train()

class OwnCount(Loop):
    def loop(self, callback, total_timesteps):
        for _ in range(60):
            self.once(callback)
            self.train()

class Blameless(Loop):
    def loop(self, callback, total_timesteps):
        while self.num_timesteps < total_timesteps:
            going_on = self.once(callback)
            self._n_updates += 0
            if not going_on:
                break
            factor = 0.01 * (self.num_timesteps % 7)
            self.ent_coef = factor
            self.train()

class Late(A2C):
    def learn(self, total_timesteps, callback=None, log_interval=1, **options):
        total_timesteps, callback = self._setup_learn(total_timesteps, callback)
        callback.on_training_start(locals(), globals())
        rounds = 0
        while self.num_timesteps < total_timesteps:
            going_on = self.collect_rollouts(self.env, callback, self.rollout_buffer, self.n_steps)
            if not going_on:
                break
            rounds += 1
            self.ent_coef = 0.01 * (rounds % 7)
            self.train()
        callback.on_training_end()
        return self

class Unset(A2C):
    def learn(self, total_timesteps, callback=None, log_interval=1, **options):
        total_timesteps, callback = self._setup_learn(total_timesteps, callback)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            if not self.collect_rollouts(self.env, callback, self.rollout_buffer, self.n_steps):
                break
            try:
                seen += 1
            except UnboundLocalError:
                seen = 1
            self.ent_coef = 0.01 * (seen % 7)
            self.train()
        callback.on_training_end()
        return self

class ByName(A2C):
    def learn(self, total_timesteps, callback=None, log_interval=1, **options):
        total_timesteps, callback = self._setup_learn(total_timesteps, callback)
        callback.on_training_start({}, {})
        while self.num_timesteps < total_timesteps:
            if not self.collect_rollouts(self.env, callback, self.rollout_buffer, self.n_steps):
                break
            if "known" in locals():
                self.ent_coef = 0.05
            known = True
            self.train()
        callback.on_training_end()
        return self

class Twice(A2C):
    def learn(self, total_timesteps, callback=None, log_interval=1, **options):
        super().learn(total_timesteps // 2, callback)
        return super().learn(total_timesteps, callback, reset_num_timesteps=False)

class AfterSupers(A2C):
    def learn(self, *arguments, **options):
        result = super().learn(*arguments, **options)
        told = str(result)
        return result if told else None

def is_hidden_by(default):
    class Hiding(A2C):
        def train(self, numbers=default):
            super().train()
    return Hiding

Default = is_hidden_by(itertools.count())

def stirred(number):
    return 0.01 * (number % 7)

class InADefault(A2C):
    def train(self, seen=[], *, more={"count": 0, "last": (0, 1)}):
        seen.append(1)
        more["count"] += 2
        more["last"] = (more["count"], 1)
        self.ent_coef = stirred(len(seen) + sum(more["last"]))
        super().train()

class InANumber(A2C):
    def train(self, seen=0, *, more=0):
        function = InANumber.train
        function.__defaults__ = (seen + 1,)
        function.__kwdefaults__["more"] += 2
        self.ent_coef = stirred(seen + more)
        super().train()

class OnAFunction(A2C):
    def train(self):
        OnAFunction.train.count = getattr(OnAFunction.train, "count", 0) + 1
        self.ent_coef = stirred(OnAFunction.train.count)
        super().train()

class OnAStaticOne(A2C):
    @staticmethod
    def rate(seen=[0]):
        seen[0] += 1
        return stirred(seen[0])

    @property
    def other(self, seen=[0]):
        seen[0] += 1
        return stirred(seen[0])

    @th.no_grad()
    def train(self):
        self.ent_coef = self.rate() + self.other
        with th.enable_grad():
            super().train()

def counting():
    seen = 0
    def train(self):
        nonlocal seen
        seen += 1
        self.ent_coef = stirred(seen)
        A2C.train(self)
    return train

class OverACell(A2C):
    train = counting()

class OnItself(A2C):
    def train(self):
        type(self).late = getattr(type(self), "late", 0) + 1
        self.ent_coef = stirred(self.late)
        super().train()

class OnTheLibrarys(A2C):
    def train(self):
        A2C.strangely_seen = getattr(A2C, "strangely_seen", 0) + 1
        self.ent_coef = stirred(A2C.strangely_seen)
        super().train()

class InTheLibrarys(A2C):
    def train(self):
        A2C.policy_aliases["strange"] = A2C.policy_aliases.get("strange", 0) + 1
        self.ent_coef = stirred(A2C.policy_aliases["strange"])
        super().train()

class Kept(A2C):
    seen = 0
    def train(self):
        Kept.seen += 1
        self.ent_coef = 0.01 * (Kept.seen % 7)
        self.half = [self.ent_coef, {"a": (1, self.ent_coef)}]
        super().train()
"""


def any_class(algorithm: str) -> list[str]:
    names = configure("agent=a2c").agent.arguments.keys() - {"gamma"}  # type: ignore[attr-defined]
    removed = [f"~agent.arguments.{name}" for name in sorted(names)]
    return [*SHORT["a2c"], *LESS, f"agent.algorithm={algorithm}", *removed, "checkpoint.every=100"]


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Makes everything as it is in a process of its own."""
    (tmp_path / "hiding.py").write_text(HIDING)
    monkeypatch.syspath_prepend(tmp_path)

    def forget() -> None:
        sys.modules.pop("hiding", None)
        A2C.policy_aliases.pop("strange", None)
        if hasattr(A2C, "strangely_seen"):
            del A2C.strangely_seen

    forget()
    monkeypatch.setitem(sys.modules, "hiding", importlib.import_module("hiding"))  # taken out at the end
    return forget


UNSEEN = {
    "Counting": "numbers is a itertools.count and what it holds cannot be seen",
    "OwnLoop": "OwnLoop.learn() has a variable memory of its own, a list",
    "Closing": "next_line.<lines> is a builtins.str_ascii_iterator and what it holds cannot be seen",
    "OwnFunction": "OwnFunction.loop() has a variable rounds of its own, which it sets after training has",
    "OwnCount": "OwnCount.loop() has a for loop around its rollouts, whose place cannot be seen",
    "Late": "Late.learn() has a variable rounds of its own, which it sets after training has started",
    "Unset": "Unset.learn() has a variable seen of its own, which it sets after training has started",
    "ByName": "ByName.learn() has a variable known of its own, which it sets after training has started",
    "Default": "train.(numbers) is a itertools.count and what it holds cannot be seen",
}


@pytest.mark.filterwarnings("ignore:Pickle, copy, and deepcopy support:DeprecationWarning")  # Python 3.12
@pytest.mark.parametrize("name", UNSEEN)
def test_hidden_state_is_found_and_refused(name: str, tmp_path: Path, fresh: Callable[[], None]) -> None:
    with pytest.raises(InputError) as refused:
        begin(tmp_path / "run", *any_class(f"hiding.{name}"))
    assert UNSEEN[name] in str(refused.value)
    assert str(refused.value).endswith("; train without checkpoints by checkpoint.every=null")
    assert [row["step"] for row in rows(tmp_path / "run")] == ["0"]
    begin(tmp_path / "without", *any_class(f"hiding.{name}"), "checkpoint.every=null")


def test_a_class_that_starts_training_twice_is_refused(tmp_path: Path, fresh: Callable[[], None]) -> None:
    with pytest.raises(InputError, match=r"its learn\(\) starts training twice; train without checkpoints"):
        begin(tmp_path / "run", *any_class("hiding.Twice"))


def test_what_cannot_be_put_back_is_refused_when_it_comes_up(
    tmp_path: Path, fresh: Callable[[], None]
) -> None:
    try:
        with pytest.raises(
            InputError, match=r"<A2C>\.policy_aliases became a builtins\.dict .* training; train"
        ):
            begin(tmp_path / "run", *any_class("hiding.InTheLibrarys"))
    finally:
        fresh()


@pytest.mark.parametrize(
    "name",
    [
        *("Kept", "Blameless", "AfterSupers", "InADefault", "InANumber", "OnAFunction", "OnAStaticOne"),
        *("OverACell", "OnItself", "OnTheLibrarys"),
    ],
)
def test_a_class_of_ones_own_goes_on(name: str, tmp_path: Path, fresh: Callable[[], None]) -> None:
    words = any_class(f"hiding.{name}")
    begin(tmp_path / "calm", *words)
    fresh()
    stopped_after(2, tmp_path / "run", *words)
    fresh()
    go_on(tmp_path / "run")
    fresh()
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []


def test_a_class_that_asks_for_masks_goes_on(tmp_path: Path) -> None:
    words = [*any_class("sb3_contrib.MaskablePPO"), "+agent.arguments.n_steps=16", "agent.log_interval=3"]
    begin(tmp_path / "calm", *words)
    stopped_after(2, tmp_path / "run", *words)
    go_on(tmp_path / "run")
    assert differences(left_behind(tmp_path / "run"), left_behind(tmp_path / "calm")) == []
