"""What a search may take, how far it is, and what keeps growing where that is too much."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from gridworld.base.console import ProgressLine
from gridworld.base.user_input import check_memory

if TYPE_CHECKING:
    from gridworld.world.door.search import Search

MOST_STATES, MOST_SECONDS = 200_000, 120.0
_MOST_BYTES = 2**31  # of all copies and observations together
SAMPLED = 16  # of so many states the copy of one is kept, to name what keeps changing
_MOST_SAMPLES = 1_000
_FIRST, _SLOW = 1.0, 6.0  # seconds after which progress is shown, and what keeps growing
_BETWEEN_LOOKS, _BETWEEN_LINES = 0.5, 3.0  # seconds: of progress on a terminal, and elsewhere


class Budget:
    """The states and the seconds of a search; its progress is shown from the first second on."""

    def __init__(self, search: Search, most_states: int, most_seconds: float) -> None:
        self._search, self.most_states, self._most_seconds = search, most_states, most_seconds
        self._is_by_settings = search.where.startswith("env.id")
        self._began = time.monotonic()
        self._line, self._due = ProgressLine(enabled=True, seconds_between_lines=_BETWEEN_LINES), _FIRST
        self._growing = ""
        self.is_explored = False  # then its environment is as it was, and not to be touched
        self.begin()

    def begin(self) -> None:
        """Nothing is found yet, as where a search begins again."""
        self.num_bytes, self.most_now = 0, self.most_states

    def seconds_left(self) -> float:
        """Of those that it may take."""
        return self._most_seconds - (time.monotonic() - self._began)

    def add(self, size: int) -> None:
        """Another state was found, whose copy has so many bytes."""
        search, self.num_bytes = self._search, self.num_bytes + size
        num_bytes = self.num_bytes + search.seen.num_bytes
        if len(search.states) > self.most_now:
            raise search.too_large(
                f"more than {self.most_now:,} states can be reached, too many to solve, since its "
                f"{self.what_changes()}"
            )
        if num_bytes > _MOST_BYTES:
            most = f"{_MOST_BYTES / 2**30:.0f} GiB"
            raise search.too_large(f"copies of the first {len(search.states):,} states take more than {most}")
        check_memory(search.where, num_bytes)

    def check_seconds(self, outcomes: int = 0) -> None:
        """Refuse to go on where its time is over, in a step that has had so many outcomes."""
        if self.seconds_left() < 0:
            size, search = len(self._search.states), self._search
            more = f"{'env.' * self._is_by_settings}most_seconds={2 * self._most_seconds:g} allows more"
            if outcomes >= size:  # so that is what took long
                raise search.too_large(
                    "a reset or a step has more random outcomes than can be tried in the time allowed: "
                    f"after {outcomes:,} there are more ({more})"
                )
            raise search.too_large(
                f"after {self._most_seconds:g} s it still finds new states ({size:,} so far; {more}), since "
                f"its {self.what_changes()}"
            )

    def show(self, what: str) -> None:
        """Show how far it is, and after some seconds what keeps growing, too."""
        seconds = time.monotonic() - self._began
        if seconds >= self._due:
            self._due = seconds + _BETWEEN_LOOKS
            if seconds > _SLOW and not (self._growing or self.is_explored) and (names := self._most_values()):
                self._growing = f"; {names} keeps changing"
            where = self._search.where
            self._line.show(lambda: f"{where}: {what}, {seconds:.0f} s{self._growing}; Ctrl-C ends it")

    def clear(self) -> None:
        """Remove that line from a terminal."""
        self._line.clear()

    def _most_values(self) -> str:
        """The attributes, or times, of most values that only later states have; empty: none has several."""
        values: dict[str, dict[Any, int]] = {}  # with the number of the state in which each is met first
        layers, ignore = self._search.layers, self._search.ignore
        if layers.clocks and 2 * len(self._search.cores) < len(self._search.states):
            return ", ".join(sorted(clock.key[1] for clock in layers.clocks))
        found = [each for each in self._search.states[::SAMPLED] if each.copy][-_MOST_SAMPLES:]
        for number, state in enumerate(found):
            layers.put(state.copy, state.depth)
            for (_, name), key in layers.values(ignore).items():
                values.setdefault(name, {}).setdefault(key, number)
            for clock in layers.clocks:
                values.setdefault(clock.key[1], {}).setdefault(state.depth, number)
        late = {
            name: (sum(2 * number >= len(found) for number in each.values()), len(each))
            for name, each in values.items()
            if len(each) > 1
        }
        return ", ".join(sorted(name for name in late if late[name] == max(late.values())))

    def what_changes(self) -> str:
        """What keeps changing, and a remedy, as the rest of a sentence."""
        names = self._most_values() or "state"
        first, by_settings = names.split(",")[0], self._is_by_settings
        limit = "env.kwargs.max_episode_steps" if by_settings else "gymnasium.wrappers.TimeLimit"
        ignored = f"env.ignore=[{first}]" if by_settings else f'ignore=["{first}"]'
        return (
            f"{names} keeps changing; use a smaller one, set a limit ({limit}), or ignore irrelevant "
            f"attributes, e.g. {ignored}"
        )
