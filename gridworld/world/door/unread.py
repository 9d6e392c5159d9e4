"""What stands for a number that is counted or summed up and that nothing ever reads.

A counter of all resets, say, or the sum of an episode's rewards that only `info` tells: as state it would
multiply the others without end. So each number that changes is replaced by a stand-in before every run, which
may be counted on and passed around. Whatever else is done with one raises `Read`, and then it is state.
"""

from __future__ import annotations

from typing import Any, NoReturn

import numpy as np

NUMBERS = frozenset({int, float, *(kind for kind in np.sctypeDict.values() if issubclass(kind, np.number))})
_COUNTING = ("add", "radd", "sub", "rsub", "mul", "rmul")
_READING = (
    *("bool", "int", "float", "complex", "index", "len", "iter", "contains", "getitem", "call", "array"),
    *("eq", "ne", "lt", "le", "gt", "ge", "hash", "str", "repr", "format", "bytes", "round", "trunc"),
    *("floor", "ceil", "abs", "neg", "pos", "invert", "getattr", "reversed", "divmod", "rdivmod"),
    *(f"{right}{name}" for name in ("truediv", "floordiv", "mod", "pow") for right in ("", "r")),
    *(f"{right}{name}" for name in ("and", "or", "xor", "lshift", "rshift", "matmul") for right in ("", "r")),
)


class Read(BaseException):  # which an environment's `except Exception` does not catch
    """Something depends on attributes that seemed to be read by nothing: a layer's number, and a name."""

    def __init__(self, found: set[tuple[int, str]]) -> None:
        super().__init__(found)
        self.found = found


class Unread:
    """A number of which nobody has asked anything."""

    def __init__(self, layer: int, name: str) -> None:
        self._of = layer, name

    __class__ = property(lambda self: self._read())

    def _counted(self, other: Any) -> Any:
        return self if type(other) in NUMBERS or type(other) in (bool, Unread) else self._read()

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        if ufunc not in (np.add, np.subtract, np.multiply) or method != "__call__" or options:
            self._read()
        return next(each for each in map(self._counted, inputs) if each is self)

    def _read(self, *_: Any) -> NoReturn:
        raise Read({self._of})


for _name in _COUNTING:
    setattr(Unread, f"__{_name}__", Unread._counted)
for _name in _READING:
    setattr(Unread, f"__{_name}__", Unread._read)
