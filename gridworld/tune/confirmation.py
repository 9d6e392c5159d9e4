"""Finalists and their confirmation, since the best of many trials on a few seeds is so partly by luck.

The best few trials run on more seeds, and the winner is chosen among them by all of their seeds. What the
search began from is always a finalist. Results are attributes of the study, so that machines share them.

The winner is confirmed on seeds that no trial has seen, beside what the search began from. These runs are
ordinary ones, with a folder each; what is there already is kept.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.console import tell
from gridworld.report import statistics
from gridworld.report.tables import number, steps_up_to
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import find_run
from gridworld.storage.atomic_write import check_no_links, inside, remove_path
from gridworld.sweep.job import JobError, run_in_sweep
from gridworld.sweep.job_table import FAILED, JobTable
from gridworld.training.together import Training, run_together
from gridworld.tune.objective import SEEDS, FinalRuns, SeedScore, read_score, score
from gridworld.tune.study_spec import StudySpec
from gridworld.tune.workers import Ask, Workers
from gridworld.world.mdp import FloatArray

FINAL = "final "  # what the names of these attributes begin with
_FAILED = sys.float_info.max  # the regret of a run that did


@dataclass(frozen=True)
class Finalist:
    """A trial after its final runs, by its own seeds and the final seeds together."""

    trial: int
    score: float
    certified: int
    seeds: int
    failed: int  # of these, runs that ended by an error, and count as not certified


def choose_finalists(study: Study, spec: StudySpec) -> list[FrozenTrial]:
    """The best complete trials, no two alike, and the one of the configuration that the search began from.

    Machines that search together may end with a few trials more than were asked for; these do not count.
    """
    began_from = spec.space.parameters_of(spec.base)
    ended = study.get_trials(deepcopy=False)[: spec.settings.trials]
    complete = [trial for trial in ended if trial.state == TrialState.COMPLETE]
    found: list[FrozenTrial] = []
    for trial in sorted(complete, key=lambda trial: (trial.value, trial.number)):
        is_new = all(trial.params != other.params for other in found)
        if is_new and (len(found) < spec.settings.finalists or trial.params == began_from):
            found.append(trial)
    return found


def rank_finalists(
    spec: StudySpec, study: Study, trials: Sequence[FrozenTrial], workers: Workers
) -> list[Finalist]:
    """Run what the finalists lack on the final seeds; returns them, the winner first."""
    runs = {
        _name(trial, seed): (spec.space.values(trial.params), seed)
        for seed in spec.final_seeds
        for trial in trials
        if _name(trial, seed) not in study.user_attrs
    }
    if runs:
        print(
            f"the {len(trials)} finalists on {len(spec.final_seeds)} seeds more: {len(runs)} runs",
            file=sys.stderr,
            flush=True,
        )
    shares = workers.shares(list(runs), spec.base.agent.shape is not None)
    tasks = [FinalRuns(spec.objective, {name: runs[name] for name in names}) for names in shares]

    def on_end(task: FinalRuns, results: Mapping[str, SeedScore | str] | None) -> None:
        for name, (_, seed) in task.runs.items():
            result = results[name] if results is not None else "the workers that ran it were killed"
            if isinstance(result, str):
                tell(f"{name.removeprefix(FINAL)} failed, and counts as not certified: {result}")
                result = SeedScore(seed, None, _FAILED)
            study.set_user_attr(name, dataclasses.asdict(result))

    workers.run(lambda: tasks.pop(0) if tasks else None, on_end)
    return sorted(_ranked(spec, study, trials), key=lambda finalist: (finalist.score, finalist.trial))


def _ranked(spec: StudySpec, study: Study, trials: Sequence[FrozenTrial]) -> Iterator[Finalist]:
    attributes: Mapping[str, Any] = study.user_attrs
    for trial in trials:
        results = [read_score(each) for each in trial.user_attrs[SEEDS]]
        results += [read_score(attributes[_name(trial, seed)]) for seed in spec.final_seeds]
        certified = sum(result.certified_since is not None for result in results)
        value = score(results, spec.base.total_timesteps, len(results))
        failed = sum(result.regret == _FAILED for result in results)
        yield Finalist(trial.number, value, certified, len(results), failed)


def _name(trial: FrozenTrial, seed: int) -> str:
    return f"{FINAL}trial={trial.number},seed={seed}"


CONFIRM = "confirm"  # the runs' folder, in the study's
_HASH_SHOWN = 8  # characters


@dataclass(frozen=True)
class HeldOutRun:
    """A run on a seed that no trial has seen."""

    folder: Path
    config: TrainConfig


@dataclass(frozen=True)
class HeldOutRuns:
    """A worker's task: such runs, together where they can. What came of them is in their folders."""

    runs: tuple[HeldOutRun, ...]

    def __call__(self, ask: Ask) -> bool:
        for result in run_together([_run(run) for run in self.runs]):
            if isinstance(result, Exception):
                raise result
        return True


def _run(run: HeldOutRun) -> Training[None]:
    inside(run.folder.parents[1], CONFIRM, run.folder.name).mkdir(parents=True, exist_ok=True)
    try:
        yield from run_in_sweep(run.config, run.folder, [], stop_at_failure=False)
    except JobError as error:
        tell(f"{run.folder}: {error}")


def held_out_runs(folder: Path, name: str, config: TrainConfig, seeds: Sequence[int]) -> list[HeldOutRun]:
    """A run of a configuration on each seed.

    A run's folder has a hash of its settings in its name: other settings are other runs.
    """
    world, runs = config.env.compile().text(), []
    for seed in seeds:
        of_seed = dataclasses.replace(config, seed=seed)
        digest = settings_hash(dataclasses.asdict(of_seed), world)[:_HASH_SHOWN]
        runs.append(HeldOutRun(folder / CONFIRM / f"{name},{digest},seed={seed}", of_seed))
    return runs


def prepare(folder: Path, runs: Sequence[HeldOutRun]) -> None:
    """Make the runs' folder in the study's, and remove damaged runs and those of an earlier winner."""
    there = inside(folder, CONFIRM)
    there.mkdir(parents=True, exist_ok=True)
    names = {run.folder.name for run in runs}
    for name in names:
        check_no_links(folder, CONFIRM, name)
    for path in there.glob("*,seed=*"):
        if path.name not in names:
            remove_path(path)
    for run in runs:
        if damaged := _damage(run.folder):
            tell(f"{'; '.join(damaged)}; it is run again")
            remove_path(run.folder)


def _damage(folder: Path) -> list[str]:
    """A sentence for each file of a run that is not the one that it wrote."""
    try:
        run = find_run(folder)
    except InputError as error:
        return [str(error)]
    return [] if run is None or not run.is_finished else list(run.damage().values())


def certified_since(folder: Path) -> float | None:
    """The steps until a run's certificate that held, infinite without one; None for a run that failed."""
    if damaged := _damage(folder):
        raise InputError("; ".join(damaged))
    run = find_run(folder)
    row = JobTable(folder.parent).row(folder.name)
    if run is None or run.manifest["status"] == "failed":
        if run is not None or (row is not None and row.status == FAILED):
            return None
    elif run.is_finished:
        since = run.read_summary().get("certified_since_step")
        if since is not None and (type(since) is not int or since < 0):
            raise InputError(f"{run.summary_file}: certified_since_step must be a number of steps, or null")
        return math.inf if since is None else float(since)
    why = (row.error if row is not None else "") or (run.manifest.get("error", "") if run is not None else "")
    raise InputError("it did not come to its end" + (f" ({why})" if why else ""))


@dataclass(frozen=True)
class HeldOutResults:
    """What the held-out runs of one configuration came to."""

    certified: statistics.Share
    steps: FloatArray  # (seeds,), environment steps until the certificate that held; infinite without one
    total: int  # environment steps of a run
    failed: tuple[str, ...] = ()  # runs that ended by an error: they count as not certified
    left_out: tuple[str, ...] = ()  # runs that have no result; in none of the numbers

    def text(self) -> str:
        """The share certified, and the median step, with their intervals, in a few words."""
        median, form = statistics.interval(statistics.median, [self.steps], 0), steps_up_to(self.total)
        share = self.certified
        text = (
            f"certified on {share.count} of {share.total} "
            f"[{100 * share.low:.0f} %, {100 * share.high:.0f} %], for good by step {form(median.point)} "
            f"[{form(median.low)}, {form(median.high)}] in the median"
        )
        notes = []
        if self.failed:
            notes += [f"{len(self.failed)} failed and count as not certified: {', '.join(self.failed)}"]
        if self.left_out:
            asked = len(self.steps) + len(self.left_out)
            notes += [
                f"{len(self.left_out)} of {asked} left out, without a result: {', '.join(self.left_out)}"
            ]
        return f"{text} ({'; '.join(notes)})" if notes else text


def read_results(runs: Sequence[HeldOutRun]) -> HeldOutResults:
    """Read what runs of one configuration came to; one that failed was not certified."""
    steps, failed, left_out = [], [], []
    for run in runs:
        try:
            found = certified_since(run.folder)
        except InputError as error:
            tell(f"{run.folder}: is left out; {error}")
            left_out.append(run.folder.name)
            continue
        steps.append(math.inf if found is None else found)
        failed += [run.folder.name] if found is None else []
    if not steps:
        raise InputError(f"{runs[0].folder.parent}: no held-out run has a result; run the command again")
    share_of = statistics.share(int(np.isfinite(steps).sum()), len(steps))
    total = runs[0].config.total_timesteps
    return HeldOutResults(share_of, np.array(steps), total, tuple(failed), tuple(left_out))


def verdict_on(winner: HeldOutResults, began_from: HeldOutResults, name: str) -> dict[str, Any]:
    """Whether the winner is better than what the search began from.

    It goes by what the search minimises: first the share certified, then how soon. The latter is the
    probability that a run of the winner is certified before one of the other's, ties half.
    """
    more = statistics.difference(winner.certified, began_from.certified)
    sooner = statistics.improvement([(-winner.steps, -began_from.steps)], 0)
    # A significant difference in shares decides. Where there is none, being sooner does, unless the shares
    # lean the other way: then what is gained in time might be paid for in certificates.
    side, time = _side(more, 0.0), _side(sooner, 0.5)
    if side == 0 and time * more.point >= 0:
        side = time
    verdict = ("does not beat", "cannot be told apart from", "beats")[1 + side]
    asked = len(winner.steps) + len(winner.left_out)
    sentence = (
        f"On {asked} held-out seeds {name} {verdict} the settings that the search began from: "
        f"{winner.text()}, against {began_from.text()}; a run of it is certified sooner with probability "
        f"{number(sooner.point)} [{number(sooner.low)}, {number(sooner.high)}]."
    )
    return {
        "verdict": verdict,
        "sentence": sentence,
        "more_certified": dataclasses.asdict(more),
        "probability_sooner": dataclasses.asdict(sooner),
        "winner": _plain(winner),
        "began_from": _plain(began_from),
    }


def _side(interval: statistics.Interval, neutral: float) -> int:
    """On which side of the neutral value the whole interval lies; 0 where it holds it."""
    return int(interval.low > neutral) - int(interval.high < neutral)


def _plain(results: HeldOutResults) -> dict[str, Any]:
    return {
        "certified": dataclasses.asdict(results.certified),
        "steps": [int(step) if math.isfinite(step) else None for step in results.steps],
        "failed": results.failed,
        "left_out": results.left_out,
    }
