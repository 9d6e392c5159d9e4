"""A diagnosis: the causes of a run's regret, the largest first, what to change, and its picture.

What it offers can be put to the test: each offer trains as an ordinary run, until one is certified. The
settings are composed from the offer's words; the world is the one that the run's folder holds.
"""

from __future__ import annotations

import dataclasses
import math
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridworld.base.atomic_write import tidy
from gridworld.base.console import command
from gridworld.base.errors import InputError
from gridworld.config.fields import Use
from gridworld.config.settings import check_foreign
from gridworld.config.train import TrainConfig
from gridworld.diagnosis.causes import CAUSES, PHRASES
from gridworld.diagnosis.evidence import Evidence, Finding, RegretSplit
from gridworld.training.saved_run import SavedRun
from gridworld.training.setup import recommended_gamma
from gridworld.visualization.maps import draw_regret
from gridworld.world.evaluation import score_of_optimum
from gridworld.world.mdp import IntArray, Mdp

_MOST_CHANGES = 3
_NAMELESS = 1e-12  # of the regret: a share that is rounding


@dataclass(frozen=True)
class Trial:
    """An offer that was trained."""

    command: str  # the offered command line
    folder: Path  # of its run
    regret: float  # of the greedy policy at its end; infinite where it did not come to its end
    certified: bool  # whether that policy is certified optimal
    why: str = ""  # why it did not come to its end


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis:
    """Why a run is not optimal."""

    mdp: Mdp  # its world
    greedy: IntArray  # (S,), its greedy actions
    split: RegretSplit  # its regret by state
    # what explains some of it, the largest share first; none if it is certified
    findings: tuple[Finding, ...]
    shares: tuple[float, ...]  # the share of the regret that each of them explains; they sum to 1
    cause_of: IntArray  # (S,), the number in `findings` of each state's cause, -1 where there is none
    offers: tuple[tuple[str, ...], ...]  # the words of at most three command lines to try
    tried: tuple[Trial, ...] = ()  # those that were tried, up to the first that is certified

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

    def __repr__(self) -> str:
        return "\n  to try: ".join([f"Diagnosis: {self.sentence()}", *map(shlex.join, self.offers)])

    def sentence(self) -> str:
        """The verdict in one sentence."""
        regret = self.split.score.regret
        if self.split.score.certified:
            return "Certified optimal: there is no regret to explain."
        if not self.findings:
            return f"The regret of {regret:.3g} is too small to be split into causes."
        first, share = self.findings[0], self.shares[0]
        part = "The" if share > 1 - 1e-3 else f"{share:.0%} of the"
        return f"{part} regret of {regret:.3g}: {first.why}."


def diagnose(run: Evidence) -> Diagnosis:
    """Find the causes of a run's regret: each state belongs to the first cause that claims it."""
    split, cause_of = run.split, np.full(run.mdp.num_states, -1)
    if split.score.certified:
        return Diagnosis(run.mdp, run.greedy, split, (), (), cause_of, ())
    cost = np.where(split.wrong, np.maximum(split.cost, 0.0), 0.0)
    if not np.isfinite(cost).all() or not cost.any():  # without a discount, endless: where it never ends
        cost = np.where(split.wrong | np.isinf(split.cost), 1.0, 0.0)
    found: dict[str, Finding] = {}  # by the cause's name, which several rules may find
    shares: dict[str, float] = {}
    for cause in CAUSES:
        left = (cause_of < 0) & (cost > 0)
        if cost[left].sum() <= _NAMELESS * cost.sum():
            break
        finding = cause(run)
        if finding is not None and (mine := left & finding.states).any():
            name = finding.cause
            found.setdefault(name, finding)
            shares[name] = shares.get(name, 0.0) + float(cost[mine].sum() / cost.sum())
            cause_of[mine] = list(found).index(name)
    order = sorted(found, key=lambda name: -shares[name])
    place = np.array([*(order.index(name) for name in found), -1])
    findings = tuple(found[name] for name in order)
    ordered = tuple(shares[name] for name in order)
    return Diagnosis(run.mdp, run.greedy, split, findings, ordered, place[cause_of], _offers(run, findings))


def _offers(run: Evidence, findings: tuple[Finding, ...]) -> tuple[tuple[str, ...], ...]:
    """The run's own words with a change each: those of the first cause, then one of each other."""
    if run.overrides is None or not findings:
        return ()
    first, others = findings[0].changes, [word for each in findings[1:] for word in each.changes[:1]]
    changes = list(dict.fromkeys((*first, *others)))[:_MOST_CHANGES]
    key, fits = run.config.agent.key("gamma"), score_of_optimum(run.evaluator, run.own.gamma).certified
    gamma = "" if fits else run.change("gamma", recommended_gamma(run.evaluator))
    added = {_key(word) for word in run.overrides if word.startswith("+")}  # to what the yaml files have
    offers = []
    for each in changes:
        words = (each if fits or key in each else f"{each} {gamma}").split(" ")
        changed = set(map(_key, words))
        words = [f"+{word}" if word.partition("=")[0] in added else word for word in words]
        offers.append((*(word for word in run.overrides if _key(word) not in changed), *words))
    return tuple(offers)


def _key(word: str) -> str:
    return re.sub(r"^\++|=.*$", "", word, flags=re.DOTALL)


def try_offers(saved: SavedRun, found: Diagnosis, folder: Path, trust: bool = False) -> Iterator[Trial]:
    """Train the offers of a diagnosis in turn, until one is certified; yields each trial as it ends.

    Each run is in a new folder in `folder`. `trust` is whether settings may name classes and callbacks from
    anywhere. Raises `InputError` where they are not trusted, `Interrupted` where training was asked to stop.
    """
    # here, since it takes a second
    from gridworld.config.compose import compose
    from gridworld.run.folder import claimed
    from gridworld.training.train import train

    for each in folder.glob("*"):  # what a killed one left half written
        tidy(each)
    for words, line in zip(found.offers, found.commands, strict=True):
        place = next(each for n in range(1, 10**6) if not (each := folder / str(n)).exists()).absolute()
        config = dataclasses.replace(compose(words), env=saved.config.env)
        check_trusted(saved, found, trust, config)
        try:
            with claimed(place):
                summary = train(config, place, list(words), lambda env: saved.mdp, is_trusted=False)
            trial = Trial(line, place, summary["regret"], summary["certified"])
        except InputError as error:  # training diverged, say
            trial = Trial(line, place, math.inf, False, str(error))
        yield trial
        if trial.certified:
            return


def trials_folder(folder: Path) -> Path:
    """Where the offers of a run in `folder` are trained."""
    return folder.resolve().parent / f"{folder.resolve().name}-tried"


def check_trusted(saved: SavedRun, found: Diagnosis, trust: bool, offer: TrainConfig | None = None) -> None:
    """Check that to compose and train the offers, or this one, runs no code of a stranger's choice."""
    if saved.omission:
        raise InputError(saved.omission)
    if found.offers and not trust:
        config = saved.config if offer is None else offer
        check_foreign(dataclasses.asdict(config), str(saved.run.manifest_file), "--trust", Use.RESUME)


def draw_diagnosis(found: Diagnosis, cell_size: int | None = None) -> NDArray[np.uint8]:
    """Draw the split of a run's regret; `cell_size` in pixels, None: 80, less on large maps."""
    cost = np.maximum(found.split.cost, 0.0)
    causes = ", ".join(
        f"{each.cause} {share:.0%}" for each, share in zip(found.findings, found.shares, strict=True)
    )
    caption = f"regret {found.split.score.regret:.3g}: {causes}"
    cost = np.where(np.isfinite(cost) & (found.cause_of >= 0), cost, 0.0)
    return draw_regret(found.mdp, cost, found.greedy, caption, cell_size)
