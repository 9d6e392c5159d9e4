"""The steps of an environment beside its transition table P: every row, and every outcome of what it draws.

The state `s` is set before each row; what else it holds is as the rows before have left it, so that steps
which depend on more than `s` differ sooner or later.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from fractions import Fraction
from functools import partial
from typing import Any, NoReturn

import numpy as np

from gridworld.base.errors import InputError, in_short
from gridworld.world.door.layers import Env, Layers
from gridworld.world.door.rejection import Rejecting
from gridworld.world.mdp import Mdp
from gridworld.world.outcomes import Outcomes

_EXACT = 2e-9  # how far a probability may be off, since those of a row may sum to 1 +- 1e-9
_PASSES = 3
_AFRESH = 20  # rows after which an episode begins
_PLAYED, _EPISODE = 6_000, 200  # steps of episodes, and of each at most
_SEED = 20_240_501
Shares = dict[Any, Fraction]


def compare_rows(mdp: Mdp, table: Outcomes, real: Env) -> bool:
    """Refuse who does not follow its table; False: `s` is not all of its state, or cannot be set."""
    branching = Rejecting(mdp.name, bytes, ())
    layers = Layers(mdp.name, real, branching)
    known = {"s", "lastaction"} if type(real).step.__module__.startswith("gymnasium.envs.") else {"s"}
    with layers.restored():
        before, found, mistake = layers.values(), False, None
        try:
            found = _Rows(mdp, table, layers.base, branching).compare()
        except InputError as error:
            mistake = error
        except Exception as error:  # it may raise anything
            raise InputError(f"{mdp.name}: cannot be stepped ({in_short(error)})") from error
        finally:
            layers.check_generators()
        after = layers.values()
    if {name for (_, name) in before | after if before.get((0, name)) != after.get((0, name))} - known:
        return False  # it holds more than the number of its state
    if mistake is not None:
        raise mistake
    return found


class _Rows:
    def __init__(self, mdp: Mdp, table: Outcomes, env: Any, branching: Rejecting) -> None:
        self.mdp, self.table, self.env, self.branching = mdp, table, env, branching
        self._numbers = np.random.default_rng(_SEED)

    def compare(self) -> bool:
        starts = {
            state: Fraction(chance) for state, chance in enumerate(self.table.start.tolist()) if chance > 0
        }
        self._compare("the start", lambda: self._shown(self.env.reset()[0]), starts)
        rows = np.flatnonzero(np.repeat(self.mdp.acting[: len(self.table.start)], self.mdp.num_actions))
        order = [np.random.default_rng(_SEED + n).permutation(rows).tolist() for n in range(_PASSES)]
        if not self._is_settable(order[0]):
            return False
        for number, row in enumerate(itertools.chain.from_iterable(order)):
            if number % _AFRESH == 0:
                self._reset()
            pair = divmod(row, self.mdp.num_actions)
            self._compare(f"P[{pair[0]}][{pair[1]}]", partial(self._stepped, *pair), self._row(*pair))
        self._play()
        return True

    def _reset(self) -> None:
        """Begin an episode by draws of numpy's own, since what they set may be more than `s`."""
        self.branching.sampling = self._numbers
        try:
            self.env.reset()
        finally:
            self.branching.sampling = None

    def _play(self) -> None:
        """Episodes with numpy's own generator, in which what it remembers would show."""
        numbers, self.branching.sampling = np.random.default_rng(_SEED), self._numbers
        try:
            state = 0
            for step in range(_PLAYED):
                if step % _EPISODE == 0:
                    state = self._shown(self.env.reset()[0])
                action = int(numbers.integers(self.mdp.num_actions))
                observation, reward, terminated, *_ = self.env.step(action)
                before, state = state, self._shown(observation)
                if (state, float(reward), bool(terminated)) not in self._row(before, action):
                    self._refuse(f"P[{before}][{action}]", (state, float(reward), bool(terminated)), 1, 0)
                if terminated:
                    state = self._shown(self.env.reset()[0])
        finally:
            self.branching.sampling = None

    def _is_settable(self, rows: list[int]) -> bool:
        """Whether `s` is what is shown, and where it is set the steps are not those of the state before."""
        state = self.branching.first(lambda: self._shown(self.env.reset()[0]))
        if getattr(self.env, "s", None) != state:
            return False
        for other, action in (divmod(row, self.mdp.num_actions) for row in rows):
            unset = self._row(state, action)
            if unset != self._row(other, action):
                self.branching.first(lambda: self._shown(self.env.reset()[0]))
                return self.branching.outcomes(partial(self._stepped, other, action)) != unset
        return True

    def _stepped(self, state: int, action: int) -> tuple[int, float, bool]:
        self.env.s = state
        observation, reward, terminated, truncated, _ = self.env.step(action)
        if truncated and not terminated:
            raise InputError(
                f"{self.mdp.name}: truncates its own episodes, which its table P does not show; leave "
                "that to the "
                "wrapper TimeLimit"
            )
        return self._shown(observation), float(reward), bool(terminated)

    def _shown(self, observation: Any) -> int:
        """The number of the state that is shown."""
        try:
            number = int(observation)
            if number == observation and 0 <= number < self.mdp.num_numbers:
                return number
        except (TypeError, ValueError, OverflowError):
            pass
        raise InputError(
            f"{self.mdp.name}: shows {str(observation)[:80]!r}, must show the number of a state of its "
            "table, 0 to "
            f"{self.mdp.num_numbers - 1}"
        )

    def _row(self, state: int, action: int) -> Shares:
        """The possible outcomes of a row of the table, with their probabilities."""
        table, found = self.table, Shares()
        tables = table.probability, table.next_state, table.reward, table.terminated
        for chance, *outcome in zip(*(each[state, action].tolist() for each in tables), strict=True):
            if chance > 0:
                found[tuple(outcome)] = found.get(tuple(outcome), Fraction(0)) + Fraction(chance)
        return found

    def _compare(self, what: str, run: Callable[[], Any], expected: Shares) -> None:
        found: Shares = self.branching.outcomes(run)
        off = {each: abs(found.get(each, Fraction(0)) - expected.get(each, 0)) for each in expected | found}
        worst = max(off, key=lambda each: off[each])
        if off[worst] <= _EXACT:
            return
        self._refuse(what, worst, found.get(worst, Fraction(0)), expected.get(worst, Fraction(0)))

    def _refuse(self, what: str, outcome: Any, chance: Any, expected: Any) -> NoReturn:
        place = f"{what} in state {outcome}"
        if isinstance(outcome, tuple):
            following, reward, terminated = outcome
            place = (
                f"{what}, to state {following} with reward {reward:g}{' and ended' if terminated else ''},"
            )
        raise InputError(
            f"{self.mdp.name}: does not follow its own table: {place} occurs with a probability of "
            f"{float(chance):.6g}, in the table it is {float(expected):.6g}, so it cannot be solved exactly"
        )
