"""The learning curve: exact evaluations of an agent's policies while it learns, and where they go.

Two policies are scored side by side: the greedy one and the one that actions are sampled from. With them go
the returns of the training episodes since the evaluation before, which the environments counted. A sink
takes every evaluation: the curve's file, TensorBoard, the progress line, the pictures.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent, WriteScalars
from gridworld.base.atomic_write import AppendLog
from gridworld.base.errors import InputError
from gridworld.base.safe_read import csv_text
from gridworld.base.serialization import State
from gridworld.config.train import TrainConfig
from gridworld.envs.training_env import NO_EPISODES, Returns, TrainingVectorEnv
from gridworld.run.writer import NEEDED
from gridworld.world.evaluation import Evaluator, PolicySnapshot, Score
from gridworld.world.metrics import METRICS, TRAINING_METRICS, Metric, numbers, regret_text

if TYPE_CHECKING:
    from gridworld.base.console import Progress

# TensorBoard sorts its groups by name and opens with the first: the greedy policy's learning curve. Behind it
# are the greedy policy's other metrics, the sampled policy, and the optimum, which is a flat line.
GREEDY, GREEDY_MORE, SAMPLED, OPTIMUM = "eval", "eval_more", "eval_sampled", "optimal"


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One point of a learning curve."""

    step: int  # environment steps so far
    snapshot: PolicySnapshot
    greedy: Score
    sampled: Score
    returns: Returns  # of the training episodes since the evaluation before


Sink = Callable[[Evaluation], None]


@dataclass
class Certificate:
    """Since when the greedy policy is certified optimal."""

    streak: int = 0  # certified policies in a row, each counted once
    first_certified_step: int | None = None
    certified_since_step: int | None = None  # of the streak that still holds

    def update(self, step: int, certified: bool, is_new_policy: bool) -> None:
        """Take in an evaluation; a policy that was evaluated last time too earns no second certificate."""
        if not certified:
            self.certified_since_step, self.streak = None, 0
            return
        self.streak += is_new_policy
        if self.certified_since_step is None:
            self.certified_since_step = step
        if self.first_certified_step is None:
            self.first_certified_step = step


@dataclass
class BestModel:
    """The model of the lowest exact regret, the earliest of equals; all certified policies are equals."""

    step: int = -1  # environment steps at its evaluation; -1: there was none yet
    regret: float = float("inf")  # of its greedy policy
    content: bytes = field(default=b"", repr=False)  # of its model file

    def is_beaten_by(self, score: Score) -> bool:
        """Whether a policy with this score is better."""
        return self.step < 0 or score.shortfall < self.regret


class LearningCurve:
    """Evaluates an agent every so many environment steps, and at the end.

    The evaluation at the end may come soon after the one before, with few episodes of its own; it takes those
    of the one before too. `envs`, in which the agent learns, count the returns of its episodes.
    """

    def __init__(
        self, evaluator: Evaluator, agent: Agent, config: TrainConfig, envs: TrainingVectorEnv
    ) -> None:
        self.evaluator = evaluator
        self.certificate = Certificate()
        self.best = BestModel()
        self.newest: Evaluation | None = None
        self.seconds = 0.0  # spent on evaluation
        self.sinks: list[Sink] = []  # take every evaluation, one after the other
        self.agent, self._envs = agent, envs
        self._every, self._stop_after = config.evaluation.every, config.evaluation.stop_after
        self._total = config.total_timesteps
        self._next = self._every
        # One that was due where training may be over, with its model if that is the best; see `on_step`
        self._held: tuple[Evaluation, bytes] | None = None
        self._due = NO_EPISODES  # those of the newest evaluation that was due, held or not

    def get_state(self) -> State:
        """The schedule, the certificate, the best model; snapshots, which give their scores."""
        newest, held, best = self.newest, None, self.best
        if self._held is not None:
            evaluation, model = self._held
            held = {
                "step": evaluation.step,
                "snapshot": vars(evaluation.snapshot).copy(),
                "model": np.frombuffer(model, np.uint8),
            }
        return {
            "step": -1 if newest is None else newest.step,
            "next": self._next,
            **vars(self.certificate),
            "seconds": self.seconds,
            "snapshot": None if newest is None else vars(newest.snapshot).copy(),
            "held": held,
            "best": {**vars(best), "content": np.frombuffer(best.content, np.uint8)},
            "due": self._due._asdict(),
        }

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`; inside `base.serialization.fitting`."""
        self._next = int(state["next"])
        self.certificate = Certificate(
            int(state["streak"]), state["first_certified_step"], state["certified_since_step"]
        )
        self.seconds = float(state["seconds"])
        best, held, due = state["best"], state["held"], state["due"]
        self.best = BestModel(int(best["step"]), float(best["regret"]), best["content"].tobytes())
        self._due = Returns(int(due["episodes"]), float(due["total"]))
        if state["snapshot"] is not None:
            self.newest = self._scored(int(state["step"]), _snapshot(state["snapshot"]), NO_EPISODES)
        if held is not None:
            evaluation = self._scored(int(held["step"]), _snapshot(held["snapshot"]), self._due)
            self._held = evaluation, held["model"].tobytes()

    def write_held_of_shorter_run(self) -> None:
        """Write what was held at the end of a shorter run, if that is no longer the end."""
        if self._held is not None and self._held[0].step < self._total:
            self._write_held()

    def on_step(self, step: int) -> int:
        """Evaluate if it is due; returns as `Agent.learn` wants it, 0 after `evaluation.stop_after`.

        The last step is left to the evaluation after training, since an update may still follow it. Which one
        is the last, training alone knows: from the configured end on, an evaluation is held until a step
        follows. So a run that is made longer later has it where the longer run has it.
        """
        self._write_held()
        if self._next <= step:
            self._next += self._every * ((step - self._next) // self._every + 1)
            self._due = self._envs.take_returns()
            evaluation = self._evaluation(step, self._due)
            if step < self._total:
                self._write(evaluation)
            else:
                is_best = self.best.is_beaten_by(evaluation.greedy)
                self._held = evaluation, self.agent.model_file() if is_best else b""
        if self._stop_after is not None and self.certificate.streak >= self._stop_after:
            return 0
        return self._next if self._held is None else step + 1

    def evaluate(self, step: int) -> Evaluation:
        """Evaluate both policies before the first or after the last step, once a step."""
        self._held = None  # of this step, as it was before the last update
        if self.newest is not None and step == self.newest.step:
            return self.newest
        evaluation = self._evaluation(step, self._due.merged(self._envs.take_returns()))
        self._write(evaluation)
        return evaluation

    def _write_held(self) -> None:
        if self._held is not None:
            held, self._held = self._held, None
            self._write(*held)

    def _evaluation(self, step: int, returns: Returns) -> Evaluation:
        """Of the agent as it is now."""
        started = time.perf_counter()
        snapshot = self.agent.snapshot()
        if not (np.isfinite(snapshot.values).all() and np.isfinite(snapshot.sampled).all()):
            raise InputError(
                f"training diverged: the agent's values are not finite numbers after {step} steps; "
                "try a smaller learning rate"
            )
        evaluation = self._scored(step, snapshot, returns)
        self.seconds += time.perf_counter() - started
        return evaluation

    def _scored(self, step: int, snapshot: PolicySnapshot, returns: Returns) -> Evaluation:
        """With the newest evaluation's scores where a policy is the same."""
        newest, score = self.newest, self.evaluator.score
        if newest is not None and np.array_equal(newest.snapshot.greedy, snapshot.greedy):
            greedy = newest.greedy
        else:
            greedy = score(snapshot.greedy_policy())
        if newest is not None and np.array_equal(newest.snapshot.sampled, snapshot.sampled):
            sampled = newest.sampled
        else:
            sampled = score(snapshot.sampled)
        return Evaluation(step, snapshot, greedy, sampled, returns)

    def _write(self, evaluation: Evaluation, model: bytes | None = None) -> None:
        """Take in an evaluation and hand it on; `model` is its model's file, None: as it is now."""
        before, self.newest = self.newest, evaluation
        values, step = evaluation.snapshot.values, evaluation.step
        is_new = before is None or not np.array_equal(before.snapshot.values, values)
        self.certificate.update(step, evaluation.greedy.certified, is_new)
        if self.best.is_beaten_by(evaluation.greedy):
            content = self.agent.model_file() if model is None else model
            self.best = BestModel(step, evaluation.greedy.shortfall, content)
        for take in self.sinks:
            take(evaluation)


def _snapshot(state: State) -> PolicySnapshot:
    """Mirrors `vars`; nothing is left to a default."""
    return PolicySnapshot(*(state[each.name] for each in dataclasses.fields(PolicySnapshot)))


CURVE_COLUMNS = (
    "step",
    *(metric.name for metric in METRICS),
    *(f"sampled_{metric.name}" for metric in METRICS),
    *(metric.name for metric in TRAINING_METRICS),
)


def write_row(log: AppendLog, evaluation: Evaluation) -> None:
    """Append a row to `curve.csv`; before the first one, the names of the columns."""
    row: dict[str, Any] = {"step": evaluation.step, **numbers(evaluation.greedy)}
    row |= {f"sampled_{name}": number for name, number in numbers(evaluation.sampled).items()}
    row |= {metric.name: metric.of(evaluation.returns) for metric in TRAINING_METRICS}
    head = [] if log.length else [CURVE_COLUMNS]
    log.append(csv_text([*head, [row[name] for name in CURVE_COLUMNS]]).encode())


def read_curve(log: AppendLog) -> dict[str, NDArray[np.float64]]:
    """Read the columns of this process's `curve.csv` that `evaluations.npz` has, (evaluations,) each."""
    rows = list(csv.DictReader(io.StringIO(log.content().decode(), newline="")))
    return {name: np.array([float(row[name]) for row in rows]) for name in NEEDED}


def show_progress(progress: Progress, evaluation: Evaluation) -> None:
    """Show how good the greedy policy is, next to the progress."""
    greedy = evaluation.greedy
    note = f"regret {regret_text(greedy.regret)}, goal {greedy.outcome.goal:.0%}"
    progress.update(evaluation.step, note + (", certified optimal" if greedy.certified else ""))


def _greedy_tag(metric: Metric) -> str:
    """SB3's name for a metric where it has one: a second chart of the same numbers would be no help."""
    front = metric.in_front or metric.sb3_name
    return f"{GREEDY if front else GREEDY_MORE}/{metric.sb3_name or metric.name}"


def _charts() -> dict[str, list[str]]:
    charts: dict[str, list[str]] = {metric.chart: [] for metric in METRICS if metric.chart is not None}
    for training_metric in TRAINING_METRICS:
        charts.setdefault(training_metric.chart, []).append(training_metric.tag)
    for metric in METRICS:
        if metric.chart is not None:
            optimum = [f"{OPTIMUM}/{metric.name}"] if metric.has_optimum else []
            charts[metric.chart] += [_greedy_tag(metric), f"{SAMPLED}/{metric.name}", *optimum]
    return charts


CHARTS = _charts()  # of TensorBoard's Custom Scalars tab, {title: tags}


def send_scalars(write_scalars: WriteScalars, best: Score, evaluation: Evaluation) -> None:
    """Write TensorBoard's scalars, a value for every tag; `best` is the optimal policy's score."""
    tags = {f"{OPTIMUM}/{metric.name}": float(metric.of(best)) for metric in METRICS if metric.has_optimum}
    tags |= {_greedy_tag(metric): float(metric.of(evaluation.greedy)) for metric in METRICS}
    tags |= {f"{SAMPLED}/{name}": float(number) for name, number in numbers(evaluation.sampled).items()}
    for metric in TRAINING_METRICS:
        if (number := metric.of(evaluation.returns)) is not None:
            tags[metric.tag] = number
    write_scalars(tags, evaluation.step)
