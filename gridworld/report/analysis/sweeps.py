"""Agents that were run with many values of some settings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gridworld.report.analysis.analyse import Result
from gridworld.report.evidence.grouping import differing, learning_key

_LEAST = 3  # configurations that make a sweep, and more of them than settings that differ


@dataclass(frozen=True, eq=False)
class Sweep:
    """The results of one agent on one task by the values of what was swept.

    Attributes:
        agent: its name.
        keys: names of settings; of more than two, those with the most values come first.
        values: of each key, the smallest first.
        results: by a value for each key; not every combination need have one.
    """

    agent: str
    keys: tuple[str, ...]
    values: tuple[tuple[str, ...], ...]
    results: Mapping[tuple[str, ...], Result]


def sweeps(results: Sequence[Result]) -> list[Sweep]:
    """Find the agents among a task's results of which settings were swept."""
    by_agent: dict[str, list[Result]] = defaultdict(list)
    for result in results:
        by_agent[result.group.runs[0].agent].append(result)
    found = []
    for agent, members in by_agent.items():
        settings = [dict(learning_key(result.group.runs[0])) for result in members]
        keys = tuple(differing(settings))
        if len(members) < max(_LEAST, len(keys) + 1):
            continue
        if len(keys) > 2:
            keys = tuple(sorted(keys, key=lambda key: -len({each.get(key, "") for each in settings})))
        places = [tuple(each.get(key, "") for key in keys) for each in settings]
        values = tuple(tuple(sorted(set(column), key=_order)) for column in zip(*places, strict=True))
        found.append(Sweep(agent, keys, values, dict(zip(places, members, strict=True))))
    return found


def _order(value: str) -> tuple[bool, float, str]:
    """Numbers by their size, then words."""
    try:
        return False, float(value), ""
    except ValueError:
        return True, 0.0, value
