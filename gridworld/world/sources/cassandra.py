"""Worlds in Cassandra's text formats, .MDP and .POMDP.

A text with observations is a POMDP. Its world is that of beliefs: the distributions over its states that the
observations so far leave. Each step pays what is expected of it, for a reward shows nothing of the state.

References: http://pomdp.org/code/pomdp-file-spec.html; K. J. Åström, Optimal control of Markov processes with
incomplete state information, 1965.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import NoReturn

import numpy as np

from gridworld.base.errors import InputError
from gridworld.world.door.beliefs import Belief, Beliefs, Step, summed
from gridworld.world.mdp import EXACT, FloatArray, Mdp
from gridworld.world.outcomes import MOST_STATES, check_size, checked_text, mdp_from_outcomes, verified
from gridworld.world.sources.files import ROUNDING, normal, outcomes_of_matrices

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_LISTS = {"states": "state", "actions": "action", "observations": "observation"}
_AXES = {"T": "ast", "O": "ato", "R": "asto"}  # of each table: action, state, state that follows, observation
_CALLED = {"a": "action", "s": "state", "t": "state", "o": "observation"}
_MOST_SECONDS = 60.0  # for the beliefs
_RESERVED = {*_LISTS, *_AXES, "discount", "values", "start"}


def world_of_text(name: str, content: bytes, where: str) -> Mdp:
    """The world of an .MDP or a .POMDP."""
    try:
        model = _Text(content.decode("utf-8-sig"), where)
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: not a text file (byte {error.start + 1} is not UTF-8)") from None
    tables, names = model.tables, model.names
    actions = [checked_text(where, "the name of an action", each) for each in names["action"]]
    if "observation" in names:
        mdp = _of_beliefs(where, model, actions)
    else:
        outcomes = outcomes_of_matrices(where, tables["T"], tables["R"][..., 0], model.start)
        mdp = mdp_from_outcomes(where, outcomes, action_names=actions)
        mdp = replace(mdp, state_names=tuple(names["state"]))
    return verified(replace(mdp, name=name), where)


class _Text:
    """A text that is read: `tables` T (A, S, S), O (A, S, O), R (A, S, S, O), `names` and `start`."""

    def __init__(self, text: str, where: str) -> None:
        self.where, self.names = where, dict[str, list[str]]()
        self.tables, self.start = dict[str, FloatArray](), None
        self._words, self._line = self._split(text), 1
        self._factor, self._places = 1.0, {"observation": {"0": 0}}
        self._next = ""
        self._advance()
        while self._next:
            key = self._advance()
            if key in _AXES:
                self._allocate()
                self._entry(key)
            elif key == "start":
                self._begin()
            elif key in _RESERVED:
                self._expect(":")
                self._declare(key)
            else:
                self._refuse(f"{key[:50]!r} is here where one of {', '.join(sorted(_RESERVED))} must be")
        self._allocate()
        for what in ("T", "O") if "observation" in self.names else ("T",):
            names = self.names["action"], self.names["state"]
            self.tables[what] = normal(where, what, self.tables[what], names)

    def _split(self, text: str) -> Iterator[tuple[str, int]]:
        for number, line in enumerate(text.split("\n"), start=1):
            for word in re.findall(r"[^\s:]+|:", line.partition("#")[0]):
                yield word, number

    def _advance(self) -> str:
        """The next word, after which the one behind it is the next."""
        word, self._at = self._next, self._line
        self._next, self._line = next(self._words, ("", self._line))
        return word

    def _refuse(self, mistake: str) -> NoReturn:
        raise InputError(f"{self.where}: line {self._at}: {mistake}")

    def _expect(self, wanted: str) -> None:
        if (word := self._advance()) != wanted:
            self._refuse(f"{word[:50]!r} is here where {wanted!r} must be")

    def _all(self) -> list[str]:
        """The words up to the next reserved one."""
        found = []
        while self._next and self._next not in _RESERVED:
            found.append(self._advance())
        return found

    def _declare(self, key: str) -> None:
        given = self._all()
        if self.tables:
            self._refuse(f"{key} must come before all of T, O and R")
        if key in _LISTS:
            kind = _LISTS[key]
            if len(given) == 1 and re.fullmatch(r"[1-9]\d{0,5}", given[0], re.ASCII):
                given = [str(number) for number in range(int(given[0]))]
            elif len(set(given)) < len(given) or any(each[0] in "0123456789*:" for each in given):
                given = []
            if not 0 < len(given) <= MOST_STATES:
                self._refuse(f"{key} must be how many, from 1 to {MOST_STATES:,}, or different names")
            self.names[kind] = [checked_text(self.where, f"the name of a {kind}", each) for each in given]
            self._places[kind] = {each: number for number, each in enumerate(given)}
        elif key == "values":
            if given not in (["reward"], ["rewards"], ["cost"], ["costs"]):
                self._refuse("values must be reward or cost")
            self._factor = -1.0 if given[0].startswith("cost") else 1.0
        elif len(given) != 1 or not _NUMBER.fullmatch(given[0]) or not 0 <= float(given[0]) <= 1:
            self._refuse("discount must be a number from 0 to 1")

    def _begin(self) -> None:
        how = self._advance() if self._next in ("include", "exclude") else ""
        self._expect(":")
        given = self._all()
        if "state" not in self.names:
            self._refuse("start must come after states")
        size = len(self.names["state"])
        if how or (len(given) == 1 and given != ["uniform"] and size > 1):
            chosen, places = np.zeros(size), [self._index("s", each) for each in given]
            for place in places:
                chosen[place] = 1.0
            start = 1 - chosen if how == "exclude" else chosen
        elif given == ["uniform"]:
            start = np.ones(size)
        else:
            start = np.array([float(each) for each in given if _NUMBER.fullmatch(each)])
            if len(start) != size or (start < 0).any() or abs(start.sum() - 1) > ROUNDING:
                self._refuse(f"start must be {size} probabilities with the sum 1, or states")
        if not start.any():
            self._refuse("start leaves no state to start in")
        self.start = start / start.sum()

    def _allocate(self) -> None:
        """Make the tables, once what they are about is declared."""
        if self.tables:
            return
        if missing := [key for key in ("states", "actions") if _LISTS[key] not in self.names]:
            self._refuse(f"there are no {missing[0]}; they must come before all of T, O and R")
        size, actions = len(self.names["state"]), len(self.names["action"])
        sizes = {"a": actions, "s": size, "t": size, "o": len(self.names.get("observation", [""]))}
        check_size(self.where, size, actions, size * sizes["o"])
        self.tables = {key: np.zeros([sizes[axis] for axis in axes]) for key, axes in _AXES.items()}

    def _index(self, axis: str, word: str) -> int | slice:
        """The place of a state, an action or an observation by its name or number; all by `*`."""
        if word == "*":
            return slice(None)
        places = self._places[_CALLED[axis]]
        number = int(word) if re.fullmatch(r"\d{1,6}", word, re.ASCII) else len(places)
        if word not in places and number >= len(places):
            known = f"must be a name or a number up to {len(places) - 1}"
            self._refuse(f"unknown {_CALLED[axis]} {word[:50]!r}; {known}")
        return places.get(word, number)

    def _entry(self, key: str) -> None:
        if key == "O" and "observation" not in self.names:
            self._refuse("O is here, but there are no observations")
        index: list[int | slice] = []
        for axis in _AXES[key]:
            if index and self._next != ":":
                break
            self._expect(":")
            index.append(self._index(axis, self._advance()))
        shape = self.tables[key].shape[len(index) :]
        keyword = (self._next, key, len(shape))
        values: FloatArray
        if self._next == "uniform" and key != "R" and shape:
            values = np.full(shape, 1 / shape[-1])
        elif keyword == ("identity", "T", 2):
            values = np.eye(shape[-1])
        elif keyword == ("reset", "T", 1):
            values = np.full(shape, 1 / shape[-1]) if self.start is None else self.start
        else:
            self.tables[key][tuple(index)] = self._numbers(key, shape)
            return
        self._advance()
        self.tables[key][tuple(index)] = values

    def _numbers(self, key: str, shape: tuple[int, ...]) -> FloatArray:
        """The numbers that come next, which are this many."""
        values, wanted = list[float](), math.prod(shape)
        while len(values) <= wanted and _NUMBER.fullmatch(self._next):
            values.append(float(self._advance()))
        if len(values) != wanted:
            found = f"{len(values)}, and then {self._next[:50]!r}" if len(values) <= wanted else "more"
            self._refuse(f"{key} needs {wanted} number{'s' * (wanted > 1)} here, not {found}")
        if not np.isfinite(values).all():
            self._refuse(f"{key} has a number here that is too large")
        return (self._factor if key == "R" else 1.0) * np.reshape(values, shape)


def _of_beliefs(where: str, model: _Text, actions: list[str]) -> Mdp:
    """The world of a POMDP's beliefs; refuses it if there is no end of them."""

    def refusal(reason: str) -> InputError:
        return InputError(
            f"{where}: {reason.partition(';')[0]}; only a POMDP with few enough beliefs is a world"
        )

    leads_to, shows = (_exact(model.tables[key]) for key in ("T", "O"))
    paid, size = model.tables["R"], len(model.names["state"])
    steps: list[list[list[Step]]] = [[] for _ in range(size)]
    expected: list[list[dict[bytes, Fraction]]] = [[] for _ in range(size)]  # by what is shown
    for state, action in np.ndindex(size, len(actions)):
        parts = [
            (chance * share, following, shown)
            for following, chance in leads_to[action][state]
            for shown, share in shows[action][following]
        ]
        steps[state].append([Step(share, to, b"%d" % shown, 0.0, False, False) for share, to, shown in parts])
        pays = ((b"%d" % o, share * Fraction(str(paid[action, state, to, o]))) for share, to, o in parts)
        expected[state].append(summed(pays))
    over = {
        state
        for state in range(size)
        if all(step.following == state for row in steps[state] for step in row)
        and not any(pay for pays in expected[state] for pay in pays.values())
    }
    begins = np.full(size, 1 / size) if model.start is None else model.start
    starts = [(chance, state, b"") for state, chance in _exact(begins[None, None])[0][0]]
    beliefs = Beliefs(starts, steps, refusal, _MOST_SECONDS)
    is_end = [over.issuperset(state for state, _ in node.belief) for node in beliefs.nodes]
    for node in beliefs.nodes:
        for action, row in enumerate(node.rows):
            for at, step in enumerate(row):
                pay = sum(share * expected[state][action].get(step.seen, 0) for state, share in node.belief)
                row[at] = step._replace(
                    reward=float(pay / step.probability), terminated=is_end[step.following]
                )
    observed = [int(node.seen or len(model.names["observation"])) for node in beliefs.nodes]
    mdp = mdp_from_outcomes(
        where,
        beliefs.outcomes(where, len(actions), np.arange(len(observed)), len(observed)),
        action_names=actions,
        own_observation=np.array(observed),
    )
    called = [_belief_name(model.names["state"], node.belief) for node in beliefs.nodes]
    aliased = beliefs.num_aliased()
    shown_of = f"; {aliased:,} observations stand for several of them" if aliased else ""
    truth = f"{EXACT}, {len(called):,} beliefs about {size:,} hidden states{shown_of}"
    return replace(mdp, state_names=tuple(called), truth=truth)


def _exact(table: FloatArray) -> list[list[list[tuple[int, Fraction]]]]:
    """What is possible in each row, with its exact probability as it is written in decimals."""
    rows = []
    for given in table.reshape(-1, table.shape[-1]):
        found = [(int(place), Fraction(str(given[place]))) for place in np.flatnonzero(given)]
        total = sum((share for _, share in found), Fraction(0))
        rows.append([(place, share / total) for place, share in found])
    return [rows[at : at + table.shape[1]] for at in range(0, len(rows), table.shape[1])]


def _belief_name(names: list[str], belief: Belief) -> str:
    """A belief as readers see it: its likeliest states, with their probabilities."""
    if len(belief) == 1:
        return names[belief[0][0]]
    likeliest = sorted(belief, key=lambda part: -part[1])
    shown = ", ".join(f"{names[state][:30]} {float(share):.3g}" for state, share in likeliest[:4])
    return f"{shown}, ..." if len(belief) > 4 else shown
