"""`check` of any train function: what it may return, what it sees, and CleanRL's learners with planted bugs.

CI plants a few bugs; GRIDWORLD_BUGS=all python -m pytest tests/checking plants all, and asks sound learners
all probes.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from helpers import cleanrl
from helpers.support import ROOT

import gridworld
from gridworld.base.errors import InputError
from gridworld.checking import pytest_plugin, run
from gridworld.checking.probes import PROBES
from gridworld.checking.training import subject
from gridworld.world.solver import solved

PLANT_ALL = os.environ.get("GRIDWORLD_BUGS") == "all"
BY_NAME = {probe.name: probe for probe in PROBES}
RANDOM = np.random.default_rng(0)


def found(train: Callable[..., Any], probe: str, **options: Any) -> tuple[bool | None, str]:
    """What a probe finds."""
    (finding,) = gridworld.check(train, probes=[probe], **options).findings
    return finding.passed, finding.found


def returns(what: Any) -> Callable[..., Any]:
    """A train function that does not learn. Action 1 of the bandit is best; observation 1 is an end."""
    return lambda env, total_timesteps, seed, gamma=0.9: what


@pytest.mark.parametrize(
    "policy",
    [
        *([1, 0], np.array([1, 2]), torch.tensor([1, 0]), [[0.2, 0.5, 0.3], [0, 0, 0]]),
        *(lambda state: 1, lambda state: np.array([1]), lambda state: torch.tensor([0.2, 0.5, 0.3])),
        *({"q": [[0, 1, 0.5], [9, 0, 0]]}, {"q": lambda state: [-3, -1, -2]}),
        {"policy": [1, 0], "q": np.zeros((2, 3)), "values": [0, 0]},
    ],
)
def test_forms_of_a_policy(policy: Any) -> None:
    assert found(returns(policy), "choice") == (True, "optimal")


@pytest.mark.parametrize(
    ("returned", "words"),
    [
        (None, r"must return a policy; policy: NoneType is neither"),
        ([[0, 1, 0.5], [0, 0, 0]], "rows are not probability distributions; give Q values as {.q.: ...}"),
        ([[0, 2, -1], [0, 2, -1]], "not probability distributions"),
        ([1, 0, 0], r"has shape \(3,\); must be \(2,\) actions or \(2, 3\) probabilities"),
        ([3, 0], "state 0 has the action 3; must be 0"),
        ({"q": [1, 0]}, r"q: has shape \(2,\); must be \(2, 3\)"),
        ({"q": [[0, 1, 0]] * 2, "values": [[0]]}, r"values: has shape \(1, 1\); must be \(2,\)"),
        ({"pi": [1, 0]}, r"a dictionary has policy or q, and may have values, but not \['pi'\]"),
        ({"values": [1, 0]}, "a dictionary has policy or q"),
        ("right", "str is neither"),
        (lambda state: (1, None), r"must return an action or numbers for 0, not \[1 None\]"),
        (lambda state: int(RANDOM.integers(3)), "draws at random; give the best action, or probabilities"),
    ],
)
def test_what_is_no_policy_is_refused(returned: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        found(returns(returned), "choice")


@pytest.mark.parametrize(
    ("train", "words"),
    [
        (returns(lambda state: {}[state]), "training failed: its policy fails for 0: KeyError"),
        (lambda env, steps, seed: sys.exit(), "training failed: SystemExit"),
        (returns({"q": np.full((2, 3), np.nan)}), "training failed: its q has numbers that are not finite"),
        (lambda env, steps, seed: env.step(1), "training failed: RuntimeError: env.step() after the end"),
        (lambda env, steps, seed: env.reset() and env.step(3), "training failed: InputError: actions="),
    ],
)
def test_what_fails_is_a_finding(train: Callable[..., Any], words: str) -> None:
    result = gridworld.check(train, probes=["choice"])
    (finding,) = result.findings
    assert (finding.passed, finding.found[: len(words)]) == (False, words)
    assert finding.meaning not in str(result)  # which is about what it has learned


def test_a_module_that_exits_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "exiting.py").write_text("raise SystemExit")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"exiting cannot be imported .SystemExit"):
        gridworld.check("exiting:train")


def test_a_function_is_asked_what_it_shows() -> None:
    exact = {"q": [[1, 1], [0, 0]]}
    assert found(returns(exact), "constant") == (True, "Q(0, 0) 1.000, exact 1.000")
    assert found(lambda env, steps, seed: exact, "constant") == (None, "takes no gamma")
    assert found(lambda env, steps, seed: exact, "discount") == (None, "takes no gamma")
    assert found(returns([0, 0]), "constant") == (None, "returns neither q nor values")
    assert found(returns({"policy": [0, 0], "values": [1, 0]}), "constant")[0] is True
    assert found(returns({"policy": [0, 0], "values": [0, 1]}), "constant")[0] is False
    assert found(returns([0, 1, 0]), "behaviour") == (None, "takes no exploration_final_eps")
    assert found(returns([0, 1, 0]), "layers") == (None, "only a class shows its layers")
    entropy = {"policy": [[0.75, 0.25], [0.25, 0.75], [1, 0]]}
    assert found(lambda env, steps, seed, ent_coef: entropy, "entropy")[0] is True
    assert found(lambda env, steps, seed, ent_coef: [0, 1, 0], "entropy")[0] is None
    with pytest.raises(InputError, match=r"needs a function that can be imported; use 1"):
        found(returns(exact), "constant", processes=2)


@pytest.mark.filterwarnings("ignore:.*spec")
@pytest.mark.parametrize("observation", ["state", "one_hot"])
def test_it_learns_in_an_ordinary_environment(observation: str) -> None:
    def train(env: Any, total_timesteps: int, seed: int) -> Any:
        check_env(env, skip_render_check=True)
        assert (total_timesteps, seed) == (7, 5)
        see = int if observation == "state" else np.argmax
        walk = [env.reset(seed=seed), env.step(1), env.step(0)]
        assert [see(each[0]) for each in walk] == [0, 1, 1]
        assert [each[1:] for each in walk[1:]] == [(0.0, False, False, {}), (1.0, False, True, {})]
        return lambda seen: int(see(seen) == 0)

    assert found(train, "truncation", observation=observation, steps=7, seed=5) == (True, "optimal")


SOUND = ("choice", "termination", "truncation")
CAUGHT = {
    ("dqn", "dones"): "termination",
    ("dqn", "target"): "truncation",
    ("dqn", "next"): "delay",
    ("ppo", "sign"): "choice",
    ("ppo", "dones"): "termination",
    ("ppo", "gamma"): "discount",
    ("ppo", "truncated"): "truncation",
    ("ppo", "leak"): "leak",
}
STEPS = {"dqn": 2000, "ppo": 3000}


@pytest.mark.slow
@pytest.mark.parametrize("kind", STEPS)
def test_cleanrls_learners_pass(kind: str) -> None:
    torch.set_num_threads(1)
    probes, more = ((), 3) if PLANT_ALL else (SOUND, 1)
    train = getattr(cleanrl, kind)
    result = gridworld.check(train, probes=probes, observation="one_hot", steps=more * STEPS[kind])
    assert result.passed, str(result)
    assert PLANT_ALL or all(finding.passed for finding in result.findings)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "bug"), CAUGHT)
def test_a_bug_in_them_is_found(kind: str, bug: str) -> None:
    torch.set_num_threads(1)
    train, probe = partial(getattr(cleanrl, kind), bug=bug), BY_NAME[CAUGHT[kind, bug]]
    [(passed, text)] = run._once(subject(train, "one_hot"), {}, 0, [probe], STEPS[kind])
    assert passed is False, text


LARGEST: dict[str, Any] = {  # how a bug finds the largest of some values
    "from 0": lambda q: max(0.0, q.max()),
    "from -1": lambda q: max(-1.0, q.max()),
    "by size": lambda q: q[np.abs(q).argmax()],
    "not 0": lambda q: q[q != 0].max(initial=-np.inf) if q.any() else 0.0,
    "above 0": lambda q: q.max() if q.max() > 0 else q.min(),
}
LIMITS = {"beyond 1": 1, "beyond 2": 2, "beyond 3": 3}  # of rewards


def q_learning(env: Any, steps: int, seed: int, gamma: float, bug: str) -> np.ndarray:
    """Q-learning, Q by states and actions."""
    rng = np.random.default_rng(seed)
    q = np.zeros((env.observation_space.n, env.action_space.n))
    visits, state, mean = np.zeros_like(q), env.reset(seed=seed)[0], 0.0
    for step in range(steps):
        explores = rng.random() < max(0.1, 1 - 2 * step / steps)
        action = int(rng.integers(q.shape[1]) if explores else q[state].argmax())
        following, reward, terminated, truncated, _ = env.step(action)
        mean += (reward - mean) / (step + 1)
        reward = np.clip(reward, -(limit := LIMITS.get(bug, np.inf)), limit)
        if bug == "mean":
            reward -= mean
        if bug == "double":
            reward *= 2
        over = terminated or (truncated and bug == "limits")
        best = LARGEST.get(bug, np.max)(q[following])
        target = reward + (0.0 if over else gamma * best)
        if bug == "targets":
            target = max(0.0, target)
        visits[state, action] += 1
        q[state, action] += 10 / (10 + visits[state, action]) * (target - q[state, action])
        state = env.reset()[0] if terminated or truncated else following
    return q


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bug", "failed"),
    [
        *[("", []), ("mean", ["costs"]), ("targets", ["costs", "large"])],
        *[(bug, ["costs"]) for bug in LARGEST],
        *[(bug, ["large"]) for bug in LIMITS],
    ],
)
def test_values_below_0_and_rewards_beyond_1(bug: str, failed: list[str]) -> None:
    """By its policy alone, of a learner that takes no discount."""
    result = gridworld.check(
        lambda env, steps, seed: q_learning(env, steps, seed, 0.95, bug).argmax(axis=1),
        probes=["trap", "costs", "large"],
        steps=5000,
    )
    assert result.failed == failed, str(result)


@pytest.mark.slow
def test_a_bug_is_blamed_once() -> None:
    result = gridworld.check(
        lambda env, steps, seed, gamma: {"q": q_learning(env, steps, seed, gamma, "limits")},
        probes=["truncation", "leak", "delay", "alternation"],
    )
    assert result.failed == ["truncation", "alternation"]
    by_name = {finding.name: finding for finding in result.findings}
    assert by_name["truncation"].may_follow_from == ()
    assert by_name["leak"].found == "not asked, its policy is not optimal"
    assert str(by_name["alternation"]).endswith("\n    may follow from truncation; mend that first")
    alone = gridworld.check(
        lambda env, steps, seed, gamma: {"q": q_learning(env, steps, seed, gamma, "limits")},
        probes=["alternation"],
    )
    assert "may follow" not in str(alone)


def test_a_function_in_a_file_is_found_by_other_processes_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a module of Python's has the file's name."""
    (tmp_path / "random.py").write_text(
        "def train(env, total_timesteps, seed):\n    return lambda state: 1\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    result = gridworld.check("random.py:train", probes=["choice", "delay"], processes=2)
    assert [each.name for each in result.findings] == ["choice", "delay"]


@pytest.mark.slow
def test_what_fails_in_one_step_is_mended_first() -> None:
    result = gridworld.check(
        lambda env, steps, seed, gamma: {"q": q_learning(env, steps, seed, gamma, "double")},
        probes=["constant", "choice", "discount", "trap"],
    )
    assert result.failed == ["constant", "discount", "trap"]
    assert [each.may_follow_from for each in result.findings] == [(), (), ("constant",), ("constant",)]


PLUGIN = """
def test_right(gridworld_check):
    assert gridworld_check(lambda env, total_timesteps, seed: [1, 0], probes=["choice"]).passed

def test_wrong(gridworld_check):
    gridworld_check(lambda env, total_timesteps, seed: [0, 0], probes=["choice"])
"""


def test_the_fixture_of_pytest(tmp_path: Path) -> None:
    shutil.copy(pytest_plugin.__file__, tmp_path / "pytest_gridworld.py")
    (tmp_path / "test_mine.py").write_text(PLUGIN)
    words = ["-m", "pytest", "-W", "error", "-p", "pytest_gridworld", "-p", "no:cacheprovider", "-q"]
    environment = os.environ | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    environment["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # where it is installed, it is there already
    where: dict[str, Any] = {"cwd": tmp_path, "env": environment, "text": True, "capture_output": True}
    done = subprocess.run([sys.executable, *words], check=False, **where)
    assert "its best actions are [0], with regret 1 (2 seeds)\n" in done.stdout
    assert "\n    worse actions are preferred: the advantage's sign is wrong" in done.stdout
    assert "1 failed, 1 passed" in done.stdout
    light = "import sys, pytest_gridworld; assert not {'gridworld', 'torch', 'numpy'} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", light], check=True, **where)


def test_without_gamma_the_best_actions_are_the_same_for_every_discount() -> None:
    for probe in PROBES:
        if probe.needs != "gamma":
            best = [solved(probe.world, gamma).optimal for gamma in (probe.gamma, 0.9, 0.99, 0.999)]
            assert all((each == best[0]).all() for each in best), probe.name
