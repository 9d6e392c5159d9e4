"""The learning curve: exact evaluations of an agent's policies while it learns, handed to sinks.

Two policies are scored side by side: the greedy one and the one that actions are sampled from. Beside them
stands what the environments counted: the returns of the training episodes since the evaluation before. The
sinks (`gridworld.training.sinks`) turn an evaluation into a row of a file, points in TensorBoard, a progress
line and pictures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gridworld.agents import Agent, PolicySnapshot
from gridworld.config.train import TrainConfig
from gridworld.envs.statistics_env import NO_EPISODES, Returns, StatisticsVectorEnv
from gridworld.errors import InputError
from gridworld.process.parallel.together import clock
from gridworld.storage.serialization import State
from gridworld.world.exact.evaluation import Evaluator, Score


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One point of a learning curve."""

    step: int  # environment steps so far
    snapshot: PolicySnapshot
    greedy: Score
    sampled: Score
    returns: Returns  # of the training episodes since the evaluation before


class Sink(Protocol):
    """What takes every evaluation, in order."""

    def write(self, evaluation: Evaluation) -> None:
        """Take one more."""


@dataclass(frozen=True, eq=False)
class _Held:
    """An evaluation that was due where training may be over; what it is of, as it was then."""

    step: int
    snapshot: PolicySnapshot
    model: bytes  # the content of its file, if it was the best by then

    def get_state(self) -> State:
        model = np.frombuffer(self.model, np.uint8)
        return {"step": self.step, "beliefs": vars(self.snapshot).copy(), "model": model}


@dataclass
class Certificate:
    """Since when the greedy policy is certified optimal."""

    streak: int = 0  # certified policies in a row, each counted once
    first_certified_step: int | None = None
    certified_since_step: int | None = None  # of the streak that still holds

    def update(self, step: int, certified: bool, is_new_policy: bool) -> None:
        """Take in an evaluation.

        Args:
            step: environment steps so far.
            certified: whether the greedy policy is certified optimal.
            is_new_policy: False if this policy was evaluated last time too. Between two updates the same one
                may be met again; it earns one certificate, not several.
        """
        if not certified:
            self.certified_since_step, self.streak = None, 0
            return
        self.streak += is_new_policy
        if self.certified_since_step is None:
            self.certified_since_step = step
        if self.first_certified_step is None:
            self.first_certified_step = step

    def get_state(self) -> State:
        """The three fields."""
        return vars(self).copy()

    def set_state(self, state: State) -> None:
        """Continue from the three fields, which may stand among others."""
        self.streak = int(state["streak"])
        self.first_certified_step = state["first_certified_step"]
        self.certified_since_step = state["certified_since_step"]


class BestModel:
    """The model of the lowest exact regret, the earliest of equals; all certified policies are equals.

    Attributes:
        step: environment steps at its evaluation; -1: there was none yet.
        regret: of its greedy policy.
        content: of its model file.
    """

    def __init__(self) -> None:
        self.step, self.regret, self.content = -1, float("inf"), b""

    def is_beaten_by(self, score: Score) -> bool:
        """Whether a policy with this score is better."""
        return self.step < 0 or score.shortfall < self.regret

    def offer(self, step: int, score: Score, model_file: Callable[[], bytes]) -> None:
        """Take a model if it is better.

        Args:
            step: environment steps so far.
            score: of its greedy policy.
            model_file: gives the content of its file, which is only then asked for.
        """
        if self.is_beaten_by(score):
            self.step, self.regret, self.content = step, score.shortfall, model_file()

    def get_state(self) -> State:
        """The attributes."""
        content = np.frombuffer(self.content, np.uint8)
        return {"step": self.step, "regret": self.regret, "content": content}

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`."""
        self.step, self.regret = int(state["step"]), float(state["regret"])
        self.content = state["content"].tobytes()


class LearningCurve:
    """Evaluates an agent every so many environment steps, and at the end.

    The evaluation at the end may come soon after the one before, with few episodes of its own; it takes those
    of the one before too.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        agent: Agent,
        config: TrainConfig,
        sinks: Sequence[Sink] = (),
        envs: StatisticsVectorEnv | None = None,
    ) -> None:
        """A curve without a point.

        Args:
            evaluator: scores policies exactly.
            agent: the one that learns.
            config: the run's settings; `evaluation` and `total_timesteps` say when an evaluation is due.
            sinks: take every evaluation, one after the other.
            envs: those that the agent learns in, which count the returns of its episodes.
        """
        self.evaluator = evaluator
        self.certificate = Certificate()
        self.best = BestModel()
        self.newest: Evaluation | None = None
        self.seconds = 0.0  # spent on evaluation
        self._agent = agent
        self._envs = envs
        self._sinks = sinks
        self._every = config.evaluation.every
        self._stop_after = config.evaluation.stop_after
        self._total = config.total_timesteps
        self._next = self._every
        self._held: _Held | None = None
        self._due = NO_EPISODES  # those of the newest evaluation that was due, held or not

    def get_state(self) -> State:
        """The schedule, the certificate, the best model; the newest snapshot, which gives its scores."""
        newest, held = self.newest, self._held
        return {
            "step": -1 if newest is None else newest.step,
            "next": self._next,
            **self.certificate.get_state(),
            "seconds": self.seconds,
            "beliefs": None if newest is None else vars(newest.snapshot).copy(),
            "held": None if held is None else held.get_state(),
            "best": self.best.get_state(),
            "due": self._due._asdict(),
        }

    def set_state(self, state: State) -> None:
        """Continue from a state.

        Raises:
            Exception: of any kind for a state that does not fit; see `storage.serialization.fitting`.
        """
        self._next = int(state["next"])
        self.certificate.set_state(state)
        self.seconds = float(state["seconds"])
        if (held := state["held"]) is not None:
            self._held = _Held(int(held["step"]), _snapshot(held["beliefs"]), held["model"].tobytes())
        self.best.set_state(state["best"])
        self._due = Returns(int(state["due"]["episodes"]), float(state["due"]["total"]))
        if state["beliefs"] is not None:
            snapshot = _snapshot(state["beliefs"])
            self.newest = Evaluation(int(state["step"]), snapshot, *self._scores(snapshot), NO_EPISODES)

    def catch_up(self) -> None:
        """Write what was held at the end of a shorter run, if that is not the end any more."""
        if self._held is not None and self._held.step < self._total:
            self._write_held()

    def on_step(self, step: int) -> int:
        """Evaluate if it is due.

        The last step is left to the evaluation after training, since an update may still follow it. Which one
        is the last, training alone knows: from the configured end on, an evaluation is held until a step
        follows. So a run that is made longer later has it where the longer run has it.

        Args:
            step: environment steps so far.

        Returns:
            The steps by which it is to be called again; 0 once the certificate has held for long enough
            (`evaluation.stop_after`).
        """
        self._write_held()
        if self._next <= step:
            self._next += self._every * ((step - self._next) // self._every + 1)
            self._due = self._take_returns()
            if step < self._total:
                self._evaluate(step, self._agent.snapshot, self._agent.model_file, self._due)
            else:
                self._held = self._hold(step, self._agent.snapshot())
        if self._stop_after is not None and self.certificate.streak >= self._stop_after:
            return 0
        return self._next if self._held is None else step + 1

    def evaluate(self, step: int) -> Evaluation:
        """Evaluate both policies before the first or after the last step, once a step.

        Args:
            step: environment steps so far.

        Returns:
            The evaluation at this step, a new one or the one that there is.
        """
        self._held = None  # of this step, as it was before the last update
        if self.newest is not None and step == self.newest.step:
            return self.newest
        returns = self._due.merged(self._take_returns())
        return self._evaluate(step, self._agent.snapshot, self._agent.model_file, returns)

    def _hold(self, step: int, snapshot: PolicySnapshot) -> _Held:
        is_best = self.best.is_beaten_by(self._greedy_score(snapshot))
        return _Held(step, snapshot, self._agent.model_file() if is_best else b"")

    def _write_held(self) -> None:
        held, self._held = self._held, None
        if held is not None:
            self._evaluate(held.step, lambda: held.snapshot, lambda: held.model, self._due)

    def _take_returns(self) -> Returns:
        return NO_EPISODES if self._envs is None else self._envs.take_returns()

    def _evaluate(
        self,
        step: int,
        snapshot: Callable[[], PolicySnapshot],
        model_file: Callable[[], bytes],
        returns: Returns,
    ) -> Evaluation:
        started = clock()
        evaluation = self._scored(step, snapshot(), returns)
        self.best.offer(step, evaluation.greedy, model_file)
        self.seconds += clock() - started
        for sink in self._sinks:
            sink.write(evaluation)
        return evaluation

    def _scored(self, step: int, snapshot: PolicySnapshot, returns: Returns) -> Evaluation:
        if not (np.isfinite(snapshot.values).all() and np.isfinite(snapshot.sampled).all()):
            raise InputError(
                f"training diverged: the agent's values are no finite numbers after {step} steps; "
                "try a smaller learning rate"
            )
        before = self.newest
        is_new = before is None or not np.array_equal(before.snapshot.values, snapshot.values)
        self.newest = evaluation = Evaluation(step, snapshot, *self._scores(snapshot), returns)
        self.certificate.update(step, evaluation.greedy.certified, is_new)
        return evaluation

    def _scores(self, snapshot: PolicySnapshot) -> tuple[Score, Score]:
        """Of the greedy and of the sampled policy; the newest ones where a policy is the same."""
        newest, greedy = self.newest, self._greedy_score(snapshot)
        if newest is not None and np.array_equal(newest.snapshot.sampled, snapshot.sampled):
            return greedy, newest.sampled
        return greedy, self.evaluator.score(snapshot.sampled)

    def _greedy_score(self, snapshot: PolicySnapshot) -> Score:
        newest = self.newest
        if newest is not None and np.array_equal(newest.snapshot.greedy, snapshot.greedy):
            return newest.greedy
        return self.evaluator.score(snapshot.greedy_policy())


def _snapshot(state: State) -> PolicySnapshot:
    """Mirrors `vars`; nothing is left to a default."""
    return PolicySnapshot(*(state[field.name] for field in dataclasses.fields(PolicySnapshot)))
