"""From a sweep's command line to its jobs: which there are, when two are the same, what they are called."""

import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from helpers.support import CONF, SHORT, configure
from hydra import initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hypothesis import given
from hypothesis import strategies as st

from gridworld.config.composition.compose import register_schemas
from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import read_run
from gridworld.run.writer import RunWriter
from gridworld.sweep.plan import Job, expand, folder_name, plan
from gridworld.training.setup import check_settings


@pytest.fixture
def loader() -> Iterator[ConfigLoader]:
    register_schemas()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield GlobalHydra.instance().config_loader()


def lines(loader: ConfigLoader, *words: str, most: int = 1000) -> list[str]:
    return [" ".join(overrides) for overrides, _ in expand(words, loader, most)]


def hashes(*jobs: Sequence[str]) -> list[str]:
    return [plan([(list(job), [])], lambda words: configure(*words))[0].hash for job in jobs]


def test_every_combination_is_a_job(loader: ConfigLoader) -> None:
    jobs = expand(["agent=dqn,ppo", "seed=range(2)", "n_envs=8"], loader, 1000)
    assert jobs == [
        ([f"agent={agent}", f"seed={seed}", "n_envs=8"], [f"agent={agent}", f"seed={seed}"])
        for agent in ("dqn", "ppo")
        for seed in (0, 1)
    ]
    assert lines(loader, "env=glob(frozen_lake_?x?)", "seed=choice(3,1)") == [
        f"env=frozen_lake_{size} seed={seed}" for size in ("4x4", "8x8") for seed in (3, 1)
    ]
    assert lines(loader, "seed=range(1,8,3)") == ["seed=1", "seed=4", "seed=7"]
    assert lines(loader, "+agent.policy_kwargs.net_arch=[64,64],[8]") == [
        "+agent.policy_kwargs.net_arch=[64,64]",
        "+agent.policy_kwargs.net_arch=[8]",
    ]
    assert lines(loader, "env.layout='a,b.txt'", "seed=1", "seed=2") == ["env.layout='a,b.txt' seed=2"]
    assert lines(loader) == [""]


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("seed=range(0)", "seed=range(0): there is nothing in it"),
        ("seed=range(5,5)", "there is nothing in it"),
        ("env=glob(mars*)", "there is nothing in it"),
        ("seed=range(1001)", "1,001 jobs; if so many are meant, add hydra.sweeper.max_jobs=1001"),
        ("seed=range(1000000000)", "more than 1,000,000 values"),
        ("seed=interval(0,1)", "jobs are made of a list"),
    ],
)
def test_what_makes_no_sweep_is_refused(loader: ConfigLoader, word: str, sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        expand([word], loader, 1000)


def test_jobs_are_the_same_if_the_same_settings_come_out(tmp_path: Path) -> None:
    map_file = tmp_path / "map.txt"
    map_file.write_text("S..\n..G\n")
    plain, spelled, logged, other, in_a_file = hashes(
        ["agent=q_learning"],
        ["agent=q_learning", "seed=0", "env=classic", "agent.gamma=0.900"],
        ["agent=q_learning", "logging.tensorboard=false", "recording.gif=false"],
        ["agent=q_learning", "seed=1"],
        ["agent=q_learning", f"env.layout={map_file}"],
    )
    assert plain == spelled == logged
    assert len({plain, other, in_a_file}) == 3
    map_file.write_text("S..\n.TG\n")
    assert hashes(["agent=q_learning", f"env.layout={map_file}"]) != [in_a_file]


@pytest.mark.parametrize("agent", SHORT)
def test_a_manifest_has_the_settings_of_its_job(agent: str, tmp_path: Path) -> None:
    """By which a sweep knows a run that is no longer the job's."""
    words = SHORT[agent]
    config = configure(*words)
    RunWriter.start(tmp_path, dataclasses.asdict(config), check_settings(config), words)
    manifest = read_run(tmp_path).manifest
    assert [settings_hash(manifest["config"], "\n".join(manifest["layout"]))] == hashes(words)


def test_a_sweep_runs_the_same_job_once_and_knows_mistakes() -> None:
    jobs = plan(
        [([f"seed={seed}"], [f"seed={seed}"]) for seed in ("0", "1", "0", "-1")],
        lambda words: configure(*words),
    )
    assert [job.overrides for job in jobs] == [("seed=0",), ("seed=1",), ("seed=-1",)]
    assert [job.mistake for job in jobs] == [None, None, "seed=-1: must be from 0 to 4294967295"]


def job(*overrides: str, swept: Sequence[str] = (), digest: str = "0123456789abcdef") -> Job:
    return Job(overrides, tuple(swept), digest, None, TrainConfig())


def test_a_folder_is_named_by_what_makes_its_job_different() -> None:
    assert folder_name(job("agent=dqn", "seed=3", "n_envs=8", swept=["agent=dqn", "seed=3"]), ()) == (
        "agent=dqn,seed=3"
    )
    assert folder_name(job("agent=dqn", "seed=3"), ()) == "agent=dqn,seed=3"
    assert folder_name(job(), ()) == "job"
    assert folder_name(job("env.layout=maps/my map.txt"), ()) == "env.layout=my-map"
    assert folder_name(job("+a.b={c: 1e-5}", "~d"), ()) == "a.b=-c-1e-5,d"
    assert folder_name(job("agent=ppo", "seed=3", swept=["seed=3"]), {"seed=3"}) == "agent=ppo,seed=3"
    assert folder_name(job("seed=3", swept=["seed=3"]), {"seed=3"}) == "seed=3,012345"


words = st.text(st.characters(min_codepoint=32, max_codepoint=300), max_size=80)


@given(st.lists(st.tuples(words, words), max_size=6), st.integers(0, 2**32), st.lists(words, max_size=3))
def test_a_folders_name_is_safe_short_free_and_keeps_the_seed(
    pairs: list[tuple[str, str]], seed: int, taken: list[str]
) -> None:
    overrides = [f"{key}={value}" for key, value in pairs] + [f"seed={seed}"]
    first = folder_name(job(*overrides), {name.lower() for name in taken})
    second = folder_name(job(*overrides, digest="fedcba9876543210"), {first.lower()})
    assert first.lower() != second.lower()
    for name in (first, second):
        assert re.fullmatch(r"[A-Za-z0-9_.=+,-]{1,100}", name)
        assert name not in (".", "..")
        assert f"seed={seed}" in name
