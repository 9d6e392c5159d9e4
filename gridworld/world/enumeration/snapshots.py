"""Copies and digests of an environment's state.

A state is what the attributes of an environment hold, everything that they refer to included, but for its
random generators. Attributes are copied by pickle, which is four times as fast as `copy.deepcopy`, or where
all are numbers, texts and lists of them by marshal, which is four times as fast again. Spaces and code are
kept as they are: they are read once, and must stay what they were.
"""

from __future__ import annotations

import hashlib
import inspect
import io
import marshal
import pickle
import random
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import gymnasium as gym
import numpy as np

from gridworld.world.reading import GENERATORS, PLAIN, UnreadableError, digest, generator_state

_KEPT = (gym.Space, gym.envs.registration.EnvSpec, FunctionType, BuiltinFunctionType, ModuleType, *GENERATORS)


def _blackjack(env: Any) -> Any:
    """All that its code reads of the player's hand: the sum, an ace, and where it matters a natural."""
    hand = env.player
    is_natural = (env.sab or env.natural) and sorted(hand) == [1, 10]
    return env.dealer, sum(hand), 1 in hand, is_natural, env.sab, env.natural


# Of classes whose attributes hold more than their steps depend on: what these do depend on, the sha256 of
# the source from which that was read, without what only draws pictures, and the attributes that are known.
_READ: dict[str, tuple[Callable[[Any], Any], str, str]] = {
    "gymnasium.envs.toy_text.blackjack:BlackjackEnv": (
        _blackjack,
        "c25a321d0d3112d10a043c8a978a690470e25c00842cda7670e19164148cb687",
        "action_space observation_space natural sab render_mode spec _np_random _np_random_seed dealer "
        "player dealer_top_card_suit dealer_top_card_value_str",
    )
}


def _what_is_read(env: Any) -> Callable[[Any], Any] | None:
    kind = type(env)
    if (known := _READ.get(f"{kind.__module__}:{kind.__qualname__}")) is None:
        return None
    read, source, names = known
    return read if source_digest(kind) == source and vars(env).keys() <= set(names.split()) else None


def source_digest(kind: type) -> str:
    """The sha256 of the source of a class and its module's functions, but for what makes pictures."""
    module = sys.modules[kind.__module__]
    members = [*vars(module).items(), *vars(kind).items()]
    functions = {
        name: each
        for name, each in members
        if isinstance(each, FunctionType)
        and not name.startswith(("draw_table", "render", "close", "__init__"))
    }
    try:
        text = "".join(inspect.getsource(functions[name]) for name in sorted(functions))
    except (OSError, TypeError):  # there is none
        return ""
    return hashlib.sha256(text.encode()).hexdigest()


_SCALARS = frozenset(
    np.dtype(code).type for code in (*np.typecodes["AllInteger"], *np.typecodes["AllFloat"], *"?U")
)
_PLAIN = marshal.dumps([])[:1]  # how a copy by marshal begins, and none by pickle


class Snapshots:
    """Takes copies of the state of an unwrapped environment, always the same one; puts them back."""

    def __init__(self, env: gym.Env[Any, Any], generator: Any = None) -> None:
        self._env = env
        self._generator = generator
        self._read_by = _what_is_read(env)
        self._replaced: dict[int, Any] = {} if generator is None else {id(generator): generator}  # by id
        self._kept: dict[int, Any] = {}  # by id
        self._read: dict[int, tuple[Any, bytes]] = {}  # what was kept, and a digest of it
        self._generators: dict[int, Any] = {}  # in what was kept
        self._scalars: list[Any] = []  # of numpy's, one of each
        self._places: dict[tuple[type, bytes], int] = {}  # in that list

    def replace(self, old: Any, new: Any) -> None:
        """Put another object in place of one, wherever the attributes hold it, now and in later copies."""
        self._replaced[id(old)] = new
        self._kept[id(new)], self._kept[id(old)] = new, old  # held, so that the id is not given again
        self.put_back(self.take())

    def _known(self) -> list[Any]:
        """What is not read: the environment, and its generator, under whatever names it has it."""
        return [self._env, self._generator or vars(self._env).get("_np_random")]

    def take(self) -> bytes:
        """A copy of the state. Equal copies are of equal states; equal states may have several."""
        if (plain := self._plain()) is not None:
            return plain
        buffer = io.BytesIO()
        _Pickler(buffer, self._env, self._kept, self._replaced).dump(vars(self._env))
        return buffer.getvalue()

    def put_back(self, snapshot: bytes) -> None:
        """Make a copy, or rather a copy of it, the environment's state."""
        attributes = vars(self._env)
        attributes.clear()
        if snapshot[:1] == _PLAIN:
            held = self._scalars, self._kept
            for name, where, value in marshal.loads(snapshot):
                attributes[name] = value if where is None else held[where][value]
            return
        attributes.update(_Unpickler(io.BytesIO(snapshot), self._kept).load())

    def _plain(self) -> bytes | None:
        """A copy by marshal; None where an attribute is neither kept as it is nor plain."""
        found, lists = [], set[int]()
        for name, value in vars(self._env).items():
            kind, where = type(value), None
            if kind is list or kind is tuple:
                if id(value) in lists or not PLAIN.issuperset(map(type, value)):
                    return None
                if kind is list:
                    lists.add(id(value))
            elif kind in _SCALARS:
                scalar = kind, value.tobytes()
                if scalar not in self._places:
                    self._places[scalar] = len(self._scalars)
                    self._scalars.append(value)
                where, value = 0, self._places[scalar]
            elif kind not in PLAIN:
                where, value = 1, id(self._replaced.get(id(value), value))
                if value not in self._kept:
                    return None  # pickle may find that it is to be kept
            found.append((name, where, value))
        return marshal.dumps(found, 2)

    def key(self, without: Collection[str] = (), kinds: bool = False) -> bytes:
        """A digest of the state, but for some attributes; UnreadableError where it cannot be compared.

        Without `kinds` a tuple is the same as a list or an array of its numbers, whose steps may differ.
        """
        if self._read_by is not None:
            return self._digest(self._read_by(self._env))
        attributes = self._attributes(without)
        try:
            return self._digest([part for item in attributes for part in item], kinds)
        except UnreadableError:
            for name, value in attributes:
                try:
                    self._digest(value)
                except UnreadableError as error:
                    raise UnreadableError(f"its {name} holds {error}") from None
            raise

    def keys(self, without: Collection[str] = ()) -> dict[str, bytes]:
        """A digest of each attribute."""
        return {name: self._digest(value) for name, value in self._attributes(without)}

    def values(self, without: Collection[str] = ()) -> Iterator[tuple[str, Any]]:
        """Each attribute that is not kept as it is, with something hashable that tells its values apart."""
        for name, value in vars(self._env).items():
            kind = type(value)
            if name in without or id(value) in self._kept:
                continue
            if kind in PLAIN:
                yield name, (kind, value)
            elif kind in _SCALARS:
                yield name, (kind, value.tobytes())
            elif (kind is list or kind is tuple) and PLAIN.issuperset(map(type, value)):
                yield name, marshal.dumps(value, 2)
            else:
                yield name, self._digest(value)

    def random_states(self) -> list[tuple[Any, Any]]:
        """The generators anywhere in the state, with their states."""
        found = {id(each): each for each in self._kept.values() if type(each) in GENERATORS}
        return [(each, generator_state(each)) for each in (found | self._generators).values()]

    def changed(self) -> Any:
        """Something of what is kept as it is that changed all the same; None if nothing did."""
        for value, before in self._read.values():
            if digest(value, self._known(), self._generators) != before:
                return value
        return None

    def _digest(self, value: Any, kinds: bool = False) -> bytes:
        return digest(value, self._known(), self._generators, self._kept_value, kinds)

    def _kept_value(self, value: Any) -> tuple[Any, Sequence[Any]]:
        if id(value) not in self._read:
            self._read[id(value)] = value, digest(value, self._known(), self._generators)
        return "kept", self._read[id(value)][1:]

    def _attributes(self, without: Collection[str]) -> list[tuple[str, Any]]:
        left_out = {"_np_random", "_np_random_seed", *without}
        return [(name, value) for name, value in sorted(vars(self._env).items()) if name not in left_out]


def _kept(number: int) -> Any:
    """What a copy says in place of an object that is kept as it is; `_Unpickler` reads it."""
    raise NotImplementedError


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, env: Any, kept: dict[int, Any], replaced: dict[int, Any]) -> None:
        super().__init__(file, protocol=5)
        self._env, self._kept_by_id, self._replaced = env, kept, replaced
        self._views: dict[int, list[Any]] = {}  # arrays by that whose memory they show

    def reducer_override(self, obj: Any) -> Any:  # three times as fast as `persistent_id`
        if id(obj) in self._replaced:
            return _kept, (id(self._replaced[id(obj)]),)
        local = isinstance(obj, type) and "<locals>" in obj.__qualname__
        if obj is not _kept and (obj is self._env or local or isinstance(obj, _KEPT)):
            self._kept_by_id[id(obj)] = obj
            return _kept, (id(obj),)
        if isinstance(obj, np.ndarray):
            views = self._views.setdefault(id(obj if obj.base is None else obj.base), [])
            if any(np.may_share_memory(obj, each) for each in views):
                raise TypeError("two arrays share memory; hold one of them")
            views.append(obj)
        return NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, kept: dict[int, Any]) -> None:
        super().__init__(file)
        self._kept_by_id = kept

    def find_class(self, module: str, name: str) -> Any:
        ours = (module, name) == (_kept.__module__, _kept.__name__)
        return self._kept_by_id.__getitem__ if ours else super().find_class(module, name)


def random_states() -> list[Any]:
    """The states of the generators that all share."""
    torch = sys.modules.get("torch")
    found = [] if torch is None else [torch.get_rng_state().numpy().tobytes()]
    numpys = np.random.get_state(legacy=False)["state"]
    return [*found, random.getstate(), (numpys["key"].tobytes(), numpys["pos"])]
