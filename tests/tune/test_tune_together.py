"""A trial's seeds, and several trials, that train together come to what they come to one by one."""

import math
import threading
from collections import Counter
from pathlib import Path
from typing import Any

import optuna
import pytest
from helpers.support import CONF, SHORT, configure
from optuna.trial import FrozenTrial, TrialState

from gridworld.config.tune import DimensionConfig, TuneConfig
from gridworld.tune import finalists
from gridworld.tune.finalists import FinalRuns
from gridworld.tune.search import objective as objective_module
from gridworld.tune.search import worker as worker_module
from gridworld.tune.search.objective import Objective, Stopped, learn, learning
from gridworld.tune.search.search_space import SearchSpace
from gridworld.tune.search.storage import StudyStorage, draw_of, is_lost
from gridworld.tune.search.worker import StudyContext
from gridworld.tune.search.worker_pool import share
from gridworld.tune.study_spec import ConfFolders, compose_study

SPACE = SearchSpace(
    {
        "agent.learning_rate": DimensionConfig("float", low=1e-3, high=3e-2, log=True),
        "agent.n_epochs": DimensionConfig("int", low=1, high=4),
        "agent.n_steps": DimensionConfig("categorical", choices=[16, 32]),
    },
    "own",
)
SEEDS = (0, 1, 2)
REPORTS = 4


@pytest.fixture(scope="module")
def objective() -> Objective:
    base = configure(*SHORT["ppo"], "total_timesteps=1024", "evaluation.every=256")
    return Objective(base, SPACE, SEEDS, REPORTS, None)


class At(optuna.pruners.BasePruner):
    """Ends some trials at a point of their way."""

    def __init__(self, ends: dict[int, int]) -> None:
        self._ends = ends

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        return trial.last_step is not None and trial.last_step >= self._ends.get(trial.number, 99)


PRUNER = At({1: 1, 2: 5, 4: 8})  # in the first seed, in the second, at the beginning of the third


def told(trial: FrozenTrial) -> tuple[Any, ...]:
    return trial.state, trial.params, trial.value, trial.intermediate_values, trial.user_attrs.get("seeds")


def test_seeds_that_train_together_are_those_that_train_one_by_one(
    objective: Objective, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: Counter[int] = Counter()
    trials: dict[float, int] = {}

    def noted(config: Any, seed: int, *more: Any) -> Any:
        begun[seed] += 1
        if trials.setdefault(config.agent.learning_rate, len(trials)) == 3 and seed == 1:
            raise ZeroDivisionError("in the fourth trial's second seed")
        return learning(config, seed, *more)

    def found() -> list[tuple[Any, ...]]:
        begun.clear()
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=3), pruner=PRUNER)
        study.optimize(lambda trial: objective(trial, lambda: False), n_trials=5, catch=ZeroDivisionError)
        return [told(trial) for trial in study.trials]

    monkeypatch.setattr(objective_module, "learning", noted)
    together = found()
    assert begun == {0: 5, 1: 5, 2: 5}
    monkeypatch.setattr(objective_module, "shape", lambda config: None)
    assert found() == together
    assert begun == {0: 5, 1: 4, 2: 2}
    states = [TrialState.COMPLETE, TrialState.PRUNED, TrialState.PRUNED, TrialState.FAIL, TrialState.PRUNED]
    assert [trial[0] for trial in together] == states


def search(folder: Path, objective: Objective, trials: int, together: int) -> list[FrozenTrial]:
    settings = TuneConfig(trials=trials, sampler="random", heartbeat=60, together=together)
    storage = StudyStorage(f"sqlite:///{folder / 'study.db'}", "one", settings)
    storage.begin({})
    context = StudyContext(folder, storage, objective, math.inf)
    study = storage.load()
    study.pruner = PRUNER
    worker_module.search(study, context)
    return study.get_trials()


def test_trials_that_train_together_are_those_that_train_one_by_one(
    objective: Objective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = []
    learn_together = worker_module.run_together

    def noted(trainings: Any) -> Any:
        sizes.append(len(trainings))
        return learn_together(trainings)

    monkeypatch.setattr(worker_module, "run_together", noted)
    found = []
    for together in (1, 3):
        (tmp_path / str(together)).mkdir()
        found.append([told(trial) for trial in search(tmp_path / str(together), objective, 5, together)])
        assert max(sizes) == 3 * together
    assert found[0] == found[1]
    assert [number for number, trial in enumerate(found[1]) if trial[0] == TrialState.PRUNED] == [1, 2, 4]


def test_the_trials_of_a_worker_that_is_stopped_are_drawn_again(
    objective: Objective, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = threading.Event()
    looks = iter(range(10**6))

    def is_stopped() -> bool:
        if next(looks) == 20:
            asked.set()
        return asked.is_set()

    monkeypatch.setattr(worker_module, "is_stopped", is_stopped)
    with pytest.raises(Stopped):
        search(tmp_path, objective, 4, 3)
    asked.clear()
    trials = search(tmp_path, objective, 4, 3)
    lost = [trial for trial in trials if is_lost(trial)]
    assert 1 <= len(lost) <= 3
    assert len(trials) - len(lost) == 4
    for trial in lost:
        (again,) = (other for other in trials if draw_of(other) == draw_of(trial) and not is_lost(other))
        assert again.params == trial.params
        assert again.state.is_finished()


def test_final_runs_that_train_together_are_those_alone(objective: Objective, tmp_path: Path) -> None:
    storage = StudyStorage(f"sqlite:///{tmp_path / 'study.db'}", "one", TuneConfig())
    storage.begin({})
    study = storage.load()
    named = [(number, {"agent.learning_rate": rate}) for number, rate in enumerate((0.01, 0.02))]
    context = StudyContext(tmp_path, storage, objective, math.inf)
    runs = FinalRuns(context, finalists.missing(study, named, (7, 8)), 2)
    assert len(runs.runs) == 4
    finalists._run_missing(runs, study, 1)
    left = finalists.missing(study, named, (7, 8))
    assert left == runs.runs[:2]
    finalists._run_missing(runs, study, 2)  # in the place of one that was lost
    assert not finalists.missing(study, named, (7, 8))
    for number, values in named:
        alone = learn(objective.config(values), 8, lambda: False)
        assert study.user_attrs[f"final trial={number},seed=8"] == vars(alone)


def test_workers_share_all_work() -> None:
    for workers in (1, 2, 3, 7):
        parts = [share(range(7), worker, workers) for worker in range(workers)]
        assert [number for part in parts for number in part] == list(range(7))
        assert all(parts)


@pytest.mark.parametrize(
    ("words", "together"),
    [
        (["agent=ppo", "tune.workers=1"], 1),
        (["agent=ppo", "tune.workers=1", "tune.together=5"], 5),
        (["agent=ppo", "tune.workers=2"], 4),
        (["agent=dqn", "tune.workers=16"], 1),
        (["agent=q_learning", "tune.workers=2", "tune.together=5"], 1),
    ],
)
def test_how_many_trials_train_together(words: list[str], together: int) -> None:
    assert compose_study(ConfFolders(CONF), words).settings.together == together
