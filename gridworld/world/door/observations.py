"""Observations as a learner gets them: arrays of the types of their space."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.base.errors import InputError, on_a_line

_LONGEST_NAME = 60  # of a state that is called by its observation


class Seen:
    """The observations that were met, by their digests.

    Args:
        env: shows them; its space may be set as late as in a reset.
        refusal: makes an error of a reason.
    """

    def __init__(self, env: gym.Env[Any, Any], refusal: Callable[[str], InputError]) -> None:
        self._env, self._refusal = env, refusal
        self.parts: dict[bytes, Any] = {}
        self.texts: dict[bytes, str] = {}  # empty where they are long
        self.num_bytes = 0
        self._met: dict[Any, bytes] = {}  # the digests of numbers, and of tuples of such

    def digest(self, observation: Any) -> bytes:
        """A digest of an observation as a learner gets it, in the types of its space."""
        may_be_met = type(observation) in (int, tuple, np.int64)
        with contextlib.suppress(TypeError):  # of a tuple of what has no hash
            if may_be_met and (met := self._met.get(observation)):
                return met
        parts = list(leaves(observation, self._env.observation_space, self._refusal))  # whose sizes are known
        whole = b"".join(each.tobytes() if isinstance(each, np.ndarray) else each for each in parts)
        seen = whole if len(whole) <= 16 else hashlib.blake2b(whole, digest_size=17).digest()
        if seen not in self.parts:
            self.parts[seen] = parts
            text = " ".join(str(observation).split())
            self.texts[seen] = f"observation {text}" if len(text) <= _LONGEST_NAME else ""
            self.num_bytes += sum(each.nbytes for each in parts if isinstance(each, np.ndarray))
        with contextlib.suppress(TypeError):
            if may_be_met and all(isinstance(each, np.ndarray) for each in parts):  # by numbers alone
                self._met[observation] = seen
        return seen


def leaves(observation: Any, space: gym.Space[Any], refusal: Callable[[str], InputError]) -> Iterator[Any]:
    """The arrays in an observation, each of the type of its space; bytes of what is none."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        inner = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, each in inner:
            try:
                part = observation[key]
            except (TypeError, KeyError, IndexError):
                raise _misfit(observation, space, refusal) from None
            yield from leaves(part, each, refusal)
    elif isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        try:
            given = np.asarray(observation)
            array: NDArray[Any] = given.astype(space.dtype, order="C")
            fits = given.shape == space.shape and given.dtype.kind in "biuf"
            if fits and given.dtype != array.dtype and not (array == given).all():
                fits = np.allclose(array.astype(np.float64), given.astype(np.float64), 1e-3, 1e-6, True)
            if isinstance(space, spaces.Discrete):
                fits = fits and bool(space.start <= array < space.start + space.n)
        except (TypeError, ValueError, OverflowError):
            fits = False
        if not fits:
            raise _misfit(observation, space, refusal)
        yield array
    else:
        yield content(observation)


def content(thing: Any) -> bytes:
    """The content of an observation of any kind, to compare it."""
    if isinstance(thing, dict):
        return b"{%b}" % b",".join(repr(key).encode() + content(each) for key, each in thing.items())
    if isinstance(thing, set | frozenset):
        return b"<%b>" % b",".join(sorted(map(content, thing)))
    if isinstance(thing, tuple | list):
        return b"(%b)" % b",".join(map(content, thing))
    array = np.asarray(thing)
    if array.dtype == object:
        return repr(thing).encode()
    return repr((array.shape, array.dtype.str)).encode() + array.tobytes()


def _misfit(observation: Any, space: gym.Space[Any], refusal: Callable[[str], InputError]) -> InputError:
    return refusal(
        f"an observation is {on_a_line(observation)}, which is not in its space {on_a_line(space)}"
    )
