"""The objective of a search: what one trial's settings come to on several seeds, as one number in [0, 1].

The number, the trial's score, is minimised: first the share of seeds that are certified counts, then how
soon. Of n seeds, m missed the certificate; seed i costs

    c_i = t_i / 2T                     certified since step t_i of T
    c_i = 1/2 + ρ_i / 2(1 + ρ_i)       not certified, with regret ρ_i at the end

and the score is (m + mean c) / (n + 1). One certified seed more always counts for more than all steps
together, since the mean is at most 1. Where the share is the same, fewer steps win; where no seed is
certified yet, less regret, so that a search has something to follow.

Seeds are trained in memory, together where they can. They are reported one after the other: after every
tenth or so of a seed's budget, the score as it would be if each seed, the present one included, stayed as it
is. So a pruner compares trials at the same point of the same seed, and decides as if the seeds trained one
after the other.
"""

from __future__ import annotations

import dataclasses
import math
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from omegaconf import OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from gridworld.agents import Learning
from gridworld.base.bounds import LARGEST_INTEGER
from gridworld.base.errors import InputError, reason
from gridworld.base.processes import LostError
from gridworld.base.signals import handling
from gridworld.config.compose import to_config
from gridworld.config.messages import sentence
from gridworld.config.train import TrainConfig
from gridworld.training.learning_curve import Evaluation, LearningCurve
from gridworld.training.setup import check_settings, make_context
from gridworld.training.together import Training, run_together
from gridworld.world.evaluation import Evaluator

SEEDS, ERROR, WORKER = "seeds", "error", "worker"  # attributes of a trial in the study
FINAL = "final "  # what attributes of the study begin with that are finalists' runs

Values = Mapping[str, Any]  # {"agent.learning_rate": 0.01, ...}


@dataclass(frozen=True)
class SeedScore:
    """What one seed of a trial has come to so far."""

    seed: int
    certified_since: int | None  # environment steps
    regret: float

    def cost(self, total: int) -> float:
        """The cost c_i in [0, 1], for a budget of `total` environment steps."""
        if self.certified_since is not None:
            return 0.5 * min(self.certified_since / total, 1.0)
        return 0.5 + 0.5 * (1.0 - 1.0 / (1.0 + max(self.regret, 0.0)))


def read_score(content: Any) -> SeedScore:
    """A seed's score from the study's storage. Raises `ValueError` or `TypeError` for anything else."""
    found = SeedScore(**content)
    since = found.certified_since
    if type(found.regret) is not float or not (since is None or 0 <= int(since) < LARGEST_INTEGER):
        raise ValueError(f"{str(content)[:80]} is not the score of a seed")
    return found


def score(seeds: Sequence[SeedScore], total: int, of: int) -> float:
    """The score of a trial on `of` seeds by the first few of them, whose missed share stands for the rest."""
    missed = sum(seed.certified_since is None for seed in seeds)
    mean_cost = sum(seed.cost(total) for seed in seeds) / len(seeds)
    return (of * missed / len(seeds) + mean_cost) / (of + 1)


def with_values(config: TrainConfig, values: Values) -> TrainConfig:
    """The configuration with these values in it. Raises `InputError` where one does not fit its schema."""
    node = OmegaConf.structured(config)
    for key, value in values.items():
        try:
            with open_dict(node):
                OmegaConf.update(node, key, value)
        except OmegaConfBaseException as error:
            raise InputError(f"{key}={value}: {sentence(error)}") from None
    return to_config(node)


@dataclass(frozen=True)
class Objective:
    """The function that a search minimises."""

    base: TrainConfig
    seeds: tuple[int, ...]
    reports: int  # to the pruner, per seed
    stop_after: int | None

    def config(self, values: Values) -> TrainConfig:
        """The configuration of a run with these values, on the first seed."""
        base = self.base
        evaluation = base.evaluation
        if evaluation.stop_after is None:
            evaluation = dataclasses.replace(evaluation, stop_after=self.stop_after)
        quiet = dataclasses.replace(base.logging, progress=False, tensorboard=False)
        return with_values(dataclasses.replace(base, evaluation=evaluation, logging=quiet), values)


@dataclass(frozen=True)
class Report:
    """A trial's score at some point of its way; the answer is whether the trial is to end there."""

    trial: int
    step: int
    value: float
    can_prune: bool


Ask = Callable[[Report], bool]


@dataclass
class Outcome:
    """How a trial ended: its score, or that it was pruned, or why it failed."""

    value: float | None = None
    error: str = ""
    seeds: list[SeedScore] = dataclasses.field(default_factory=list)  # that have ended, in order


@dataclass(frozen=True)
class Trials:
    """A task: trials, which train together where they can. Returns their outcomes."""

    objective: Objective
    trials: Mapping[Any, tuple[Values, tuple[int, ...]]]  # values and seeds, by the trial's number or name

    def __call__(self, ask: Ask = lambda report: False) -> list[Outcome]:
        trials = [_Trial(self.objective, name, *trial, ask) for name, trial in self.trials.items()]
        runs = [trial.training(place) for trial in trials for place in range(len(trial.seeds))]
        at_once = dict.fromkeys((signal.SIGINT, signal.SIGTERM), signal.SIG_DFL)
        with handling(at_once):  # there is nothing to save
            run_together(runs)
        return [trial.outcome or Outcome() for trial in trials]

    def ended(self, outcomes: list[Outcome] | LostError) -> Iterator[tuple[Any, Outcome]]:
        """How each trial ended, by its number or name."""
        lost = Outcome(error="its workers were killed")
        of_each = [lost] * len(self.trials) if isinstance(outcomes, LostError) else outcomes
        return zip(self.trials, of_each, strict=True)


class _EndedError(Exception):
    """The trial has ended without this seed."""


class _Trial:
    """A trial while its seeds train. Each is reported when those before it have ended."""

    def __init__(
        self, objective: Objective, name: Any, values: Values, seeds: tuple[int, ...], ask: Ask
    ) -> None:
        self.outcome: Outcome | None = None
        self.seeds = seeds
        self._objective, self._name, self._values, self._ask = objective, name, values, ask
        self._standings: list[list[SeedScore]] = [[] for _ in seeds]  # at each report that is due
        self._results: dict[int, SeedScore | Exception] = {}  # by the seed's place
        self._reports = self._report()

    def training(self, place: int) -> Training[None]:
        """Train the seed at this place, unless the trial ends without it."""
        try:
            self._check()
            config = self._objective.config(self._values)
            result = yield from learning(config, self.seeds[place], partial(self._note, place))
            self._results[place] = result
            self._note(place, 1.0, result)
        except _EndedError:
            pass
        except Exception as error:
            self._results[place] = error
            next(self._reports, None)

    def _check(self) -> None:
        if self.outcome is not None:
            raise _EndedError

    def _note(self, place: int, share: float, standing: SeedScore) -> None:
        """Note a seed's score after a share of its budget, also at points skipped, so that all have all."""
        due = min(math.floor(share * self._objective.reports + 1e-9), self._objective.reports)
        self._standings[place] += [standing] * (due - len(self._standings[place]))
        next(self._reports, None)
        self._check()

    def _report(self) -> Iterator[None]:
        """Report the seeds in order, and set the outcome; yields where the next report is not due yet."""
        reports, of, ended = self._objective.reports, len(self.seeds), list[SeedScore]()
        total = self._objective.base.total_timesteps
        for place, standings in enumerate(self._standings):
            point = 0
            while point < len(standings) or place not in self._results:
                if point == len(standings):
                    yield
                    continue
                standing, step = standings[point], place * reports + point
                value = score([*ended, standing], total, of)
                is_skipped = any(standing is later for later in standings[point + 1 :])
                is_behind = self._ask(Report(self._name, step, value, not is_skipped))
                if is_behind and step + 1 < of * reports:
                    self.outcome = Outcome(seeds=ended)
                    return
                point += 1
            result = self._results[place]
            if isinstance(result, Exception):
                self.outcome = Outcome(None, reason(result), ended)
                return
            ended.append(result)
        value = score(ended, total, of)
        failed = Outcome(None, "the objective is NaN", ended)
        self.outcome = failed if math.isnan(value) else Outcome(value, "", ended)


def learning(
    config: TrainConfig,
    seed: int,
    on_evaluation: Callable[[float, SeedScore], None] = lambda share, seed: None,
) -> Training[SeedScore]:
    """Train and evaluate as a run would, and keep nothing but the end."""
    config = dataclasses.replace(config, seed=seed)
    mdp = check_settings(config)
    evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.step_limit(mdp))
    context = make_context(config, mdp)
    agent = config.agent.build(context)
    curve = LearningCurve(evaluator, agent, config, envs=context.envs)
    steps, total = 0, config.total_timesteps

    def standing(evaluation: Evaluation) -> SeedScore:
        return SeedScore(seed, curve.certificate.certified_since_step, evaluation.greedy.regret)

    def on_step(done: int) -> int:
        nonlocal steps
        steps = done
        return curve.on_step(done)

    curve.evaluate(0)
    curve.sinks.append(lambda evaluation: on_evaluation(evaluation.step / total, standing(evaluation)))
    yield Learning(agent, total, on_step)
    curve.sinks.clear()  # the last evaluation is the result
    return standing(curve.evaluate(steps))
