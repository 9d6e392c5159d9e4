"""What an environment shows, as a learner gets it: observations while states are found, and of each state.

For `observation=own` there are a space and rows: an array (S, *shape), or such arrays by the keys of a Dict.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
from collections.abc import Callable, Iterator
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from gridworld.base.errors import InputError, on_a_line
from gridworld.base.user_input import DAMAGED, check_memory

_LONGEST_NAME = 60  # of a state that is called by its observation
_MOST_NAMED = 4  # numbers of an observation
_ARRAYS = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def of_learners(space: gym.Space[Any], rows: Any) -> tuple[gym.Space[Any] | None, Any]:
    """The space and the rows that SB3 learns from.

    They are the environment's own where SB3 takes its space. Of a Tuple of numbers, and of a Discrete that
    does not start at 0, there are only the numbers, without a space; of a Dict with texts the array called
    `image`. Where there is nothing, both are None.
    """
    flat = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    if all(isinstance(each, _ARRAYS) and not np.any(getattr(each, "start", 0)) for each in flat):
        return space, rows
    if isinstance(space, spaces.Dict):
        return None, rows["image"] if isinstance(rows.get("image"), np.ndarray) else None
    if isinstance(space, spaces.Tuple):
        is_numbers = all(isinstance(each, spaces.Discrete) for each in space.spaces)
        return None, np.stack(rows, axis=1).astype(np.int64) if is_numbers and len(rows) else None
    return None, rows if isinstance(rows, np.ndarray) else None


def channels_first(space: gym.Space[Any], rows: Any) -> tuple[gym.Space[Any], Any]:
    """The same with images as (C, H, W), which SB3 makes of (H, W, C) before it learns."""
    if isinstance(space, spaces.Dict):
        parts = {key: channels_first(each, rows[key]) for key, each in space.spaces.items()}
        if all(parts[key][0] is each for key, each in space.spaces.items()):
            return space, rows
        return spaces.Dict([(key, each) for key, (each, _) in parts.items()]), {
            key: each for key, (_, each) in parts.items()
        }
    if not isinstance(space, spaces.Box) or len(space.shape) != 3 or space.dtype != np.uint8:
        return space, rows
    if (space.low != 0).any() or (space.high != 255).any() or not np.argmin(space.shape):
        return space, rows
    turned = np.ascontiguousarray(np.moveaxis(rows, -1, 1))
    return spaces.Box(0, 255, turned.shape[1:], np.uint8), turned


def usual_numbers(rows: Any) -> dict[str, NDArray[Any]]:
    """By the keys of a Dict, the number (n,) at each place that lies in the middle of those of all states."""
    parts = rows if isinstance(rows, dict) else {"": rows}
    flat = {key: each.reshape(len(each), -1) for key, each in parts.items()}
    return {key: np.partition(each, len(each) // 2, axis=0)[len(each) // 2] for key, each in flat.items()}


def unusual_numbers(rows: Any, usual: dict[str, NDArray[Any]], state: int) -> str:
    """What tells a state's observation from most others: "[3]=1, [7]=0.5 and 2 more"."""
    found = []
    for key, middle in usual.items():
        part = rows[key] if isinstance(rows, dict) else rows
        own = part[state].ravel()
        for at in np.flatnonzero(own != middle):
            place = np.unravel_index(at, part.shape[1:])
            found.append(f"{key}[{', '.join(map(str, map(int, place)))}]={own[at]:g}")
    more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
    return f"{', '.join(found[:_MOST_NAMED]) or 'its usual numbers'}{more}"


def stacked(space: gym.Space[Any], parts: Iterator[Any]) -> Any:
    """Observations as arrays of all states, from an iterator over the leaves of a space; None for others."""
    if isinstance(space, spaces.Dict):
        return {key: stacked(each, parts) for key, each in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(stacked(each, parts) for each in space.spaces)
    found = next(parts)
    return None if isinstance(found[0], bytes) else np.stack(found)


def misfit(space: gym.Space[Any] | None, rows: Any, size: int) -> str | None:
    """Why rows are not those of so many states, of the space if there is one; None: they are."""
    if isinstance(space, spaces.Dict):
        if not isinstance(rows, dict) or rows.keys() != space.spaces.keys():
            return f"must have {', '.join(space.spaces)}"
        found = (misfit(each, rows[key], size) for key, each in space.spaces.items())
        return next((each for each in found if each is not None), None)
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "biuf" or rows.shape[:1] != (size,):
        return f"must be numbers, the first of its axes {size} states"
    if space is None:
        return None
    fits = rows.dtype == space.dtype and rows.shape[1:] == space.shape
    if fits and isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        most = space.n if isinstance(space, spaces.Discrete) else space.nvec
        fits = bool(((rows >= 0) & (rows < most)).all())
    return None if fits else f"does not fit its space {' '.join(str(space).split())[:100]}"


def space_text(space: gym.Space[Any]) -> str:
    """A space of learners as JSON."""
    if isinstance(space, spaces.Dict):
        return json.dumps({"Dict": [[key, space_text(each)] for key, each in space.spaces.items()]})
    if isinstance(space, spaces.Box):
        bounds = (
            [0, 0]
            if not space.low.size
            else [
                each.flat[0].item() if (each == each.flat[0]).all() else each.tolist()
                for each in (space.low, space.high)
            ]
        )
        return json.dumps({"Box": [*bounds, list(space.shape), space.dtype.str]})
    if isinstance(space, spaces.Discrete):
        return json.dumps({"Discrete": [int(space.n), space.dtype.str]})
    if isinstance(space, spaces.MultiDiscrete):
        return json.dumps({"MultiDiscrete": [space.nvec.tolist(), space.dtype.str]})
    assert isinstance(space, spaces.MultiBinary)
    return json.dumps({"MultiBinary": list(space.shape)})


def space_of_text(text: str, where: str) -> gym.Space[Any]:
    """Mirrors `space_text`; InputError: it is none."""
    try:
        ((kind, given),) = json.loads(text).items()
        if kind == "Dict":
            return spaces.Dict([(str(key), space_of_text(each, where)) for key, each in given])
        if kind == "Box":
            low, high, shape, name = given
            of: Any = np.dtype(name).type
            check_memory(where, 3 * 8 * math.prod(shape))
            low, high = (np.broadcast_to(np.array(each, of), shape) for each in (low, high))
            return cast(gym.Space[Any], spaces.Box(low, high, tuple(shape), of))
        if kind == "Discrete":
            return spaces.Discrete(given[0], dtype=np.dtype(given[1]).type)
        if kind == "MultiDiscrete":
            return spaces.MultiDiscrete(np.array(given[0]), dtype=np.dtype(given[1]).type)
        if kind == "MultiBinary":
            return spaces.MultiBinary(given if len(given) > 1 else given[0])
    except InputError:
        raise
    except (*DAMAGED, AssertionError, AttributeError):
        pass
    raise InputError(f"{where}: own_space is not a space of observations")


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
        # their sizes are known by the space
        parts = list(_leaves(observation, self._env.observation_space, self._refusal))
        whole = b"".join(each.tobytes() if isinstance(each, np.ndarray) else each for each in parts)
        seen = whole if len(whole) <= 16 else hashlib.blake2b(whole, digest_size=17).digest()
        if seen not in self.parts:
            self.parts[seen] = parts
            shown = _plain(observation) if isinstance(observation, dict | tuple) else observation
            text = " ".join(str(shown).split())
            self.texts[seen] = f"observation {text}" if len(text) <= _LONGEST_NAME else ""
            self.num_bytes += sum(each.nbytes for each in parts if isinstance(each, np.ndarray))
        with contextlib.suppress(TypeError):
            if may_be_met and all(isinstance(each, np.ndarray) for each in parts):  # by numbers alone
                self._met[observation] = seen
        return seen


def _plain(part: Any) -> Any:
    """A part of an observation without arrays, as it can be read."""
    if isinstance(part, dict):
        return {key: _plain(each) for key, each in part.items()}
    if isinstance(part, tuple):
        return tuple(map(_plain, part))
    return part.tolist() if isinstance(part, np.ndarray | np.generic) else part


def _leaves(observation: Any, space: gym.Space[Any], refusal: Callable[[str], InputError]) -> Iterator[Any]:
    """The arrays in an observation, each of the type of its space; bytes of what is none."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        inner = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, each in inner:
            try:
                part = observation[key]
            except (TypeError, KeyError, IndexError):
                raise _misfit(observation, space, refusal) from None
            yield from _leaves(part, each, refusal)
    elif isinstance(space, _ARRAYS):
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
