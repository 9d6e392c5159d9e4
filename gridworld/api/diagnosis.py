"""Why a run is not optimal, asked from Python."""

from __future__ import annotations

import dataclasses
import tempfile
from os import PathLike
from pathlib import Path

from gridworld.api.runs import RunResult, torch_threads_kept
from gridworld.diagnosis.evidence import Evidence
from gridworld.diagnosis.verdict import Diagnosis, check_trusted, trials_folder
from gridworld.diagnosis.verdict import diagnose as _diagnose
from gridworld.diagnosis.verdict import try_offers as _try_offers
from gridworld.process.memory_budget import limited
from gridworld.restore.saved_run import SavedRun


def diagnose(
    run: RunResult | str | PathLike[str], try_offers: bool = False, trust: bool = False
) -> Diagnosis:
    """Say why a run is not optimal: its regret by state, the causes, and what to try.

    Args:
        run: what `train` or `open_run` returned, or the folder of a finished run.
        try_offers: train what there is to try, until one is certified: `tried` has the results. The new runs
            are in the folder `RUN-tried`; of a run without a folder they do not stay.
        trust: import the classes that the run's settings name, wherever they are from.

    Returns:
        The diagnosis; without causes for a run that is certified optimal.

    Raises:
        InputError: the folder holds no finished run, or one of its files was changed; it would take more
            memory than the budget, `GRIDWORLD_BUDGET`, usually 1 GB; or its settings name classes from
            elsewhere, and are not trusted.

    Example:
        >>> import gridworld
        >>> run = gridworld.train("agent=q_learning", "agent.learning_rate=0.001", progress=False)
        >>> found = gridworld.diagnose(run)
        >>> found.cause, bool(abs(found.split.cost.sum() - found.split.score.regret) < 1e-9)
        ('slow', True)
    """
    with torch_threads_kept(), limited():
        if isinstance(run, RunResult):
            folder, saved = run.folder, run.saved
            evidence = Evidence(
                run.config, run.overrides, run.curve, run.visits, run.evaluator, run.agent, run.policy
            )
        else:
            folder = Path(run).expanduser()
            saved = SavedRun(folder, trust)
            evidence = Evidence.of(saved)
        found = _diagnose(evidence)
        if not try_offers:
            return found
        check_trusted(saved, found, trust)
        with tempfile.TemporaryDirectory(prefix="gridworld-") as elsewhere:
            place = Path(elsewhere) if folder is None else trials_folder(folder)
            return dataclasses.replace(found, tried=tuple(_try_offers(saved, found, place, trust)))
