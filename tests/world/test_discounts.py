"""Discounts under which another policy is optimal, and what is said of them before training."""

from pathlib import Path

import pytest

import gridworld
from gridworld.training.setup import check_settings, objective_note
from gridworld.world.evaluation import Evaluator, fitting_discounts, score_of_optimum
from gridworld.world.grid import compile_mdp
from gridworld.world.layout import load, parse


def note(*words: str) -> str | None:
    config = gridworld.compose(*words)
    return objective_note(config, check_settings(config))


def test_a_short_horizon_takes_the_near_goal() -> None:
    judge = Evaluator(compile_mdp(load("classic"), slip=0.1), 0.99, 100)
    assert score_of_optimum(judge, 0.9).regret == pytest.approx(1.1e-5, rel=0.05)
    assert not score_of_optimum(judge, 0.9).certified
    assert fitting_discounts(judge) == [0.95, 0.97, 0.99]


def test_of_equally_good_actions_the_better_one_counts() -> None:
    judge = Evaluator(compile_mdp(parse("S.G", "map")), 0.99, 100)
    assert score_of_optimum(judge, 0.0).certified  # under 0 all ways are as good
    assert fitting_discounts(judge) == [0.8, 0.9, 0.95, 0.97, 0.99]


@pytest.mark.parametrize(
    ("words", "said", "right"),
    [
        ("agent=dqn agent.gamma=0.9 env.slip=0.1", "agent.gamma=0.9: ", "agent.gamma=0.95"),
        ("agent=q_learning agent.gamma=0.5 env.slip=0.2", "agent.gamma=0.5: ", "agent.gamma=0.99"),
        (
            "agent=a2c agent.arguments.gamma=0.9 env.slip=0.1",
            "agent.arguments.gamma=0.9: ",
            "agent.arguments.gamma=0.95",
        ),
    ],
)
def test_it_is_said_with_what_would_be_right(words: str, said: str, right: str) -> None:
    found = note(*words.split())
    assert found is not None
    assert found.startswith(said)
    assert found.endswith(f"under evaluation.gamma=0.99, too much for a certificate; take {right}")
    assert note(*words.split(), right) is None


def test_nothing_is_said_of_what_fits_or_would_take_long(tmp_path: Path) -> None:
    assert note("agent=dqn") is None
    assert note("agent=dqn", "env.slip=0.1") is None
    large = tmp_path / "large.txt"
    large.write_text("\n".join(["S" + "." * 39, *["." * 40] * 38, "." * 39 + "G"]))
    assert note("agent=q_learning", f"env.layout={large}", "env.slip=0.1", "agent.gamma=0.1") is None


def test_a_run_says_it_once(capsys: pytest.CaptureFixture[str]) -> None:
    words = "agent=q_learning env.slip=0.1 agent.gamma=0.9 total_timesteps=64 logging.tensorboard=false"
    for progress, times in ((True, 1), (False, 0)):
        gridworld.train(*words.split(), progress=progress)
        assert capsys.readouterr().err.count("too much for a certificate") == times
