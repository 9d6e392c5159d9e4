"""The world of an environment, by trying every action in a copy of every state.

    layers        what its wrappers and itself hold, copied and put back
    search        the states, and what each action does there
    rejection     the generator in place of its own, which takes every outcome of every draw
    counters      numbers that are counted and that nothing reads, and step limits, are no state
    checks        that resets and episodes lead to what was found
    beliefs       what observations leave open of the state; states that are alike are one

The step limit is that of a `TimeLimit`, or the one at which the environment truncates by itself. A state at
its own limit is not terminal, since the environment does not say so, but every action stays there and pays
nothing. An end is a success if it pays more than 0, and if none does, if it pays best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import EnumType
from functools import partial
from types import FunctionType
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from gridworld.base.user_input import check_memory
from gridworld.world.door.attributes import GENERATORS, attributes
from gridworld.world.door.beliefs import Beliefs, Node, State, Step
from gridworld.world.door.branching import RAREST
from gridworld.world.door.budget import MOST_STATES
from gridworld.world.door.checks import walk
from gridworld.world.door.counters import limit_of
from gridworld.world.door.known import Named, is_kept
from gridworld.world.door.layers import KEPT, Env, Layers
from gridworld.world.door.rejection import Rejecting
from gridworld.world.door.search import Search
from gridworld.world.mdp import ENUMERATED, Mdp, taken
from gridworld.world.outcomes import mdp_from_outcomes
from gridworld.world.shown import of_learners, stacked


@dataclass(frozen=True, eq=False)
class Found:
    """What the search found of an environment.

    Attributes:
        mdp: its world.
        space: of its observations.
        rows: the observation of each state, (S, *shape), by the keys of a Dict; None: they are no arrays.
        masks: (S, A), the actions that `action_masks()` allows; None: it has none.
    """

    mdp: Mdp
    space: gym.Space[Any]
    rows: Any
    masks: NDArray[np.bool_] | None


def enumerated(where: str, env: Env, *, name: str = "", **bounds: Any) -> Found:
    """Find the world of an environment, wrappers included, which is left as it was.

    Without a name it is called by its id or its class; `where` and `bounds`: see `Search`. Raises InputError
    where it has no such world, or none within these bounds.
    """
    search = Search(where, env, **bounds)
    try:
        search.explore()
        called = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        return _World(search, name or called).found
    finally:
        search.budget.clear()


class _World:
    """The world of what a search found; its states are `beliefs` about the environment's own."""

    def __init__(self, search: Search, name: str) -> None:
        self.search = search
        classes = list(search.classes)
        members: dict[int, list[State]] = {}
        for state, number in zip(search.states, classes, strict=True):
            members.setdefault(number, []).append(state)
        self.members = [*(members[number] for number in range(len(members))), []]
        classes.append(len(members))  # what is over, as the last
        limit, self._cuts_end = limit_of(search)
        of_classes = partial(_in_classes, classes=classes, cuts_end=self._cuts_end)
        first = [[list(map(of_classes, row)) for row in found[0].steps] for found in self.members[:-1]]
        starts = [(each.probability, classes[each.following], each.seen) for each in search.resets.starts]
        budget = search.budget
        budget.check_seconds()
        self.beliefs = beliefs = Beliefs(
            starts, [*first, []], search.too_large, budget.seconds_left(), budget.show, limit
        )
        space, numbers, size = search.env.observation_space, *self._numbers()
        named: list[Named] = [(f"observation {number}", None) for number in range(size)]
        leaves: list[Any] = [None] * size
        masks = np.ones((size, search.num_actions), dtype=np.bool_)
        for node, number in reversed(list(zip(beliefs.nodes, numbers.tolist(), strict=True))):
            named[number], leaves[number] = self._name(node), search.seen.parts[node.seen]
            masks[number] = self._mask(node)
        if isinstance(space, spaces.Discrete):
            leaves = [each or [np.array(space.start + n, space.dtype)] for n, each in enumerate(leaves)]
        memory = sum(each.nbytes for row in leaves for each in row if not isinstance(each, bytes))
        check_memory(search.where, memory)
        found = [place for _, place in named if place is not None]
        panels, places = list(dict.fromkeys(facing for facing, _, _ in found)), None
        if len(found) == len(named):
            places = np.array([(panels.index(facing), row, column) for facing, row, column in found])
            places[:, 1:] -= places[:, 1:].min(axis=0)  # without the walls around the room
        rows = stacked(space, iter(zip(*leaves, strict=True)))
        own = of_learners(space, rows)
        mdp = mdp_from_outcomes(
            name,
            beliefs.outcomes(name, search.num_actions, numbers, size),
            action_names=_action_names(search),
            places=places,
            panel_names=panels,
            max_episode_steps=limit,
            own_space=own[0],
            own_observation=own[1],
        )
        names = tuple(each for each, _ in named)
        mdp = replace(mdp, state_names=names if all(names) else (), truth=self._truth())
        shown = taken(rows, mdp.number)
        self.found = Found(mdp, space, shown, masks[mdp.number] if search.has_masks else None)

    def _numbers(self) -> tuple[NDArray[Any], int]:
        """The number of each node in the tables, the environment's own if it has such; how many there are."""
        space, nodes = self.search.env.observation_space, self.beliefs.nodes
        acting = [node.seen for node in nodes if node.rows]
        if isinstance(space, spaces.Discrete) and space.n <= MOST_STATES and len(set(acting)) == len(acting):
            shown = [int(self.search.seen.parts[node.seen][0]) - int(space.start) for node in nodes]
            return np.array(shown), int(space.n)
        return np.arange(len(nodes)), len(nodes)

    def _mask(self, node: Node) -> tuple[bool, ...]:
        """The actions that are allowed where a node's observation is shown."""
        everything = (True,) * self.search.num_actions
        found = {each.mask or everything for each in self._possible(node)} or {everything}
        if len(found) > 1 or any(len(each) != self.search.num_actions for each in found):
            raise self.search.refusal(
                "action_masks() depends on what the observations do not show, or has not one entry for each "
                f"of its {self.search.num_actions} actions; show what it depends on"
            )
        return found.pop()

    def _possible(self, node: Node) -> list[State]:
        """The environment's own states that a belief does not rule out; none where the episode is over."""
        return [state for number, _ in node.belief for state in self.members[number]]

    def _name(self, node: Node) -> Named:
        """What a reader calls a node: as its states, or by what is shown there."""
        found = {(each.name, each.place) for each in self._possible(node)} or {self.search.ends[node.seen]}
        name, place = found.pop() if len(found) == 1 else ("", None)
        return name or self.search.seen.texts[node.seen], place

    def _truth(self) -> str:
        ignored = f" without {', '.join(self.search.ignore)}, as you asked" if self.search.ignore else ""
        without = f"{ignored}, of which state= says all" if self.search.is_by_word else ignored
        size, nodes = len(self.members) - 1, self.beliefs.nodes
        if all(len(each.belief) == 1 for each in nodes):
            found = f"{ENUMERATED}, {len(nodes):,} states{without}"
        else:
            found = f"{ENUMERATED}, {len(nodes):,} beliefs about {size:,} hidden states{without}"
        aliased = self.beliefs.num_aliased()
        found += f"; {aliased:,} observations stand for several of them" if aliased else ""
        found += "; what it truncates, other than by a step limit, is an end" if self._cuts_end else ""
        endless = " and ".join(f"{each}()" for each in sorted(self.search.branching.endless))
        found += f"; {endless} without what has a chance below {RAREST:g}" if endless else ""
        readers = sorted(self.search.clock_readers)
        return f"{found}; the clock is read ({', '.join(readers[:3])})" if readers else found


def _in_classes(step: Step, classes: Sequence[int], cuts_end: bool) -> Step:
    ends = step.terminated or (step.truncated and cuts_end)
    return step._replace(following=classes[step.following], terminated=ends)


def _action_names(search: Search) -> list[str] | None:
    """The names in an enumeration `actions`, if the environment has one that fits."""
    actions = getattr(search.env.unwrapped, "actions", None)
    if not isinstance(actions, EnumType):
        return None
    names = {member.value: member.name for member in actions}  # type: ignore[var-annotated]
    numbers = range(search.num_actions)
    return [names[number] for number in numbers] if names.keys() >= set(numbers) else None


# The environment below; what was kept of its spec once somebody asked; the seed of a generator without one.
_OF_GYMNASIUM = ("env", "_cached_spec", "_np_random_seed")


def traits(env: Env) -> tuple[list[type], dict[Any, Any], list[Any]]:
    """What two environments that are one task have in common: classes, what never changes, and a walk."""
    search = Search("env", env)
    search.branching = branching = Rejecting("env", lambda: (b"", True), ())
    search.layers = Layers("env", env, branching, keeps_views=True)
    with search.layers.restored():
        held = {
            (number, name): value
            for number, layer in enumerate(search.layers.layers)
            for name, value in attributes(layer).items()
        }
        before = search.layers.values()
        shown = walk(search, np.int64)
        after = search.layers.values()
    constant = {
        key: _lasting(held[key], value)
        for key, value in before.items()
        if key[1] not in _OF_GYMNASIUM and after.get(key) == value and held[key] is not branching
    }
    return [type(each) for each in search.layers.layers], constant, shown


def _lasting(held: Any, copy: bytes) -> Any:
    """What an attribute holds, to be compared with another environment's."""
    if isinstance(held, gym.Space | EnvSpec):
        return held
    if is_kept(type(held)):
        return type(held)
    is_plain = isinstance(held, FunctionType) and held.__closure__ is None
    return (held.__code__, held.__defaults__) if is_plain else copy


def contents(env: Env) -> dict[str, bytes]:
    """The content of each attribute of an environment, to compare it with another's."""
    layers = Layers("env", env.unwrapped, object(), keeps_views=True)
    layers.is_adopting = True
    skipped = {
        name for name, value in attributes(layers.base).items() if isinstance(value, (*KEPT, *GENERATORS))
    }
    return {name: value for (_, name), value in layers.values([*skipped, "_np_random_seed"]).items()}
