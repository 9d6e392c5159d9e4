"""From a sweep's command line or yaml to its jobs: which there are, what they are, what they are called."""

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from helpers.support import CONF, SHORT, composed, configure, script
from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import DictConfig

from gridworld.base.errors import InputError
from gridworld.base.safe_read import read_object
from gridworld.config.compose import register_schemas, to_config
from gridworld.config.train import TrainConfig
from gridworld.run.provenance import settings_hash
from gridworld.run.reader import read_run
from gridworld.run.writer import RunWriter
from gridworld.sweeps import plan as sweep_plan
from gridworld.sweeps.folder import folder_name
from gridworld.sweeps.plan import Configurations, Job, expand, largest_population, plan, populations
from gridworld.training.setup import check_settings


@pytest.fixture
def loader() -> Iterator[ConfigLoader]:
    register_schemas()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield GlobalHydra.instance().config_loader()
    HydraConfig.instance().cfg = None


def lines(loader: ConfigLoader, *words: str) -> list[str]:
    return [" ".join(overrides) for overrides, _ in expand(words, loader, 1000)]


def hashes(*jobs: Sequence[str]) -> list[str]:
    return [plan([(list(job), [])], composed)[0].hash for job in jobs]


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
    def of(*lines: str) -> list[Job]:
        return plan([(line.split(), line.split()) for line in lines], composed)

    jobs = of("seed=0", "seed=1", "seed=0", "seed=-1")
    assert [job.overrides for job in jobs] == [("seed=0",), ("seed=1",), ("seed=-1",)]
    assert [job.mistake for job in jobs] == [None, None, "seed=-1: must be from 0 to 4294967295"]
    assert [job.notes for job in jobs] == [(), (), ()]
    (job,) = of("tuned=none seed=0", "preset=auto seed=0")
    assert job.notes[-1] == "preset=auto repeats the runs of tuned=none; they run once"


def job(*overrides: str, swept: Sequence[str] = (), digest: str = "0123456789abcdef") -> Job:
    return Job(overrides, tuple(swept), digest, None, TrainConfig())


def test_a_folder_is_named_by_what_makes_its_job_different() -> None:
    two = ["agent=dqn", "seed=3"]
    assert folder_name(job(*two, "n_envs=8", swept=two), ()) == "agent=dqn,seed=3"
    assert folder_name(job(*two), ()) == "agent=dqn,seed=3"
    assert folder_name(job(), ()) == "job"
    assert folder_name(job("env.layout=maps/my map.txt"), ()) == "env.layout=my-map"
    assert folder_name(job("+a.b={c: 1e-5}", "~d"), ()) == "a.b=-c-1e-5,d"
    assert folder_name(job("agent=ppo", "seed=3", swept=["seed=3"]), {"seed=3"}) == "agent=ppo,seed=3"
    assert folder_name(job("seed=3", swept=["seed=3"]), {"seed=3"}) == "seed=3,012345"


@pytest.mark.parametrize(
    ("population", "launcher", "device", "files", "sizes"),
    [
        (8, "forks", "cpu", 1000, [4, 3, 3]),
        (8, "forks", "cuda", 1000, [5, 5]),  # which no fork takes
        ("auto", "forks", "cuda", 1000, [10]),
        (10, "basic", "cpu", 10, [1] * 10),  # so few may be open
        (10, "basic", "cpu", 90, [5, 5]),
        (10, "basic", "cpu", 114, [10]),
    ],
)
def test_jobs_are_divided_into_populations(
    population: int | str,
    launcher: str,
    device: str,
    files: int,
    sizes: list[int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sweep_plan, "file_limit", lambda: files)
    config = configure("agent=ppo", f"device={device}")
    jobs = [Job((), (), str(number), None, config) for number in range(10)]
    groups = populations(jobs, largest_population(population), launcher, {"n_jobs": 4})
    assert sorted(map(len, groups), reverse=True) == sizes
    assert [job for group in groups for job in group] == jobs


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


def master_of(loader: ConfigLoader, *words: str) -> DictConfig:
    return loader.load_configuration("train", list(words), RunMode.MULTIRUN)


@pytest.mark.parametrize(
    ("words", "composed"),
    [
        ([], 1),
        (["agent=ppo,q_learning", "env.slip=0,0.1", "seed=0,1"], 2),
        (["env=maze", "agent=q_learning", "agent.learning_rate=lin_0.5,0.25", "seed=1,2"], 1),
        (["agent=a2c", "+agent.arguments.max_grad_norm=0.5", "seed=0,1", "observation=coordinates"], 1),
        (["agent.gamma=0.1,0.2", "agent.policy_kwargs.net_arch=[8,8]", "agent=dqn", "++n_envs=4"], 2),
        (["agent.gamma=0.1,0.2", "agent={gamma: 0.5}", "env.layout='my map.txt'"], 2),
        (["n_envs=${seed}", "seed=1,2,3"], 1),  # it follows from the seed
    ],
)
def test_each_job_is_what_hydra_composes(
    loader: ConfigLoader, words: list[str], composed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_hydra: list[list[str]] = []
    load = type(loader).load_sweep_config

    def counted(self: ConfigLoader, master: DictConfig, words: list[str]) -> DictConfig:
        by_hydra.append(words)
        return load(self, master, words)

    monkeypatch.setattr(type(loader), "load_sweep_config", counted)
    configure = Configurations(loader, master_of(loader))
    jobs = [overrides for overrides, _ in expand(words, loader, 100)]
    configs = [configure(job)[0] for job in jobs]
    assert len(by_hydra) == composed
    assert configs == [to_config(compose("train", job)) for job in jobs]


GRID = """\
# @package _global_
defaults: [{override /agent: q_learning}]
total_timesteps: 300
recording: {frames: false, gif: false, learning: false}
hydra:
  mode: MULTIRUN
  sweeper:
    params: {seed: range(2), agent.learning_rate: "0.1,0.2", env: "classic,cliff", n_envs: 4}
    paired: [agent.learning_rate, env]
"""
OTHER = "# @package _global_\nhydra: {sweeper: {params: {seed: '0,1'}}}\n"
NO_TEXT = "# @package _global_\nhydra: {sweeper: {params: {seed: [0, 1]}}}\n"


@pytest.fixture(scope="module")
def conf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conf")
    (folder / "experiment").mkdir()
    for name, text in {"grid": GRID, "other": OTHER, "no_text": NO_TEXT}.items():
        (folder / "experiment" / f"{name}.yaml").write_text(text)
    return folder


def test_a_yaml_says_what_is_swept_and_that_it_is_a_sweep(conf: Path, tmp_path: Path) -> None:
    words = ["--config-dir", str(conf), "experiment=grid", "hydra.sweep.dir=sweep"]
    done = script("train.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    names = {path.parent.name for path in tmp_path.glob("sweep/*/summary.json")}
    pairs = ("agent.learning_rate=0.1,env=classic", "agent.learning_rate=0.2,env=cliff")
    assert names == {f"seed={seed},{pair}" for seed in (0, 1) for pair in pairs}
    config = read_object(tmp_path / "sweep" / min(names) / "manifest.json")["config"]
    assert (config["total_timesteps"], config["n_envs"]) == (300, 4)

    words[2:3] = ["-m", "experiment=grid", "seed=1", "total_timesteps=300"]  # the command line goes before
    again = script("train.py", *words, cwd=tmp_path)
    assert "2 jobs: 2 done; 0 to run" in again.stderr + again.stdout, again.stderr


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("experiment=grid env=maze", "[agent.learning_rate,env]: env has no list of values; add"),
        ("experiment=other,maze_dqn", "hydra.sweeper: is set by only some of the jobs"),
        ("experiment=no_text", "hydra.sweeper.params.seed: must be text as on the command line, such as 0,1"),
        ("hydra.sweep.subdir=x seed=0", "hydra.sweep.subdir=x: a sweep names the folders of its jobs by"),
    ],
)
def test_a_yaml_that_cannot_be_swept_is_refused(
    words: str, told: str, conf: Path, tmp_path: Path, refusal: Callable[[str], str]
) -> None:
    assert told in refusal(f"train.py --config-dir {conf} -m {words}")
    assert list(tmp_path.rglob("*.*")) == []


def test_lists_that_vary_together(loader: ConfigLoader) -> None:
    words = ["agent=dqn,ppo", "device=cpu", "seed=0,1", "+n_envs=2,4", "threads=3,4"]
    found = [" ".join(job) for job, _ in expand(words, loader, 8, ["agent", "n_envs"])]
    assert found == [
        f"agent={agent} device=cpu seed={seed} +n_envs={n_envs} threads={threads}"
        for agent, n_envs in (("dqn", 2), ("ppo", 4))
        for seed in (0, 1)
        for threads in (3, 4)
    ]
    jobs = expand(words, loader, 4, [["threads", "seed"], ["n_envs", "agent"]])
    assert [" ".join(job) for job, _ in jobs] == [
        f"agent={agent} device=cpu seed={seed} +n_envs={n_envs} threads={threads}"
        for agent, n_envs in (("dqn", 2), ("ppo", 4))
        for seed, threads in ((0, 3), (1, 4))
    ]
    assert jobs[0][1] == ["agent=dqn", "seed=0", "+n_envs=2", "threads=3"]


@pytest.mark.parametrize(
    ("paired", "told"),
    [
        (["agent", "seed"], "[agent,seed]: lists that vary together must have equal lengths; agent has 2, "),
        (["agent", "n_envs"], "[agent,n_envs]: n_envs has no list of values; add n_envs=A,B"),
        ([["agent", "env"], ["env", "agent"]], "[env,agent]: must name two settings or more"),
        ([1, 2], "[1,2]: 1 has no list of values"),
    ],
)
def test_pairs_that_cannot_be_are_refused(loader: ConfigLoader, paired: list[object], told: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"hydra.sweeper.paired={told}")):
        expand(["agent=dqn,ppo", "env=maze,cliff", "n_envs=3", "seed=0,1,2"], loader, 100, paired)
