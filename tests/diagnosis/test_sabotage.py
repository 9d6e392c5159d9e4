"""Runs that were spoilt on purpose: the first cause named is what was done to them."""

import dataclasses

import numpy as np
import pytest

import gridworld

_ALWAYS = ["agent.exploration_initial_eps=1", "agent.exploration_final_eps=1", "agent.initial_value=0"]
_TABLE = {
    "step too small": (["agent.learning_rate=0.001"], "slow"),
    "step too large where chance decides": (["agent.learning_rate=1", "env.slip=0.3"], "rate"),
    "too few steps": ([*_ALWAYS, "total_timesteps=300"], "budget"),
    "no look ahead": ([*_ALWAYS, "agent.gamma=0"], "objective"),
    "first values too high": (["agent.initial_value=1000"], "slow"),
    "first values too low": (
        [
            *("agent.exploration_initial_eps=0.05", "agent.exploration_final_eps=0.05"),
            "agent.initial_value=-100",
        ],
        "exploration",
    ),
    "exploration over at once": (
        [
            *("agent.exploration_initial_eps=1", "agent.exploration_final_eps=0", "agent.initial_value=0"),
            *("agent.exploration_fraction=0.02", "total_timesteps=20000"),
        ],
        "exploration",
    ),
}
_DQN = {
    "rate too small": (["agent.learning_rate=1e-6"], "slow"),
    "rate too large": (["agent.learning_rate=1"], "rate"),
    "target too old": (["agent.target_update_interval=20000"], "target"),
    "network too narrow": (["agent.policy_kwargs.net_arch=[1]"], "network"),
    "no exploration": (
        ["agent.exploration_initial_eps=0.01", "agent.exploration_final_eps=0.01"],
        "exploration",
    ),
    "learning begins too late": (["agent.learning_starts=29950"], "slow"),
    "horizon too short": (["agent.gamma=0.1"], "objective"),
}
_PPO = {
    "bonus too large": (["agent.ent_coef=20"], "entropy"),
    "no bonus": (["agent.ent_coef=0"], "exploration"),
    "rate too small": (["agent.learning_rate=1e-7"], "slow"),
    "rate too large": (["agent.learning_rate=1"], "diverged"),
    "horizon too short": (["agent.gamma=0.1"], "objective"),
}
_BASE = {"q_learning": [], "dqn": [], "ppo": ["total_timesteps=60000"]}
_CATALOGUE = [
    pytest.param(agent, *entry, id=f"{agent}: {name}")
    for agent, entries in (("q_learning", _TABLE), ("dqn", _DQN), ("ppo", _PPO))
    for name, entry in entries.items()
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("agent", "spoilt", "cause"), _CATALOGUE)
def test_the_first_cause_is_what_was_done(agent: str, spoilt: list[str], cause: str) -> None:
    run = gridworld.train(f"agent={agent}", *_BASE[agent], *spoilt, seed=5, progress=False)
    found = gridworld.diagnose(run)
    assert found.cause == cause, found.sentence()
    assert found.split.cost.sum() == pytest.approx(run.summary["regret"], abs=1e-9)
    assert sum(found.shares) == pytest.approx(1)
    assert found.sentence().count(". ") == 0
    assert 1 <= len(found.commands) <= 3


def test_two_optima_that_differ_are_told_apart() -> None:
    run = gridworld.train("agent=value_iteration", "agent.gamma=0.5", "env.slip=0.2", progress=False)
    found = gridworld.diagnose(run)
    assert found.cause == "objective"
    assert "optimal under its gamma of 0.5, not under the evaluation's 0.99" in found.sentence()
    assert "agent.gamma=0.99" in " ".join(found.commands)


def test_on_policy_control_learns_what_is_best_for_one_that_explores() -> None:
    explores = ["agent.exploration_initial_eps=0.5", "agent.exploration_final_eps=0.5"]
    run = gridworld.train(
        "agent=sarsa", "env=cliff", "total_timesteps=60000", *explores, seed=0, progress=False
    )
    assert gridworld.diagnose(run).cause == "epsilon"


@pytest.mark.parametrize("agent", ["q_learning", "dqn"])
def test_nothing_is_named_for_a_certified_run(agent: str) -> None:
    run = gridworld.train(f"agent={agent}", seed=0, progress=False)
    found = gridworld.diagnose(run)
    assert run.summary["certified"]
    assert found.cause is None
    assert found.findings == found.commands == ()


def test_a_certificate_that_was_lost_is_said() -> None:
    run = gridworld.train("agent=q_learning", "agent.learning_rate=0.001", seed=0, progress=False)
    run.curve["certified"] = run.curve["certified"].copy()
    run.curve["certified"][3] = True
    found = gridworld.diagnose(run)
    step = run.curve["step"][3]
    assert found.cause == "lost"
    assert f"certified at step {step:,}" in found.sentence()


def test_a_command_takes_the_place_of_the_setting_that_it_changes() -> None:
    run = gridworld.train("agent=q_learning", "agent.learning_rate=0.001", seed=0, progress=False)
    first = gridworld.diagnose(run).commands[0]
    assert first.endswith("train.py agent=q_learning seed=0 agent.learning_rate=0.01")


def test_every_state_that_costs_something_has_a_cause() -> None:
    run = gridworld.train("agent=q_learning", "env.slip=0.2", "total_timesteps=500", seed=1, progress=False)
    found = gridworld.diagnose(run)
    assert (found.cause_of[found.split.wrong & (found.split.cost > 1e-9)] >= 0).all()
    assert np.isin(np.unique(found.cause_of), [-1, *range(len(found.findings))]).all()
    assert dataclasses.replace(found, shares=(0.5,)).sentence().startswith("50% of the regret")
