"""The parts of tuning: the score, search spaces, what Optuna is told, and how trials end."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import math
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
import yaml
from helpers.runs_folder import Maker
from helpers.support import CONF, SHORT, configure
from hypothesis import given
from hypothesis import strategies as st
from optuna.trial import FrozenTrial, TrialState, create_trial
from test_tune import refused

from gridworld.base.errors import InputError
from gridworld.base.processes import LostError, Processes
from gridworld.base.safe_read import sealed
from gridworld.config.compose import compose
from gridworld.config.fields import MISSING
from gridworld.config.recipe_file import literal
from gridworld.config.sweep import DimensionConfig
from gridworld.config.worlds import SOURCES
from gridworld.sweeps.tune import objective as objective_module
from gridworld.sweeps.tune.confirmation import (
    HeldOutResults,
    choose_finalists,
    held_out_runs,
    rank_finalists,
    read_results,
    verdict_on,
)
from gridworld.sweeps.tune.objective import (
    Objective,
    Outcome,
    Report,
    SeedScore,
    Trials,
    learning,
    score,
    with_values,
)
from gridworld.sweeps.tune.search import open_study, search
from gridworld.sweeps.tune.study import write_recipe
from gridworld.sweeps.tune.study_spec import SearchSpace, StudySpec, compose_study
from gridworld.training.setup import check_settings
from gridworld.training.together import run_alone

SPACES = sorted(
    file.stem
    for file in (CONF / "agent").glob("*.yaml")
    if not file.stem.endswith("_sb3_defaults") and file.stem != "value_iteration"
)
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
    if missed < other_missed or (missed == other_missed == 0 and steps < other_steps):
        assert scores[0] < scores[1]


def test_the_score_of_known_seeds() -> None:
    seeds = [SeedScore(0, 500, 0.0), SeedScore(1, 250, 0.0), SeedScore(2, None, 1.0)]
    assert score(seeds, TOTAL, 3) == pytest.approx((1 + (0.25 + 0.125 + 0.75) / 3) / 4)
    assert score(seeds[:1], TOTAL, 3) == pytest.approx(0.25 / 4)
    assert score([SeedScore(2, None, 0.5)], TOTAL, 3) < score(seeds[2:], TOTAL, 3)


@pytest.mark.parametrize("name", SPACES)
def test_a_shipped_space_holds_the_shipped_settings_and_suggests_what_can_train(name: str) -> None:
    asked = compose_study([f"agent={name}"])
    first = asked.space.parameters_of(asked.base)
    assert first is not None
    assert with_values(asked.base, asked.space.values(first)) == asked.base
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(8):
        suggested = asked.space.values(study.ask(asked.space.distributions).params)
        check_settings(with_values(asked.base, suggested))


TABLES: dict[str, Any] = {
    "next_state": [[0, 1], [0, 1]],
    "reward": [[0.0, 0.0], [0.0, 1.0]],
    "terminated": [[False, False], [False, True]],
}
SETTINGS: dict[str, dict[str, Any]] = {  # of a world of each source
    "map": {"layout": "my maps/one map.txt", "slip": 0.25},
    "gymnasium": {"id": "FrozenLake-v1", "kwargs": {"desc": ["SF", "FG"], "is_slippery": False}},
    "enumerated": {"id": "FrozenLake-v1", "kwargs": {"map_name": "4x4"}, "ignore": ["lastaction"]},
    "arrays": {"path": "my maps/tables.npz"},
    "built": {"builder": "gridworld.world.sources.classics.river_swim", "kwargs": {"length": 4}},
    "river_swim": {"length": 7},
    "deep_sea": {"size": 3},
    "combination_lock": {"length": 3, "seed": 1},
    "random_walk": {"length": 7},
}


# An agent with a setting that every command line has to give, and one that follows from another.
AN_AGENT = """\
# @package _global_
defaults:
  - /agent/schema/q_learning@agent
  - override /observation: none
  - _self_
agent:
  name: mine
  gamma: ???
  log_interval: ${n_envs}
"""


@pytest.mark.slow
@pytest.mark.parametrize("given", ["on the command line", "in a file", "in a file that leaves it open"])
@pytest.mark.parametrize("source", SOURCES)
def test_the_recipe_of_a_study_in_any_world_is_of_that_world(
    source: str, given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings, world = SETTINGS[source], {"map": "classic"}.get(source, source)
    content: dict[str, Any] = {"defaults": [{"override /env/schema@_global_.env": source}]}
    if given != "on the command line":
        world = "mine"
        content |= settings if given == "in a file" else dict.fromkeys(settings, MISSING)
    monkeypatch.chdir(tmp_path)
    for path, text in (
        ("my maps/one map.txt", "S..\n.T.\n..G\n"),
        ("conf/agent/mine.yaml", AN_AGENT),
        (
            "conf/tune/mine.yaml",
            "# @package tune.space\nagent.learning_rate: {type: float, low: 0.1, high: 1}\n",
        ),
        ("conf/env/mine.yaml", yaml.safe_dump(content, sort_keys=False)),
    ):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(text)
    np.savez("my maps/tables.npz", start=[1.0, 0.0], **TABLES)
    words = ["agent=mine", "agent.gamma=0.9", f"env={world}"]
    if given != "in a file":
        words += [f"{'++' * isinstance(v, dict)}env.{k}={literal(v, k)}" for k, v in settings.items()]
    spec = compose_study(words, (Path("conf"),))
    winner = with_values(spec.base, {"agent.learning_rate": 0.3})
    Path("study").mkdir()
    write_recipe(Path("study"), spec.conf, spec.choices, winner, "a winner")
    again = compose(["recipe=study", "trust=true", "--config-dir=conf"])
    assert again == winner
    assert {key: getattr(again.env, key) for key in settings} == settings


def test_choices_that_need_each_other_are_no_mistake() -> None:
    base = configure("agent=ppo")  # 128 environments, so that a rollout is 128 times n_steps
    batch = {"agent.batch_size": DimensionConfig("categorical", choices=[384, 1024])}
    with pytest.raises(InputError, match=r"^agent\.batch_size=384"):
        SearchSpace(batch).check(base, check_settings(base))
    rollout = {"agent.n_steps": DimensionConfig("categorical", choices=[3, 16])}
    SearchSpace(batch | rollout).check(base, check_settings(base))


def test_lists_and_arguments_of_a_class_can_be_searched() -> None:
    nets = DimensionConfig("categorical", choices=[[64], [64, 64]])
    space = SearchSpace({"agent.policy_kwargs.net_arch": nets})
    base = configure("agent=ppo")
    space.check(base, check_settings(base))
    values = space.values(optuna.create_study().ask(space.distributions).params)
    assert with_values(base, values).agent.policy_kwargs.net_arch in nets.choices  # type: ignore[attr-defined, operator]
    space = SearchSpace({"agent.arguments.gae_lambda": DimensionConfig("float", low=0.5, high=1)})
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
    space = SearchSpace({key: dimension})
    found = space.parameters_of(configure("agent=q_learning", f"{key}={value}"))
    assert found == ({key: value} if is_inside else None)


@pytest.mark.parametrize(
    ("words", "together"),
    [
        (["agent=ppo", "tune.workers=1"], 1),
        (["agent=ppo", "tune.workers=1", "tune.together=5"], 5),
        (["agent=ppo", "tune.workers=2"], 4),
        (["agent=q_learning", "tune.workers=2", "tune.together=5"], 1),
    ],
)
def test_how_many_trials_train_together(words: list[str], together: int) -> None:
    assert compose_study(words).settings.together == together


RATES = (0.01, 0.02, 1e30, 0.005, 0.003)
ENDS = {1: 1, 3: 5, 4: 8}  # of these trials: in the first seed, in the second, at the beginning of the third


def reported(objective: Objective, rates: dict[int, float]) -> tuple[list[Outcome], list[Report]]:
    """How trials end that are behind at some point, and what was reported of them, in order."""
    reports: list[Report] = []

    def answer(report: Report) -> bool:
        reports.append(report)
        return report.can_prune and report.step >= ENDS.get(report.trial, 99)

    values = {number: {"agent.learning_rate": rate} for number, rate in rates.items()}
    trials = Trials(objective, {number: (each, objective.seeds) for number, each in values.items()})
    return trials(answer), sorted(reports, key=lambda report: (report.trial, report.step))


@pytest.mark.slow
def test_trials_and_seeds_that_train_together_are_those_that_train_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    base = configure(*SHORT["ppo"], "total_timesteps=1024", "evaluation.every=256")
    objective = Objective(base, (0, 1, 2), 4, None)
    outcomes, reports = reported(objective, dict(enumerate(RATES)))
    assert [len(outcome.seeds) for outcome in outcomes] == [3, 0, 0, 1, 2]
    assert [outcome.value is None for outcome in outcomes] == [False, True, True, True, True]
    assert ["diverged" in outcome.error for outcome in outcomes] == [False, False, True, False, False]
    twice = reported(Objective(base, (0,), 8, None), {0: RATES[0]})[1]  # as often as it is evaluated
    assert [report.can_prune for report in twice] == [False, True] * 4
    whole = [report for report in reports if report.trial == 0]
    assert [report.step for report in whole] == list(range(12))
    assert whole[-1].value == pytest.approx(outcomes[0].value)
    monkeypatch.setattr(objective_module, "run_together", lambda tasks: [run_alone(task) for task in tasks])
    alone = [reported(objective, {number: rate}) for number, rate in enumerate(RATES)]
    assert [outcome for found, _ in alone for outcome in found] == outcomes
    assert [report for _, found in alone for report in found] == reports
    assert outcomes[0].seeds == [
        run_alone(learning(objective.config({"agent.learning_rate": RATES[0]}), seed)) for seed in range(3)
    ]


class Inline(Processes):
    """In place of trials, a function of their values; None is for a task that has killed its processes."""

    def __init__(self, function: Callable[[Any, Callable[[Any], bool]], Outcome | None]) -> None:
        super().__init__(1, True)
        self._function = function

    def run(self, tasks: Any, ended: Any = None, tick: Any = None, answer: Any = None) -> None:
        for task in tasks:
            trials = task.trials.items()
            found = [self._function(values, answer_of(answer, name)) for name, (values, _) in trials]
            ended(task, LostError() if None in found else found)


def answer_of(answer: Any, number: int) -> Callable[[Any], bool]:
    return lambda point: answer(Report(number, *point, can_prune=True))


def asked(folder: Path, *words: str) -> tuple[StudySpec, optuna.Study]:
    """A search, and its study, which is begun or continued."""
    base = ("agent=q_learning", "total_timesteps=1500", "tune.seeds=2", "tune.workers=1")
    spec = compose_study([*base, f"tune.folder={folder}", *words])
    folder.mkdir(exist_ok=True)
    return spec, open_study(f"sqlite:///{folder / 'study.db'}", "one", {}, spec.space)


def outcome(value: float | None = None, error: str = "") -> Outcome:
    return Outcome(value, error, [SeedScore(0, 1, 0.0)])


def test_what_fails_is_a_trial_with_its_reason_and_the_study_goes_on(tmp_path: Path) -> None:
    answers = iter([outcome(0.5), outcome(error="too\nlarge"), None, outcome(0.25)])
    spec, study = asked(tmp_path, "tune.trials=4")
    search(spec, study, Inline(lambda *_: next(answers)))
    states = [TrialState.COMPLETE, TrialState.FAIL, TrialState.FAIL, TrialState.COMPLETE]
    assert [trial.state for trial in study.trials] == states
    table = (tmp_path / "trials.csv").read_text()
    assert "too large" in table
    assert "its workers were killed" in table


def test_a_study_whose_tables_were_cut_short_is_one_study(tmp_path: Path) -> None:
    """A kill between the table of studies and its index leaves names that need not be unique."""
    url, space = f"sqlite:///{tmp_path}/study.db", compose_study(["agent=q_learning"]).space
    optuna.storages.RDBStorage(url)
    with contextlib.closing(sqlite3.connect(tmp_path / "study.db")) as database:
        database.execute("DROP INDEX ix_studies_study_name")
        database.commit()
    for _ in range(3):
        open_study(url, "one", {}, space)
    assert optuna.get_all_study_names(url) == ["one"]


def test_a_trial_that_is_worse_than_the_median_is_pruned(tmp_path: Path) -> None:
    values = iter([0.5, 0.4, 0.6, 0.3, 0.7, 0.45, 0.55, 0.2, 0.46, 0.44])

    def function(_: Any, is_behind: Callable[[Any], bool]) -> Outcome:
        value = next(values)
        return outcome(None if max(is_behind((step, value)) for step in range(10)) else value)

    spec, study = asked(tmp_path, "tune.trials=10")
    search(spec, study, Inline(function))
    pruned = [trial.number for trial in study.trials if trial.state == TrialState.PRUNED]
    assert pruned == [6, 8]  # the medians before them are 0.475 and 0.45
    assert all(len(trial.intermediate_values) == 10 for trial in study.trials)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "killed"), [("tune.sampler=tpe", (0, 1)), ("tune.pruner=hyperband", (3, 11))]
)
def test_a_search_of_one_worker_is_the_same_however_it_was_stopped(
    word: str, killed: tuple[int, ...], tmp_path: Path
) -> None:
    def searched(name: str, kills: Sequence[int]) -> list[tuple[Any, ...]]:
        calls = itertools.count()

        def function(values: Any, is_behind: Callable[[Any], bool]) -> Outcome:
            rate = values["agent.learning_rate"]
            if max(is_behind((step, rate + step / 100)) for step in range(10)):
                return outcome()
            if next(calls) in kills:
                raise KeyboardInterrupt
            return outcome(error="too large") if rate > 0.9 else outcome(rate)

        for _ in range(len(kills) + 1):
            spec, study = asked(tmp_path / name, "tune.trials=14", word)
            with contextlib.suppress(KeyboardInterrupt):
                search(spec, study, Inline(function))
        return [told(trial) for trial in study.trials]

    calm = searched("calm", ())
    assert len(calm) == 14
    assert len({str(trial[1]) for trial in calm}) == 14
    assert searched("killed", killed) == calm


def test_after_a_kill_that_left_gaps_no_trial_is_drawn_twice(tmp_path: Path) -> None:
    """Of four trials at once the last one has ended; the first, the baseline, runs again."""

    class Killed(Inline):
        def run(self, tasks: Any, ended: Any = None, tick: Any = None, answer: Any = None) -> None:
            (last,) = itertools.islice(tasks, 3, 4)
            ended(last, [outcome(0.5)])
            raise KeyboardInterrupt

    words = ("tune.trials=6", "tune.sampler=random", "tune.workers=4", "tune.together=1")
    spec, study = asked(tmp_path, *words)
    with contextlib.suppress(KeyboardInterrupt):
        search(spec, study, Killed(lambda *_: None))
    spec, study = asked(tmp_path, *words)
    search(spec, study, Inline(lambda *_: outcome(0.25)))
    assert len({str(trial.params) for trial in study.trials}) == 6
    assert [trial.params == spec.space.parameters_of(spec.base) for trial in study.trials[:2]] == [
        False,
        True,
    ]


def told(trial: FrozenTrial) -> tuple[Any, ...]:
    return trial.state, trial.params, trial.values, trial.intermediate_values, trial.user_attrs.get("seeds")


def test_commands_that_share_a_study_draw_other_trials_and_know_of_each_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = f"tune.storage=sqlite:///{tmp_path}/study.db"
    spec, study = asked(tmp_path, "tune.trials=6", "tune.sampler=random", storage)
    turns = itertools.count()

    def function(values: Any, is_behind: object) -> Outcome:
        if next(turns) == 2:
            monkeypatch.setattr("os.getpid", lambda: 1)  # another command, perhaps on the same machine
            search(spec, study, Inline(lambda values, _: outcome(values["agent.learning_rate"])))
        return outcome(values["agent.learning_rate"])

    search(spec, study, Inline(function))
    assert len(study.trials) == 7  # one ran here while the other machine came to six
    assert len({str(trial.params) for trial in study.trials}) == 7
    assert len({trial.user_attrs["worker"] for trial in study.trials}) == 2
    assert max(trial.number for trial in choose_finalists(study, spec)) < 6


def test_a_final_run_that_fails_is_named_and_counted_as_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec, study = asked(tmp_path, "tune.trials=1", "tune.final_seeds=3")
    search(spec, study, Inline(lambda values, _: outcome(0.1)))

    results = iter([Outcome(error="training diverged"), Outcome(0.1, "", [SeedScore(3, 100, 0.0)]), None])
    ranked = rank_finalists(spec, study, choose_finalists(study, spec), Inline(lambda *_: next(results)))
    (finalist,) = ranked
    error = capsys.readouterr().err
    assert "trial=0,seed=2 failed, and counts as not certified: training diverged\n" in error
    assert "trial=0,seed=4 failed, and counts as not certified: its workers were killed\n" in error
    assert (finalist.certified, finalist.seeds, finalist.failed) == (2, 4, 2)
    assert rank_finalists(spec, study, study.trials, Inline(lambda *_: next(results))) == ranked


@dataclasses.dataclass(frozen=True)
class Killed:
    """Kills its worker as often as asked, each time but the last noted in a file; then returns its name."""

    name: str
    times: int
    folder: Path

    def __call__(self, ask: Any) -> str:
        marks = len(list(self.folder.glob(f"{self.name}-*")))
        if marks < self.times:
            (self.folder / f"{self.name}-{marks}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return f"{self.name} {ask(self.name)}"


def test_a_task_whose_worker_is_killed_is_run_again_until_it_has_killed_four(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tasks = [Killed("never", 0, tmp_path), Killed("once", 1, tmp_path), Killed("ever", 9, tmp_path)]
    found = {}
    Processes(2, forks=True, attempts=4).run(
        tasks,
        lambda task, result: found.update({task.name: str(result)}),
        answer=lambda message: f"heard {message}",
    )
    assert found == {"never": "never heard never", "once": "once heard once", "ever": "exit code -9"}
    assert capsys.readouterr().err.count("a worker died (exit code -9)") == 5


@given(st.integers(1, 40), st.integers(0, 80), st.booleans())
def test_workers_share_all_runs(count: int, runs: int, can_join: bool) -> None:
    shares = list(Processes(count, True).shares(range(runs), can_join))
    assert [run for share in shares for run in share] == list(range(runs))
    assert max(map(len, shares), default=1) <= (32 if can_join else 1)
    assert len(shares) <= max(count, math.ceil(runs / (32 if can_join else 1)))


def results(*steps: float) -> HeldOutResults:
    return HeldOutResults(np.array(steps, dtype=np.float64), TOTAL)


def test_held_out_runs_of_other_settings_are_other_runs(tmp_path: Path) -> None:
    def names(*words: str) -> list[str]:
        found = held_out_runs(tmp_path, "default", configure("agent=q_learning", *words), range(3, 6), ())
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


UNCLEAR = "cannot be distinguished from"


@pytest.mark.parametrize(
    ("winner", "began_from", "verdict"),
    [
        ((100, 110, 120, 130, 140, 150), (500, 510, 520, 530, 540, math.inf), "beats"),
        ((500, 510, 520, 530, 540, math.inf), (100, 110, 120, 130, 140, 150), "does not beat"),
        ((*[10] * 7, math.inf), [80] * 8, UNCLEAR),
        ((100, 200, 300, 400), (110, 190, 310, 390), UNCLEAR),
        ((math.inf, math.inf), (math.inf, math.inf), UNCLEAR),
        # A share that is surely greater decides, whoever is sooner.
        (around(20, 550), around(10, 250), "beats"),
        (around(10, 250), around(20, 550), "does not beat"),
        # One that may be as great leaves the decision to time, unless it leans the other way.
        (around(19, 110), around(20, 850), UNCLEAR),
        (around(19, 850), around(20, 110), "does not beat"),
        (around(20, 110), around(19, 850), "beats"),
        (around(20, 110), around(20, 850), "beats"),
    ],
)
def test_the_verdict(winner: Sequence[float], began_from: Sequence[float], verdict: str) -> None:
    found = verdict_on(results(*winner), results(*began_from))
    assert found["verdict"] == verdict
    assert f"held-out seeds the winner {verdict} the baseline" in found["sentence"]


def test_the_verdict_says_which_runs_it_is_without(tmp_path: Path) -> None:
    config = configure("agent=q_learning")
    before, winner = (held_out_runs(tmp_path, name, config, range(6), ()) for name in ("default", "trial=3"))
    maker = Maker("agent=q_learning")
    for run in [*before, *winner]:
        maker.write(run.folder, run.config.seed, 3000)
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
    found = verdict_on(read_results(winner), read_results(before))
    names = ", ".join(run.folder.name for run in winner[:4])
    assert found["sentence"].startswith("On 6 held-out seeds the winner ")
    assert "certified on 2 of 2 [34 %, 100 %], for good from step 3,000" in found["sentence"]
    assert f"(4 of 6 left out, without a result: {names})" in found["sentence"]
    assert f"(1 failed and count as not certified: {before[0].folder.name})" in found["sentence"]
    assert found["winner"]["left_out"] == tuple(run.folder.name for run in winner[:4])
    for run in winner:
        shutil.rmtree(run.folder, ignore_errors=True)
    with pytest.raises(InputError, match="no held-out run has a result"):
        read_results(winner)


ABOUT = {"objective": {"seeds": [0, 1]}}
TWO = SearchSpace(
    {
        "agent.gamma": DimensionConfig(type="categorical", choices=[0.9, 0.99]),
        "agent.learning_rate": DimensionConfig(type="float", low=0.1, high=0.9),
    }
)


@pytest.fixture(scope="module")
def sqlite_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With two complete trials."""
    file = tmp_path_factory.mktemp("study") / "study.db"
    study = open_study(f"sqlite:///{file}", "mine", ABOUT, TWO)
    params = {"agent.gamma": 0.9, "agent.learning_rate": 0.5}
    own: Any = {"seeds": [dataclasses.asdict(SeedScore(seed, 500, 0.25)) for seed in (0, 1)]}
    for value in (0.25, 1.25):
        trial = create_trial(params=params, distributions=TWO.distributions, value=value, user_attrs=own)
        study.add_trial(trial)
    open_study(f"sqlite:///{file}", "mine", ABOUT, TWO)
    return file


@pytest.mark.parametrize(("what", "statement"), refused("altered database"))
def test_a_study_whose_database_was_altered_is_refused_in_a_sentence(
    what: str, statement: str, sqlite_study: Path, tmp_path: Path
) -> None:
    shutil.copy(sqlite_study, tmp_path / "study.db")
    with contextlib.closing(sqlite3.connect(tmp_path / "study.db")) as database, database:
        database.execute(statement)
    with pytest.raises(InputError, match=r"^tune\.(storage|study)=.*") as caught:
        open_study(f"sqlite:///{tmp_path / 'study.db'}", "mine", ABOUT, TWO, must_exist=True)
    assert "\n" not in str(caught.value)
