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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from gridworld.base.atomic_write import check_no_links, inside, remove_path
from gridworld.base.console import tell
from gridworld.base.errors import InputError, reason
from gridworld.base.processes import LostError, Processes
from gridworld.config.train import TrainConfig
from gridworld.report import statistics
from gridworld.report.tables import number, steps_up_to
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import find_run
from gridworld.sweeps.folder import FAILED, job_row, one_line
from gridworld.sweeps.job import run_in_sweep
from gridworld.sweeps.plan import Job
from gridworld.sweeps.tune.objective import FINAL, SEEDS, Outcome, SeedScore, Trials, read_score, score
from gridworld.sweeps.tune.study_spec import StudySpec
from gridworld.training.together import run_together
from gridworld.world.mdp import FloatArray

CONFIRM = "confirm"  # the folder of the winner's runs, in the study's
_HASH_SHOWN = 8  # characters
_LOST_REGRET = sys.float_info.max  # of a run that failed
_IN_TENSORBOARD = 10  # runs of a configuration: of more than 40 runs it selects none


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
    spec: StudySpec, study: Study, trials: Sequence[FrozenTrial], workers: Processes
) -> list[Finalist]:
    """Run what the finalists lack on the final seeds; returns them, the winner first."""
    runs = {
        _name(trial, seed): (spec.space.values(trial.params), (seed,))
        for seed in spec.final_seeds
        for trial in trials
        if _name(trial, seed) not in study.user_attrs
    }
    if runs:
        tell(f"the {len(trials)} finalists on {len(spec.final_seeds)} more seeds: {len(runs)} runs")
    shares = workers.shares(list(runs), spec.base.agent.shape is not None)
    tasks = (Trials(spec.objective, {name: runs[name] for name in names}) for names in shares)

    def on_end(task: Trials, outcomes: list[Outcome] | LostError) -> None:
        for name, outcome in task.ended(outcomes):
            _, (seed,) = runs[name]
            if outcome.error:
                tell(f"{name.removeprefix(FINAL)} failed, and counts as not certified: {outcome.error}")
            found = SeedScore(seed, None, _LOST_REGRET) if outcome.error else outcome.seeds[0]
            study.set_user_attr(name, dataclasses.asdict(found))

    workers.run(tasks, on_end)
    attributes = study.user_attrs
    ranked = []
    for trial in trials:
        results = [read_score(each) for each in trial.user_attrs[SEEDS]]
        results += [read_score(attributes[_name(trial, seed)]) for seed in spec.final_seeds]
        value = score(results, spec.base.total_timesteps, len(results))
        certified = sum(result.certified_since is not None for result in results)
        failed = sum(result.regret == _LOST_REGRET for result in results)
        ranked.append(Finalist(trial.number, value, certified, len(results), failed))
    return sorted(ranked, key=lambda finalist: (finalist.score, finalist.trial))


def _name(trial: FrozenTrial, seed: int) -> str:
    return f"{FINAL}trial={trial.number},seed={seed}"


def run_held_out(runs: Sequence[Job]) -> None:
    """Train held-out runs, together where they can; what came of them is in their folders."""
    for run in runs:
        inside(run.folder.parents[1], CONFIRM, run.folder.name).mkdir(parents=True, exist_ok=True)
    for run, result in zip(runs, run_together([run_in_sweep(run) for run in runs]), strict=True):
        if isinstance(result, Exception):
            tell(f"{run.folder}: {one_line(reason(result))}")


def held_out_runs(
    folder: Path, name: str, config: TrainConfig, seeds: Sequence[int], words: Sequence[str]
) -> list[Job]:
    """A run of a configuration on each seed; only the first ones write event files.

    A run's folder has a hash of its settings in its name: other settings are other runs.
    """
    world, runs = config.env.compile().text(), list[Job]()
    silent = dataclasses.replace(config.logging, tensorboard=False)
    for seed in seeds:
        logging = config.logging if len(runs) < _IN_TENSORBOARD else silent
        of_seed = dataclasses.replace(config, seed=seed, logging=logging)
        digest = settings_hash(dataclasses.asdict(of_seed), world)
        place = folder / CONFIRM / f"{name},{digest[:_HASH_SHOWN]},seed={seed}"
        runs.append(Job((*words, f"seed={seed}"), (), digest, None, of_seed, folder=place))
    return runs


def prepare(folder: Path, runs: Sequence[Job]) -> None:
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
            tell(f"{damaged}; it runs again")
            remove_path(run.folder)


def _damage(folder: Path) -> str:
    """What is wrong with the files of a run: which are not those that it wrote."""
    try:
        run = find_run(folder)
    except InputError as error:
        return str(error)
    return "; ".join(run.damage().values()) if run is not None and run.is_finished else ""


def certified_since(folder: Path) -> float | None:
    """The steps until a run's certificate that held, infinite without one; None for a run that failed."""
    if damaged := _damage(folder):
        raise InputError(damaged)
    run, row = find_run(folder), job_row(folder)
    if row.status == FAILED:
        return None
    if run is None or not run.is_finished:
        raise InputError("it did not finish" + (f" ({row.error})" if row.error else ""))
    since = run.read_summary()["certified_since_step"]
    return math.inf if since is None else float(since)


@dataclass(frozen=True)
class HeldOutResults:
    """What the held-out runs of one configuration came to."""

    steps: FloatArray  # (seeds,), environment steps until the certificate that held; infinite without one
    total: int  # environment steps of a run
    failed: tuple[str, ...] = ()  # runs that ended by an error: they count as not certified
    left_out: tuple[str, ...] = ()  # runs that have no result; in none of the numbers

    @property
    def certified(self) -> statistics.Share:
        """The share of the runs that were certified."""
        return statistics.share(int(np.isfinite(self.steps).sum()), len(self.steps))

    def text(self) -> str:
        """The share certified, and the median step, with their intervals, in a few words."""
        median, form = statistics.interval(statistics.median, [self.steps], 0), steps_up_to(self.total)
        text = (
            f"certified on {self.certified}, for good from step {form(median.point)} [{form(median.low)}, "
            f"{form(median.high)}] in the median"
        )
        notes = []
        if self.failed:
            notes.append(f"{len(self.failed)} failed and count as not certified: {', '.join(self.failed)}")
        if self.left_out:
            of = len(self.steps) + len(self.left_out)
            names = ", ".join(self.left_out)
            notes.append(f"{len(self.left_out)} of {of} left out, without a result: {names}")
        return f"{text} ({'; '.join(notes)})" if notes else text

    def plain(self) -> dict[str, Any]:
        """The results as JSON."""
        steps = [int(step) if math.isfinite(step) else None for step in self.steps]
        own = {"steps": steps, "failed": self.failed, "left_out": self.left_out}
        return {"certified": dataclasses.asdict(self.certified), **own}


def read_results(runs: Sequence[Job]) -> HeldOutResults:
    """Read what runs of one configuration came to; one that failed was not certified."""
    steps, failed, left_out = [], [], []
    for run in runs:
        try:
            found = certified_since(run.folder)
        except InputError as error:
            tell(f"{run.folder}: is left out: {error}")
            left_out.append(run.folder.name)
            continue
        steps.append(math.inf if found is None else found)
        failed += [run.folder.name] if found is None else []
    if not steps:
        raise InputError(f"{runs[0].folder.parent}: no held-out run has a result; run the command again")
    return HeldOutResults(np.array(steps), runs[0].config.total_timesteps, tuple(failed), tuple(left_out))


def verdict_on(winner: HeldOutResults, began_from: HeldOutResults) -> dict[str, Any]:
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
    verdict = ("does not beat", "cannot be distinguished from", "beats")[1 + side]
    asked = len(winner.steps) + len(winner.left_out)
    sentence = (
        f"On {asked} held-out seeds the winner {verdict} the baseline: {winner.text()}, against "
        f"{began_from.text()}; its runs are certified sooner with probability {number(sooner.point)} "
        f"[{number(sooner.low)}, {number(sooner.high)}]."
    )
    return {
        "verdict": verdict,
        "sentence": sentence,
        "more_certified": dataclasses.asdict(more),
        "probability_sooner": dataclasses.asdict(sooner),
        "winner": winner.plain(),
        "began_from": began_from.plain(),
    }


def _side(interval: statistics.Interval, neutral: float) -> int:
    """On which side of the neutral value the whole interval lies; 0 where it holds it."""
    return int(interval.low > neutral) - int(interval.high < neutral)
