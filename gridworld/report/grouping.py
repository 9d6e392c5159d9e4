"""Which runs belong together: the same agent with the same settings on the same task, over seeds.

A task is a world with its step limit and the discount it is judged by. Runs of one agent on one task that
differ in anything that touches learning are reported apart, under labels that say in what.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gridworld.base.safe_read import sha256
from gridworld.config.fields import Effect
from gridworld.config.settings import effect_of
from gridworld.report.evidence import Evidence, Settings

_OF_LEARNING = (Effect.LEARNING, Effect.LENGTH, Effect.EVALUATION)
_MAP = ("env.layout", "env.num_rows", "env.num_cols")
_SOURCE = "env.source"  # of a world that is not a map
_OF_TABLES = ("layout", "max_episode_steps", "evaluation.gamma")
_NULL = "null"
_EMPTY = "{}"  # a mapping; where it has entries, these are settings of their own
_UNSET = "(not set)"
_LONGEST_VALUE = 24  # characters in a label

Key = tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Group:
    """The runs of one agent on one task, one for each seed, in the seeds' order."""

    agent: str  # label
    task: str  # label
    runs: tuple[Evidence, ...]

    @property
    def privileges(self) -> str:
        """What its runs had and a learner in the world would not have; "" where that is nothing."""
        return ", ".join(dict.fromkeys(each for run in self.runs for each in run.privileges))

    @property
    def scope(self) -> str:
        """How the tables of its world are known; "" by construction."""
        return "; ".join(dict.fromkeys(run.scope for run in self.runs if run.scope))


@dataclass(frozen=True, eq=False)
class Study:
    """All usable runs, put in order."""

    groups: tuple[Group, ...]  # by task, then agent
    agents: tuple[str, ...]
    tasks: tuple[str, ...]
    notes: tuple[str, ...]  # what a reader should know, a sentence each
    warnings: tuple[str, ...]  # what somebody should look into

    @property
    def runs(self) -> list[tuple[Group, Evidence]]:
        """All that are counted, each with its group."""
        return [(group, run) for group in self.groups for run in group.runs]


def arrange(runs: Iterable[Evidence]) -> Study:
    """Sort runs into groups, name the groups, and keep one run per seed."""
    notes: list[str] = []
    warnings: list[str] = []
    tasks: dict[Key, list[Evidence]] = defaultdict(list)
    for run in runs:
        tasks[task_key(run)].append(run)
    plainest = [min(map(_world_of, members), key=len) for members in tasks.values()]
    task_labels = labels([(world["layout"], world) for world in plainest], with_unset=False)
    groups = []
    for task, members in zip(task_labels, tasks.values(), strict=True):
        configurations: dict[tuple[str, Key], list[Evidence]] = defaultdict(list)
        for run in members:
            configurations[run.agent, learning_key(run)].append(run)
        named = [(agent, dict(key)) for agent, key in configurations]
        for agent in dict.fromkeys(agent for agent, _ in named):
            found = [settings for name, settings in named if name == agent]
            if len(found) > 1:
                notes.append(
                    f"{agent} on {task} was run with {len(found)} different configurations, reported "
                    f"separately; they differ in {', '.join(differing(found))}."
                )
        for label, group in zip(labels(named), configurations.values(), strict=True):
            groups.append(Group(label, task, _one_per_seed(group, notes, warnings)))
    groups.sort(key=lambda group: (group.task, group.agent))
    agents, on = sorted({group.agent for group in groups}), sorted({group.task for group in groups})
    return Study(tuple(groups), tuple(agents), tuple(on), tuple(notes), tuple(warnings))


def task_key(run: Evidence) -> Key:
    """What makes the task: map, dynamics, rewards, step limit and the discount of the evaluation."""
    world = _world_of(run)
    if _SOURCE in run.settings:  # its tables count, not what they were made from
        world = {key: world[key] for key in _OF_TABLES} | {"tables": run.layout}
    return tuple(sorted(world.items()))


def _world_of(run: Evidence) -> dict[str, str]:
    """The settings by which labels distinguish tasks."""
    # The map itself counts, not the path it was read from or the size that is given with it.
    world = {
        name.removeprefix("env."): value
        for name, value in run.settings.items()
        if effect_of(name) is Effect.TASK and name not in _MAP and value not in (_EMPTY, _NULL)
    }
    world |= {"layout": run.env, "evaluation.gamma": str(run.gamma)}
    if _SOURCE in run.settings:
        return world | {"max_episode_steps": str(run.step_limit)}
    return world | {"map": sha256(run.layout.encode())[:6]}


def learning_key(run: Evidence) -> Key:
    """Everything that touches learning, but the seed and the task."""
    return tuple(
        (name, value)
        for name, value in sorted(run.settings.items())
        if effect_of(name) in _OF_LEARNING and value != _EMPTY
    )


def labels(named: Sequence[tuple[str, Settings]], with_unset: bool = True) -> list[str]:
    """A label for each (name, settings): the name, with the settings that differ from its namesakes'."""
    out = []
    for name, settings in named:
        namesakes = [other for other_name, other in named if other_name == name]
        text = "" if len(namesakes) == 1 else _difference(settings, namesakes, with_unset)
        out.append(f"{name} ({text})" if text else name)
    return out


def differing(settings: Sequence[Settings]) -> list[str]:
    """Names of the settings that are not the same in all, the agent's first, a network's last."""
    names = sorted(
        {name for each in settings for name in each},
        key=lambda name: (".policy_kwargs." in name, name[:6] != "agent.", name),
    )
    return [name for name in names if len({each.get(name, _UNSET) for each in settings}) > 1]


def _difference(settings: Settings, namesakes: Sequence[Settings], with_unset: bool) -> str:
    """The differing settings that it takes until no two labels are the same, the first ones before others."""
    names = differing(namesakes)

    def are_distinct(chosen: Sequence[str]) -> bool:
        return len({_label(each, chosen, with_unset) for each in namesakes}) == len(namesakes)

    for count in range(1, len(names) + 1):
        if are_distinct(chosen := names[:count]):
            for name in chosen[:-1]:
                if are_distinct(without := [other for other in chosen if other != name]):
                    chosen = without
            return _label(settings, chosen, with_unset)
    digest = sha256(repr(sorted(settings.items())).encode())[:6]  # where values begin alike and are long
    return f"{_label(settings, names[:3], with_unset)}, {digest}"


def _label(settings: Settings, names: Sequence[str], with_unset: bool) -> str:
    parts = []
    for name in names:
        if with_unset or name in settings:
            value = settings.get(name, _UNSET)
            short = value if len(value) <= _LONGEST_VALUE else f"{value[: _LONGEST_VALUE - 3]}..."
            parts.append(f"{name.removeprefix('agent.')}={short}")
    return ", ".join(parts)


def _one_per_seed(runs: list[Evidence], notes: list[str], warnings: list[str]) -> tuple[Evidence, ...]:
    """Of runs with the same settings and seed the first whole one stays: a mean would count it twice."""
    kept: dict[int, Evidence] = {}
    for run in sorted(runs, key=lambda run: (bool(run.damage), str(run.folder))):
        first = kept.setdefault(run.seed, run)
        if first is run:
            continue
        warnings += run.damage
        text = f"{run.folder} has the same settings and seed as {first.folder}"
        curves = [{name: column.tobytes() for name, column in each.curve.items()} for each in (first, run)]
        if curves[0] == curves[1]:
            notes.append(f"{text}, and the same curve; it is counted once.")
        else:
            warnings.append(
                f"{text}, but a DIFFERENT curve (final regret {run.curve['regret'][-1]:.6g}, not "
                f"{first.curve['regret'][-1]:.6g}): one command, two results. Only the latter is counted."
            )
    return tuple(kept[seed] for seed in sorted(kept))
