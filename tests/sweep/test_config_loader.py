"""Jobs composed as Hydra composes them, by internals of Hydra that are checked one by one."""

import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.support import CONF
from hydra import __version__ as hydra_version
from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from gridworld.config.composition import loader as composition_loader
from gridworld.config.composition.compose import register_schemas, to_config
from gridworld.errors import InputError
from gridworld.sweep.config_loader import Configurations, SweepLoader
from gridworld.sweep.plan import expand

WHAT_TO_DO = (
    f"Hydra {hydra_version} changed an internal that gridworld/sweep/config_loader.py, or "
    "gridworld/config/composition/loader.py, composes with. "
    "Adapt SweepLoader to it, or let its load_sweep_config call Hydra's own, which takes 50 ms a job; until "
    "then, keep this version out of the range of hydra-core in pyproject.toml."
)
SIGNATURES = {
    "ConfigLoaderImpl": "(config_search_path)",
    "ConfigLoaderImpl.load_sweep_config": "(self, master_config, sweep_overrides)",
    "ConfigLoaderImpl.get_search_path": "(self)",
    "ConfigLoaderImpl._apply_overrides_to_config": "(overrides, cfg)",
    "get_overrides_dirname": "(overrides, exclude_keys, item_sep, kv_sep)",
    "ConfigLoaderImpl.load_configuration": (
        "(self, config_name, overrides, run_mode, from_shell, validate_sweep_overrides)"
    ),
    "ConfigLoaderImpl._load_single_config": "(self, default, repo)",
}


@pytest.fixture
def loader() -> Iterator[ConfigLoader]:
    register_schemas()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        yield GlobalHydra.instance().hydra.config_loader  # type: ignore[union-attr]


def test_hydra_has_the_internals_that_jobs_are_composed_with(loader: ConfigLoader) -> None:
    try:
        from hydra._internal import config_loader_impl as internals
    except ImportError as error:
        pytest.fail(f"{error}. {WHAT_TO_DO}")
    for name, expected in SIGNATURES.items():
        found: object = internals
        for part in name.split("."):
            found = getattr(found, part, None)
        assert callable(found), f"There is no {name}. {WHAT_TO_DO}"
        signature = f"({', '.join(inspect.signature(found).parameters)})"
        assert signature == expected, f"{name}{signature} was {name}{expected}. {WHAT_TO_DO}"
    exists = getattr(getattr(loader, "repository", None), "group_exists", None)
    assert callable(exists), f"A loader has no repository.group_exists. {WHAT_TO_DO}"
    assert (exists("agent"), exists("seed")) == (True, False), WHAT_TO_DO


def test_hydra_composes_only_to_know_the_mode_before_it_composes() -> None:
    """What `gridworld.config.composition.loader` replaces: the class that is looked up, and its question."""
    from hydra._internal import utils
    from hydra._internal.hydra import Hydra

    assert str(inspect.signature(Hydra.__init__)).startswith("(self, task_name: str, config_loader: "), (
        WHAT_TO_DO
    )
    assert list(inspect.signature(Hydra.get_mode).parameters) == ["self", "config_name", "overrides"], (
        WHAT_TO_DO
    )
    source = inspect.getsource(utils._run_hydra)
    for line in (
        "from .hydra import Hydra",
        "Hydra.create_main_hydra2(",
        "run_mode = hydra.get_mode(config_name=config_name, overrides=overrides)",
    ):
        assert line in source, WHAT_TO_DO
    assert "if mode is None:\n        if run:\n            mode = RunMode.RUN" in inspect.getsource(
        utils._run_app
    )
    assert "return cls(" in inspect.getsource(Hydra) or "cls(task_name=" in inspect.getsource(Hydra), (
        WHAT_TO_DO
    )


@pytest.mark.parametrize(
    ("word", "yaml", "asked"),
    [
        ("seed=3", "seed: 3", False),
        ("hydra.run.dir=runs/models", "agent: {model: 1}  # modern", False),
        ("hydra.mode=MULTIRUN", "", True),
        ("hydra={mode: MULTIRUN}", "", True),
        ("+hydra={a: b}", "", True),
        ("experiment@hydra=x", "", True),
        ("hydra.searchpath=[file://x]", "", True),
        ("seed=3", "hydra: {mode: MULTIRUN}", True),
        ("seed=3", '"hydra": {"m\\x6fde": MULTIRUN}', True),
        ("seed=3", "hydra: {searchpath: [file://x]}", True),
    ],
)
def test_hydra_is_asked_for_the_mode_where_something_may_set_it(
    word: str, yaml: str, asked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hydra._internal.hydra import Hydra
    from hydra._internal.utils import create_automatic_config_search_path

    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "mine.yaml").write_text(yaml)
    monkeypatch.setattr(Hydra, "get_mode", lambda *_: RunMode.MULTIRUN)
    app = composition_loader._Hydra.__new__(composition_loader._Hydra)
    for folder, found in ((tmp_path, RunMode.MULTIRUN if asked else None), (CONF, None)):
        path = create_automatic_config_search_path(None, "x", str(folder))
        app.config_loader = composition_loader.Loader(ConfigLoaderImpl(path))
        words = [word] if folder == tmp_path else ["agent=dqn"]  # of the files in conf/ none may set it
        assert app.get_mode("train", words) == found
    path.append("plugin", "pkg://somebody.conf")
    app.config_loader = composition_loader.Loader(ConfigLoaderImpl(path))
    assert app.get_mode("train", ["agent=dqn"]) is RunMode.MULTIRUN


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["agent=ppo", "seed=3", "hydra.sweep.subdir='a=1,b=2'"],
        ["agent=q_learning", "env=maze", "agent.learning_rate=lin_0.5", "env.slip=0.25"],
        ["agent=a2c", "+agent.arguments.max_grad_norm=0.5", "observation=coordinates"],
        ["agent.policy_kwargs.net_arch=[8,8]", "seed=1", "agent=dqn", "++n_envs=4"],
        ["agent={gamma: 0.5}", "env.layout='my map.txt'"],
    ],
)
def test_jobs_are_composed_as_hydra_does_it(loader: ConfigLoader, overrides: list[str]) -> None:
    known_in_a_job = "hydra.job.id=${hydra.job.num}"
    words = ["n_envs=2", "hydra.sweep.dir=x", known_in_a_job]
    master = loader.load_configuration("train", words, RunMode.MULTIRUN)
    quick = SweepLoader(loader)

    def plain(config: DictConfig) -> object:
        return OmegaConf.to_container(config, resolve=False, enum_to_str=True)

    for _ in range(2):  # afresh, and from what is kept
        ours = quick.load_sweep_config(master, overrides)
        theirs = loader.load_sweep_config(master, overrides)
        assert plain(ours) == plain(theirs), WHAT_TO_DO
        assert OmegaConf.get_type(ours, "agent") is OmegaConf.get_type(theirs, "agent"), WHAT_TO_DO
        settings = quick.load_settings(master, overrides)
        with open_dict(theirs), read_write(theirs):
            del theirs["hydra"]
        assert plain(settings) == plain(theirs), WHAT_TO_DO
        assert OmegaConf.to_object(settings) == OmegaConf.to_object(theirs), WHAT_TO_DO
        assert plain(settings) == plain(compose("train", overrides)), WHAT_TO_DO


@pytest.mark.parametrize(
    ("word", "job", "sentence"),
    [
        ("hydra.sweep.subdir=mine", "seed=0", r"hydra.sweep.subdir=mine: a sweep names the folders of its"),
        ("hydra.sweep.subdir=${seed}", "seed=0", r"hydra.sweep.subdir=\$\{seed\}: a sweep names"),
        ("seed=1", "experiment=subdir", r"hydra.sweep.subdir=mine: a sweep names"),
        ("seed=1", "experiment=dir", r"hydra.sweep.dir=mine: stands in a file that only some of the jobs"),
    ],
)
def test_folders_that_the_sweep_would_not_use_are_refused(
    loader: ConfigLoader, word: str, job: str, sentence: str, tmp_path: Path
) -> None:
    (tmp_path / "experiment").mkdir()
    for key in ("dir", "subdir"):
        text = f"# @package _global_\nhydra: {{sweep: {{{key}: mine}}}}\n"
        (tmp_path / "experiment" / f"{key}.yaml").write_text(text)
    words = [f"hydra.searchpath=[file://{tmp_path}]", word]
    master = loader.load_configuration("train", words, RunMode.MULTIRUN)
    with pytest.raises(InputError, match=sentence):
        SweepLoader(loader).load_settings(master, [job])
    for allowed in ("hydra.sweep.dir=mine", "hydra.sweep.subdir=${hydra.job.num}"):
        master = loader.load_configuration("train", [words[0], allowed], RunMode.MULTIRUN)
        assert SweepLoader(loader).load_settings(master, ["seed=3"]).seed == 3


@pytest.mark.parametrize(
    ("words", "compositions"),
    [
        (["agent=ppo,q_learning", "env.slip=0,0.1", "seed=range(3)"], 4),
        (["seed=range(3)", "agent=ppo,q_learning"], 2),
        (["agent.learning_rate=0.1,0.2", "agent=q_learning"], 2),
        (["n_envs=${seed}", "seed=1,2,3"], 3),  # it follows from the seed
        (["seed=${n_envs}", "n_envs=1,2"], 2),
        (["seed=3", "agent=ppo,q_learning"], 2),
    ],
)
def test_jobs_that_differ_in_the_seed_only_are_composed_once(
    loader: ConfigLoader, words: list[str], compositions: int
) -> None:
    master = loader.load_configuration("train", [], RunMode.MULTIRUN)
    composed: list[list[str]] = []

    class Counted(SweepLoader):
        def load_settings(self, master_config: DictConfig, sweep_overrides: list[str]) -> DictConfig:
            composed.append(sweep_overrides)
            return super().load_settings(master_config, sweep_overrides)

    configure = Configurations(Counted(loader), master)
    jobs = [overrides for overrides, _ in expand(words, loader, 100)]
    configs = [configure(job) for job in jobs]
    assert len(composed) == compositions
    for job, config in zip(jobs, configs, strict=True):
        assert config == to_config(SweepLoader(loader).load_settings(master, job))
