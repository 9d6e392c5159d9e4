"""The metrics of a run, their statistics over seeds, and the exact ends of a task's scale."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gridworld.config.worlds import schema_of
from gridworld.report.evidence.curve_reader import ONLINE, SAMPLED_RETURN, reported
from gridworld.report.evidence.run_reader import Evidence
from gridworld.run.reader import read_run, stored_world
from gridworld.world.exact.evaluation import Evaluator

_MOST_CELLS = 100_000  # beyond, solving the world again would take longer than the report
_TOLERANCE = 1e-6  # relative


@dataclass(frozen=True)
class Reference:
    """Exact numbers of a task; NaN where its world cannot be built again."""

    optimal_value: float
    optimal_return: float  # of the policy with the optimal value, undiscounted, within the step limit
    random_value: float
    random_return: float
    problem: str | None = None  # why they are missing, or in doubt


def reference(run: Evidence) -> Reference:
    """Solve the run's world again, from its manifest. Nothing is raised: `problem` says what is wrong."""
    try:
        schema = schema_of(run.world)
        known = {field.name for field in dataclasses.fields(schema)}
        if unknown := sorted(run.world.keys() - known):
            raise ValueError(f"env.{unknown[0]} is not known to this version")
        lines = run.layout.split("\n")
        if len(lines) * max(map(len, lines)) > _MOST_CELLS:
            raise ValueError(f"it has more than {_MOST_CELLS:,} cells")
        env = schema(**run.world)
        env.check()
        mdp = stored_world(read_run(run.folder), env)
        evaluator = Evaluator(mdp, run.gamma, env.step_limit(mdp))
        random = evaluator.score(np.full(evaluator.mdp.probability.shape[:2], 1 / evaluator.mdp.num_actions))
    except (ValueError, TypeError, ArithmeticError, np.linalg.LinAlgError) as error:
        # Whatever is wrong with another version's world, the runs' own scores are as good as before.
        nan = math.nan
        return Reference(run.optimal_value, nan, nan, nan, f"its world cannot be built again here ({error})")
    optimum, problem = evaluator.optimal_value, None
    if not math.isclose(optimum, run.optimal_value, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE):
        problem = (
            f"its optimal value is {optimum:.6g} here, and {run.optimal_value:.6g} according "
            f"to {run.folder}; was it written by another version?"
        )
    returns = evaluator.optimum.expected_return, random.outcome.expected_return
    return Reference(run.optimal_value, returns[0], random.value, returns[1], problem)


@dataclass(frozen=True)
class RunMetric:
    """One number of a run."""

    key: str
    title: str
    of: Callable[
        [Evidence, Reference], float
    ]  # from its task's scale, too; NaN where the run does not have it
    statistics: tuple[str, ...] = ("mean",)  # over seeds; the first one is drawn
    better: int = 1  # -1 where less is better
    compared: bool = False  # between agents, as a probability of improvement


def _optimality(run: Evidence, world: Reference) -> float:
    """The final regret rescaled: 1 for the optimum, 0 for the uniformly random policy, below 0 for worse."""
    span = world.optimal_value - world.random_value
    if not (math.isfinite(span) and span > 0):
        return math.nan
    return 1.0 - run.regret / span


def online_return(run: Evidence, last: float = 1.0) -> float:
    """Mean return of the training episodes in the `last` part of training; NaN where there is none.

    It is the mean over the curve's rows, weighted by their steps in that part.
    """
    if ONLINE not in run.curve:
        return math.nan
    weights = np.diff(np.maximum(run.curve["step"], (1 - last) * run.steps), prepend=(1 - last) * run.steps)
    told = np.isfinite(run.curve[ONLINE]) & (weights > 0)
    if not told.any():
        return math.nan
    return float(run.curve[ONLINE][told] @ (weights[told] / weights[told].sum()))


def _last(column: str) -> Callable[[Evidence, Reference], float]:
    return lambda run, _: float(run.curve[column][-1]) if column in run.curve else math.nan


METRICS = (
    RunMetric(
        "regret", "final regret", lambda run, _: run.regret, ("iqm", "median", "mean"), -1, compared=True
    ),
    RunMetric(
        "steps",
        "steps to the first certificate",
        lambda run, _: run.first_certified_step,
        ("iqm", "median"),
        -1,
        compared=True,
    ),
    RunMetric("optimality", "optimality", _optimality, ("iqm", "mean")),
    *(RunMetric(metric.name, metric.label, _last(metric.name)) for metric in reported()),
    RunMetric("sampled_return", "sampled policy's return", _last(SAMPLED_RETURN)),
    RunMetric("online_return", "on-line return, all of training", lambda run, _: online_return(run)),
    RunMetric(
        "online_return_end",
        "on-line return, last tenth",
        lambda run, _: online_return(run, 0.1),
        compared=True,
    ),
)
BY_KEY = {metric.key: metric for metric in METRICS}
