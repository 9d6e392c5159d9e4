"""Whole runs: seconds until a certificate, whole commands (RL Zoo's too), a sweep, and their peak memory."""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial

from benchmarks import peers
from benchmarks.measure import Comparison, Workload

from gridworld.base.errors import InputError

_STEPS = 20_000  # of the environment, compared with RL Zoo


def comparisons(workload: Workload) -> Iterator[Comparison]:
    """The comparisons."""
    seeds = range(workload.certified_seeds)
    for agent in ("dqn", "ppo"):
        table = "training until the first certificate, seconds"
        yield Comparison(table, f"{agent}, median of {len(seeds)} seeds", _certified(agent, seeds))
    for agent in ("dqn", "ppo"):
        yield Comparison(
            "whole command, seconds",
            f"train.py agent={agent}",
            partial(_seconds, train(f"agent={agent}")),
            'python -c "import stable_baselines3"',
            partial(_seconds, [sys.executable, "-c", "import stable_baselines3"]),
        )
    for agent in ("dqn", "ppo"):
        yield Comparison(
            "whole command, seconds",
            f"train.py agent={agent}, {_STEPS:,} steps",
            partial(_seconds, train(f"agent={agent}", f"total_timesteps={_STEPS}")),
            f"RL Zoo's {agent}, {_STEPS:,} steps, SB3's defaults, one env",
            None if peers.why_not("RL_ZOO") else partial(_rl_zoo, agent),
            peers.why_not("RL_ZOO"),
        )
    count = 2 * workload.sweep_seeds
    sweep = train("-m", "agent=dqn,ppo", f"seed=range({workload.sweep_seeds})")
    yield Comparison("whole command, seconds", f"a sweep of {count}, per run", lambda: run(sweep)[0] / count)
    large = ["env.num_rows=200", "env.num_cols=200", "total_timesteps=8192"]
    for name, words in (("5x6", []), ("200x200", large)):
        for agent in ("dqn", "ppo"):
            command = train(f"agent={agent}", "evaluation.every=100000", *words)
            yield Comparison(
                "peak memory of the whole command, MB",
                f"train.py agent={agent}, {name}",
                lambda command=command: run(command)[1],  # type: ignore[misc]
                'python -c "import stable_baselines3"',
                lambda: run([sys.executable, "-c", "import stable_baselines3"])[1],
            )


def train(*words: str) -> list[str]:
    """The command line of a training run, or of a sweep, without progress lines."""
    return [sys.executable, "-m", "gridworld", "train", *words, "logging.progress=false"]


# A small process in between starts the command, since a child's peak memory includes its parent's.
_MEASURE = """
import resource, subprocess, sys, time
started = time.perf_counter()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
print(time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
sys.exit(done.returncode)
"""


def _rl_zoo(agent: str) -> float:
    return _seconds(peers.rl_zoo(agent, _STEPS), peers.environment())


def _seconds(command: list[str], env: Mapping[str, str] | None = None) -> float:
    return run(command, env)[0]


def run(command: list[str], env: Mapping[str, str] | None = None) -> tuple[float, float]:
    """Seconds, and peak memory in MB, of a process in a folder of its own."""
    measured = [sys.executable, "-S", "-c", _MEASURE, *command]
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(measured, cwd=folder, env=env, capture_output=True, text=True)
    if done.returncode:
        raise InputError(f"{' '.join(command)}: {peers.why(done)}")
    seconds, peak = map(float, done.stdout.split())
    return seconds, peak / (1024 if sys.platform.startswith("linux") else 1024**2)


def _certified(agent: str, seeds: range) -> Callable[[], float]:
    """Median over the seeds; a seed that is never certified raises."""

    def measure() -> float:
        from gridworld.config.compose import compose
        from gridworld.training.learning_curve import LearningCurve
        from gridworld.training.setup import make_context
        from gridworld.world.evaluation import Evaluator

        seconds = []
        for seed in seeds:
            config = compose([f"agent={agent}", f"seed={seed}"])
            mdp = config.env.compile()
            evaluator = Evaluator(mdp, config.evaluation.gamma, config.env.step_limit(mdp))
            context = make_context(config, mdp)
            made = config.agent.build(context)
            config.evaluation.every, config.evaluation.stop_after = 1000, 1
            curve = LearningCurve(evaluator, made, config, context.envs)
            started = time.perf_counter()
            made.learn(config.total_timesteps, curve.on_step)
            seconds.append(time.perf_counter() - started - curve.seconds)
            if curve.certificate.first_certified_step is None:
                raise RuntimeError(f"agent={agent} seed={seed}: never certified")
        return statistics.median(seconds)

    return measure
