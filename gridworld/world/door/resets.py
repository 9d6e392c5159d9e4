"""Whether a reset always leads to the same, whatever came before it."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from gridworld.world.door.attributes import differing, held_by, innermost, is_plain
from gridworld.world.door.observations import content

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

_FEW_STARTS, _SEEDS = 256, 100  # of more starts, those with so many seeds are compared
_MOST_RESETS = 1_000  # that lead to other states than usual; more will not turn out to be alike
Start = tuple[Fraction, int, bytes]  # a probability, the number of a state, a digest of the observation


class Resets:
    """The resets of a search, which begins with one from a copy of the environment as it is."""

    def __init__(self, search: Search, first: bytes) -> None:
        self._search, self._first = search, first
        self.starts = search.merged(partial(search.reset_from, first))
        self._first_start = search.branching.first(partial(search.reset_from, first))[:2]
        self._others: dict[Any, bytes] = {}  # a copy before each reset that leads to other states

    def check_first(self, copy: bytes) -> None:
        """The first outcome of its draws must lead to the same."""
        number, seen = self._search.branching.first(partial(self._search.reset_from, copy))[:2]
        self._compare([(Fraction(1), *self._first_start)], [(Fraction(1), number, seen)], copy)

    def check(self, copy: bytes) -> None:
        """It must lead to the same, whatever it draws; of many outcomes, some that numpy draws are tried."""
        if len(self.starts) > _FEW_STARTS and all(map(partial(self._is_same, copy), range(_SEEDS))):
            return
        found = self._search.merged(partial(self._search.reset_from, copy))
        self._compare([each[:3] for each in self.starts], [each[:3] for each in found], copy)

    def _is_same(self, copy: bytes, seed: int) -> bool:
        """Whether it leads to the same as the first with the same draws."""
        after = []
        for each in (self._first, copy):
            with self._search.branching.drawing(np.random.default_rng(seed)):
                after.append(self._search.reset_from(each)[:2])
        return after[0] == after[1]

    def _compare(self, usual: list[Start], found: list[Start], copy: bytes) -> None:
        """Both must be the same, or states that turn out to be alike, which are tried too."""
        if sorted(usual) == sorted(found):
            return
        self._others.setdefault((tuple(usual), tuple(found)), copy)
        if len(self._others) > _MOST_RESETS:
            self._refuse(copy)
        self._search.open(number for _, number, _ in found)

    def check_others(self, classes: Sequence[int]) -> None:
        """Those that led elsewhere must have led to states of the same classes."""
        for (usual, found), copy in self._others.items():
            shares: list[dict[Any, Fraction]] = [{}, {}]
            for share, starts in zip(shares, (usual, found), strict=True):
                for probability, number, seen in starts:
                    key = classes[number], seen
                    share[key] = share.get(key, Fraction(0)) + probability
            if shares[0] != shares[1]:
                self._refuse(copy)

    def _refuse(self, copy: bytes) -> NoReturn:
        usual, found = self._values_after(self._first), self._values_after(copy)
        outer, inner = (differing(*each) for each in zip(usual, found, strict=True))
        changed = ", ".join(innermost(outer, inner)) or "nothing"
        raise self._search.refusal(
            f"a reset does not always lead to the same state (in {changed}), so its "
            "states cannot be enumerated from one start; set all of it in reset(), or name what does not "
            "matter in env.ignore"
        )

    def _values_after(self, copy: bytes) -> tuple[dict[str, set[bytes]], dict[str, set[bytes]]]:
        """The contents of attributes, and of what they hold, after all outcomes of a reset."""
        values: dict[str, set[bytes]] = {}
        inner: dict[str, set[bytes]] = {}
        search = self._search

        def reset() -> Any:
            result = search.reset_from(copy)
            for (_, name), value in search.layers.values(search.ignore).items():
                values.setdefault(name, set()).add(value)
            for name, held in (each for layer in search.layers.layers for each in held_by(layer)):
                if is_plain(held):
                    inner.setdefault(name, set()).add(content(held))
            return result

        search.branching.outcomes(reset)
        return values, inner
