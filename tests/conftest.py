"""Settings for all tests: no screen, the same examples on every run, and how processes share the tests."""

import gc
import logging
import os
import signal
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # before pygame is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a second thread waits busily for the next product

import pytest
from helpers.quickly import compose_quickly
from hypothesis import settings

from gridworld.base import console
from gridworld.base.workarounds import keep_compiler_out

# The package and the tests are compiled once, not in every process.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a background job
    signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).resolve().parents[1]
console._SECONDS_BETWEEN_LINES = 600.0  # no line says that something takes long, as on a busy machine it may
settings.register_profile("gridworld", derandomize=True, deadline=None, database=None, max_examples=30)
settings.load_profile("gridworld")


@pytest.fixture(autouse=True)
def _environment() -> Iterator[None]:
    """What a test, or the program in it, does to the environment variables ends with the test."""
    before = dict(os.environ)
    yield
    os.environ.clear()
    os.environ.update(before)


@pytest.fixture
def refusal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Iterator[Callable[[str], str]]:
    """The sentence that a command line in `tmp_path` is refused with, by a command in this process."""
    from gridworld import commands
    from gridworld.commands import train

    logger = logging.getLogger()
    handlers, level = logger.handlers[:], logger.level

    def sentence_of(line: str) -> str:
        name, *words = line.split()
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("sys.argv", [str(ROOT / "scripts" / name), *words])
        monkeypatch.setattr(commands, "prepare", lambda: None)
        monkeypatch.setattr(train, "_job_started", threading.Event())
        with pytest.raises(SystemExit) as ended:
            commands.call(name.removesuffix(".py"))
        told = capsys.readouterr()
        assert (ended.value.code, told.out) == (2, "")
        return told.err.strip().splitlines()[-1]

    yield sentence_of
    logger.handlers, logger.level = handlers, level  # Hydra has its own


# One after the other: clusters and kills at random moments; and browsers.
IN_TURN = {
    "clusters": ("sweep/test_sweep_cluster.py", "sweep/test_sweep_kills.py"),
    "browsers": ("training/test_tensorboard.py", "report/test_report_page.py"),
    "playground": ("playground/test_numbers.py", "playground/test_page.py"),
}
# What takes more than ten seconds of a processor, the longest first.
LONG = (
    *("clusters", "tests/test_docs.py", "commands/test_settings_of_strangers.py", "api/test_certificates.py"),
    *("docs/test_atlas.py", "commands/test_hostile_runs.py", "checking/test_functions.py"),
    *("course/test_course.py", "commands/test_own_environments.py", "docs/test_examples.py"),
    *("diagnosis/test_sabotage.py", "door/test_sixty_environments.py", "config/test_recipe_rule.py"),
    *("door/test_door.py", "world/test_solver.py", "api/test_worlds.py", "commands/test_play.py"),
    *("sweep/test_sweep_population.py", "sweep/test_sweep.py", "sources/test_enumerated.py"),
    *("tune/test_tune.py", "browsers", "playground", "config/test_recipes.py", "tune/test_tune_parts.py"),
    "engine/test_populations.py",
    *("report/test_report.py", "config/test_config.py", "commands/test_bad_input.py"),
    *("commands/test_commands.py", "process/test_output.py"),
    *("restore/test_reproduce.py", "restore/test_resume.py", "checking/test_check.py"),
    *("examining/test_examine.py", "restore/test_resume_commands.py", "sources/test_chance.py"),
    "commands/test_train_on_worlds.py",
    *("export/test_export.py", "training/test_training.py"),
    *("agents/sb3/test_custom_code.py", "engine/test_updates.py", "restore/test_resume_states.py"),
    *("commands/test_console.py", "docs/test_site.py", "course/test_grade.py"),
    *("agents/tabular/test_tabular.py", "process/test_forks.py", "api/test_runs.py", "api/test_sweeps.py"),
)


def scope(nodeid: str) -> str:
    """Tests of one scope run in one process, in order: many of a file share a run that was trained once."""
    file = nodeid.partition("::")[0]
    return next((name for name, files in IN_TURN.items() if file.endswith(files)), file)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes longest comes first, so that no process is alone with it at the end."""
    sizes = Counter(scope(item.nodeid) for item in items)
    long = {name: place for place, end in enumerate(LONG) for name in sizes if name.endswith(end)}
    longest_first = sorted(sizes, key=lambda name: (long.get(name, len(LONG)), -sizes[name]))
    places = {name: place for place, name in enumerate(longest_first)}
    items.sort(key=lambda item: places[scope(item.nodeid)])


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One process more than there are cores: what tests start is often waited for."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """While modules are imported there is no garbage to look for."""
    gc.disable()
    yield
    gc.enable()


def pytest_collection_finish() -> None:
    """What was imported stays, and need not be looked through each time that garbage is collected."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)  # networks this small take longer with more
        keep_compiler_out()
    compose_quickly()
    gc.freeze()
    gc.set_threshold(50_000)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Callable[..., Any]) -> object:
    """By scope, where the command line asks for nothing else than pyproject.toml."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class ByScope(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return scope(nodeid)

    return ByScope(config, log)
