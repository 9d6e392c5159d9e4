"""The checker believes nothing: files that claim more than is true are refused, and what is none."""

import copy
import gzip
import json
import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import gridworld
from gridworld.base.errors import InputError
from gridworld.commands import verify as command
from gridworld.training.verify import Verified, _checker, proven
from gridworld.world.evaluation import Evaluator

SCRIPT = Path(__file__).parents[2] / "scripts" / "check_certificate.py"
FALSIFIED = 300  # files in CI; 10,000 were tried
LAKE = {"world": "frozen_lake_v1", "gamma": 0.99}


def certificate(name: str = "classic", gamma: float = 0.99) -> dict[str, Any]:
    evaluator = Evaluator(gridworld.compile_env(name), gamma, 100)
    found = proven(evaluator, evaluator.solution.optimal.argmax(axis=1))
    assert found.is_optimal
    return found.certificate


@pytest.fixture(scope="module")
def holding() -> list[dict[str, Any]]:
    return [
        certificate(),
        certificate("frozen_lake_v1"),
        certificate("classic", 1.0),
        certificate("cliff_walking", 1),
    ]


def run(*paths: Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-I", SCRIPT, *paths], capture_output=True, text=True, check=False)


def test_a_file_is_checked_with_python_alone(tmp_path: Path) -> None:
    plain, packed = tmp_path / "plain.json", tmp_path / "packed.json.gz"
    found = certificate()
    for path in (plain, packed):
        Verified(0.0, is_optimal=True, is_exact=True, certificate=found).write(path)
    assert json.loads(gzip.decompress(packed.read_bytes())) == json.loads(plain.read_bytes())
    done = run(plain, packed)
    assert done.returncode == 0, done.stderr
    assert (
        len(
            re.findall(
                r"holds. The policy earns at least 0\.93206534790\d*, and no policy earns", done.stdout
            )
        )
        == 2
    )
    assert done.stdout.count(f"Rows {found['digest']}, 26 states, known like this: 'by construction'") == 2
    source = SCRIPT.read_text()
    assert "gridworld" not in source
    imported = set(re.findall(r"^(?:import|from) (\w+)", source, re.MULTILINE))
    assert imported <= sys.stdlib_module_names
    assert len([line for line in source.splitlines() if line.strip()]) <= 80


WRONG: dict[str, tuple[Any, str]] = {
    "no JSON": (lambda text: text[:5], "Unterminated"),
    "a list": (lambda text: "[]", "not the keys"),
    "a key twice": (lambda text: text.replace('"lower": {', '"lower": {"0": -9.0, '), "a key comes twice"),
    "NaN": (lambda text: re.sub(r'"gamma": [\d.]+', '"gamma": NaN', text), "NaN"),
    "infinity": (lambda text: re.sub(r'("upper": {"0": )[\d.e-]+', r"\1Infinity", text), "Infinity"),
    "too large": (lambda text: re.sub(r'("upper": {"0": )[\d.e-]+', r"\g<1>1e999", text), "Infinity"),
    "a text": (lambda text: re.sub(r'("upper": {"0": )[\d.e-]+', r'\1"9"', text), "sequence"),
    "another digest": (lambda text: re.sub(r'"digest": "..', '"digest": "xx', text), "digest"),
    "bytes": (lambda text: "\x00" + text, "Expecting"),
    "a scope that is no sentence": (lambda text: text.replace('"by construction"', '["x"]'), "scope"),
    "beyond floats": (
        lambda text: re.sub(r'("lower": {"0": )[\d.e-]+', rf"\g<1>-{10**400}", text),
        "too large",
    ),
    "deep": (lambda text: "[" * 100_000, "while decoding"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_no_certificate_is_refused(what: str, tmp_path: Path) -> None:
    change, told = WRONG[what]
    path = tmp_path / "file.json"
    path.write_text(change(json.dumps(certificate())))
    done = run(path)
    assert (done.returncode, done.stdout) == (1, "")
    assert f"{path}: DOES NOT HOLD: " in done.stderr
    assert told in done.stderr
    assert "Traceback" not in done.stderr


def test_a_file_that_is_not_there_proves_nothing(tmp_path: Path) -> None:
    assert run(tmp_path / "none.json").returncode == 1


def falsified(given: dict[str, Any], numbers: np.random.Generator) -> dict[str, Any]:
    """The same with something changed, of all that can be."""
    found = copy.deepcopy(given)
    states = list(found["world"])
    state = states[numbers.integers(len(states))]
    inside = list(found["policy"])[numbers.integers(len(found["policy"]))]
    row = found["world"][state][numbers.integers(len(found["world"][state]))]
    outcome = row[numbers.integers(len(row))]
    near = float(numbers.choice([1e-15, 1e-9, 1e-3, 1.0])) * float(numbers.choice([-1, 1]))
    match int(numbers.integers(13)):
        case 0:
            found["policy"][inside] = int(numbers.integers(-1, 6))
        case 1:
            found["upper"][state] += near
        case 2:
            found["lower"][inside] += near
        case 3:
            outcome[2] += near
        case 4:
            outcome[0] += near
        case 5:
            outcome[1] = int(numbers.integers(40))
        case 6:
            del found["world"][state]
        case 7:
            found["world"][str(100 + int(state))] = found["world"].pop(state)
        case 8:
            name = str(numbers.choice(["upper", "lower", "policy", "world", "steps"]))
            if found[name]:
                del found[name][next(iter(found[name]))]
        case 9:
            found["start"][0][numbers.integers(2)] = float(numbers.choice([0, 1, 5, 0.5]))
        case 10:
            found["gamma"] = float(numbers.choice([0.5, 0.999, 1.0, 1.5]))
        case 11:
            found["ended"] = found["ended"] + [int(state)]
        case 12:
            found["steps"] = {each: steps * (1 + near) for each, steps in found["steps"].items()}
    return found


def truth(found: dict[str, Any]) -> float:
    """The regret of what a file says, by value iteration over its own rows; raises where these are none."""
    gamma, ended = float(found["gamma"]), {str(each) for each in found["ended"]} - found["world"].keys()
    best, own = (dict.fromkeys(found["world"], 0.0) for _ in range(2))
    policy = found["policy"]
    for _ in range(3_000 if gamma > 0.9 else 200):
        worths = {
            state: [
                sum(p * (r + gamma * (0.0 if str(t) in ended else best[str(t)])) for p, t, r in row)
                / sum(p for p, _, _ in row)
                for row in rows
            ]
            for state, rows in found["world"].items()
        }
        ahead = {
            state: sum(
                p * (r + gamma * (0.0 if str(t) in ended else own[str(t)]))
                for p, t, r in found["world"][state][action]
            )
            for state, action in policy.items()
        }
        new = {state: max(each) for state, each in worths.items()}
        change = max(abs(new[each] - best[each]) for each in new)
        change = max([change, *(abs(ahead[each] - own[each]) for each in ahead)])
        best, own = new, {**own, **ahead}
        if change < 1e-13:
            break
    return sum(p * (best.get(str(s), 0.0) - own.get(str(s), 0.0)) for s, p in found["start"])


def accepted(checker: ModuleType, found: Any) -> Fraction | None:
    try:
        best, worth = checker.check(checker.parsed(json.dumps(found)))
    except Exception:  # as the script takes it
        return None
    return Fraction(best) - worth


@pytest.mark.slow
def test_falsified_files_claim_no_more_than_is_true(holding: list[dict[str, Any]]) -> None:
    numbers, checker, kept = np.random.default_rng(0), _checker(), 0
    for number in range(FALSIFIED):
        found = falsified(holding[number % len(holding)], numbers)
        if (regret := accepted(checker, found)) is not None:
            kept += 1
            assert float(regret) >= truth(found) - 1e-9
    assert 0 < kept < FALSIFIED / 2


LOOP = {
    "claim": "", "digest": "", "scope": "", "gamma": 1, "start": [[0, 1.0]], "ended": [1],
    "world": {"0": [[[1.0, 0, 0]], [[1.0, 1, 1]]]}, "policy": {"0": 0},
    "upper": {"0": 1}, "lower": {"0": 1}, "steps": {},
}  # fmt: skip


@pytest.mark.parametrize("steps", [{}, {"0": 1}, {"0": 10**9}])
def test_waiting_for_ever_earns_nothing_without_a_discount(steps: dict[str, int]) -> None:
    """It waits, though leaving pays 1; both inequalities hold with any number."""
    checker = _checker()
    assert accepted(checker, {**LOOP, "steps": steps}) is None
    assert accepted(checker, {**LOOP, "lower": {"0": 0}}) == 1
    leaving = {**LOOP, "policy": {"0": 1}, "steps": {"0": 1}}
    assert accepted(checker, leaving) == 0
    costly = {
        **leaving,
        "world": {"0": [[[1.0, 0, 0]], [[1.0, 1, -1]]]},
        "lower": {"0": -1},
        "upper": {"0": -1},
    }
    assert accepted(checker, costly) is None  # since waiting is worth 0
    costly["world"] = {"0": [[[1.0, 0, -0.5]], [[1.0, 1, -1]]]}
    assert accepted(checker, costly) == 0


def battery(holding: list[dict[str, Any]]) -> list[str]:
    """Texts of files, most of which are wrong in one thing."""
    numbers = np.random.default_rng(1)
    found = [falsified(holding[number % len(holding)], numbers) for number in range(120)]
    leaving = {**LOOP, "policy": {"0": 1}, "steps": {"0": 1}}
    pay: Any = {"0": [[[1.0, 0, 0]], [[1.0, 1, -1]]]}
    found += [LOOP, {**LOOP, "steps": {"0": 1}}, {**LOOP, "steps": {"0": 10**9}}, leaving]
    found += [
        {**leaving, "policy": {"0": -1}},
        {**leaving, "ended": [1, 0]},
        {**leaving, "start": [[7, 1.0]]},
    ]
    once: Any = {**leaving, "world": {"0": [[[1.0, 1, 1]]]}, "policy": {"0": 0}}
    found += [{**once, "gamma": 2}, {**once, "gamma": -1}, {**once, "more": 1}]
    through = {"0": [[[1.0, 2, 1]]], "2": [[[1.0, 1, -5]]]}  # an end that goes on
    found += [{**once, "gamma": 0.5, "ended": [1, 2], "world": through, "upper": {"0": 1, "2": 0}}]
    found += [
        {**leaving, "gamma": 2},
        {**leaving, "gamma": -1},
        {**leaving, "more": 1},
        {**leaving, "steps": {"0": 0.5}},
    ]
    found += [{**leaving, "world": pay, "lower": {"0": -1}, "upper": {"0": -1}}]
    found += [
        {
            **leaving,
            "gamma": 0.5,
            "start": [[0, 2.0], [1, -1.0]],
            "world": pay,
            "lower": {"0": -1},
            "upper": {"0": 0},
        }
    ]
    found += [{**leaving, "gamma": 0.5, "world": {"0": [[[1.0 - 1e-13, 0, 0]], [[1.0 - 1e-13, 1, 1]]]}}]
    found += [{**leaving, "gamma": 0.5, "world": {"0": [[[1.0, 5, 0]], [[1.0, 1, 1]]]}}]
    found += [
        {**leaving, "upper": {"0": 1, "5": 9}},
        {**LOOP, "gamma": 0.5, "policy": {}, "lower": {}, "upper": {"0": 1}},
        {**leaving, "scope": ["x"]},
    ]
    found += [
        {
            **leaving,
            "world": {"0": [[[1.0, 0, 0]], [[1.0, 3, 1]]], "3": [[[1.0, 1, 5]]]},
            "upper": {"0": 6, "3": 5},
        }
    ]
    texts = [json.dumps(each) for each in found]
    return [
        *texts,
        json.dumps(leaving).replace("{", '{"gamma": 0.1, ', 1),
        json.dumps({**LOOP, "steps": {"0": float("inf")}}),
    ]


def verdicts(source: str, texts: list[str]) -> list[Any]:
    names: dict[str, Any] = {"__name__": "mutant"}
    exec(compile(source, "mutant", "exec"), names)
    found = []
    for text in texts:
        try:
            found.append(names["check"](names["parsed"](text)))
        except Exception as error:
            found.append(type(error).__name__ == "KeyError")
    return found


@pytest.mark.slow
def test_every_check_of_the_script_matters(holding: list[dict[str, Any]]) -> None:
    source, texts = SCRIPT.read_text(), battery(holding)
    whole = verdicts(source, texts)
    body = source[: source.index("if __name__")]
    mutants = {}
    for match in re.finditer(r"^ +need\(", body, re.MULTILINE):
        line = body[: match.start()].count("\n") + 1
        mutants[f"line {line}"] = source[: match.end()] + "True or " + source[match.end() :]
    swaps = [
        ("best <= upper[state]", "best <= upper[state] + 1"),
        ("own >= lower[state]", "own >= lower[state] - 1"),
        ("min(upper.values(), default=0) >= 0 or", "True or"), (">= 1 + left", ">= left"),
        ("- rows.keys()", ""), ("max(mean(", "min(mean("),
        ("if gamma == 1:", "if False:"), (" and action >= 0", ""), ("all(costs)", "True"),
        ("max(lower.values(), default=0) > 0", "False"),
        ('"parse_constant": Fraction', '"parse_constant": float'),
        ("<= 1, f", "<= 9, f"), ("0 <= given", "-9 <= given"),
        ("total / sum(p for p, *_ in row)", "total"),
    ]  # fmt: skip
    for old, new in swaps:
        assert source.count(old) == 1, old
        mutants[f"{old} as {new}"] = source.replace(old, new)
    missed = [name for name, mutant in mutants.items() if verdicts(mutant, texts) == whole]
    assert missed == []


def test_a_run_is_verified_and_written(tmp_path: Path) -> None:
    result = gridworld.train("agent=q_learning", folder=tmp_path / "run")
    assert result.summary["proven_regret"] < 1e-12
    found = gridworld.verify(tmp_path / "run", tmp_path / "certificate.json.gz")
    assert found.is_optimal
    assert found.is_exact
    assert str(found).startswith("optimal: no policy is worth more than ")
    assert gridworld.verify(result).regret == found.regret
    assert run(tmp_path / "certificate.json.gz").returncode == 0
    with pytest.raises(InputError, match="nothing is proven"):
        Verified(np.inf, is_optimal=False, is_exact=False, certificate={}).write(tmp_path / "none.json")


def test_a_certificate_is_written_where_nothing_else_is(tmp_path: Path) -> None:
    run_folder, file = tmp_path / "run", tmp_path / "c.json.gz"
    gridworld.train("agent=q_learning", folder=run_folder)
    before = (run_folder / "model.zip").read_bytes()
    (tmp_path / "link.json").symlink_to(run_folder / "model.zip")
    for name, why in (
        ("run/model.zip", "not a certificate"),
        ("run", "is a folder"),
        *((name, "is not a plain file") for name in ("/dev/null", "link.json")),
        *(("none/c.json", "no such folder"), ("x" * 300, "too long"), ("\ud800", "surrogates")),
    ):
        with pytest.raises(InputError, match=why):
            gridworld.verify(run_folder, tmp_path / name)
    assert (run_folder / "model.zip").read_bytes() == before
    for _ in range(2):  # an older one may be replaced
        gridworld.verify(run_folder, file)
    assert run(file).returncode == 0


def test_what_a_file_says_of_itself_is_printed_as_one_text(tmp_path: Path) -> None:
    forged = certificate() | {"scope": "by construction\nother.json: holds.\x1b[2A"}
    (tmp_path / "forged.json").write_text(json.dumps(forged))
    done = run(tmp_path / "forged.json")
    assert done.returncode == 0
    assert len(done.stdout.splitlines()) == 2
    assert "\x1b" not in done.stdout


def test_both_numbers_that_it_prints_hold_together(tmp_path: Path) -> None:
    """The most that a policy earns more is beside the least that it earns as printed, after its rounding."""
    found = certificate() | {
        "gamma": 0.5,
        "start": [["0", 0.85], ["1", 1 - 0.85]],
        "ended": ["e"],
        "policy": {"0": 0, "1": 0},
        "world": {"0": [[[1.0, "e", 1e100]]], "1": [[[1.0, "e", 3e99]]]},
        "upper": {"0": 1e100, "1": 3e99},
        "lower": {"0": 1e100, "1": 3e99},
        "steps": {},
    }
    found["digest"] = _checker().digest_of(found)
    (tmp_path / "c.json").write_text(json.dumps(found))
    told = run(tmp_path / "c.json").stdout
    least, most = (Fraction(float(each)) for each in re.findall(r"earns (?:at least )?([\d.e+-]+)[, ]", told))
    exact = (Fraction(0.85) * Fraction(1e100) + Fraction(1 - 0.85) * Fraction(3e99)) / (
        Fraction(0.85) + Fraction(1 - 0.85)
    )
    assert least <= exact <= least + most


def test_the_command_verifies_several_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, steps in (("long", 4_000), ("short", 100)):
        short = [f"total_timesteps={steps}", f"evaluation.every={steps}", "recording.frames=false"]
        gridworld.train("agent=q_learning", *short, folder=tmp_path / "runs" / name, progress=False)
    capsys.readouterr()
    command.main([str(tmp_path / "runs")])
    told = capsys.readouterr().out.splitlines()
    assert re.fullmatch(
        r".*long on classic, discount 0.99: optimal: no policy is worth more than .*", told[0]
    )
    assert re.fullmatch(
        r".*short on classic, discount 0.99: no policy is worth more than 0.9\d more, .*", told[2]
    )
    assert told[-1] == "1 of 1 certified runs are proven optimal, of 2 in all"
    with pytest.raises(InputError, match="is for one run, and there are 2"):
        command.main([str(tmp_path / "runs"), "--out", str(tmp_path / "certificate.json")])
