"""All probes of one implementation, in one process or several, and their table."""

from __future__ import annotations

import itertools
import pickle
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from typing import Any

from gridworld.base.console import aligned
from gridworld.base.errors import InputError, in_short
from gridworld.checking.function import ReturnedError
from gridworld.checking.probes import PROBES, Probe, UnknownError, UnmetError, optimal
from gridworld.checking.training import build, settings, subject, train
from gridworld.config.compose import named_world
from gridworld.config.train import AgentConfig
from gridworld.envs.inspection import task_of

Outcomes = list[tuple[bool | None, str]]  # of one probe on each seed: see `Finding`
SEEDS = 3  # of a probe that fails at first: it has failed if it fails on most of them
_WIDTH = 100
_BROKEN = "training failed"
_WORDS = {True: "passed", False: "FAILED", None: "-"}


@dataclass(frozen=True)
class Finding:
    """The result of one probe."""

    name: str  # of the probe
    passed: bool | None  # whether its expectation held; None: the algorithm has nothing of the kind
    found: str  # what was found, on the last seed that decided
    meaning: str  # what a failure means
    seeds: int = 1  # how many seeds it was trained on
    seconds: float = 0.0  # that this took, shared by the probes that look at the same training run
    may_follow_from: tuple[str, ...] = ()  # probes that failed too, which may be the cause

    @property
    def advice(self) -> list[str]:
        """What a failure means, and what to mend first; nothing unless it failed after training."""
        if self.passed is not False or self.found.startswith(_BROKEN):
            return []
        mend = "that" if len(self.may_follow_from) == 1 else "these"
        first = f"may follow from {' or '.join(self.may_follow_from)}; mend {mend} first"
        return [self.meaning, first] if self.may_follow_from else [self.meaning]

    def __str__(self) -> str:
        """A row of the table, and below it the advice."""
        seeds = "" if self.seeds == 1 else f" ({self.seeds} seeds)"
        cells = [self.name, _WORDS[self.passed], f"{self.seconds:.1f} s", f" {self.found}{seeds}"]
        below = [textwrap.indent(textwrap.fill(each, _WIDTH), " " * 4) for each in self.advice]
        return "\n".join([*aligned([cells], ("<12", "<7", ">7", "<0")), *below])


@dataclass(frozen=True)
class CheckResult:
    """The findings of all probes on one implementation; its text is their table."""

    name: str  # of the implementation
    findings: tuple[Finding, ...]  # in the order of the probes
    seconds: float  # of the whole check

    @property
    def failed(self) -> list[str]:
        """The names of the probes that failed."""
        return [each.name for each in self.findings if each.passed is False]

    @property
    def passed(self) -> bool:
        """Whether no probe failed."""
        return not self.failed

    def verdict(self) -> str:
        """The last line of the table."""
        asked, failed = sum(each.passed is not None for each in self.findings), self.failed
        what = f"failed {len(failed)} of {asked} probes ({', '.join(failed)})"
        return f"{self.name}: {what if failed else f'passed all {asked} probes'}, {self.seconds:.0f} s"

    def __str__(self) -> str:
        return "\n".join([*map(str, self.findings), self.verdict()])


def check(
    algorithm: Any,
    arguments: Mapping[str, Any] | None = None,
    probes: Sequence[str] = (),
    seed: int = 0,
    processes: int = 1,
    on_finding: Callable[[Finding], None] = lambda finding: None,
    *,
    observation: str = "state",
    steps: int | None = None,
    worlds: Sequence[Any] = (),
) -> CheckResult:
    """Train an implementation on small worlds with known answers, and compare with the exact numbers.

    It takes about half a minute. `check.py --help` has the probes and what it means where one fails; a probe
    fails if it fails on two of three seeds.

    Args:
        algorithm: a function `train(env, total_timesteps, seed)`, or module:function as text; or a class with
            SB3's interface, its import path, or the name of a shipped agent, which trains in its own loop.
            A function learns in a Gymnasium environment and returns its policy: a function of the observation
            that returns an action or the probabilities of all, a table of actions (N,) or probabilities
            (N, A) by observations, or a dictionary with such a `policy` or with `q` (N, A), or both, and
            perhaps `values` (N,). If it takes `gamma`, that is each probe's; if not, only its policy
            is checked.
        arguments: of the function or the constructor, in place of those that the probes choose.
        probes: names; none: all.
        seed: the first of the three.
        processes: how many train at a time; 1: in this process.
        on_finding: called with every finding, in the order of the probes.
        observation: what a function sees of a state: `state`, its number, or `one_hot`, a float32 vector.
        steps: environment steps of a training run; None: 20,000 of a function, as many as its kind needs of
            an agent.
        worlds: worlds of your own on which its policy must become optimal too, at a discount of 0.99: what
            `compile_env` takes, or compiled worlds. Give them enough `steps`.

    Returns:
        `passed`, `failed` (names), `findings` (a row for each probe); its text is the table.

    Raises:
        InputError: no such implementation, probe or argument; a class that refuses its arguments, or a
            function that does not return a policy.

    Example:
        >>> check("q_learning").passed
        True
    """
    config, given = subject(algorithm, observation), dict(arguments or {})
    if processes > 1:
        try:
            pickle.dumps(config)
        except (pickle.PicklingError, AttributeError, TypeError):
            raise InputError(f"processes={processes}: needs a function that can be imported; use 1") from None
    started = time.monotonic()
    known = [probe.name for probe in PROBES]
    probes = [probes] if isinstance(probes, str) else probes
    for name in probes:
        if name not in known:
            raise InputError(f"--probe {name}: no such probe; choose from {', '.join(known)}")
    chosen = [probe for probe in PROBES if not probes or probe.name in probes]
    chosen += [_own_probe(world) for world in worlds]
    groups = [list(group) for _, group in itertools.groupby(chosen, lambda probe: probe.training)]
    if (first := settings(config, chosen[0], given)) is not None:
        try:  # what it refuses is the user's mistake, not a finding
            build(first[0], chosen[0].world, first[1].num_envs, seed)
        except InputError as error:
            raise InputError(str(error).replace("agent.arguments.", "--set ")) from None
    findings, follows = list[Finding](), {probe.name: probe.follows for probe in chosen}
    check_group = partial(_check_group, config, given, seed, steps)
    # A process imports a module by its file before it is sent what is in it.
    again = partial(subject, algorithm, observation) if ":" in str(algorithm) else None
    count = max(1, min(processes, len(groups)))
    with ProcessPoolExecutor(count, get_context("spawn"), again) as pool:
        results = itertools.chain.from_iterable((map if processes == 1 else pool.map)(check_group, groups))
        for finding in results:
            if finding.passed is False:
                roots = {each.name for each in findings if each.passed is False and not each.may_follow_from}
                causes = tuple(name for name in follows[finding.name] if name in roots)
                finding = replace(finding, may_follow_from=causes)
            findings.append(finding)
            on_finding(finding)
    return CheckResult(config.name, tuple(findings), time.monotonic() - started)


def _own_probe(world: Any) -> Probe:
    """Whether a policy becomes optimal in a world of the user's own."""
    is_named = isinstance(world, str)
    task = task_of(named_world(world) if is_named else world)
    mdp = replace(task.mdp, max_episode_steps=task.max_episode_steps)
    meaning = "its policy is not optimal there: it may need more --steps or other settings, or be wrong"
    return Probe(world if is_named else mdp.name, mdp, optimal, meaning, gamma=0.99)


def _check_group(
    config: AgentConfig, given: Mapping[str, Any], seed: int, steps: int | None, group: list[Probe]
) -> list[Finding]:
    """The findings of probes that share a training run; those that fail get further seeds."""
    started = time.monotonic()
    outcomes: dict[str, Outcomes] = {probe.name: [] for probe in group}
    for number in range(SEEDS):
        if unsettled := [probe for probe in group if not _is_settled(outcomes[probe.name])]:
            found = _once(config, given, seed + number, unsettled, steps)
            for probe, outcome in zip(unsettled, found, strict=True):
                outcomes[probe.name].append(outcome)
    seconds = (time.monotonic() - started) / len(group)
    return [
        Finding(probe.name, *outcomes[probe.name][-1], probe.meaning, len(outcomes[probe.name]), seconds)
        for probe in group
    ]


def _is_settled(outcomes: Outcomes) -> bool:
    """Whether it has passed at once, or failed or passed on most seeds."""
    failures, most = [passed for passed, _ in outcomes].count(False), SEEDS // 2 + 1
    return bool(outcomes) and (not failures or max(failures, len(outcomes) - failures) >= most)


def _once(
    config: AgentConfig, given: Mapping[str, Any], seed: int, probes: list[Probe], steps: int | None = None
) -> Outcomes:
    """Train on one seed, and ask all probes of the group."""
    first = probes[0]
    if (found := settings(config, first, given)) is None:
        return [(None, f"takes no {first.needs}")] * len(probes)
    settled, kind = found
    try:
        trained = train(settled, first.world, first.gamma, kind.num_envs, steps or kind.steps, seed)
    except ReturnedError:
        raise
    except UnmetError as unmet:
        return [(False, f"{_BROKEN}: {unmet}")] * len(probes)
    except (Exception, SystemExit) as error:  # it may be anybody's code
        return [(False, f"{_BROKEN}: {in_short(error)}")] * len(probes)
    outcomes: Outcomes = []
    for probe in probes:
        try:
            outcomes.append((True, probe.found(trained)))
        except UnmetError as unmet:
            outcomes.append((False, str(unmet)))
        except UnknownError as unknown:
            outcomes.append((None, str(unknown)))
    return outcomes
