"""Which runs belong together: the same agent with the same settings on the same task, over seeds.

A task is a world with its step limit and the discount it is judged by. Runs of one agent on one task that
differ in anything that touches learning are reported apart, under labels that say in what.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gridworld.config.fields import Effect
from gridworld.config.settings import effect_of
from gridworld.report.evidence.run_reader import Evidence, Settings, Unusable
from gridworld.storage.safe_read import sha256

_OF_LEARNING = (Effect.LEARNING, Effect.LENGTH, Effect.EVALUATION)
_MAP = ("env.layout", "env.num_rows", "env.num_cols")
_SOURCE = "env.source"  # of a world that is no map
_OF_TABLES = ("layout", "max_episode_steps", "evaluation.gamma")
_NULL = "null"
_EMPTY = "{}"  # a mapping; in what its entries are, it is told by these
_UNSET = "(not set)"
_MOST_NAMED = 3  # folders
_LONGEST_VALUE = 24  # characters in a label

Key = tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Group:
    """The runs of one agent on one task, one for each seed, in the seeds' order."""

    agent: str  # label
    task: str  # label
    runs: tuple[Evidence, ...]
    lost: tuple[Unusable, ...] = ()  # of other seeds
    perhaps: tuple[Unusable, ...] = ()  # the same, but they may be of another group

    @property
    def privileges(self) -> str:
        """What its runs had and a learner in the world would not have; "" where that is nothing."""
        return ", ".join(dict.fromkeys(each for run in self.runs for each in run.privileges))

    @property
    def seeds(self) -> str:
        """How many of its seeds are counted, "4 of 5 seeds"; "" for all of them."""
        runs = len(self.runs)
        least, most = runs + len(self.lost), runs + len(self.lost) + len(self.perhaps)
        return f"{runs} of {least if most == least else f'{least} to {most}'} seeds" if most > runs else ""

    @property
    def shortfall(self) -> str:
        """The same, and which ones are not."""
        return f"{self.seeds}; {listed([*self.lost, *self.perhaps])}" if self.seeds else ""


@dataclass(frozen=True, eq=False)
class Study:
    """All usable runs, put in order."""

    groups: tuple[Group, ...]  # by task, then agent
    agents: tuple[str, ...]
    tasks: tuple[str, ...]
    notes: tuple[str, ...]  # what a reader should know, a sentence each
    warnings: tuple[str, ...]  # what somebody should look into

    def on(self, task: str) -> list[Group]:
        """The groups of one task."""
        return [group for group in self.groups if group.task == task]


def arrange(runs: Iterable[Evidence], unusable: Sequence[Unusable] = ()) -> Study:
    """Sort runs into groups, name the groups, and keep one run per seed.

    Each unusable run is put to the group that it would be in, as far as that can be told. The notes and
    warnings name runs with the same settings and seed.
    """
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
        agent_labels = labels([(agent, dict(key)) for agent, key in configurations])
        of_agent: dict[str, list[Settings]] = defaultdict(list)
        for agent, key in configurations:
            of_agent[agent].append(dict(key))
        notes += [
            f"{agent} on {task} was run with {len(found)} different configurations, which are reported "
            f"apart; they differ in {', '.join(differing(found))}."
            for agent, found in of_agent.items()
            if len(found) > 1
        ]
        for agent, group in zip(agent_labels, configurations.values(), strict=True):
            groups.append(Group(agent, task, _one_per_seed(group, notes, warnings)))
    groups.sort(key=lambda group: (group.task, group.agent))
    return Study(
        tuple(_with_lost(groups, unusable, warnings)),
        tuple(sorted({group.agent for group in groups})),
        tuple(sorted({group.task for group in groups})),
        tuple(notes),
        tuple(warnings),
    )


def shortfall(groups: Iterable[Group]) -> str:
    """What numbers of these groups leave out, to go on a caption with; "" where that is nothing."""
    short = [group for group in groups if group.seeds]
    told = [f"{each.agent} on {each.task} has {each.shortfall}" for each in short[:_MOST_NAMED]]
    told += [f"{len(short) - _MOST_NAMED} more are not complete"] if len(short) > _MOST_NAMED else []
    return f"; not all runs are counted: {'; '.join(told)}" if told else ""


def listed(lost: Sequence[Unusable]) -> str:
    """How many runs are in which state, and their folders' names."""
    states: dict[str, list[str]] = defaultdict(list)
    for run in lost:
        states[run.state].append(run.folder.name)
    told = []
    for state, names in states.items():
        more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
        told.append(f"{len(names)} {state}: {', '.join(names[:_MOST_NAMED])}{more}")
    return "; ".join(told)


def _with_lost(groups: list[Group], unusable: Sequence[Unusable], warnings: list[str]) -> Iterator[Group]:
    """The groups with the unusable runs of seeds that they lack; a warning for those that are of none."""
    like: dict[object, list[Group]] = defaultdict(list)
    for group in groups if unusable else ():
        for key in {each for run in group.runs for each in (_but_for_seed(run), (run.agent, run.env))}:
            like[key].append(group)
    lost: dict[tuple[Group, bool], dict[object, Unusable]] = defaultdict(dict)  # by seed
    alone: dict[str, list[Unusable]] = defaultdict(list)
    for run in unusable:
        found = like[_but_for_seed(run)]
        if not found and run.settings is not None:
            alone[f"{run.agent or '?'} on {run.env or '?'}"].append(run)
            continue
        for group in found or groups:
            if all(run.seed != other.seed for other in group.runs):
                lost[group, len(found) == 1][run.folder if run.seed is None else run.seed] = run
    warnings += [f"no run of {of} with these settings is counted; {listed(alone[of])}" for of in alone]
    for group in groups:
        surely, perhaps = (tuple(lost[group, is_sure].values()) for is_sure in (True, False))
        yield replace(group, lost=surely, perhaps=perhaps)


def _but_for_seed(run: Evidence | Unusable) -> object:
    """What is the same in runs that differ in the seed alone; of one without settings, less."""
    if run.settings is None:
        return run.agent, run.env
    kinds = (*_OF_LEARNING, Effect.TASK)
    settings = {(name, value) for name, value in run.settings.items() if effect_of(name) in kinds}
    kept = frozenset((name, value) for name, value in settings if name not in _MAP and value != _EMPTY)
    return run.agent, run.layout, kept


def task_key(run: Evidence) -> Key:
    """What makes the task: map, dynamics, rewards, step limit and the discount of the evaluation."""
    world = _world_of(run)
    if _SOURCE in run.settings:  # its tables count, not what they were made from
        world = {key: world[key] for key in _OF_TABLES} | {"tables": run.layout}
    return tuple(sorted(world.items()))


def _world_of(run: Evidence) -> dict[str, str]:
    """What labels tell tasks apart by."""
    # The map itself counts, not the path it was read from or the size that is told beside it.
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
    """A label for each (name, settings): the name, with the settings that tell it from its namesakes.

    `with_unset` is whether to tell of a setting that only others have that it is not set.
    """
    out = []
    for name, settings in named:
        namesakes = [other for other_name, other in named if other_name == name]
        told = "" if len(namesakes) == 1 else _difference(settings, namesakes, with_unset)
        out.append(f"{name} ({told})" if told else name)
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

    def tell_apart(chosen: Sequence[str]) -> bool:
        return len({_told(each, chosen, with_unset) for each in namesakes}) == len(namesakes)

    for count in range(1, len(names) + 1):
        if tell_apart(chosen := names[:count]):
            for name in chosen[:-1]:
                if tell_apart(without := [other for other in chosen if other != name]):
                    chosen = without
            return _told(settings, chosen, with_unset)
    digest = sha256(repr(sorted(settings.items())).encode())[:6]  # where values begin alike and are long
    return f"{_told(settings, names[:3], with_unset)}, {digest}"


def _told(settings: Settings, names: Sequence[str], with_unset: bool) -> str:
    told = []
    for name in names:
        if with_unset or name in settings:
            value = settings.get(name, _UNSET)
            short = value if len(value) <= _LONGEST_VALUE else f"{value[: _LONGEST_VALUE - 3]}..."
            told.append(f"{name.removeprefix('agent.')}={short}")
    return ", ".join(told)


def _one_per_seed(runs: list[Evidence], notes: list[str], warnings: list[str]) -> tuple[Evidence, ...]:
    """Of runs with the same settings and seed the first whole one stays: a mean would count it twice."""
    kept: dict[int, Evidence] = {}
    for run in sorted(runs, key=lambda run: (bool(run.damage), str(run.folder))):
        first = kept.setdefault(run.seed, run)
        if first is run:
            continue
        warnings += run.damage
        told = f"{run.folder} has the settings and the seed of {first.folder}"
        same = first.curve.keys() == run.curve.keys() and all(
            np.array_equal(first.curve[name], run.curve[name], equal_nan=True) for name in run.curve
        )
        if same:
            notes.append(f"{told}, and the same curve; it is counted once.")
        else:
            warnings.append(
                f"{told}, but ANOTHER curve (final regret {run.curve['regret'][-1]:.6g} against "
                f"{first.curve['regret'][-1]:.6g}): one command, two results. Only the latter is counted."
            )
    return tuple(kept[seed] for seed in sorted(kept))
