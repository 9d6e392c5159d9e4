"""The parts of tuning: the score, search spaces, what Optuna is told, and how trials end."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import optuna
import pytest
from helpers.hostile import seal
from helpers.runs_folder import Maker
from helpers.support import CONF, configure
from hypothesis import given
from hypothesis import strategies as st
from optuna.trial import create_trial

from gridworld.config.tune import DimensionConfig, TuneConfig
from gridworld.errors import InputError
from gridworld.report import statistics
from gridworld.storage.sealed_json import sealed
from gridworld.training.setup import check_settings
from gridworld.training.together import run_alone
from gridworld.tune import finalists
from gridworld.tune.confirmation import HeldOutResults, held_out_runs, read_results, verdict_on
from gridworld.tune.existing_study import check_study, legible
from gridworld.tune.search import storage, worker
from gridworld.tune.search.objective import Objective, SeedScore, Stopped, score
from gridworld.tune.search.search_space import SearchSpace, with_values
from gridworld.tune.search.storage import StudyStorage, count_trials, is_lost
from gridworld.tune.search.worker import StudyContext, search
from gridworld.tune.search.worker_pool import StorageLostError
from gridworld.tune.study_folder import SEARCH_JSON, is_claimed, write_trials
from gridworld.tune.study_spec import ConfFolders, compose_study

SPACES = sorted(file.stem for file in (CONF / "tune").glob("*.yaml"))
FOLDERS = ConfFolders(CONF)
TOTAL = 1000
ONE_SEED = st.builds(
    SeedScore,
    seed=st.just(0),
    certified_since=st.none() | st.integers(0, TOTAL),
    regret=st.floats(0, 100) | st.just(math.inf),
)
SEEDS = st.lists(ONE_SEED, min_size=3, max_size=3)


@given(SEEDS, SEEDS)
def test_the_score_ranks_by_certificates_first_and_by_steps_then(
    first: list[SeedScore], second: list[SeedScore]
) -> None:
    def rank(seeds: list[SeedScore]) -> tuple[int, float]:
        missed = sum(seed.certified_since is None for seed in seeds)
        return missed, sum(seed.certified_since or 0 for seed in seeds)

    scores = [score(seeds, TOTAL, 3) for seeds in (first, second)]
    assert all(0 <= value <= 1 for value in scores)
    (missed, steps), (other_missed, other_steps) = rank(first), rank(second)
    if missed < other_missed:
        assert scores[0] < scores[1]
    if missed == other_missed == 0 and steps < other_steps:
        assert scores[0] < scores[1]


def test_the_score_of_known_seeds() -> None:
    seeds = [SeedScore(0, 500, 0.0), SeedScore(1, 250, 0.0), SeedScore(2, None, 1.0)]
    assert score(seeds, TOTAL, 3) == pytest.approx((1 + (0.25 + 0.125 + 0.75) / 3) / 4)
    assert score(seeds[:1], TOTAL, 3) == pytest.approx(0.25 / 4)
    less_regret = [dataclasses.replace(seeds[2], regret=0.5)]
    assert score(less_regret, TOTAL, 3) < score(seeds[2:], TOTAL, 3)


@pytest.mark.parametrize("name", SPACES)
def test_a_shipped_space_holds_the_shipped_settings(name: str) -> None:
    asked = compose_study(FOLDERS, [f"agent={name}"])
    first = asked.space.parameters_of(asked.base)
    assert first is not None
    assert with_values(asked.base, asked.space.values(first)) == asked.base


@pytest.mark.parametrize("name", SPACES)
def test_what_a_shipped_space_suggests_can_train(name: str) -> None:
    asked = compose_study(FOLDERS, [f"agent={name}"])
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        check_settings(with_values(asked.base, asked.space.suggest(study.ask())))


def test_every_batch_of_ppo_divides_every_rollout() -> None:
    asked = compose_study(FOLDERS, ["agent=ppo"])
    keys = ("agent.n_steps", "agent.batch_size")
    lists = [asked.space.dimensions[key].choices or [] for key in keys]
    for choice in itertools.product(*lists):
        check_settings(with_values(asked.base, dict(zip(keys, choice, strict=True))))


def test_choices_that_need_each_other_are_no_mistake() -> None:
    base = configure("agent=ppo")  # 128 environments, so that a rollout is 128 times n_steps
    batch = {"agent.batch_size": DimensionConfig("categorical", choices=[384, 1024])}
    with pytest.raises(InputError, match=r"tune=own: agent\.batch_size=384"):
        SearchSpace(batch, "own").check(base, check_settings(base))
    rollout = {"agent.n_steps": DimensionConfig("categorical", choices=[3, 16])}
    SearchSpace(batch | rollout, "own").check(base, check_settings(base))


def test_there_is_a_space_for_every_agent_that_learns() -> None:
    agents = {file.stem for file in (CONF / "agent").glob("*.yaml")}
    learn = {name for name in agents if not name.endswith("_sb3_defaults")} - {"value_iteration"}
    assert set(SPACES) == learn


def test_lists_and_arguments_of_a_class_can_be_searched() -> None:
    nets = DimensionConfig("categorical", choices=[[64], [64, 64]])
    space = SearchSpace({"agent.policy_kwargs.net_arch": nets}, "own")
    base = configure("agent=ppo")
    space.check(base, check_settings(base))
    values = space.suggest(optuna.create_study().ask())
    assert with_values(configure("agent=ppo"), values).agent.policy_kwargs.net_arch in nets.choices  # type: ignore[attr-defined, operator]
    space = SearchSpace({"agent.arguments.gae_lambda": DimensionConfig("float", low=0.5, high=1)}, "own")
    config = with_values(configure("agent=a2c"), space.values({"agent.arguments.gae_lambda": 0.123456}))
    assert config.agent.arguments["gae_lambda"] == 0.5  # type: ignore[attr-defined]  # never below the range


@pytest.mark.parametrize(
    ("key", "dimension", "value", "is_inside"),
    [
        ("agent.gamma", DimensionConfig("float", low=0.5, high=1.0, step=0.25), 0.75, True),
        ("agent.gamma", DimensionConfig("float", low=0.5, high=1.0, step=0.25), 0.9, False),
        ("agent.gamma", DimensionConfig("float", low=0.0, high=1.0, step=0.1), 0.3, True),
        ("agent.gamma", DimensionConfig("float", low=0.5, high=1.0), 0.9, True),
        ("n_envs", DimensionConfig("int", low=1, high=9, step=4), 5, True),
        ("n_envs", DimensionConfig("int", low=1, high=9, step=4), 4, False),
        ("agent.gamma", DimensionConfig("int", low=0, high=1), 0.5, False),
    ],
)
def test_what_is_off_the_grid_is_outside(
    key: str, dimension: DimensionConfig, value: float, is_inside: bool
) -> None:
    found = SearchSpace({key: dimension}, "own").parameters_of(
        configure("agent=q_learning", f"{key}={value}")
    )
    assert found == ({key: value} if is_inside else None)


def small(*words: str) -> Objective:
    asked = compose_study(FOLDERS, ["agent=q_learning", "total_timesteps=1500", "tune.seeds=2", *words])
    return Objective(asked.measured, asked.space, asked.seeds, asked.settings.reports, 2)


def test_optuna_is_told_the_same_points_of_every_trial() -> None:
    objective = small("tune.reports=7")
    study = optuna.create_study(pruner=optuna.pruners.NopPruner())
    study.optimize(lambda trial: objective(trial, lambda: False), n_trials=3)
    for trial in study.trials:
        assert sorted(trial.intermediate_values) == list(range(14))
        assert trial.intermediate_values[13] == pytest.approx(trial.value)
        assert [seed["seed"] for seed in trial.user_attrs["seeds"]] == [0, 1]


class AfterOneSeed(optuna.pruners.BasePruner):
    """Ends a trial between its seeds."""

    def prune(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> bool:
        return trial.last_step is not None and trial.last_step >= 9


def test_a_pruned_trial_spares_its_other_seeds() -> None:
    objective = small()
    study = optuna.create_study(pruner=AfterOneSeed())
    study.optimize(lambda trial: objective(trial, lambda: False), n_trials=1)
    assert study.trials[0].state == optuna.trial.TrialState.PRUNED
    assert max(study.trials[0].intermediate_values) == 9


@dataclass
class Plain:
    """An objective that trains nothing: a function of the trial."""

    function: Callable[[optuna.Trial, Any], float]
    trial: Any = None

    def begin(self, trial: optuna.Trial) -> Plain:
        return Plain(self.function, trial)

    def trainings(self, is_stopped: object) -> list[Any]:
        return [[]]

    def score(self) -> float:
        return self.function(self.trial, None)


def study_of(
    folder: Path, objective: Any, trials: int, sampler: str = "tpe"
) -> tuple[optuna.Study, StudyContext]:
    settings = TuneConfig(trials=trials, heartbeat=1, sampler=sampler)
    url = f"sqlite:///{folder / 'study.db'}"
    storage = StudyStorage(url, "one", settings)
    storage.begin({})
    own: Any = objective if isinstance(objective, Objective) else Plain(objective)
    return storage.load(), StudyContext(folder, storage, own, math.inf)


def test_what_fails_is_a_trial_with_its_reason_and_the_study_goes_on(tmp_path: Path) -> None:
    answers = iter(
        [0.5, math.nan, InputError("agent.gamma=2: must be from 0 to 1"), ZeroDivisionError("x"), 0.25]
    )

    def objective(trial: optuna.Trial, is_stopped: object) -> float:
        answer = next(answers)
        if isinstance(answer, Exception):
            raise answer
        return answer

    study, context = study_of(tmp_path, objective, 5)
    search(study, context)
    now = count_trials(study)
    assert (now.complete, now.failed, now.ended) == (2, 3, 5)
    assert study.best_value == 0.25
    write_trials(tmp_path, study, SearchSpace({"n_envs": DimensionConfig("int", low=1, high=2)}, "own"))
    table = (tmp_path / "trials.csv").read_text()
    for reason in ("the objective is NaN", "agent.gamma=2: must be from 0 to 1", "ZeroDivisionError: x"):
        assert reason in table


def test_the_pruner_sees_at_once_what_its_process_has_ended(tmp_path: Path) -> None:
    values = iter([0.5, 0.4, 0.6, 0.3, 0.7, 0.45, 0.55, 0.2, 0.46, 0.44])

    def objective(trial: optuna.Trial, is_stopped: object) -> float:
        value = next(values)
        for step in range(10):
            trial.report(value, step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return value

    study, context = study_of(tmp_path, objective, 10)
    search(study, context)
    pruned = [trial.number for trial in study.trials if trial.state == optuna.trial.TrialState.PRUNED]
    assert pruned == [6, 8]  # the medians before them are 0.475 and 0.45


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")  # of `ask`
def test_a_trial_whose_worker_is_lost_before_its_first_sign_of_life_is_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, context = study_of(tmp_path, lambda trial, is_stopped: 0.0, 1)
    lost = study.ask()  # and nothing more: Optuna takes it for alive
    monkeypatch.setattr(worker._stopped, "wait", lambda seconds: None)
    for _ in range(3):
        assert worker._begin(study, context) == ([], False)  # it may still be about to begin
    assert [trial.number for trial in study.trials] == [lost.number]
    monkeypatch.setattr(storage, "_SILENT_BEATS", 0)
    search(study, context)
    states = optuna.trial.TrialState
    assert [trial.state for trial in study.trials] == [states.FAIL, states.COMPLETE]
    assert is_lost(study.trials[0])


def test_who_runs_a_trial_is_known_after_a_sign_of_life(tmp_path: Path) -> None:
    def objective(trial: optuna.Trial, is_stopped: object) -> float:
        with contextlib.closing(sqlite3.connect(tmp_path / "study.db")) as database:
            return float(database.execute("SELECT COUNT(*) FROM trial_heartbeats").fetchone()[0])

    study, context = study_of(tmp_path, objective, 1)
    search(study, context)
    assert study.best_value == 1
    assert study.trials[0].user_attrs.keys() >= {"worker"}


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_a_study_gone_on_with_chooses_as_an_undisturbed_one(tmp_path: Path, sampler: str) -> None:
    def objective(trial: optuna.Trial, is_stopped: object) -> float:
        return trial.suggest_float("x", -1, 1) ** 2

    chosen = []
    for name, parts in (("calm", [14]), ("halting", [3, 12, 14])):
        (tmp_path / name).mkdir()
        for trials in parts:
            study, context = study_of(tmp_path / name, objective, trials, sampler)
            search(study, context)
        chosen.append([trial.params["x"] for trial in study.trials])
    assert len(set(chosen[0])) == 14
    assert chosen[0] == chosen[1]


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_trials_that_are_cut_short_do_not_change_what_is_chosen(tmp_path: Path, sampler: str) -> None:
    calls = itertools.count()

    def chosen(name: str, stops: Sequence[int]) -> list[tuple[float, float]]:
        def objective(trial: optuna.Trial, is_stopped: object) -> float:
            place = next(calls)
            value = trial.suggest_float("x", -1, 1) ** 2 + trial.suggest_float("y", -1, 1) ** 2
            if place in stops:
                raise Stopped
            return value

        nonlocal calls
        calls = itertools.count()
        (tmp_path / name).mkdir()
        study, context = study_of(tmp_path / name, objective, 14, sampler)
        for _ in range(1 + len(stops)):
            try:
                search(study, context)
            except Stopped:
                study, context = study_of(tmp_path / name, objective, 14, sampler)
        assert len(study.trials) == 14 + len(stops)
        return [(trial.params["x"], trial.params["y"]) for trial in study.trials if not is_lost(trial)]

    assert chosen("calm", []) == chosen("stopped", [0, 4, 5, 13])


MOMENTS = ("before its draw", "half drawn", "drawn", "on its way", "failed")


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")  # of `ask`
@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("killed", [(0,), (0, 0, 1), (3, 11)])
def test_a_killed_search_of_one_worker_goes_on_as_if_it_had_not_been(
    moment: str, killed: tuple[int, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker._stopped, "wait", lambda seconds: pytest.fail("it waits for a dead worker"))
    keys = ("x", "y", "z")

    def objective(trial: optuna.Trial, is_stopped: object) -> float:
        value = sum(trial.suggest_float(key, -1, 1) ** 2 for key in keys)
        if trial.params["x"] > 0.8:
            raise ValueError("too far")
        for step in range(10):
            trial.report(value + step, step)
            if trial.should_prune():
                raise optuna.TrialPruned
        return value

    def die(study: optuna.Study, context: StudyContext) -> None:
        """What a worker leaves that is killed in its next trial."""
        draw = storage.next_draw(study)
        if draw == 0 and not count_trials(study).waiting:
            study.enqueue_trial(context.first or {})
        storage.seed_sampler(study, context.storage.settings, draw, "")
        trial = study.ask()
        if moment != "before its draw":
            storage.sign_on(trial, draw, "here:1")
            for key in keys[: 2 if moment == "half drawn" else 3]:
                trial.suggest_float(key, -1, 1)
        if moment == "on its way":
            trial.report(0.0, 9)
        if moment == "failed" and trial.params["x"] > 0.8:
            trial.set_user_attr("error", "ValueError: too far")

    def searched(name: str, killed: Sequence[int]) -> list[tuple[object, ...]]:
        (tmp_path / name).mkdir()
        for ended in (*killed, 14):
            study, context = study_of(tmp_path / name, objective, 14)
            context = dataclasses.replace(context, first={"x": 0.25, "y": -0.5, "z": 0.75})
            with worker.among_workers(study, context):
                while count_trials(study).ended < ended:
                    worker._run(worker._begin(study, context)[0], context)
                if ended < 14:
                    die(study, context)
        found = [trial for trial in study.trials if not is_lost(trial)]
        return [(trial.state, trial.params, trial.value, trial.intermediate_values) for trial in found]

    calm = searched("calm", ())
    assert calm[0][1] == {"x": 0.25, "y": -0.5, "z": 0.75}
    assert searched("killed", killed) == calm


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")  # of `ask`
def test_only_who_is_alone_gives_up_what_runs(tmp_path: Path) -> None:
    study, context = study_of(tmp_path, lambda trial, is_stopped: 0.0, 1)
    named = dataclasses.replace(context.storage.settings, storage="postgresql://elsewhere/db")
    elsewhere = dataclasses.replace(context, storage=dataclasses.replace(context.storage, settings=named))
    study.ask()
    with worker.among_workers(study, elsewhere), worker.among_workers(study, context):
        assert count_trials(study).running == 1
    with worker.among_workers(study, context):
        assert count_trials(study).running == 0


@pytest.mark.filterwarnings("ignore:Heartbeat of storage")  # of `ask`
def test_settings_that_kill_their_worker_again_and_again_are_left_out(tmp_path: Path) -> None:
    study, _ = study_of(tmp_path, None, 1)
    for draw in (0, 0, 0, 0, 1):
        assert storage.next_draw(study) == draw
        storage.sign_on(study.ask(), draw, "here:1")
        storage.give_up_running(study)
    for _ in range(5):  # being stopped is no reason
        assert storage.next_draw(study) == 1
        trial = study.ask()
        storage.sign_on(trial, 1, "here:1")
        trial.set_user_attr("stopped", True)
        storage.give_up_running(study)


def test_a_storage_that_goes_away_is_told_in_a_sentence(tmp_path: Path) -> None:
    study, context = study_of(tmp_path, None, 3)
    (tmp_path / "study.db").unlink()
    with (
        pytest.raises(StorageLostError, match=r"study\.db: the study cannot be"),
        context.storage.in_reach(),
    ):
        study.set_user_attr("x", 1)
    with pytest.raises(StorageLostError, match="has no study one"), context.storage.in_reach():
        context.storage.load()
    with pytest.raises(ZeroDivisionError), context.storage.in_reach():
        _ = 1 / 0


def test_training_that_diverges_is_such_a_failure(tmp_path: Path) -> None:
    asked = compose_study(
        FOLDERS, ["agent=ppo", "agent.learning_rate=1e30", "total_timesteps=9000", "tune.seeds=1"]
    )
    space = SearchSpace({"agent.clip_range": DimensionConfig("float", low=0.1, high=0.3)}, "own")
    study, context = study_of(tmp_path, Objective(asked.measured, space, asked.seeds, 10, 2), 1)
    search(study, context)
    assert "diverged" in study.trials[0].user_attrs["error"]


def results(*steps: float) -> HeldOutResults:
    import numpy as np

    found = np.array(steps, dtype=np.float64)
    certified = int(np.isfinite(found).sum())
    return HeldOutResults(statistics.share(certified, len(found)), found, TOTAL)


def test_held_out_runs_of_other_settings_are_other_runs(tmp_path: Path) -> None:
    def names(*words: str) -> list[str]:
        found = held_out_runs(tmp_path, "default", configure("agent=q_learning", *words), range(3, 6))
        assert [run.config.seed for run in found] == [3, 4, 5]
        return [run.folder.name for run in found]

    assert len(set(names())) == 3
    assert names() == names("seed=9", "logging.progress=false")
    for other in ("total_timesteps=50", "agent.gamma=0.8", "env.slip=0.1"):
        assert not set(names()) & set(names(other))


def around(certified: int, step: int) -> list[float]:
    """Twenty runs, so many certified within 10 % of that step."""
    spread = [step * (0.9 + 0.2 * place / 19) for place in range(20)]
    return [*spread[:certified], *[math.inf] * (20 - certified)]


@pytest.mark.parametrize(
    ("winner", "began_from", "verdict"),
    [
        ((100, 110, 120, 130, 140, 150), (500, 510, 520, 530, 540, math.inf), "beats"),
        ((500, 510, 520, 530, 540, math.inf), (100, 110, 120, 130, 140, 150), "does not beat"),
        (
            (10, 10, 10, 10, 10, 10, 10, math.inf),
            (80, 80, 80, 80, 80, 80, 80, 80),
            "cannot be told apart from",
        ),
        ((100, 200, 300, 400), (110, 190, 310, 390), "cannot be told apart from"),
        ((math.inf, math.inf), (math.inf, math.inf), "cannot be told apart from"),
        # A share that is surely greater decides, whoever is sooner.
        (around(20, 550), around(10, 250), "beats"),
        (around(10, 250), around(20, 550), "does not beat"),
        # Newcombe's interval of 20 / 20 less 16 / 20 is [-0.0005, 0.416], of 15 / 20 it lies above 0.
        (around(20, 550), around(16, 250), "cannot be told apart from"),
        (around(20, 550), around(15, 250), "beats"),
        # One seed does not outweigh being much sooner, nor does being sooner outweigh it.
        (around(19, 110), around(20, 850), "cannot be told apart from"),
        (around(19, 850), around(20, 110), "does not beat"),
        (around(20, 110), around(19, 850), "beats"),
        (around(20, 110), around(20, 850), "beats"),
    ],
)
def test_the_verdict(winner: Sequence[float], began_from: Sequence[float], verdict: str) -> None:
    found = verdict_on(results(*winner), results(*began_from), "the winner")
    assert found["verdict"] == verdict
    assert f"held-out seeds the winner {verdict} the settings" in found["sentence"]


def test_the_verdict_says_which_runs_it_is_without(tmp_path: Path) -> None:
    config = configure("agent=q_learning")
    before, winner = (held_out_runs(tmp_path, name, config, range(6)) for name in ("default", "trial=3"))
    maker = Maker("agent=q_learning")
    for run in [*before, *winner]:
        maker.write(run.folder, run.config.seed, 3000)
        content = json.loads((run.folder / "summary.json").read_text()) | {"certified_since_step": 3000}
        (run.folder / "summary.json").write_text(json.dumps(content))
        seal(run.folder, "summary.json")
    whole = read_results(winner)
    assert (whole.certified.count, whole.certified.total) == (6, 6)
    assert "left out" not in whole.text()
    os.truncate(winner[0].folder / "summary.json", 3)
    os.truncate(winner[1].folder / "manifest.json", 3)
    (winner[2].folder / "curve.csv").unlink()
    shutil.rmtree(winner[3].folder)
    manifest = before[0].folder / "manifest.json"
    failed = json.loads(manifest.read_text()) | {"status": "failed", "error": "diverged"}
    manifest.write_text(json.dumps(sealed(failed)))
    found = verdict_on(read_results(winner), read_results(before), "the winner")
    names = ", ".join(run.folder.name for run in winner[:4])
    assert found["sentence"].startswith("On 6 held-out seeds the winner ")
    assert "certified on 2 of 2 [34 %, 100 %], for good by step 3,000" in found["sentence"]
    assert f"(4 of 6 left out, without a result: {names})" in found["sentence"]
    assert f"(1 failed and count as not certified: {before[0].folder.name})" in found["sentence"]
    assert found["winner"]["left_out"] == tuple(run.folder.name for run in winner[:4])
    for run in winner:
        shutil.rmtree(run.folder, ignore_errors=True)
    with pytest.raises(InputError, match="no held-out run has a result"):
        read_results(winner)


def test_a_final_run_that_fails_is_told_and_counted_as_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverge(*arguments: object) -> None:
        raise InputError("training diverged")

    monkeypatch.setattr(finalists, "learning", diverge)
    study = optuna.create_study()
    score = dataclasses.asdict(SeedScore(0, 100, 0.0))
    study.add_trial(create_trial(value=0.1, user_attrs={"seeds": [score]}))
    objective = SimpleNamespace(config=lambda values: None)
    run_alone(finalists._run(objective, study, 0, {}, 7))  # type: ignore[arg-type]
    told = "trial 0 on the final seed 7 failed, and counts as not certified: training diverged\n"
    assert capsys.readouterr().err == told
    (finalist,) = finalists.ranking(study, study.trials, [7], TOTAL)
    assert (finalist.certified, finalist.seeds, finalist.failed) == (1, 2, 1)


SQL = {
    "a score that is no number": "UPDATE trial_values SET value = NULL",
    "an infinite score": "UPDATE trial_values SET value = 9e999",
    "a score of a kind that there is not": "UPDATE trial_values SET value_type = 'x'",
    "no score": "DELETE FROM trial_values",
    "a choice that there is not": "UPDATE trial_params SET param_value = 77",
    "a parameter of another name": "UPDATE trial_params SET param_name = 'agent.' || param_id",
    "no parameter": "DELETE FROM trial_params",
    "a distribution that is no JSON": "UPDATE trial_params SET distribution_json = '{'",
    "a distribution that there is not": 'UPDATE trial_params SET distribution_json = \'{"name": "x"}\'',
    "an attribute that is no JSON": "UPDATE trial_user_attributes SET value_json = '['",
    "seeds that are no list": "UPDATE trial_user_attributes SET value_json = '1'",
    "seeds that are none": "UPDATE trial_user_attributes SET value_json = '[{\"seed\": 0}]'",
    "a seed with a regret beyond all numbers": "UPDATE trial_user_attributes SET value_json = "
    '\'[{"seed": 0, "certified_since": null, "regret": 1' + 400 * "0" + "}]'",
    "no seeds": "DELETE FROM trial_user_attributes",
    "a state that there is not": "UPDATE trials SET state = 'x'",
    "a date that is none": "UPDATE trials SET datetime_start = 'x'",
    "what it is about, no JSON": "UPDATE study_user_attributes SET value_json = '{'",
    "what it is about, no object": "UPDATE study_user_attributes SET value_json = '[1]'",
    "what it is about, nested as deep as Python goes": "UPDATE study_user_attributes SET value_json = '"
    + 10**5 * "["
    + "'",
    "final seeds that are none": "INSERT INTO study_user_attributes (study_id, key, value_json) "
    "VALUES (1, 'final trial=0,seed=9', '3')",
    "another direction": "UPDATE study_directions SET direction = 'MAXIMIZE'",
    "a direction that there is not": "UPDATE study_directions SET direction = 'x'",
    "a table less": "DROP TABLE trial_values",
    "a database of nothing": "DROP TABLE studies",
    "a draw that is none": "INSERT INTO trial_user_attributes (trial_id, key, value_json) "
    "VALUES (1, 'draw', '\"x\"')",
}


@pytest.fixture(scope="module")
def sqlite_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With two complete trials."""
    file = tmp_path_factory.mktemp("study") / "study.db"
    study = StudyStorage(f"sqlite:///{file}", "mine", TuneConfig()).begin(ABOUT)
    for number in (0, 1):
        seeds = [dataclasses.asdict(SeedScore(seed, 500, 0.25)) for seed in (0, 1)]
        study.add_trial(
            optuna.trial.create_trial(
                params={"agent.gamma": 0.9, "agent.learning_rate": 0.5},
                distributions={
                    "agent.gamma": optuna.distributions.CategoricalDistribution([0.9, 0.99]),
                    "agent.learning_rate": optuna.distributions.FloatDistribution(0.1, 0.9),
                },
                value=0.25 + number,
                user_attrs={"seeds": seeds},
            )
        )
    check_study(study, TWO)
    return file


ABOUT = {"objective": {"seeds": [0, 1]}}
TWO = SearchSpace(
    {
        "agent.gamma": DimensionConfig(type="categorical", choices=[0.9, 0.99]),
        "agent.learning_rate": DimensionConfig(type="float", low=0.1, high=0.9),
    },
    "two",
)


@pytest.mark.parametrize("what", SQL)
def test_a_study_whose_database_was_altered_is_refused_in_a_sentence(
    what: str, sqlite_study: Path, tmp_path: Path
) -> None:
    shutil.copy(sqlite_study, tmp_path / "study.db")
    with contextlib.closing(sqlite3.connect(tmp_path / "study.db")) as database, database:
        database.execute(SQL[what])
    url = f"sqlite:///{tmp_path / 'study.db'}"
    with pytest.raises(InputError, match=r"^tune\.(storage|study)=.*") as caught, legible(url):
        check_study(StudyStorage(url, "mine", TuneConfig()).begin(ABOUT), TWO)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[1]", b"\xff", b'{"study": 3}', b'{"study": "mine", "about": 3}']
)
def test_a_folder_that_does_not_say_whose_it_is_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / SEARCH_JSON).write_bytes(content)
    with pytest.raises(InputError):
        is_claimed(tmp_path, "mine", ABOUT)
    (tmp_path / SEARCH_JSON).unlink()
    os.mkfifo(tmp_path / SEARCH_JSON)
    with pytest.raises(InputError, match=r"search\.json: is no ordinary file"):
        is_claimed(tmp_path, "mine", ABOUT)
