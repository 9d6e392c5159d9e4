"""The objective of a search: what one trial's settings come to on several seeds, as one number in [0, 1].

The number, the trial's score, is minimised: first the share of seeds that are certified counts, then how
soon. Of n seeds, m missed the certificate; seed i costs

    c_i = t_i / 2T                     certified since step t_i of T
    c_i = 1/2 + ρ_i / 2(1 + ρ_i)       not certified, with regret ρ_i at the end

and the score is (m + mean c) / (n + 1). One certified seed more always counts for more than all steps
together, since the mean is at most 1. Where the share is the same, fewer steps win; where no seed is
certified yet, less regret, so that a search has something to follow.

Seeds are trained in memory, together where they can. Optuna is told of them one after the other: after every
tenth or so of a seed's budget, the score as it would be if each seed, the present one included, stayed as it
is. So its pruners compare trials at the same point of the same seed; a trial that is behind ends within a
curve or between two seeds, as it does where the seeds train one after the other.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from gridworld.agents import Learning, family
from gridworld.config.train import TrainConfig
from gridworld.envs.observations import make_observation
from gridworld.sweep.plan import shape
from gridworld.training.learning_curve import LearningCurve
from gridworld.training.setup import check_settings, make_context
from gridworld.training.together import Training, run_alone, run_together
from gridworld.tune.search.search_space import SearchSpace, Values, with_values
from gridworld.world.exact.evaluation import Evaluator

if TYPE_CHECKING:
    from optuna.trial import Trial

# A trial's attributes in the storage; see `storage.draw_of` for the draw.
SEEDS, ERROR, WORKER, DRAW, STOPPED = "seeds", "error", "worker", "draw", "stopped"
_MOST_STEPS = 2**63


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
    """A seed's score from the study's storage. Raises `ValueError` for content that is none."""
    if isinstance(content, dict) and content.keys() == {"seed", "certified_since", "regret"}:
        seed, since, regret = content["seed"], content["certified_since"], content["regret"]
        is_step = since is None or (type(since) is int and 0 <= since < _MOST_STEPS)
        if type(seed) is int and is_step and type(regret) is float and math.isfinite(regret):
            return SeedScore(seed, since, regret)
    raise ValueError(f"{str(content)[:80]} is not how a seed stands")


def score(seeds: Sequence[SeedScore], total: int, of: int) -> float:
    """The score of a trial on `of` seeds by the first few of them, whose missed share stands for the rest.

    Args:
        seeds: how these seeds stand, at least one.
        total: a run's budget in environment steps.
        of: how many seeds the trial has.
    """
    missed = sum(seed.certified_since is None for seed in seeds)
    mean_cost = sum(seed.cost(total) for seed in seeds) / len(seeds)
    return (of * missed / len(seeds) + mean_cost) / (of + 1)


OnEvaluation = Callable[[float, SeedScore], None]  # (share of the seed's budget, how the seed stands)
IsStopped = Callable[[], bool]


class Stopped(KeyboardInterrupt):
    """The worker was asked to end, and so the trial ends."""


@dataclass(frozen=True)
class Objective:
    """The function that a search minimises."""

    base: TrainConfig
    space: SearchSpace
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

    def __call__(self, trial: Trial, is_stopped: IsStopped) -> float:
        """Train a trial's settings on every seed.

        Args:
            trial: Optuna's trial, which chooses the settings and is told the scores on the way.
            is_stopped: whether this process was asked to end.

        Returns:
            The trial's score.

        Raises:
            TrialPruned: the trial is behind the others.
            Stopped: this process was asked to end.
            Exception: what training raises.
        """
        seeds = self.begin(trial)
        for group in seeds.trainings(is_stopped):
            run_together(group)
        return seeds.score()

    def begin(self, trial: Trial) -> Seeds:
        """Choose a trial's settings, to train them on its seeds."""
        return Seeds(trial, self, self.config(self.space.suggest(trial)))

    def can_join(self) -> bool:
        """Whether trials can train together, as far as the settings that the search begins from tell."""
        return shape(self.base) is not None


class _LeftError(Exception):
    """The trial has ended without this seed."""


class Seeds:
    """A trial's seeds while they train. Optuna is told of each when those before it have ended."""

    def __init__(self, trial: Trial, objective: Objective, config: TrainConfig) -> None:
        self._trial = trial
        self._config = config
        self._objective = objective
        self._ended: list[SeedScore] = []  # those that Optuna has been told of
        self._untold: list[deque[tuple[float, SeedScore]]] = [deque() for _ in objective.seeds]
        self._results: list[SeedScore | Exception | None] = [None] * len(objective.seeds)
        self._error: Exception | None = None  # that the trial ends with
        self._reporter = _Reporter(trial, objective, [])

    def trainings(self, is_stopped: IsStopped) -> list[list[Callable[[], Training[None]]]]:
        """What trains the seeds: groups, one after the other, of those that can train together."""
        places = range(len(self._objective.seeds))
        all_of_them: list[Callable[[], Training[None]]] = [
            partial(self._training, place, is_stopped) for place in places
        ]
        return [[each] for each in all_of_them] if shape(self._config) is None else [all_of_them]

    def _training(self, place: int, is_stopped: IsStopped) -> Training[None]:
        """Train the seed at this place, unless the trial ends without it; raises nothing but `Stopped`."""

        def is_over() -> bool:
            if self._error is not None:
                raise _LeftError
            return is_stopped()

        def on_evaluation(share: float, standing: SeedScore) -> None:
            self._untold[place].append((share, standing))
            self._tell()

        try:
            is_over()
            seed = self._objective.seeds[place]
            self._results[place] = yield from learning(self._config, seed, is_over, on_evaluation)
        except _LeftError:
            return
        except Exception as error:
            self._results[place] = error
        self._tell()

    def score(self) -> float:
        """The trial's score. Raises what it ended with instead."""
        if self._error is not None:
            raise self._error
        return score(self._ended, self._objective.base.total_timesteps, len(self._objective.seeds))

    def _tell(self) -> None:
        try:
            while self._error is None and len(self._ended) < len(self._results):
                place = len(self._ended)
                while self._untold[place]:
                    self._reporter.at(*self._untold[place].popleft())
                result = self._results[place]
                if result is None:
                    return
                self._end(result)
        except Exception as error:
            self._error = error

    def _end(self, result: SeedScore | Exception) -> None:
        if isinstance(result, Exception):
            raise result
        self._reporter.at(1.0, result)
        self._ended.append(result)
        self._trial.set_user_attr(SEEDS, [dataclasses.asdict(each) for each in self._ended])
        self._reporter = _Reporter(self._trial, self._objective, self._ended)


class _Reporter:
    """Reports to Optuna how a seed stands, and raises `TrialPruned` if Optuna's pruner says so."""

    def __init__(self, trial: Trial, objective: Objective, ended: list[SeedScore]) -> None:
        self._trial = trial
        self._ended = list(ended)
        self._total = objective.base.total_timesteps
        self._of = len(objective.seeds)
        self._reports = objective.reports
        self._reported = 0

    def at(self, share: float, standing: SeedScore) -> None:
        """Report after a share of the seed's budget; also the points skipped, so that all trials have all."""
        due = min(math.floor(share * self._reports + 1e-9), self._reports)
        value = score([*self._ended, standing], self._total, self._of)
        if due <= self._reported or math.isnan(value):
            return
        for place in range(self._reported, due):
            self._trial.report(value, len(self._ended) * self._reports + place)
        self._reported = due
        is_last = due == self._reports and len(self._ended) + 1 == self._of
        if not is_last and self._trial.should_prune():
            import optuna

            raise optuna.TrialPruned(f"at {share:.0%} of seed {standing.seed}")


def learn(
    config: TrainConfig,
    seed: int,
    is_stopped: IsStopped,
    on_evaluation: OnEvaluation = lambda share, standing: None,
) -> SeedScore:
    """Train and evaluate as a run would, and keep nothing but the end.

    Args:
        config: the run's, whose own seed does not matter.
        seed: the run's.
        is_stopped: whether this process was asked to end.
        on_evaluation: is called at every evaluation but the last.

    Raises:
        Stopped: this process was asked to end.
        Exception: what training raises.
    """
    return run_alone(learning(config, seed, is_stopped, on_evaluation))


def learning(
    config: TrainConfig,
    seed: int,
    is_stopped: IsStopped,
    on_evaluation: OnEvaluation = lambda share, standing: None,
) -> Training[SeedScore]:
    """The same as a generator, for `run_together`."""
    config = dataclasses.replace(config, seed=seed)
    mdp = check_settings(config)
    observation = make_observation(mdp, config.observation.kind, config.observation.cell_size)
    evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.step_limit(mdp))
    context = make_context(config, mdp, observation)
    agent = family(config.agent).build(config.agent, context)
    curve = LearningCurve(evaluator, agent, config, envs=context.envs)
    steps = 0

    def standing() -> SeedScore:
        assert curve.newest is not None
        return SeedScore(config.seed, curve.certificate.certified_since_step, curve.newest.greedy.regret)

    def on_step(done: int) -> int:
        nonlocal steps
        steps = done
        if is_stopped():
            raise Stopped
        before = curve.newest
        next_call = curve.on_step(done)
        if curve.newest is not None and curve.newest is not before:
            on_evaluation(curve.newest.step / config.total_timesteps, standing())
        return next_call

    curve.evaluate(0)
    yield Learning(agent, config.total_timesteps, on_step)
    curve.evaluate(steps)
    return standing()
