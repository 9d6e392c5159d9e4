"""`check`: right implementations pass, planted bugs fail the probe that is theirs.

CI plants a few bugs; GRIDWORLD_BUGS=all python -m pytest tests/checking plants all.
"""

import dataclasses
import itertools
import os

import numpy as np
import pytest
from helpers import planted_bugs as bugs
from stable_baselines3 import A2C, DQN, PPO

import gridworld
from gridworld.base.errors import InputError
from gridworld.checking import probes as expect
from gridworld.checking import run
from gridworld.checking.probes import PROBES, Trained
from gridworld.checking.training import arguments, settings, subject, train
from gridworld.commands import check as command
from gridworld.world.chain import one_hot_policy
from gridworld.world.evaluation import PolicySnapshot
from gridworld.world.mdp import Mdp
from gridworld.world.solver import solved

PLANT_ALL = os.environ.get("GRIDWORLD_BUGS") == "all"
FEW = [
    *(bugs.WrongSign, bugs.NoTargetNetwork, bugs.ReplayOffByOne, bugs.PPOEntropySign),
    *(bugs.EpsilonStaysAtTenth, bugs.PPORewardsClipped, bugs.DQNNeverNegative),
]
BY_NAME = {probe.name: probe for probe in PROBES}


def once(kind: object, name: str) -> tuple[bool | None, str]:
    """What a probe finds on one seed."""
    return run._once(subject(kind), {}, 0, [BY_NAME[name]])[0]


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(bugs.CAUGHT) if PLANT_ALL else FEW, ids=lambda kind: kind.__name__)
def test_a_planted_bug_fails_its_probe(kind: type) -> None:
    for name in bugs.CAUGHT[kind] if PLANT_ALL else bugs.CAUGHT[kind][:1]:
        passed, found = once(kind, name)
        assert passed is False, (name, found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name", "expected"),
    [
        *[(DQN, "target", True), (DQN, "exploration", True), (PPO, "behaviour", True)],
        *[(PPO, "entropy", True), ("dqn", "alternation", True), (PPO, "costs", True), (DQN, "large", True)],
        # Of what an algorithm does not take nothing is asked.
        *[(PPO, "target", None), (A2C, "exploration", None), (DQN, "entropy", None)],
        ("sb3_contrib.TRPO", "entropy", None),
    ],
)
def test_right_classes_pass_what_they_are_asked(kind: object, name: str, expected: bool | None) -> None:
    passed, found = once(kind, name)
    assert passed is expected, found
    assert found.startswith("takes no") == (expected is None)


def test_a_table_passes_all_it_is_asked() -> None:
    """Of Q-learning the command on docs/how-to/check.md does."""
    result = gridworld.check("value_iteration")
    assert result.passed, str(result)
    asked = [finding for finding in result.findings if finding.passed is not None]
    assert len(asked) == len(PROBES) - 5  # target, entropy, exploration, layers, behaviour
    unasked = {finding.name: finding.found for finding in result.findings if finding.passed is None}
    assert unasked["layers"] == "has no layers"
    assert unasked["behaviour"] == "takes no steps at the end"
    assert f"passed all {len(asked)} probes" in str(result)


@pytest.mark.parametrize("kind", [DQN, A2C])
def test_states_that_look_alike_are_alike_in_both_loops(kind: type) -> None:
    found = settings(subject(kind), BY_NAME["constant"], {})
    assert found is not None
    steps = [expect._any(1, 0, expect.GOES_ON), expect._any(0, 1, expect.ENDS)]  # which are not chosen
    world = expect._world("end like the start", steps)
    stock, tabulated = (
        train(dataclasses.replace(found[0], engine=engine), world, 0.9, 8, 640, 0).last
        for engine in ("stock", "tabulated")
    )
    assert tabulated.values == pytest.approx(stock.values, abs=1e-4)
    assert tabulated.values[0] == tabulated.values[2]


def test_a_crash_is_a_failure_and_is_told() -> None:
    assert once(bugs.PPOCrashes, "constant") == (False, "training failed: RuntimeError: shapes do not fit")


@pytest.mark.parametrize(
    ("outcomes", "seeds", "passed"),
    [
        ([True], 1, True),
        ([False, False], 2, False),
        ([False, True, True], 3, True),
        ([False, True, False], 3, False),
    ],
)
def test_two_of_three_seeds_decide(
    outcomes: list[bool], seeds: int, passed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rest = iter(outcomes)
    monkeypatch.setattr(run, "_once", lambda *given: [(next(rest), "found")])
    monkeypatch.setattr(run, "build", lambda *given: None)
    (finding,) = gridworld.check("q_learning", probes=["choice"]).findings
    assert (finding.passed, finding.seeds) == (passed, seeds)


def trained(q: np.ndarray) -> Trained:
    """A learner of Q on the alternation, which acts as it has learned."""
    mdp = expect.ALTERNATION
    greedy = q.argmax(axis=1)
    last = PolicySnapshot(greedy, one_hot_policy(greedy, 2), q.max(axis=1), q)
    visits = np.ones((2, 2), np.int64)
    return Trained(mdp, 0.8, last, last, last.greedy_policy(), 2 * visits, visits, ["a.bias"])


def test_expectations_have_a_tolerance_and_tell_what_is_farthest() -> None:
    exact = solved(expect.ALTERNATION, 0.8).q
    assert expect.optimal_with_values(trained(exact)) == "optimal, Q(0, 0) 1.778, exact 1.778"
    near, far = exact.copy(), exact.copy()
    near[1, 0] += 0.27
    far[1, 0] += 0.29
    expect.values(trained(near))
    for holds, q, words in (
        (expect.values, far, r"^Q\(1, 0\) 2.512, exact 2.222, tolerance 0.28$"),
        (expect.values, exact * np.nan, "nan"),
        (expect.optimal, -exact, r"its best actions are \[0, 0\], with regret 2.22"),
        (expect.acts_as_learned, exact, "50% of its last actions"),
        (expect.all_layers_learn, exact, r"^a.bias did not change$"),
    ):
        with pytest.raises(expect.UnmetError, match=words):
            holds(trained(q))


def test_settings_are_those_of_the_kind_that_a_class_takes() -> None:
    for kind, steps in ((DQN, 6400), (PPO, 20_480), (A2C, 25_600), (bugs.WrongSign, 20_480)):
        found = settings(subject(kind), BY_NAME["discount"], {"learning_rate": 1.0})
        assert found is not None
        config = found[0]
        assert (found[1].steps, config.arguments["learning_rate"], config.gamma) == (steps, 1.0, 0.5)
    shipped = settings(subject("dqn"), BY_NAME["discount"], {})
    assert dataclasses.asdict(shipped[0])["batch_size"] == 128
    given = arguments(["a=1e-3", "b=[64, 64]", "c=true", "d=lin_0.1", "e={'x': None}"])
    assert given == {"a": 1e-3, "b": [64, 64], "c": True, "d": "lin_0.1", "e": {"x": None}}


def test_what_a_class_refuses_is_the_users_mistake() -> None:
    with pytest.raises(InputError, match=r"^--set clip_range=wide: must be a number of at least 0"):
        gridworld.check(PPO, {"clip_range": "wide"}, probes=["choice"])
    with pytest.raises(InputError, match="PPO cannot be built"):
        gridworld.check(PPO, {"policy_kwargs": {"depth": 3}}, probes=["choice"])
    with pytest.raises(InputError, match="keeps memory between steps"):
        gridworld.check("sb3_contrib.RecurrentPPO", probes=["choice"])


@pytest.mark.slow
def test_worlds_of_ones_own_are_probes_too(capsys: pytest.CaptureFixture[str]) -> None:
    lake = gridworld.compile_env("FrozenLake-v1")
    result = gridworld.check("q_learning", probes=["choice"], worlds=["classic", lake], steps=100_000)
    assert [each.name for each in result.findings] == ["choice", "classic", "FrozenLake-v1"]
    assert result.findings[1].passed
    command.main(
        [
            "q_learning",
            "--processes",
            "1",
            "--probe",
            "choice",
            "--world",
            "CliffWalking-v1",
            "--steps",
            "100000",
        ]
    )
    assert "passed all 2 probes" in capsys.readouterr().out
    with pytest.raises(InputError, match="no_such_world"):
        gridworld.check("q_learning", worlds=["no_such_world"])


def test_the_command_ends_with_0_or_1(capsys: pytest.CaptureFixture[str]) -> None:
    command.main(["q_learning", "--processes", "1", "--probe", "choice"])
    assert capsys.readouterr().out.splitlines()[-1].startswith("q_learning: passed all 1 probes, ")
    with pytest.raises(SystemExit) as ended:
        command.main(["helpers.planted_bugs.PPOCrashes", "--processes", "1", "--probe", "constant"])
    assert ended.value.code == 1
    told = capsys.readouterr().out
    assert "constant     FAILED" in told
    assert "training failed: RuntimeError: shapes do not fit" in told
    assert "failed 1 of 1 probes (constant)" in told


def test_two_processes_find_the_same() -> None:
    one, two = (gridworld.check("q_learning", probes=["choice", "trap"], processes=n) for n in (1, 2))
    rows = [[dataclasses.replace(each, seconds=0.0) for each in result.findings] for result in (one, two)]
    assert rows[0] == rows[1]


VALUES = [  # a world, a discount, and Q* of its live states
    (expect.CONSTANT, 0.9, [[1, 1]]),
    (expect.CORRIDOR, 0.5, [[0.25, 0.25], [0.5, 0.5], [1, 1], [0.4, 0.125]]),
    (expect.BANDIT, 0.9, [[0, 1, 0.5]]),
    (expect.TWO_CONTEXTS, 0.9, np.eye(2)),
    (expect.END_LIKE_THE_START, 0.9, [[0.7, 0.9], [1, 1]]),
    (expect.ENDLESS, 0.8, [[5, 5]]),
    (expect.CUT_SHORT, 0.8, [[1.1, 4], [5, 5]]),
    (expect.GAMBLE, 0.9, [[0.1, 0.4]]),
    (expect.ALTERNATION, 0.8, [[0.8**2 / 0.36, 0.8 / 0.36], [0.8 / 0.36, 1 / 0.36]]),
    (expect.TRAP, 0.9, [[0.2, 0.7], [0, 1]]),
    (
        expect.COSTS_AND_LARGE,
        0.9,
        [
            *([-2.71, -2.3], [-1.9] * 2, [-1] * 2),
            *([-0.5, 0], [-2, 0], [3, 4.5], [5] * 2, [-4.1, -3], [1] * 2),
        ],
    ),
]


@pytest.mark.parametrize(("world", "gamma", "q"), VALUES, ids=lambda value: getattr(value, "name", ""))
def test_their_values_are_those_that_the_page_tells(world: Mdp, gamma: float, q: object) -> None:
    assert solved(world, gamma).q[~world.terminal] == pytest.approx(np.array(q))


def test_worlds_are_what_they_are_for() -> None:
    assert solved(expect.DELAY, 0.9).q[0] == pytest.approx([0.9**3, 0])
    assert solved(expect.SLIPPERY, 0.9).q[1, 1] == pytest.approx(0.8 / 0.82)
    assert expect.END_LIKE_THE_START.number.tolist() == [0, 1, 0, 0]  # its ends look like a live state
    assert (expect.ENDLESS.max_episode_steps, expect.ENDLESS.terminal.any()) == (5, False)
    names = [probe.name for probe in PROBES]
    assert len(set(names)) == len(names)
    for number, probe in enumerate(PROBES):
        assert set(probe.follows) <= set(names[:number]), probe.name  # it is known when it is printed
    trained_on = [probe.training for probe in PROBES]
    assert len(list(itertools.groupby(trained_on))) == len(
        set(trained_on)
    )  # those that share one are adjacent
