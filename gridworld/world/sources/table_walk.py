"""A real environment beside its transition table: which outcomes occur, and how often.

It is walked along several policies; where its state can be set, every row of the table is stepped, and every
outcome of what a row or a reset draws from `np_random` is tried (`enumeration.branching`), so that its
probability is known exactly. Counts, which what it remembers or draws elsewhere would show in, are judged by
Bayes factors against the table: with a true table one that is ever above 1/α has at most probability α,
whatever is stepped next and whenever one looks.

Reference: J. Ville, Étude critique de la notion de collectif, 1939.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp

from gridworld.base.errors import InputError
from gridworld.world.enumeration.branching import Branching
from gridworld.world.mdp import FloatArray, IntArray, Mdp, backup
from gridworld.world.outcomes import Outcomes

if TYPE_CHECKING:
    import gymnasium as gym

SEED = 20_240_501  # of the walk
FALSE_ALARM = 1e-9  # probability that a true table is refused
_JUDGED = 5  # kinds of counts
_CONCENTRATIONS = np.array([1.0, 10.0, 100.0, 1000.0])  # of the Dirichlet priors around a row
_VAGUE = 0.5  # what cannot be told nearer than that is not told
_GAMMA = 0.99
_SWEEPS = 100  # at most, of value iteration, for the policies of the walk
_WORK = 2 * 10**7  # outcomes that it takes in a policy, and in all that lead to what is new
_WALK = 6_000  # steps along policies where the state can be set besides
_LONG_WALK = 24_000  # more of them where it cannot
_ROWS = 24_000  # steps over all rows, and outcomes that are tried
_EXACT = 2e-9  # how far a probability may be off, since those of a row may sum to 1 +- 1e-9
_MOST_STEPS = 200  # of an episode, where there is no limit
_RESETS = 1_500  # at least
_SEEDED = 11  # so often with a seed
_BLOCKS = 8  # of starts that follow each other
_MOST_KINDS = 10_000  # numbers in different rows, up to which what came before an outcome is counted too
_PROBES = 12


def walk(mdp: Mdp, table: Outcomes, real: gym.Env[Any, Any]) -> str:
    """Compare steps of the real environment with its table; says what was compared, and how exactly."""
    walker = _Walker(mdp, table, real)
    walker.along_policies(_WALK)
    while walker.episodes < _RESETS:
        walker.reset()
    if walker.is_settable():
        walker.try_outcomes()
        walker.along_rows()
    else:
        walker.along_policies(_LONG_WALK)
    return walker.summary()


class _Walker:
    """Steps an environment, and counts what its R = N * A rows did."""

    def __init__(self, mdp: Mdp, table: Outcomes, real: gym.Env[Any, Any]) -> None:
        self.mdp, self.table, self.real = mdp, table, real
        self.episodes = 0
        self._rng = np.random.default_rng(SEED)
        self._limit = mdp.max_episode_steps or _MOST_STEPS
        self._column, self._chance = _merged(table)
        self._counts = np.zeros(self._chance.shape, dtype=np.int64)
        self._chances, kind = np.unique(self._chance, axis=0, return_inverse=True)  # of the kinds of rows
        self._kind = kind.ravel()
        contexts = 1 + self._chance.shape[1] if self._chances.size < _MOST_KINDS else 1
        self._after = np.zeros((len(self._chances), contexts, self._chance.shape[1]), dtype=np.int64)
        self._before = 0  # 1 + the column of the last outcome
        self._started = np.zeros(len(table.start), dtype=np.int64)
        self._open = np.flatnonzero(np.repeat(mdp.acting[: len(table.start)], mdp.num_actions))
        self._met: list[tuple[int, int, float, bool]] = []  # row, next state, reward, terminated
        self._state = self._elapsed = 0
        self._is_exact = np.zeros(
            1 + len(self._chance), dtype=np.bool_
        )  # of each row, and last of the starts

    def reset(self) -> None:
        seed = None if self.episodes % _SEEDED else SEED + self.episodes  # never one twice
        self._state = self._shown(self.real.reset(seed=seed)[0])
        self._elapsed = 0
        self.episodes += 1
        self._started[self._state] += 1
        if not self.table.start[self._state] > 0:
            raise InputError(
                f"{self.mdp.name}: started in state {self._state}, which has no probability in "
                "initial_state_distrib"
            )

    def _step(self, action: int) -> bool:
        """Take an action; whether the episode is over."""
        observation, reward, terminated, truncated, _ = self.real.step(action)
        row = self._state * self.mdp.num_actions + action
        self._state = self._shown(observation)
        self._met.append((row, self._state, float(reward), bool(terminated)))
        self._elapsed += 1
        if truncated and self._elapsed < (self.mdp.max_episode_steps or np.inf):
            self.check()
            raise InputError(
                f"{self.mdp.name}: truncates its own episodes, which its table P does not show; leave that "
                "to the wrapper TimeLimit"
            )
        return bool(terminated or truncated) or self._elapsed >= self._limit

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
            f"table, 0 to {self.mdp.num_numbers - 1}"
        )

    def along_policies(self, most: int) -> None:
        """Take steps that are good, that live long, that lead to what is new, and random ones."""
        mdp, steps = self.mdp, 0
        good = self._policy(backup(mdp, np.zeros(mdp.num_states), 1.0))
        living = self._policy(~mdp.absorbing[:, None] * np.ones(mdp.num_actions))
        new, more = good, _WORK // (_SWEEPS * mdp.probability.size)
        for episode in range(most):
            if episode % 5 == 3 and more > 0:
                new, more = self._policy(self._newness()), more - 1
            policy, share = [(good, 0.0), (good, 0.1), (living, 0.02), (new, 0.05), (good, 1.0)][episode % 5]
            self.reset()
            over = False
            while not over:
                random = self._rng.random() < share
                over = self._step(int(self._rng.integers(mdp.num_actions) if random else policy[self._state]))
                steps += 1
            if steps >= most:
                break
        self.check()

    def _policy(self, bonus: FloatArray) -> IntArray:
        """(S,), actions that lead to a bonus (S, A), up to what value iteration leaves open."""
        v = np.zeros(self.mdp.num_states)
        reward = backup(self.mdp, v, 1.0)
        for _ in range(min(_SWEEPS, max(10, _WORK // self.mdp.probability.size))):
            q = backup(self.mdp, v, _GAMMA) - reward + bonus
            v = q.max(axis=1)
        return np.asarray(q.argmax(axis=1))

    def _newness(self) -> FloatArray:
        """(S, A), 1 for a row that was never stepped, and less with each step."""
        self.check()
        found = np.zeros((self.mdp.num_states, self.mdp.num_actions))
        visits = self._counts.sum(axis=1).reshape(-1, self.mdp.num_actions)
        found[: len(visits)] = 1 / (1.0 + visits) ** 2
        return np.where(self.mdp.absorbing[:, None], 0.0, found)

    def is_settable(self) -> bool:
        """Whether its attribute `s` is what it shows, and it makes steps that only the state set can make."""
        proven = 0
        for row in self._rng.choice(self._open, size=20 * _PROBES if self._open.size else 0).tolist():
            self.reset()
            if getattr(self.real.unwrapped, "s", None) != self._state:
                return False
            state, action = divmod(row, self.mdp.num_actions)
            if self._row(state, action).keys() & self._row(self._state, action).keys():
                continue
            if self._stepped(state, action) not in self._row(state, action):
                return False
            proven += 1
            if proven == _PROBES:
                break
        return proven > 0

    def _set(self, state: int) -> None:
        self.real.unwrapped.s = state  # type: ignore[attr-defined]
        self._state = state

    def _stepped(self, state: int, action: int) -> tuple[int, float, bool]:
        """The outcome of an action in a state that is set; it is not counted."""
        self._set(state)
        observation, reward, terminated, *_ = self.real.step(action)
        return self._shown(observation), float(reward), bool(terminated)

    def _row(self, state: int, action: int) -> dict[tuple[int, float, bool], Fraction]:
        """The possible outcomes of a row of the table, with their probabilities."""
        table, found = self.table, dict[tuple[int, float, bool], Fraction]()
        tables = table.probability, table.next_state, table.reward, table.terminated
        for chance, *outcome in zip(*(each[state, action].tolist() for each in tables), strict=True):
            if chance > 0:
                following, reward, terminated = outcome
                key = following, reward, terminated
                found[key] = found.get(key, Fraction(0)) + Fraction(chance)
        return found

    def try_outcomes(self) -> None:
        """Try all that resets and rows draw from `np_random`, as long as nothing is drawn elsewhere."""
        own = self.real.unwrapped
        generator, branching = own.np_random, Branching(self.mdp.name)
        own.np_random = branching  # type: ignore[assignment]
        try:
            starts = {state: Fraction(chance) for state, chance in enumerate(self.table.start.tolist())}
            is_known = self._try(branching, -1, lambda: self._shown(self.real.reset()[0]), starts)
            for row in self._rng.permutation(self._open).tolist():
                if not is_known or branching.run > _ROWS:
                    break
                pair = divmod(row, self.mdp.num_actions)
                is_known = self._try(branching, row, partial(self._stepped, *pair), self._row(*pair))
        finally:
            own.np_random = generator

    def _try(
        self, branching: Branching, row: int, draw: Callable[[], Any], expected: dict[Any, Fraction]
    ) -> bool:
        """Compare what is drawn, and how likely it is, with a row, -1 for the starts; whether it could be."""
        try:
            found = branching.outcomes(draw)
        except Exception:  # another use of random numbers than can be tried
            return False
        off = {each: found.get(each, Fraction(0)) - expected.get(each, 0) for each in expected | found}
        worst = max(off, key=lambda each: float(abs(off[each])))
        self._is_exact[row] = abs(off[worst]) <= _EXACT
        if branching.has_drawn and not self._is_exact[row]:
            place = f"the start in state {worst}"
            if row >= 0:
                following, reward, _ = worst
                place = f"{self._name(row)}, to state {following} with reward {reward:g},"
            raise InputError(
                f"{self.mdp.name}: does not follow its own table: {place} occurs with a probability of "
                f"{float(found.get(worst, 0)):.6g}, in the table it is {float(expected.get(worst, 0)):.6g}, "
                "so it cannot be solved exactly"
            )
        return bool(self._is_exact[row])

    def along_rows(self) -> None:
        """Step every row, or as many as there is time for."""
        rows = self._rng.permutation(self._open)[:_ROWS]
        over = True
        for row in self._rng.permutation(np.tile(rows, _ROWS // len(rows))).tolist():
            if over:
                self.reset()
            state, action = divmod(row, self.mdp.num_actions)
            self._set(state)
            over = self._step(action)
        self.check()

    def check(self) -> None:
        """Count what was met since the last time, and refuse counts that are not those of the table."""
        if self._met:
            self._count()
        seen = np.flatnonzero(self._counts.any(axis=1))
        firsts = np.unique(self._kind, return_index=True)[1]
        kinds = [f"all rows like {self._name(row)}" for row in firsts]
        contexts, columns = self._after.shape[1:]
        start = self.table.start
        block = (_BLOCKS * (np.cumsum(start) - start / 2)).astype(np.int64).clip(0, _BLOCKS - 1)
        in_blocks = [np.bincount(block, each, _BLOCKS).astype(np.float64) for each in (self._started, start)]
        of_contexts = [f"{kind} after outcome {last - 1}" for kind in kinds for last in range(contexts)]
        self._judge(["the start in state"], self._started[None], start[None])
        self._judge([f"of {_BLOCKS} parts of the starts, part"], in_blocks[0][None], in_blocks[1][None])
        self._judge([f"{self._name(row)}, outcome" for row in seen], self._counts[seen], self._chance[seen])
        self._judge([f"{kind}, outcome" for kind in kinds], self._after.sum(axis=1), self._chances)
        self._judge(
            [f"{each}, outcome" for each in of_contexts],
            self._after.reshape(-1, columns),
            np.repeat(self._chances, contexts, axis=0),
        )

    def _judge(self, names: list[str], counts: NDArray[Any], chance: FloatArray) -> None:
        """Refuse counts (n, K) that cannot come from these probabilities (n, K)."""
        found = evidence(counts, chance)
        if found.max(initial=0) <= np.log(_JUDGED * max(1, len(found)) / FALSE_ALARM):
            return
        row = int(found.argmax())
        size = int(counts[row].sum())
        which = int(np.abs(counts[row] - size * chance[row]).argmax())
        raise InputError(
            f"{self.mdp.name}: does not follow its own table: {names[row]} {which}, occurred "
            f"{counts[row, which]:,.0f} times in {size:,}, its probability there is "
            f"{chance[row, which]:.3g}, so it cannot be solved exactly"
        )

    def _name(self, row: Any) -> str:
        state, action = divmod(int(row), self.mdp.num_actions)
        return f"P[{state}][{action}]"

    def _count(self) -> None:
        met, self._met = self._met, []
        row, following, reward, terminated = (np.array(each) for each in zip(*met, strict=True))
        state, action = np.divmod(row, self.mdp.num_actions)
        table = self.table
        same = table.probability[state, action] > 0
        found = (table.next_state, following), (table.reward, reward), (table.terminated, terminated)
        for given, seen in found:
            same &= given[state, action] == seen[:, None]
        if not same.any(axis=1).all():
            wrong = int(np.argmin(same.any(axis=1)))
            place = f"{state[wrong]}, action {action[wrong]} led to state {following[wrong]}"
            raise InputError(
                f"{self.mdp.name}: does not follow its own table: in state {place} with reward "
                f"{reward[wrong]:g}{' and ended' if terminated[wrong] else ''}, which "
                f"{self._name(row[wrong])} does not have, so it cannot be solved exactly"
            )
        column = self._column[row, same.argmax(axis=1)]
        np.add.at(self._counts, (row, column), 1)
        before = np.concatenate([[self._before], 1 + column])
        self._before = int(before[-1])
        np.add.at(self._after, (self._kind[row], before[:-1] % self._after.shape[1], column), 1)

    def summary(self) -> str:
        """What the counts say."""
        visits = self._counts.sum(axis=1)
        stepped = self._open[visits[self._open] > 0]
        sampled = stepped[~self._is_exact[stepped]]
        off = _resolved(visits[sampled], self._chance[sampled]).max(initial=0)
        rows = f"{len(stepped):,} of {len(self._open):,}" if len(stepped) < len(self._open) else "all"
        (starts,) = _resolved(self._started.sum(keepdims=True), self.table.start[None])
        parts = ("probabilities", not sampled.size, off), ("starts", self._is_exact[-1], starts)
        precise = [
            f"exact {what}" if is_exact else f"{what} to {100 * worst:.2g} %"
            for what, is_exact, worst in parts
            if is_exact or worst < _VAGUE
        ]
        return (
            f"table P, checked by {visits.sum():,} steps in {self.episodes:,} episodes: "
            f"{', '.join([f'support of {rows} rows', *precise])}"
        )


def _merged(table: Outcomes) -> tuple[IntArray, FloatArray]:
    """Of outcomes that cannot be told apart, the column of the first (R, K), and there the chance of all."""
    count = table.probability.shape[-1]
    parts = (table.next_state, table.reward, table.terminated, table.probability > 0)
    flat = [each.reshape(-1, count) for each in parts]
    column = np.zeros(flat[0].shape, dtype=np.int64)
    for k in reversed(range(count)):
        column[np.all([each == each[:, k : k + 1] for each in flat], axis=0)] = k
    first = (np.arange(len(column))[:, None] * count + column).ravel()
    chance = np.bincount(first, weights=table.probability.ravel(), minlength=first.size)
    return column, np.asarray(chance.reshape(-1, count))


def evidence(counts: NDArray[Any], chance: FloatArray) -> FloatArray:
    """(R,), log Bayes factors of Dirichlet mixtures around the chances (R, K), against the chances."""
    if not len(counts):
        return np.zeros(0)
    met = counts > 0
    size = counts.sum(axis=1)
    found = []
    for each in _CONCENTRATIONS:
        prior = each * np.where(met, chance, 1.0)
        ratio = gammaln(prior + counts) - gammaln(prior) - counts * np.log(np.where(met, chance, 1.0))
        found.append(gammaln(each) - gammaln(each + size) + np.where(met, ratio, 0.0).sum(axis=1))
    return np.asarray(logsumexp(found, axis=0) - np.log(len(_CONCENTRATIONS)))


def _resolved(size: IntArray, chance: FloatArray) -> FloatArray:
    """(R,), by how much a probability must be off in a row to be found out nearly always."""
    spread = (chance * (1 - chance)).max(axis=1)
    return np.asarray(np.minimum(1.0, 6 * np.sqrt(spread / size) + 4 / size))
