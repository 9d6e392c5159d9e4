"""The two ends of a task's scale, exact: its optimum and the uniformly random policy."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from gridworld.config.worlds import schema_of
from gridworld.report.evidence.run_reader import Evidence
from gridworld.run.identity.stored_world import stored_world
from gridworld.run.reader import read_run
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
    """Solve the run's world again, from its manifest.

    Returns:
        The ends of the scale. Where the world cannot be built, or differs from the run's summary, `problem`
        says so; nothing is raised.
    """
    try:
        evaluator = _evaluator(run)
        random = evaluator.score(np.full(evaluator.mdp.probability.shape[:2], 1 / evaluator.mdp.num_actions))
    except (ValueError, TypeError, ArithmeticError, np.linalg.LinAlgError) as error:
        # Whatever is wrong with another version's world, the runs' own scores are as good as before.
        nan = math.nan
        return Reference(run.optimal_value, nan, nan, nan, f"its world cannot be built again here ({error})")
    problem = None
    if not math.isclose(evaluator.optimal_value, run.optimal_value, rel_tol=_TOLERANCE, abs_tol=_TOLERANCE):
        problem = (
            f"its optimal value is {evaluator.optimal_value:.6g} here, and {run.optimal_value:.6g} according "
            f"to {run.folder}; was it written by another version?"
        )
    return Reference(
        run.optimal_value,
        evaluator.optimum.expected_return,
        random.value,
        random.outcome.expected_return,
        problem,
    )


def _evaluator(run: Evidence) -> Evaluator:
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
    return Evaluator(mdp, run.gamma, env.step_limit(mdp))
