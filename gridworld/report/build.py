"""Gathering everything that a report shows from the given paths, and why runs are not certified."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import gridworld
from gridworld.errors import InputError
from gridworld.report.analysis import Overall, TaskAnalysis, analyse
from gridworld.report.evidence import DAMAGED, Evidence, Unusable, find_runs, read
from gridworld.report.grouping import Group, Study, arrange
from gridworld.report.tuning_study import TuningStudy, find_tunings

MOST_SHOWN = 20  # sentences on standard error; the page has them all


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
        counted = [sentence for group in self.study.groups for run in group.runs for sentence in run.damage]
        return [*counted, *(each for run in self.unusable if run.state == DAMAGED for each in run.reasons)]

    def sentences(self) -> list[str]:
        """What somebody should look into."""
        unfinished = [each for run in self.unusable if run.state != DAMAGED for each in run.reasons]
        return [*self.problems, *self.damage, *unfinished, *self.study.warnings]


def gather(paths: Sequence[Path], seed: int = 0, log_steps: bool = False) -> Report:
    """Read and analyse all runs and tuning studies below the paths.

    `seed` is of the bootstrap; `log_steps` is whether all curves are against the logarithm of the steps.
    Raises `InputError` where no run can be used.
    """
    folders, problems = find_runs(paths)
    outcomes = [read(folder) for folder in folders]
    runs = [outcome for outcome in outcomes if isinstance(outcome, Evidence)]
    unusable = tuple(outcome for outcome in outcomes if isinstance(outcome, Unusable))
    if not runs:
        sentences = [*problems, *(reason for run in unusable for reason in run.reasons)]
        more = f"; and {len(sentences) - MOST_SHOWN} more" if len(sentences) > MOST_SHOWN else ""
        is_damage = any(run.state == DAMAGED for run in unusable)
        kind = NothingFinishedError if unusable and not is_damage else InputError
        raise kind(f"nothing to report: {'; '.join(sentences[:MOST_SHOWN])}{more}")
    study = arrange(runs)
    tasks, overall = analyse(study, seed, log_steps)
    problems += [f"{task.task}: {task.world.problem}" for task in tasks if task.world.problem]
    tunings, unread = find_tunings(paths)
    problems += unread
    versions: dict[str, list[Path]] = defaultdict(list)
    for run in runs:
        versions[run.version].append(run.folder)
    notes = [
        f"{len(found)} {'runs were' if len(found) > 1 else 'run was'} written by gridworld {version}, "
        f"this is {gridworld.__version__}: {found[0]}{' and others' if len(found) > 1 else ''}."
        for version, found in sorted(versions.items())
        if version != gridworld.__version__
    ]
    return Report(study, tasks, overall, unusable, tuple(problems), tuple(notes), seed, tuple(tunings))


def reasons(
    groups: Iterable[Group], ask: Callable[[Path], Reason | None], most: int
) -> tuple[Reasons, list[str]]:
    """Ask why runs are not certified, the first seed of each group before the second of any.

    `ask` gives the reason of the run in a folder, None where it does not know, and raises `InputError` where
    a file of the run is damaged; `most` is how many runs to ask about. Returns the reasons, and a sentence
    for each run that cannot be asked about.
    """
    found, problems = {}, []
    columns = ([run for run in group.runs if not run.certified] for group in groups)
    in_turn = (run for row in itertools.zip_longest(*columns) for run in row if run is not None)
    for run in itertools.islice(in_turn, most):
        try:
            if (reason := ask(run.folder)) is not None:
                found[run.folder] = reason
        except InputError as error:
            problems.append(f"{run.folder}: is not diagnosed; {error}")
    return found, problems
