"""Why a run is not optimal, asked from Python."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from gridworld.api.runs import RunResult, torch_threads_kept
from gridworld.diagnosis.evidence import Evidence
from gridworld.diagnosis.verdict import Diagnosis
from gridworld.diagnosis.verdict import diagnose as _diagnose
from gridworld.restore.saved_run import SavedRun


def diagnose(run: RunResult | str | PathLike[str]) -> Diagnosis:
    """Say why a run is not optimal: its regret by state, the causes, and what to try.

    Args:
        run: what `train` or `open_run` returned, or the folder of a finished run.

    Returns:
        The diagnosis; without causes for a run that is certified optimal.

    Raises:
        InputError: the folder holds no finished run, or one of its files was changed.

    Example:
        >>> import gridworld
        >>> run = gridworld.train("agent=q_learning", "agent.learning_rate=0.001", progress=False)
        >>> found = gridworld.diagnose(run)
        >>> found.cause, bool(abs(found.split.cost.sum() - found.split.score.regret) < 1e-9)
        ('slow', True)
    """
    with torch_threads_kept():
        if not isinstance(run, RunResult):
            return _diagnose(Evidence.of(SavedRun(Path(run).expanduser())))
        return _diagnose(
            Evidence(run.config, run.overrides, run.curve, run.visits, run.evaluator, run.agent, run.policy)
        )
