"""All probes of one implementation, in one process or several."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

from gridworld.checking.expectations import UnmetError
from gridworld.checking.probes import PROBES, Probe
from gridworld.checking.settings import settings
from gridworld.checking.training import build, train
from gridworld.config.agents import AgentConfig
from gridworld.errors import InputError, in_short

Outcomes = list[tuple[bool | None, str]]  # of one probe on each seed: see `Finding`
SEEDS = 3  # of a probe that fails at first: it has failed if it fails on most of them


@dataclass(frozen=True)
class Finding:
    """The result of one probe.

    Attributes:
        name: of the probe.
        passed: whether its expectation held; None: the algorithm has nothing of the kind.
        found: what was found, on the last seed that decided.
        meaning: what a failure means.
        seeds: how many seeds it was trained on.
        seconds: that this took, shared by the probes that look at the same training run.
    """

    name: str
    passed: bool | None
    found: str
    meaning: str
    seeds: int = 1
    seconds: float = 0.0


@dataclass(frozen=True)
class CheckResult:
    """The findings of all probes on one implementation.

    Attributes:
        name: of the implementation.
        findings: in the order of the probes.
        seconds: of the whole check.
    """

    name: str
    findings: tuple[Finding, ...]
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether no probe failed."""
        return not self.failed

    @property
    def failed(self) -> list[str]:
        """The names of the probes that failed."""
        return [each.name for each in self.findings if each.passed is False]

    def __str__(self) -> str:
        from gridworld.checking.table import text

        return text(self)


def check_all(
    config: AgentConfig,
    given: Mapping[str, Any],
    names: Sequence[str] = (),
    seed: int = 0,
    processes: int = 1,
    told: Callable[[Finding], None] = lambda finding: None,
) -> CheckResult:
    """Train on every probe's world and compare with the exact numbers.

    Args:
        config: the implementation, see `subject`.
        given: arguments for it that differ from those of `settings`.
        names: of the probes; none: all.
        seed: the first of the `SEEDS` that a probe may take.
        processes: how many train at a time.
        told: called with every finding, in the order of the probes.
    """
    started = time.monotonic()
    groups = [list(group) for _, group in itertools.groupby(_chosen(names), lambda probe: probe.training)]
    _try_out(config, given, groups[0][0], seed)
    findings = []
    for group in _findings(partial(_check_group, config, dict(given), seed), groups, processes):
        findings += group
        for finding in group:
            told(finding)
    return CheckResult(config.name, tuple(findings), time.monotonic() - started)


def _chosen(names: Sequence[str]) -> list[Probe]:
    known = [probe.name for probe in PROBES]
    for name in names:
        if name not in known:
            raise InputError(f"--probe {name}: there is no such probe; there are {', '.join(known)}")
    return [probe for probe in PROBES if not names or probe.name in names]


def _try_out(config: AgentConfig, given: Mapping[str, Any], probe: Probe, seed: int) -> None:
    """Build it once: what it refuses is the user's mistake, and no finding."""
    found = settings(config, probe, given)
    if found is None:
        return
    try:
        build(found[0], probe.world(), found[1].num_envs, seed)
    except InputError as error:
        raise InputError(str(error).replace("agent.arguments.", "--set ")) from None


def _findings(
    check: Callable[[list[Probe]], list[Finding]], groups: list[list[Probe]], processes: int
) -> Iterator[list[Finding]]:
    processes = min(processes, len(groups))
    if processes == 1:
        yield from map(check, groups)
        return
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        yield from pool.map(check, groups)


def _check_group(
    config: AgentConfig, given: Mapping[str, Any], seed: int, group: list[Probe]
) -> list[Finding]:
    """The findings of probes that share a training run; those that fail get further seeds."""
    started = time.monotonic()
    outcomes: dict[str, Outcomes] = {probe.name: [] for probe in group}
    for number in range(SEEDS):
        unsettled = [probe for probe in group if _is_open(outcomes[probe.name])]
        if unsettled:
            for probe, outcome in zip(unsettled, _once(config, given, seed + number, unsettled), strict=True):
                outcomes[probe.name].append(outcome)
    seconds = (time.monotonic() - started) / len(group)
    return [_finding(probe, outcomes[probe.name], seconds) for probe in group]


def _is_open(outcomes: Outcomes) -> bool:
    """Whether it has failed, but neither failed nor passed on most seeds."""
    failures = [passed for passed, _ in outcomes].count(False)
    return not outcomes or (0 < failures <= SEEDS // 2 and len(outcomes) - failures <= SEEDS // 2)


def _finding(probe: Probe, outcomes: Outcomes, seconds: float) -> Finding:
    passed, found = outcomes[-1]
    return Finding(probe.name, passed, found, probe.meaning, len(outcomes), seconds)


def _once(config: AgentConfig, given: Mapping[str, Any], seed: int, probes: list[Probe]) -> Outcomes:
    first = probes[0]
    found = settings(config, first, given)
    if found is None:
        return [(None, f"takes no {first.needs}")] * len(probes)
    settled, kind = found
    try:
        trained = train(settled, first.world(), first.gamma, kind.num_envs, kind.steps, seed)
    except Exception as error:  # it may be anybody's code
        return [(False, f"training failed: {in_short(error)}")] * len(probes)
    outcomes: Outcomes = []
    for probe in probes:
        try:
            outcomes.append((True, probe.holds(trained)))
        except UnmetError as unmet:
            outcomes.append((False, str(unmet)))
    return outcomes
