"""Every outcome of a draw with its probability, against numpy's own draws and closed forms."""

import itertools
from collections import Counter, deque
from collections.abc import Callable, Hashable
from fractions import Fraction
from math import comb, exp, lgamma, log
from typing import Any

import numpy as np
import pytest

from gridworld.base.errors import InputError
from gridworld.world.door import branching
from gridworld.world.door.branching import Branching

DRAWN = 4000
SHARES = [0.1, 0.2, 0.3, 0.4]


def _shuffled(rng: Any, kind: Callable[[Any], Any] = list) -> Hashable:
    items = kind([1, 2, 3])
    rng.shuffle(items)
    return tuple(items)


def _until(rng: Any) -> int:
    count = 0
    while count < 4 and rng.random() < 0.5:
        count += 1
    return count


def _twice(rng: Any) -> Hashable:
    drawn = rng.random()
    return bool(drawn < 0.5), bool(drawn < 0.25), bool(drawn >= 0.75), bool(drawn > 2)


DRAWS: dict[str, Callable[[Any], Hashable]] = {
    "choice": lambda rng: rng.choice([1, 2, 2, 5]).item(),
    "choice of letters": lambda rng: rng.choice(["a", "b"], p=[0.3, 0.7]).item(),
    "choice of rows": lambda rng: tuple(rng.choice([(1, 2), (3, 4)]).tolist()),
    "choices": lambda rng: tuple(rng.choice(3, size=2).tolist()),
    "different choices": lambda rng: tuple(rng.choice(4, 2, replace=False).tolist()),
    "different weighted choices": lambda rng: tuple(rng.choice(4, 2, replace=False, p=SHARES).tolist()),
    "integers": lambda rng: tuple(rng.integers([1, 2], [2, 3], endpoint=True).tolist()),
    "an integer": lambda rng: int(rng.integers(2, 5)),
    "several integers": lambda rng: tuple(rng.integers(2, size=3).tolist()),
    "categorical": lambda rng: int(np.argmax(np.cumsum(SHARES) > rng.random())),
    "searched": lambda rng: int(np.searchsorted(np.cumsum(SHARES), rng.random())),
    "searched right": lambda rng: int(np.cumsum(SHARES).searchsorted(rng.random(), side="right")),
    "compared twice": _twice,
    "several numbers": lambda rng: tuple((rng.random(2) < np.array([0.4, 0.1])).tolist()),
    "whole part": lambda rng: int(rng.random() * 4),
    "rounded down": lambda rng: int(np.floor(1 + 3 * rng.random())),
    "one minus": lambda rng: bool(1 - rng.random() < np.float64(0.2)),
    "uniform": lambda rng: bool(np.float64(0) < rng.uniform(-1, 3)),
    "permutation": lambda rng: tuple(rng.permutation([3, 1, 1]).tolist()),
    "shuffle": _shuffled,
    "binomial": lambda rng: int(rng.binomial(3, 0.3)),
    "multinomial": lambda rng: tuple(rng.multinomial(3, [0.2, 0.3, 0.5]).tolist()),
    "poisson": lambda rng: int(rng.poisson(2.5)),
    "geometric": lambda rng: tuple(rng.geometric(0.7, size=2).tolist()),
    "several shuffles": lambda rng: (rng.permutation(0).size, _shuffled(rng)),
    "a shuffled deque": lambda rng: _shuffled(rng, deque),
    "an instance": lambda rng: isinstance(rng, np.random.Generator) and isinstance(rng.random(), float),
    "as many as earlier draws say": _until,
}


def outcomes(draw: Callable[[Any], Any]) -> dict[Any, Fraction]:
    rng = Branching("env.id=Test-v0")
    return rng.outcomes(lambda: draw(rng))


@pytest.mark.parametrize("what", DRAWS)
def test_outcomes_are_those_of_numpy(what: str) -> None:
    exact, rng = outcomes(DRAWS[what]), np.random.default_rng(1)
    assert sum(exact.values()) == 1
    counts = Counter(DRAWS[what](rng) for _ in range(DRAWN))
    assert counts.keys() <= exact.keys()
    for outcome, probability in exact.items():
        spread = (float(probability * (1 - probability)) / DRAWN) ** 0.5
        assert abs(counts[outcome] / DRAWN - probability) < 5 * spread + 1e-9, outcome


def test_probabilities_are_exact() -> None:
    assert outcomes(DRAWS["choice"]) == {1: Fraction(1, 4), 2: Fraction(1, 2), 5: Fraction(1, 4)}
    assert set(outcomes(DRAWS["different choices"]).values()) == {Fraction(1, 12)}
    share = Fraction(0.3)
    assert outcomes(DRAWS["binomial"]) == {
        k: comb(3, k) * share**k * (1 - share) ** (3 - k) for k in range(4)
    }
    assert outcomes(lambda rng: (rng.poisson(0), rng.geometric(1))) == {(0, 1): 1}
    found = outcomes(lambda rng: rng.poisson(400.0))  # of which the least are rare, too
    assert sum(k * share for k, share in found.items()) == pytest.approx(400, rel=1e-12)
    assert float(found[400]) == pytest.approx(exp(400 * log(400) - 400 - lgamma(401)), rel=1e-11)
    edges = [Fraction(each) for each in [0.0, *np.cumsum(SHARES).tolist()]]
    found = outcomes(DRAWS["categorical"])
    assert [found[k] for k in range(4)] == [end - start for start, end in itertools.pairwise(edges)]


@pytest.mark.parametrize(
    "draw",
    [
        lambda rng: rng.choice(5),
        lambda rng: rng.choice(np.array([1.5])),
        lambda rng: rng.integers(3),
        lambda rng: rng.integers(3, dtype=np.int8),
        lambda rng: rng.integers(3, dtype=int),
        lambda rng: rng.binomial(3, 0.5),
        lambda rng: rng.poisson(0.5),
        lambda rng: rng.geometric(0.5),
        lambda rng: rng.random() < 0.5,
        lambda rng: 1 - rng.random() > np.float64(0.5),
        lambda rng: 2 * rng.random(2)[0] >= 1,
    ],
)
def test_types_are_those_of_numpy(draw: Callable[[Any], Any]) -> None:
    assert list(outcomes(lambda rng: type(draw(rng)))) == [type(draw(np.random.default_rng(0)))]


REFUSED: dict[str, tuple[Callable[[Any], Any], str]] = {
    "a number": (lambda rng: float(rng.random()), "used for more than comparisons"),
    "a number in an array": (
        lambda rng: np.array([rng.random()], np.float32),
        "used for more than comparisons",
    ),
    "a number in a text": (lambda rng: f"{rng.random():.2f}", "used for more than comparisons"),
    "a root": (lambda rng: np.sqrt(rng.random()), "used for more than comparisons"),
    "two numbers": (lambda rng: rng.random() < rng.random(), "used for more than comparisons"),
    "a negative whole part": (lambda rng: int(1 - 3 * rng.random()), "used for more than comparisons"),
    "an array to put it in": (
        lambda rng: np.less(rng.random(), np.ones(2), out=np.zeros(2, bool)),
        "used for more than comparisons",
    ),
    "what is rounded off": (lambda rng: rng.random() + 1e16 - 1e16 < 0.5, "used for more than comparisons"),
    "a threshold of 16 bits": (lambda rng: rng.random() < np.float16(0.3), "meets a float16"),
    "a factor of 32 bits": (lambda rng: rng.random() * np.float32(6) < 1, "meets a float32"),
    "draws of 32 bits": (lambda rng: rng.random(dtype=np.float32) < 0.3, "of 32 bits"),
    "a list": (lambda rng: rng.random() < [0.2, 0.5], "used for more than comparisons"),
    "a method": (lambda rng: rng.random().hex(), "used for more than comparisons"),
    "equality": (lambda rng: rng.random() == 0.5, "used for more than comparisons"),
    "normal": (lambda rng: rng.normal(), r"np_random.normal\(\) has too many outcomes"),
    "gamma": (lambda rng: rng.gamma(2), r"np_random.gamma\(\) has too many outcomes"),
    "a large mean": (lambda rng: rng.poisson(20_000), r"poisson\(20000\) has more than 10,000 outcomes"),
    "a small chance": (lambda rng: rng.geometric(1e-9), r"geometric\(1e-09\) has more than 10,000 outc"),
    "several poisson": (lambda rng: rng.poisson([2, 3]), r"poisson\(\) with arrays cannot be enumerated"),
    "many integers": (lambda rng: rng.integers(10**6), "a draw has 1,000,000 outcomes"),
    "many draws": (lambda rng: str(rng.integers(100, size=3)), "more than 300 random outcomes"),
    "no last draw": (
        lambda rng: [None for _ in iter(lambda: bool(rng.random() < 0.5), False)],
        "more than 500",
    ),
    "the generator's state": (lambda rng: rng.bit_generator.state, "bit_generator is used"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_enumerated_is_refused_with_its_line(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw, reason = REFUSED[what]
    monkeypatch.setattr(branching, "MOST_BRANCHES", 300)
    with pytest.raises(InputError, match=f"^env.id=Test-v0: .*{reason}") as refused:
        outcomes(draw)
    assert "test_branching.py:" in str(refused.value) or what == "many draws"


def test_an_environment_that_catches_a_refusal_is_refused_all_the_same() -> None:
    def careful(rng: Any) -> float:
        try:
            return float(rng.normal())
        except Exception:
            return 0.0

    with pytest.raises(InputError, match="normal"):
        outcomes(careful)


def test_what_numpy_refuses_is_refused() -> None:
    for draw in (
        lambda rng: rng.choice([]),
        lambda rng: rng.choice(2, p=[0.5, 0.6]),
        lambda rng: rng.integers(0),
    ):
        with pytest.raises(ValueError, match=r"."):
            outcomes(draw)


def test_a_number_of_another_run_and_a_step_that_is_not_repeatable() -> None:
    kept: list[Any] = []

    def keeps(rng: Any) -> bool:
        kept.append(rng.random())
        return bool(rng.random() < 0.5 and kept[0] < 0.5)

    with pytest.raises(InputError, match="kept beyond its step"):
        outcomes(keeps)
    with pytest.raises(InputError, match="draws otherwise"):
        outcomes(lambda rng: (kept.append(0), rng.integers(2 + len(kept) % 2))[1])
