"""A diagnosis: the causes of a run's regret, the largest first, and what to change."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gridworld.diagnosis.causes import CAUSES, PHRASES
from gridworld.diagnosis.causes.objective import clearest_gamma
from gridworld.diagnosis.evidence import Evidence
from gridworld.diagnosis.finding import Finding
from gridworld.diagnosis.split import RegretSplit
from gridworld.process.console.command_line import command
from gridworld.world.exact.evaluation import score_of_optimum
from gridworld.world.mdp import FloatArray, IntArray, Mdp

_MOST_CHANGES = 3
_NAMELESS = 1e-12  # of the regret: a share that is rounding


@dataclass(frozen=True)
class Trial:
    """An offer that was trained, see `trials`.

    Attributes:
        command: the offered command line.
        folder: of its run.
        regret: of the greedy policy at its end; infinite where it did not come to its end.
        certified: whether that policy is certified optimal.
        why: why it did not come to its end, else "".
    """

    command: str
    folder: Path
    regret: float
    certified: bool
    why: str = ""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Why a run is not optimal.

    Attributes:
        mdp: its world.
        greedy: (S,), its greedy actions.
        split: its regret by state.
        findings: the causes that explain some of it, the largest share first; none for a certified run.
        shares: the share of the regret that each of them explains; they sum to 1.
        cause_of: (S,), the number in `findings` of each state's cause, -1 where there is none.
        offers: the words of at most three command lines to try.
        tried: those that were tried, up to the first that is certified.
    """

    mdp: Mdp
    greedy: IntArray
    split: RegretSplit
    findings: tuple[Finding, ...]
    shares: tuple[float, ...]
    cause_of: IntArray
    offers: tuple[tuple[str, ...], ...]
    tried: tuple[Trial, ...] = ()

    @property
    def commands(self) -> tuple[str, ...]:
        """The command lines to try."""
        return tuple(f"{command('train')} {shlex.join(words)}" for words in self.offers)

    @property
    def cause(self) -> str | None:
        """The name of the first cause; None for a certified run."""
        return self.findings[0].cause if self.findings else None

    @property
    def phrase(self) -> str | None:
        """The first cause in about four words; None for a certified run."""
        return PHRASES[self.cause] if self.cause else None

    @property
    def first_change(self) -> str:
        """The word for a command line to try first; "" where there is none."""
        return next((each.changes[0] for each in self.findings[:1] if each.changes), "")

    def sentence(self) -> str:
        """The verdict in one sentence."""
        if not self.findings:
            return "Certified optimal: there is no regret to explain."
        first, share = self.findings[0], self.shares[0]
        regret = self.split.score.regret
        part = "The" if share > 1 - 1e-3 else f"{share:.0%} of the"
        return f"{part} regret of {regret:.3g}: {first.why}."


def diagnose(run: Evidence) -> Diagnosis:
    """Find the causes of a run's regret."""
    split = run.split
    nowhere = np.full(run.mdp.num_states, -1)
    if split.score.certified:
        return Diagnosis(run.mdp, run.greedy, split, (), (), nowhere, ())
    cost = np.where(split.wrong, np.maximum(split.cost, 0.0), 0.0)
    if not np.isfinite(cost).all() or not cost.any():  # without a discount, endless: where it never ends
        cost = np.where(split.wrong | np.isinf(split.cost), 1.0, 0.0)
    found, shares, cause_of = _assigned(run, cost)
    order = sorted(range(len(found)), key=lambda index: -shares[index])
    place = np.array([*(order.index(index) for index in range(len(found))), -1])
    findings = tuple(found[index] for index in order)
    return Diagnosis(
        run.mdp,
        run.greedy,
        split,
        findings,
        tuple(shares[index] for index in order),
        place[cause_of],
        _offers(run, findings),
    )


def _assigned(run: Evidence, cost: FloatArray) -> tuple[list[Finding], list[float], IntArray]:
    """Each state to the first cause that claims it, until nothing is left to explain."""
    found: list[Finding] = []
    shares: list[float] = []
    cause_of = np.full(run.mdp.num_states, -1)
    for cause in CAUSES:
        left = (cause_of < 0) & (cost > 0)
        if cost[left].sum() <= _NAMELESS * cost.sum():
            break
        finding = cause(run)
        mine = left & finding.states if finding is not None else left & False
        if finding is None or not mine.any():
            continue
        if (index := next((n for n, each in enumerate(found) if each.cause == finding.cause), None)) is None:
            index = len(found)
            found.append(finding)
            shares.append(0.0)
        cause_of[mine] = index
        shares[index] += float(cost[mine].sum() / cost.sum())
    return found, shares, cause_of


def _offers(run: Evidence, findings: tuple[Finding, ...]) -> tuple[tuple[str, ...], ...]:
    """The run's own words with a change each: those of the first cause, then one of each other.

    No change helps as long as even the optimum under the agent's own discount is not certified, so each has
    another discount with it then.
    """
    first, others = findings[0].changes, [word for each in findings[1:] for word in each.changes[:1]]
    changes = list(dict.fromkeys((*first, *others)))[:_MOST_CHANGES]
    key, fits = run.config.agent.key("gamma"), score_of_optimum(run.evaluator, run.own.gamma).certified
    gamma = "" if fits else run.change("gamma", clearest_gamma(run, run.split.wrong))
    return tuple(
        _with(run.overrides, (each if fits or key in each else f"{each} {gamma}").split(" "))
        for each in changes
    )


def _with(overrides: Sequence[str], changes: Sequence[str]) -> tuple[str, ...]:
    keys = set(map(_key, changes))
    return (*(word for word in overrides if _key(word) not in keys), *changes)


def _key(word: str) -> str:
    return re.sub(r"^\++|=.*$", "", word, flags=re.DOTALL)
