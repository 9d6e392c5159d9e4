"""Classes of states in which all that follows is alike, against a plain fixed point."""

from collections import Counter
from fractions import Fraction
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from gridworld.world.door.beliefs import Step, lumped

States = list[list[list[Step]]]


@st.composite
def systems(draw: st.DrawFn) -> States:
    """A few states, some of them ends, whose outcomes are often alike."""
    size = draw(st.integers(1, 12))
    outcome = st.tuples(st.integers(1, 2), st.integers(-1, size - 1), st.sampled_from(["", "", "other"]))
    rows = st.lists(st.lists(outcome, min_size=1, max_size=3), min_size=2, max_size=2)
    states = draw(st.lists(st.one_of(st.just([]), rows, rows), min_size=size, max_size=size))

    def steps(row: list[tuple[int, int, str]]) -> list[Step]:
        total = sum(weight for weight, *_ in row)
        return [Step(Fraction(w, total), to, seen.encode(), 0.0, to < 0, False) for w, to, seen in row]

    return [[steps(row) for row in rows] for rows in states]


def naive(states: States, apart: list[Any]) -> list[Any]:
    """Split by all that follows, everywhere, until nothing is split any more."""
    classes: list[Any] = [(bool(rows), each) for rows, each in zip(states, apart, strict=True)]
    for _ in states:
        found = []
        for own, rows in zip(classes, states, strict=True):
            following = []
            for row in rows:
                sums: Counter[Any] = Counter()
                for probability, to, *shown in row:
                    sums[classes[to] if to >= 0 else "over", *shown] += probability  # type: ignore[assignment]
                following.append(frozenset(sums.items()))
            found.append((own, tuple(following)))
        names: dict[Any, int] = {}
        classes = [names.setdefault(each, len(names)) for each in found]
    return classes


@given(systems(), st.data())
def test_classes_are_those_of_the_fixed_point(states: States, data: st.DataObject) -> None:
    apart = data.draw(st.lists(st.sampled_from([0, 0, 0, 1]), min_size=len(states), max_size=len(states)))
    assert lumped(states, apart) == naive(states, apart)


def test_a_state_of_a_long_chain_is_looked_at_a_few_times() -> None:
    size, looks = 1_000, Counter[int]()

    class Rows(list[list[Step]]):
        def __iter__(self) -> Any:
            looks["all"] += 1
            return super().__iter__()

    states = [
        Rows([[Step(Fraction(1), min(s + 1, size - 1), b"", float(s == 7), False, False)]])
        for s in range(size)
    ]
    classes = lumped(states, [0] * size)
    assert len(set(classes)) == 9
    assert looks["all"] <= 4 * size
