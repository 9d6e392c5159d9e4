"""Worlds from Gymnasium environments without a table, enumerated: every action in a copy of every state.

The steps are modules of `world.enumeration`:

    state_search  the states and what each action does there; all that changes is state, the time included
    branching     a generator in place of the environment's own takes every outcome in turn
    beliefs       what observations leave open of the state: the states of the world
    replay        the environment itself beside the table, thousands of steps: any difference is refused

The replay is for what the search may miss, such as attributes that the user told it to leave out, or a
wrapper. With attributes that a user names as no part of a state, the claim rests on that, and `truth` says
so.

The step limit is that of the id or the one at which the environment truncates by itself. A state at the limit
is not terminal, since the environment does not say so, but every action stays there and pays nothing.

Its own observation is a table where the observation space is a Box, of whole numbers (Discrete,
MultiDiscrete, MultiBinary, a Tuple of Discrete), or a Dict with a Box `image`, of which this entry is taken,
as minigrid's `ImgObsWrapper` does. An end is a success if it pays more than 0, and if none does, if it pays
best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from gridworld.base.console import telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.world.enumeration.beliefs import Beliefs, Node, lumped
from gridworld.world.enumeration.replay import Replay
from gridworld.world.enumeration.state_search import OVER, Named, State, StateSearch
from gridworld.world.mdp import ENUMERATED, Mdp
from gridworld.world.outcomes import MOST_STATES, mdp_from_outcomes
from gridworld.world.reading import UnreadableError
from gridworld.world.sources.gymnasium_table import compile_gymnasium, has_table, make_env
from gridworld.world.wrappers import refuse_transformed


def enumerate_env(
    env_id: str,
    kwargs: Mapping[str, Any] | None = None,
    *,
    ignore: Sequence[str] = (),
    most_states: int = MOST_STATES,
) -> Mdp:
    """Compile an environment by trying every action in a copy of every state, with every draw of `np_random`.

    Args:
        env_id: its registered id.
        kwargs: the arguments of `gymnasium.make`.
        ignore: attributes of the environment that are not part of its state.
        most_states: more are refused as soon as they are found.

    Returns:
        The world; its `truth` is "enumerated, N states", of what, and without which attributes. Its states
        are what a history of observations and rewards leaves open of the environment's own, see `beliefs`.
    """
    with telling_if_slow(f"enumerating {env_id}"):
        env = make_env(env_id, kwargs)
        try:
            search = StateSearch(env_id, env, ignore, most_states)
            limit = None if env.spec is None else env.spec.max_episode_steps
            limit = limit if limit is not None and limit > 0 else None  # -1 is "none" to `gymnasium.make`
            search.explore(limit)
            found = Enumerated(search, limit)
            found_limit = Replay(found, partial(make_env, env_id, kwargs)).check()
            refuse_transformed(f"env.id={env_id}", env)
        except UnreadableError as error:
            raise InputError(
                f"env.id={env_id}: its state cannot be compared: {error}; hold numbers, lists and numpy "
                "arrays, or name in env.ignore what nothing depends on"
            ) from error
        finally:
            env.close()
    return replace(found.mdp, max_episode_steps=found_limit)


class Enumerated:
    """The world of what a search found, `mdp`; its states are `beliefs` about the environment's own."""

    def __init__(self, search: StateSearch, limit: int | None) -> None:
        self.search, is_random = search, search.is_random
        steps = [each.steps for each in search.states]
        if is_random:  # where an episode is over, nothing but the observation matters
            steps = [
                [[each._replace(following=OVER) if each.terminated else each for each in row] for row in rows]
                for rows in steps
            ]
        # Else, what differs only in the types of numbers counts as one where the steps are the same.
        classes = lumped(steps, [None if is_random else each.alike for each in search.states])
        members: dict[int, list[State]] = {}
        for state, number in zip(search.states, classes, strict=True):
            members.setdefault(number, []).append(state)
        self.members = [*(members[number] for number in range(len(members))), []]
        classes.append(len(members))  # what is over, as the last
        first = [
            [
                [each._replace(following=classes[each.following]) for each in row]
                for row in steps[found[0].number]
            ]
            for found in self.members[:-1]
        ]
        starts = [(each.probability, classes[each.following], each.seen) for each in search.starts]
        self.beliefs = beliefs = Beliefs(starts, [*first, []], search.refusal, MOST_STATES)
        limits = [each for each in (search.own_limit(), limit) if each is not None]
        observations = [search.observations[each.seen] for each in beliefs.nodes]
        shown = [each for each in observations if each is not None]
        check_memory(f"env.id={search.name}: its own observations", sum(each.nbytes for each in shown))
        named = [self._name(each) for each in beliefs.nodes]
        found = [place for _, place in named if place is not None]
        panels, places = list(dict.fromkeys(facing for facing, _, _ in found)), None
        if len(found) == len(named):
            places = np.array([(panels.index(facing), row, column) for facing, row, column in found])
            places[:, 1:] -= places[:, 1:].min(axis=0)  # without the walls around the room
        mdp = mdp_from_outcomes(
            search.name,
            beliefs.outcomes(search.name, search.num_actions),
            action_names=search.action_names(),
            places=places,
            panel_names=panels,
            max_episode_steps=min(limits, default=None),
            own_observation=np.stack(shown) if len(shown) == len(named) else None,
        )
        names = tuple(name for name, _ in named)
        self.mdp = replace(mdp, state_names=names if all(names) else (), truth=self._truth())

    def possible(self, node: Node) -> list[State]:
        """The environment's own states that a belief does not rule out; none where the episode is over."""
        return [state for number, _ in node.belief for state in self.members[number]]

    def _name(self, node: Node) -> Named:
        """What a reader calls a node: as its states, or where there is chance by what is shown there."""
        found = {(each.name, each.place) for each in self.possible(node)} or {self.search.ends[node.seen]}
        name, place = found.pop() if len(found) == 1 else ("", None)
        return name or (self.search.shown[node.seen] if self.search.is_random else ""), place

    def _truth(self) -> str:
        without = f" without {', '.join(self.search.ignore)}, as you asked" if self.search.ignore else ""
        size, nodes = len(self.members) - 1, self.beliefs.nodes
        if all(len(each.belief) == 1 for each in nodes):
            found = f"{ENUMERATED}, {len(nodes):,} states{without}"
        else:
            found = f"{ENUMERATED}, {len(nodes):,} beliefs about {size:,} hidden states{without}"
        aliased = self.beliefs.num_aliased() if self.search.is_random else 0
        return f"{found}; {aliased:,} observations stand for several of them" if aliased else found


def compile_id(env_id: str, kwargs: Mapping[str, Any] | None = None) -> Mdp:
    """Compile an environment by its transition table if it has one, else by enumeration."""
    env = make_env(env_id, kwargs)
    env.close()
    return (compile_gymnasium if has_table(env.unwrapped) else enumerate_env)(env_id, kwargs)
