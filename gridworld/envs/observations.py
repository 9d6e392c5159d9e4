"""What the agent sees: tables over states, and the wrappers that look observations up in them.

An observation is a function of the state alone, so each kind is a table of S rows: `table.rows(states)` is
all there is to it, for one environment, a batch, a replay buffer or the whole state space at once.

    kind         dtype    shape        row of a state
    one_hot      float32  (N,)         1 at the state's number; N is S but for further ends
    coordinates  float32  (2,), (3,)   row and column (and panel, if there are several), scaled to [0, 1]
    image        uint8    (3, H, W)    the pixels of its frame, channels first as SB3's CnnPolicy takes them
    own          its own  its own      what the environment itself shows, where the world was made from one
    none         int64    ()           the state's number itself

A new kind is a function with its row in `KINDS`, and a yaml in `conf/observation`. The two generic wrappers
take it by its name.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv, VectorObservationWrapper
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import NDArray

from gridworld.base.bounds import positive_int
from gridworld.base.errors import InputError
from gridworld.base.user_input import check_memory
from gridworld.envs import rendering as drawing
from gridworld.world.mdp import IntArray, Mdp, frozen, taken
from gridworld.world.shown import channels_first

IMAGE_CELL_SIZE = 8  # pixels; 5x6 cells and their border make 56 x 64, enough for SB3's NatureCNN

_MAX_TABLE_BYTES = 2**30
_OF_A_FRAME = 140  # bytes that a space, a sample of it and a network make of each of a frame's
_SMALL_TABLE_BYTES = 2**24  # up to here a table is kept, beyond it one-hot rows are made when asked for


@dataclass(frozen=True, eq=False)
class ObservationTable:
    """One observation per state; `space` is of one observation, and `kind` of `KINDS`, if it is of these."""

    space: gym.Space[Any]
    num_states: int
    # (S, *shape), read-only, or such by the keys of a Dict; None: one-hot rows, written when they are asked
    # for
    stored: Any
    kind: str = "of its own"

    def rows(self, states: IntArray, out: NDArray[Any] | None = None) -> NDArray[Any]:
        """Look up the observations (..., *shape) of states (...), in `out` or a fresh array."""
        if isinstance(self.stored, dict):
            return taken(self.stored, states)  # type: ignore[no-any-return]
        if self.stored is not None:
            # States are within the table; "clip" merely spares numpy a buffered copy.
            return np.take(self.stored, states, axis=0, out=out, mode="clip" if out is not None else "raise")
        if out is None:
            out = np.zeros((*np.shape(states), self.num_states), dtype=np.float32)
        else:
            out[...] = 0.0
        np.put_along_axis(out, np.asarray(states)[..., None], 1.0, axis=-1)
        return out

    def table(self) -> NDArray[Any]:
        """All observations, (S, *shape), in a fresh array."""
        return self.rows(np.arange(self.num_states))


Rows = tuple[gym.Space[Any], Any]  # of one observation; (S, *shape) or None, see the table


def _one_hot(mdp: Mdp, cell_size: int) -> Rows:
    size = mdp.num_numbers
    space = spaces.Box(0.0, 1.0, (size,), np.float32)
    if size == mdp.num_states and size * size * 4 > _SMALL_TABLE_BYTES:
        return space, None
    check_memory("observation one_hot", mdp.num_states * size * 4)
    return space, np.eye(size, dtype=np.float32)[mdp.number]


def _places(mdp: Mdp, kind: str) -> IntArray:
    if mdp.places is None:
        raise InputError(
            f"observation {kind}: the states of {mdp.name} have no coordinates; use another observation"
        )
    return mdp.places


def _coordinates(mdp: Mdp, cell_size: int) -> Rows:
    """Each from 0 (first) to 1 (last), 0 where there is only one; -1 of a state that has no place."""
    given = _places(mdp, "coordinates")
    panels = given[:, :1] if given[:, 0].max() > 0 else given[:, :0]
    places = np.concatenate([given[:, 1:], panels], axis=1).astype(np.float32)
    scaled = np.where(places < 0, np.float32(-1), places / np.maximum(places.max(axis=0), 1))
    return spaces.Box(min(0.0, scaled.min()), 1.0, scaled.shape[1:], np.float32), scaled


def _image(mdp: Mdp, cell_size: int) -> Rows:
    _places(mdp, "image")
    cell_size = positive_int("cell_size", cell_size)
    width, height = drawing.frame_size(mdp, cell_size)
    size = mdp.num_states * 3 * width * height
    if size > _MAX_TABLE_BYTES:
        raise InputError(
            f"observation image: {mdp.num_states} frames of {width} x {height} pixels take "
            f"{size / 2**30:.1f} GiB, more than 1; use a cell_size below {cell_size} or another observation"
        )
    check_memory(f"observation image, cells of {cell_size} pixels", size + _OF_A_FRAME * 3 * width * height)
    pixels = np.empty((mdp.num_states, 3, height, width), dtype=np.uint8)
    for state, frame in enumerate(pixels):
        frame[...] = drawing.draw_frame(mdp, state, cell_size).transpose(2, 0, 1)
    return spaces.Box(0, 255, pixels.shape[1:], np.uint8), pixels


def _own(mdp: Mdp, cell_size: int) -> Rows:
    """As the environment shows it; of arrays alone, within their own bounds."""
    table, space = mdp.own_observation, mdp.own_space
    if table is None:
        raise InputError(
            f"observation own: {mdp.name} has no array observation of its own; use another observation"
        )
    if space is not None:
        return channels_first(space, table)
    if table.ndim == 1 and table.dtype.kind in "iu":
        return spaces.Discrete(int(table.max()) + 1), table.astype(np.int64)
    low, high = table.min(), table.max()
    if table.ndim == 4 and table.dtype == np.uint8 and (low, high) == (0, 255):
        table = table.reshape(len(table), -1)  # SB3 would take other pixels for CnnPolicy's
    return spaces.Box(low, high, table.shape[1:], table.dtype.type), table


KINDS: dict[str, Callable[[Mdp, int], Rows]] = {  # takes the world and `cell_size`
    "one_hot": _one_hot,
    "coordinates": _coordinates,
    "image": _image,
    "own": _own,
    "none": lambda mdp, cell_size: (spaces.Discrete(mdp.num_numbers), mdp.number),
}


def make_observation(mdp: Mdp, kind: str, cell_size: int = IMAGE_CELL_SIZE) -> ObservationTable:
    """The observations of a kind of `KINDS` of all states of a world; `cell_size` is of images, in pixels."""
    if kind not in KINDS:
        *others, last = KINDS
        raise InputError(f"observation kind {kind!r}: must be {', '.join(others)} or {last}")
    space, stored = KINDS[kind](mdp, cell_size)
    return ObservationTable(space, mdp.num_states, frozen(stored), kind)


class TableObservation(gym.ObservationWrapper[Any, int, int], gym.utils.RecordConstructorArgs):
    """A GridWorld environment with observations (*shape) of a kind of `KINDS`; `cell_size` is of images."""

    def __init__(self, env: gym.Env[int, int], kind: str, cell_size: int = IMAGE_CELL_SIZE) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, kind=kind, cell_size=cell_size)
        gym.ObservationWrapper.__init__(self, env)
        self.table = make_observation(_mdp(env), kind, cell_size)
        self.observation_space = self.table.space

    def observation(self, observation: int) -> NDArray[Any]:
        """The row (*shape) of a state."""
        return self.table.rows(np.asarray(observation))


class VectorTableObservation(VectorObservationWrapper[Any, Any, Any, Any]):
    """A GridWorld batch with observations (num_envs, *shape) of a kind of `KINDS`; `cell_size` is of images.

    `copy` says whether every step returns a fresh array; else all write to the same one, as in SyncVectorEnv.
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], kind: str, cell_size: int = IMAGE_CELL_SIZE, copy: bool = True
    ) -> None:
        super().__init__(env)
        self.table = make_observation(_mdp(env), kind, cell_size)
        self.single_observation_space = self.table.space
        self.observation_space = batch_space(self.table.space, self.num_envs)
        self._reused: Any = None if copy else create_empty_array(self.table.space, self.num_envs)

    def observations(self, observations: IntArray) -> NDArray[Any]:
        """The rows (num_envs, *shape) of states (num_envs,)."""
        return self.table.rows(observations, out=self._reused)


class OneHotObservation(TableObservation):
    """float32 (S,): 1 at the state's number."""

    def __init__(self, env: gym.Env[int, int]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env, "one_hot")


class CoordinateObservation(TableObservation):
    """float32 (2,): row and column, each scaled to [0, 1]."""

    def __init__(self, env: gym.Env[int, int]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env, "coordinates")


class ImageObservation(TableObservation):
    """uint8 (3, H, W): the frame at `cell_size` pixels a cell, channels first."""

    def __init__(self, env: gym.Env[int, int], cell_size: int = IMAGE_CELL_SIZE) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, cell_size=cell_size)
        super().__init__(env, "image", cell_size)


class VectorOneHotObservation(VectorTableObservation):
    """float32 (num_envs, S). `copy` as in `VectorTableObservation`."""

    def __init__(self, env: VectorEnv[Any, Any, Any], copy: bool = True) -> None:
        super().__init__(env, "one_hot", copy=copy)


class VectorCoordinateObservation(VectorTableObservation):
    """float32 (num_envs, 2). `copy` as in `VectorTableObservation`."""

    def __init__(self, env: VectorEnv[Any, Any, Any], copy: bool = True) -> None:
        super().__init__(env, "coordinates", copy=copy)


class VectorImageObservation(VectorTableObservation):
    """uint8 (num_envs, 3, H, W). `copy` as in `VectorTableObservation`."""

    def __init__(
        self, env: VectorEnv[Any, Any, Any], cell_size: int = IMAGE_CELL_SIZE, copy: bool = True
    ) -> None:
        super().__init__(env, "image", cell_size, copy)


def _mdp(env: Any) -> Mdp:
    world = getattr(env.unwrapped, "mdp", None)
    if not isinstance(world, Mdp):
        raise InputError(f"{env}: this observation needs a GridWorld environment under it")
    return world
