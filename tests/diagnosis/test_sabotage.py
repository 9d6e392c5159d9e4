"""Runs that were spoilt on purpose: the first cause named is what was done to them.

CI spoils a few. `GRIDWORLD_SABOTAGES=all python -m pytest -s -n 0 tests/diagnosis/test_sabotage.py` spoils
all, on the worlds and seeds that the rules were not made on, and prints what is named.
"""

import dataclasses
import os
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from helpers.sabotage import CATALOGUE, HELD_OUT, MADE_ON, SOUND, Sabotage, random_map

import gridworld
from gridworld.agents.sb3.settings import SB3ClassConfig
from gridworld.diagnosis.causes import PHRASES
from gridworld.diagnosis.causes.implementation import of_library
from gridworld.diagnosis.oracle_fit import one_state_fit
from gridworld.diagnosis.verdict import Diagnosis
from gridworld.world.solver import solved

ALL = os.environ.get("GRIDWORLD_SABOTAGES") == "all"
_MAP, _SEED = MADE_ON[0]
_FEW = (
    *("dqn: learning begins too late", "ppo: bonus too large"),
    *("ppo: rate too small", "ppo: rate too large", "ppo: horizon too short"),
    *("WrongSign: The advantage has the wrong sign", "QuietDQN: a sound class, target too old"),
)
_SLOW = ("agent=q_learning", "agent.learning_rate=0.001", "seed=0")


def diagnosed(each: Sabotage, world: str, seed: int) -> Diagnosis:
    run = gridworld.train(*each.settings(), f"env.layout={world}", seed=seed, progress=False)
    found = gridworld.diagnose(run)
    assert (found.cause is None) == run.summary["certified"]
    assert found.split.cost.sum() == pytest.approx(run.summary["regret"], abs=1e-9)
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "each",
    [each for each in CATALOGUE if each.agent in ("q_learning", "sarsa") or str(each) in _FEW],
    ids=str,
)
def test_the_first_cause_is_what_was_done(each: Sabotage) -> None:
    found = diagnosed(each, _MAP, _SEED)
    assert found.cause in each.causes, found.sentence()
    assert sum(found.shares) == pytest.approx(1)
    assert found.sentence().count(". ") == 0
    assert 1 <= len(found.commands) <= 3
    assert found.phrase in PHRASES.values()
    assert len(str(found.phrase).split()) <= 4


@pytest.mark.skipif(not ALL, reason="takes a quarter of an hour")
@pytest.mark.filterwarnings("ignore")
def test_four_of_five_are_told_on_worlds_held_out(tmp_path: Path) -> None:
    counts: Counter[str] = Counter()
    for number, seed in HELD_OUT:
        world = tmp_path / f"{number}.txt"
        world.write_text(random_map(number))
        sound = {agent: diagnosed(Sabotage(agent, "", (), ()), str(world), seed) for agent in SOUND}
        for each in CATALOGUE:
            result, cause = "unspoilt, it is not certified", None
            if sound[each.like].cause is None:
                try:
                    cause = diagnosed(each, str(world), seed).cause
                    result = "told" if cause in each.causes else "certified" if cause is None else "missed"
                except gridworld.InputError:
                    result = "training diverged"
            counts[result] += 1
            print(f"map {number}, {each}: {cause}, {result}")
    print(counts)
    assert counts["told"] >= 0.8 * (counts["told"] + counts["missed"])


@pytest.mark.slow
@pytest.mark.parametrize(("width", "fewest", "most"), [(64, 0, 2), (1, 3, 30)])
def test_one_state_is_taught_alone(width: int, fewest: int, most: int) -> None:
    narrow = f"agent.policy_kwargs.net_arch=[{width}]"
    run = gridworld.train("agent=dqn", "total_timesteps=2048", narrow, progress=False)
    mdp, greedy = run.evaluator.mdp, run.policy.greedy
    states, best = np.flatnonzero(~mdp.absorbing), solved(mdp, run.config.agent.gamma)
    wrong = int(states[~best.optimal[states, greedy[states]]][0])
    found = one_state_fit(run.agent, best, states, wrong)
    assert found is not None
    assert found.told_apart
    assert fewest <= len(found.spoilt) <= most
    assert best.optimal[found.spoilt, greedy[found.spoilt]].all()
    assert wrong not in found.spoilt
    assert one_state_fit(run.agent, best, np.tile(states, 99999), wrong) is None  # too large


def test_a_class_has_the_librarys_own_in_its_place() -> None:
    def own(algorithm: str) -> SB3ClassConfig | None:
        arguments = {"gamma": 0.5, "caution": 1}
        return of_library(SB3ClassConfig("own", "sb3", algorithm, arguments=arguments))

    found = own("helpers.planted_bugs.WrongSign")
    assert found is not None
    assert (found.algorithm, found.arguments) == ("stable_baselines3.PPO", {"gamma": 0.5})
    assert own("stable_baselines3.PPO") is None
    assert own("stable_baselines3.common.on_policy_algorithm.OnPolicyAlgorithm") is None
    assert of_library(gridworld.compose("agent=dqn").agent) is None


# fmt: off
OTHERS = {  # settings, the causes that name it, what the sentence or the commands have
    "two optima that differ": (
        "agent=value_iteration agent.gamma=0.5 env.slip=0.2", "objective",
        ("optimal under its gamma of 0.5, not under the evaluation's 0.99", "agent.gamma=0.99")),
    "what is best for one that explores": (
        "agent=sarsa env=cliff tuned=none total_timesteps=60000 "
        "agent.exploration_initial_eps=0.5 agent.exploration_final_eps=0.5", "epsilon", ()),
    "gradients clipped to nothing": (
        "agent=ppo agent.max_grad_norm=1e-6", "clipping",
        ("clipped to max_grad_norm=1e-06", "agent.max_grad_norm=0.5")),
    "the same of a class": (
        "agent=a2c +agent.arguments.max_grad_norm=1e-7", "clipping",
        (" +agent.arguments.max_grad_norm=0.5",)),
    "never a random action": (
        "agent=dqn agent.exploration_initial_eps=0 agent.exploration_final_eps=0", "exploration",
        ("it hardly ever took a random action", "0 of its 30,000", "agent.exploration_initial_eps=1")),
    "hardly ever one, with optimism": (
        "agent=q_learning env=cliff tuned=none agent.exploration_initial_eps=1e-4 "
        "agent.exploration_final_eps=1e-4", "exploration", ("it hardly ever took a random action",)),
    "no entropy bonus to raise": (
        "agent=trpo exploration_bonus=0 total_timesteps=40000", "exploration budget",
        ("exploration_bonus=0.1",)),
}
# fmt: on


@pytest.mark.slow
@pytest.mark.parametrize("what", OTHERS)
def test_what_else_is_told(what: str) -> None:
    words, causes, parts = OTHERS[what]
    found = gridworld.diagnose(gridworld.train(*words.split(), seed=0, progress=False))
    assert found.cause in causes.split()
    told = " ".join([found.sentence(), *found.commands])
    assert all(part in told for part in parts)
    assert "still learning" not in told
    assert "ent_coef" not in told


def test_shares_are_said_in_percent() -> None:
    words = ["agent=a2c", "agent.arguments.ent_coef=0", "seed=0"]
    found = gridworld.diagnose(gridworld.train(*words, progress=False)).sentence()
    assert "it reached the goal in 1.4% of episodes at first and practically never at the end" in found


def test_a_certificate_that_was_lost_is_said() -> None:
    run = gridworld.train(*_SLOW, progress=False)
    first = gridworld.diagnose(run).commands[0]  # takes the place of the setting that it changes
    assert re.search(r"gridworld train agent=q_learning seed=0 agent.learning_rate=0\.\d+$", first)
    found = diagnosed_as_lost(run)
    assert f"certified at step {run.curve['step'][3]:,}" in found.sentence()


def test_a_rate_that_falls_is_not_told_to_fall_and_falls_in_what_is_told() -> None:
    falls = ["agent=q_learning", "agent.learning_rate=quad_0.001", "evaluation.stop_after=5"]
    (told,) = diagnosed_as_lost(gridworld.train(*falls, seed=0, progress=False)).commands
    assert told.endswith("evaluation.stop_after=5 seed=0 agent.learning_rate=quad_0.0001")


def diagnosed_as_lost(run: gridworld.RunResult) -> Diagnosis:
    """As if it had been certified once."""
    run.curve["certified"] = run.curve["certified"].copy()
    run.curve["certified"][3] = True
    found = gridworld.diagnose(run)
    assert found.cause == "lost"
    return found


# fmt: off
SPOILT = {  # what was done, and the offer that has to come first
    "a unit for all actions":
        ("a2c", "+agent.arguments.policy_kwargs.net_arch=[1]", "network", "net_arch=[64,64]"),
    "plain gradients":
        ("dqn", "agent.policy_kwargs.optimizer_class=torch.optim.SGD", "slow", "torch.optim.Adam"),
    "rewards too small": ("dqn", "agent.reward_scale=2e-4", "scale", "reward_scale=1"),
}
# fmt: on


@pytest.mark.slow
@pytest.mark.parametrize("what", SPOILT)
def test_what_is_offered_first_is_certified(what: str) -> None:
    agent, word, causes, offer = SPOILT[what]
    run = gridworld.train(f"agent={agent}", word, "env.layout=aima_4x3", seed=8, progress=False)
    if run.summary["certified"]:
        run = gridworld.train(f"agent={agent}", word, seed=8, progress=False)
    found = gridworld.diagnose(run, try_offers=True)
    assert found.cause in causes.split(), found.sentence()
    if causes == "network":
        assert re.search("as trained, it can learn row|cannot even distinguish row", found.sentence())
    assert offer in found.commands[0]
    assert found.tried[0].certified
    assert len(found.tried) == 1


def test_with_a_discount_that_cannot_be_certified_every_offer_changes_it() -> None:
    wild = ["agent=q_learning", "agent.learning_rate=1", "agent.gamma=0.5", "env.slip=0.2"]
    run = gridworld.train(*wild, "total_timesteps=4000", seed=2, progress=False)
    found = gridworld.diagnose(run)
    assert found.commands
    assert all("agent.gamma=0.99" in line for line in found.commands)


def test_every_state_that_costs_something_has_a_cause() -> None:
    run = gridworld.train("agent=q_learning", "env.slip=0.2", "total_timesteps=500", seed=1, progress=False)
    found = gridworld.diagnose(run)
    assert (found.cause_of[found.split.wrong & (found.split.cost > 1e-9)] >= 0).all()
    assert np.isin(np.unique(found.cause_of), [-1, *range(len(found.findings))]).all()
    assert dataclasses.replace(found, shares=(0.5,)).sentence().startswith("50% of the regret")
