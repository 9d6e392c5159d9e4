"""What several tests need: the repository's paths, its configurations composed, its scripts run."""

import copy
import functools
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import hydra
from helpers import forks
from helpers.quickly import compose_quickly
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from gridworld.config.compose import register_schemas
from gridworld.config.recipes import Chosen, with_recipe_by_rule
from gridworld.config.train import TrainConfig
from gridworld.config.words import prepared
from gridworld.sweeps.plan import Configurations
from gridworld.training.train import train

ROOT = Path(__file__).resolve().parents[2]
CONF = ROOT / "conf"

# A run that takes a moment: too short to learn, long enough to pass through everything.
SHORT = {
    "dqn": [
        *("agent=dqn", "total_timesteps=2000", "evaluation.every=500", "n_envs=128"),
        *("agent.batch_size=128", "agent.target_update_interval=512"),  # with slip too
        *("agent.learning_starts=300", "agent.exploration_fraction=1", "agent.log_interval=4"),
    ],
    "ppo": ["agent=ppo", "total_timesteps=2000", "n_envs=16", "agent.n_steps=32", "agent.batch_size=64"],
    "a2c": ["agent=a2c", "total_timesteps=500", "n_envs=4", "evaluation.every=200"],
    "qrdqn": [
        *("agent=qrdqn", "total_timesteps=1000", "n_envs=4"),
        *("+agent.arguments.learning_starts=500", "agent.arguments.gradient_steps=4"),
    ],
    "trpo": [
        *("agent=trpo", "total_timesteps=500", "n_envs=4"),
        *("agent.arguments.n_steps=32", "agent.arguments.batch_size=64"),
    ],
    **{
        agent: [f"agent={agent}", "total_timesteps=2000", "evaluation.every=500", "agent.log_interval=4"]
        for agent in ("q_learning", "sarsa", "expected_sarsa")
    },
    "value_iteration": ["agent=value_iteration"],
}
# Of a run whose result alone is looked at.
NO_FILES = (
    *("recording.frames=false", "recording.gif=false", "recording.policy_map=false"),
    *("recording.learning=false", "recording.q_error=false", "recording.visits=false"),
    *("logging.tensorboard=false", "logging.progress=false"),
)
DEEP = ["dqn", "ppo"]  # those with a tabulated engine


def configure(*overrides: str) -> TrainConfig:
    """The configuration that the command line would give to a run, composed as that of a sweep's job.

    It comes to the same, see tests/sweep/test_sweep_plan.py, in 3 ms instead of 100.
    """
    return copy.deepcopy(_composed(overrides))


@functools.lru_cache(maxsize=500)
def _composed(overrides: tuple[str, ...]) -> TrainConfig:
    return with_recipe_by_rule(prepared(overrides), composed)[0]


def composed(words: Sequence[str]) -> tuple[TrainConfig, Chosen]:
    """What a command line composes to by itself, and the files that it chooses, as for a sweep's plan."""
    configurations, master = _configurations()
    HydraConfig.instance().set_config(master)
    try:
        return configurations(words)
    finally:
        HydraConfig.instance().cfg = None


@functools.cache
def _configurations() -> tuple[Configurations, DictConfig]:
    compose_quickly()
    register_schemas()
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        loader = GlobalHydra.instance().config_loader()
        master = loader.load_configuration("train", [], run_mode=RunMode.MULTIRUN)
        return Configurations(loader, master), master


def train_in(folder: Path, *overrides: str) -> dict[str, object]:
    """A run in `folder` without a process of its own; returns its summary."""
    folder.mkdir(parents=True, exist_ok=True)
    return train(configure(*overrides), folder, list(overrides))


# What Python itself reads when it starts: a fork would not see it.
_READ_AT_START = re.compile(r"PYTHON(?!PATH$)|LC_|LANG|LD_|MKL_|OPENBLAS_")


def script(
    name: str,
    *arguments: str,
    cwd: Path,
    real: bool = False,
    stdout: Path | None = None,
    timeout: float = 120,
    **environment: str,
) -> subprocess.CompletedProcess[str]:
    """Run one of the scripts as a user does, from another folder.

    It runs in a fork of a process that has imported everything, which takes seconds less (`helpers.warm`), or
    in a `real` Python; so it does with a variable in `environment` that Python reads when it starts. A fork
    may print to the file `stdout`, instead of to what comes back.
    """
    if not real and not any(map(_READ_AT_START.match, environment)):
        ended = forks.run(name, *arguments, cwd=cwd, environment=environment, timeout=timeout, stdout=stdout)
        return subprocess.CompletedProcess([name, *arguments], ended.code, ended.stdout, ended.stderr)
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / name), *arguments],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=timeout,
    )


def start(name: str, *words: str, cwd: Path, **environment: str) -> forks.Started:
    """Start one of the scripts, to be watched and stopped: in a fork too, in a session of its own."""
    return forks.Started(name, words, cwd, environment)


def wait_for(
    condition: Callable[[], object], what: str, process: subprocess.Popen[bytes] | forks.Started | None = None
) -> None:
    """Until it holds, while the process is at work. Fails after three minutes."""
    end = time.monotonic() + 180
    while not condition():
        assert time.monotonic() < end, f"waited for {what}"
        assert process is None or process.poll() is None, f"{what} ended"
        time.sleep(0.02)


def train_on_full_disk(most: int, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run `train.py` in a process whose files may not grow beyond `most` bytes."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "train.py"), *words],
        cwd=cwd,
        # The changes of a tree at work would not fit, and compiled modules would be half written.
        env={**os.environ, "GIT_DIR": "none", "PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=limit,
        capture_output=True,
        text=True,
        check=False,
    )
