"""The promise: the shipped settings end certified optimal on the default world, on every seed."""

from functools import partial
from pathlib import Path

import pytest
from helpers.support import configure

from gridworld.training.together import run_together
from gridworld.training.train import training

QUIET = (
    "recording.frames=false",
    "recording.gif=false",
    "recording.learning=false",
    "logging.tensorboard=false",
    "logging.progress=false",
)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["dqn", "ppo", "q_learning", "sarsa", "expected_sarsa", "value_iteration"])
def test_the_default_job_is_certified(agent: str, tmp_path: Path) -> None:
    """On ten seeds, which train together: each run is what it is alone, see engine/test_populations.py."""
    for seed in range(10):
        (tmp_path / str(seed)).mkdir()
    configs = [configure(f"agent={agent}", f"seed={seed}", *QUIET) for seed in range(10)]
    summaries = run_together(
        [partial(training, config, tmp_path / str(config.seed), []) for config in configs]
    )
    assert len(summaries) == 10
    for seed, summary in enumerate(summaries):
        assert isinstance(summary, dict), summary
        assert summary["certified"], seed
        assert summary["goal_probability"] == 1
        assert summary["length"] == 8
        assert int(summary["first_certified_step"]) <= int(summary["certified_since_step"])
