"""Finalists: the best few trials on more seeds, among which the winner is chosen by all of their seeds.

The best of many trials on a few seeds is so partly by luck, and settings that fail one seed in seven look as
good as those that never fail. The configuration that the search began from is always among the finalists.
Results are attributes of the study, so that machines share them.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from optuna import Study
from optuna.trial import FrozenTrial, TrialState

from gridworld.process.console import tell
from gridworld.tune.objective import SEEDS, FinalRuns, SeedScore, read_score, score
from gridworld.tune.study_spec import StudySpec
from gridworld.tune.workers import Workers

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
