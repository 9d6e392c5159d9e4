"""Gathering everything that a report shows from the given paths, and why runs are not certified."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import gridworld
from gridworld.config.settings import flat
from gridworld.config.train import TrainConfig
from gridworld.config.worlds import SOURCES
from gridworld.errors import InputError
from gridworld.report.analysis.analyse import Overall, TaskAnalysis, analyse
from gridworld.report.evidence.discovery import find_runs
from gridworld.report.evidence.grouping import Group, Study, arrange
from gridworld.report.evidence.run_reader import DAMAGED, Evidence, Unusable, read
from gridworld.report.evidence.tuning_study import TuningStudy, find_tunings

MOST_TOLD = 20  # sentences on standard error; the page has them all


class NothingFinishedError(InputError):
    """No run can be used, and none is damaged: they are not finished."""


@dataclass(frozen=True)
class Reason:
    """Why one run is not certified, in about four words, and the word for the command line to try, if any."""

    cause: str
    change: str = ""


Reasons = Mapping[Path, Reason]  # by the run's folder


@dataclass(frozen=True, eq=False)
class Report:
    """Runs, their analysis, and what should be looked into."""

    study: Study
    tasks: tuple[TaskAnalysis, ...]
    overall: Overall | None
    unusable: tuple[Unusable, ...]
    problems: tuple[str, ...]  # with the paths that were given
    notes: tuple[str, ...]
    seed: int  # of the bootstrap
    tunings: tuple[TuningStudy, ...] = ()
    reasons: Reasons = field(default_factory=dict)  # of runs that are not certified

    @property
    def complete(self) -> bool:
        """Whether every run is counted and nothing contradicts anything."""
        return not self.sentences()

    @property
    def damage(self) -> list[str]:
        """A sentence for each damaged file of the runs."""
        counted = [told for group in self.study.groups for run in group.runs for told in run.damage]
        others = [told for run in self.unusable if run.state == DAMAGED for told in run.reasons]
        return [*counted, *others]

    def sentences(self) -> list[str]:
        """What somebody should look into."""
        unfinished = [told for run in self.unusable if run.state != DAMAGED for told in run.reasons]
        return [*self.problems, *self.damage, *unfinished, *self.study.warnings]


def gather(paths: Sequence[Path], seed: int = 0, log_steps: bool = False) -> Report:
    """Read and analyse all runs and tuning studies below the paths.

    `seed` is of the bootstrap; `log_steps` is whether all curves are against the logarithm of the steps.
    Raises `InputError` where no run can be used.
    """
    found = find_runs(paths)
    problems = found.problems
    outcomes = [read(folder) for folder in found.folders]
    runs = [outcome for outcome in outcomes if isinstance(outcome, Evidence)]
    unusable = tuple(outcome for outcome in outcomes if isinstance(outcome, Unusable))
    if not runs:
        reasons = [*problems, *(reason for run in unusable for reason in run.reasons), *found.notes]
        more = f"; and {len(reasons) - MOST_TOLD} more" if len(reasons) > MOST_TOLD else ""
        is_damage = any(run.state == DAMAGED for run in unusable)
        kind = NothingFinishedError if unusable and not is_damage else InputError
        raise kind(f"nothing to report: {'; '.join(reasons[:MOST_TOLD])}{more}")
    study = arrange(runs, unusable)
    tasks, overall = analyse(study, seed, log_steps)
    problems += [f"{task.task}: {task.world.problem}" for task in tasks if task.world.problem]
    tunings, unread = find_tunings(paths)
    problems += unread
    notes = (*found.notes, *_foreign(runs))
    return Report(study, tasks, overall, unusable, tuple(problems), notes, seed, tuple(tunings))


_OPEN = ("agent.", "env.kwargs.")  # sections with settings that no schema names


def _foreign(runs: Sequence[Evidence]) -> tuple[str, ...]:
    """What was written by another version, and what it says that this one does not know."""
    versions: dict[str, list[Path]] = defaultdict(list)
    unknown: dict[str, list[Path]] = defaultdict(list)
    worlds = [asdict(TrainConfig(env=source())) for source in SOURCES.values()]
    known = {name for settings in worlds for name, _ in flat(settings)}
    for run in runs:
        if run.version != gridworld.__version__:
            versions[run.version].append(run.folder)
        for name in run.settings:
            if name not in known and not name.startswith(_OPEN):
                unknown[name].append(run.folder)
    notes = [
        f"{len(folders)} {'runs were' if len(folders) > 1 else 'run was'} written by gridworld {version}, "
        f"this is {gridworld.__version__}: {folders[0]}{' and others' if len(folders) > 1 else ''}."
        for version, folders in sorted(versions.items())
    ]
    notes += [
        f"{len(folders)} {'runs have' if len(folders) > 1 else 'run has'} the setting {name}, which this "
        f"version does not know: {folders[0]}{' and others' if len(folders) > 1 else ''}."
        for name, folders in sorted(unknown.items())
    ]
    return tuple(notes)


def reasons(
    groups: Iterable[Group], ask: Callable[[Path], Reason | None], most: int
) -> tuple[Reasons, list[str]]:
    """Ask why runs are not certified.

    Args:
        groups: their runs, of which the first seed of each comes before the second of any.
        ask: tells the reason of the run in a folder; None: it cannot. Raises `InputError` where a file of
            the run keeps it from that.
        most: how many to ask about.

    Returns:
        The reasons, and a sentence for each run that cannot be asked about.
    """
    found, untold = {}, []
    columns = ([run for run in group.runs if not run.certified] for group in groups)
    in_turn = (run for row in itertools.zip_longest(*columns) for run in row if run is not None)
    for run in itertools.islice(in_turn, most):
        try:
            if (reason := ask(run.folder)) is not None:
                found[run.folder] = reason
        except InputError as error:
            untold.append(f"{run.folder}: is not diagnosed; {error}")
    return found, untold
