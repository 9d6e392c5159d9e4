"""Jobs in this process, one after the other, as Hydra's launcher `basic` runs them in five times the time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.utils import JobReturn

from gridworld.sweep.launchers.worker import JobRunner


def launch(
    runner: JobRunner, settings: Mapping[str, Any], jobs: Sequence[Sequence[str]], first: int
) -> list[JobReturn]:
    """Run jobs. See `on_joblib.launch`."""
    return [runner.run(overrides, number) for number, overrides in enumerate(jobs, first)]
