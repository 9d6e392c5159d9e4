"""Whether somebody's method is a function of its argument alone, as far as that can be found out.

It is asked for every argument again and again, in two orders. Before and after, whatever it could remember by
or draw from is looked at: attributes, classes, defaults, closures, globals, and generators of random numbers.
What draws from the operating system or the clock, once in thousands of calls, is beyond this.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.errors import InputError, in_short
from gridworld.world.sources.snapshots import AnotherEnvError, Reader, random_states

_CALLS = 1000  # at least
SO_UNKNOWN = (
    ", so what it makes of the task is not exactly known; "
    "leave it out, or make it a function of its argument alone"
)


def asked(where: str, owner: Any, method: str, arguments: list[Any], chain: Iterable[Any] = ()) -> list[Any]:
    """What a method of `owner` makes of (copies of) each argument; refuses what is no function of it alone.

    `chain` are the environments that it may refer to; `where` is what messages call the environment.
    """
    name, ask = f"{method}() of {type(owner).__name__}", getattr(owner, method)

    def all_of(order: list[Any]) -> list[Any]:
        return [copy.deepcopy(ask(copy.deepcopy(each))) for each in order]

    try:
        found = all_of(arguments)
        before = remembered(where, name, owner, chain)
        for order in [*[-1] * (1 + _CALLS // max(1, len(arguments))), 1]:  # backwards, at last forwards
            again = all_of(arguments[::order])[::order]
            for argument, one, other in zip(arguments, found, again, strict=True):
                if not same(one, other):
                    raise InputError(
                        f"{where}: {name} does not always give the same for {str(argument)[:50]}{SO_UNKNOWN}"
                    )
    except InputError:
        raise
    except Exception as error:  # it may be anybody's
        raise InputError(f"{where}: {name} raised {in_short(error)}") from error
    if remembered(where, name, owner, chain) != before:
        raise InputError(f"{where}: {name} keeps a memory or draws random numbers{SO_UNKNOWN}")
    return found


def same(one: Any, other: Any) -> bool:
    """Whether two observations, actions or rewards are equal, dictionaries of arrays included."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return np.array_equal(np.asarray(one), np.asarray(other))


def alike(one: Any, other: Any, without: Iterable[str] = ()) -> bool:
    """Whether two objects of one class hold the same values and functions, but for some attributes."""
    if type(one) is not type(other):
        return False
    digests = set()
    for each in (one, other):
        reader = Reader([each], deep=True, skips_envs=True)
        digests.add(reader.digest(*((k, v) for k, v in sorted(vars(each).items()) if k not in without)))
        if not reader.is_complete:
            return False
    return len(digests) == 1


def remembered(where: str, name: str, owner: Any, chain: Iterable[Any] = ()) -> list[Any]:
    """Whatever a method of `owner` could change or draw from, to compare; refuses other environments."""
    known = [*chain, owner]
    held = {key: value for key, value in vars(owner).items() if key != "env"}
    generators = [each.np_random for each in known if isinstance(each, gym.Env)]
    try:
        digest = Reader(known, deep=True).digest(generators, held, *type(owner).__mro__)
    except AnotherEnvError:
        raise InputError(f"{where}: {name} looks into an environment{SO_UNKNOWN}") from None
    return [digest, *random_states()]
