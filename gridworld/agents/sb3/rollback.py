"""Undoing the side effects of a block: random generators, and the attributes of classes of one's own.

A class may count its objects, and its module may have a generator. While something is tried out, both have
copies in the place of what they keep; afterwards they have the originals again, which nothing has touched.

What is not looked for: variables that a function closes over, modules that such a module imports, and what
cannot be copied.
"""

from __future__ import annotations

import contextlib
import copy
import inspect
import io
import sys
import types
import warnings
from collections.abc import Iterable, Iterator
from typing import Any

from gridworld.agents.sb3.snapshot.callback import set_torch_state, torch_state
from gridworld.agents.sb3.snapshot.class_state import is_known
from gridworld.process.console.terminal import TOLD
from gridworld.process.parallel.together import by_itself
from gridworld.storage.rng_state import global_state, set_global_state


@contextlib.contextmanager
def rolled_back(*classes: type) -> Iterator[None]:
    """Restore generators, these classes and their modules at the block's end, and print nothing in it."""
    holders = list(_holders(classes))
    chance, torch_chance = global_state(), torch_state()
    before = [dict(vars(holder)) for holder in holders]
    copied: dict[int, Any] = {}  # what is shared stays shared
    for holder, content in zip(holders, before, strict=True):
        for name, value in content.items():
            if _is_data(name, value):
                with contextlib.suppress(Exception):  # each kind of object has its own
                    setattr(holder, name, copy.deepcopy(value, copied))
    try:
        with _silence(), by_itself():
            yield
    finally:
        for holder, content in zip(holders, before, strict=True):
            _put_back(holder, content)
        set_global_state(chance)
        set_torch_state(torch_chance)


def _holders(classes: Iterable[type]) -> Iterator[Any]:
    """The modules of those that are no library's, and all classes that are defined there."""
    own = [base for each in classes for base in each.__mro__ if not is_known(base.__module__)]
    modules = dict.fromkeys(base.__module__ for base in own)
    found = [sys.modules[name] for name in modules if name in sys.modules]
    yield from found
    for module in found:
        for value in list(vars(module).values()):
            if isinstance(value, type) and value.__module__ == module.__name__:
                yield value


def _is_data(name: str, value: Any) -> bool:
    is_code = inspect.isroutine(value) or inspect.isdatadescriptor(value)
    return not (name.startswith("__") or is_code or isinstance(value, type | types.ModuleType))


def _put_back(holder: Any, content: dict[str, Any]) -> None:
    for name, value in list(vars(holder).items()):
        with contextlib.suppress(AttributeError, TypeError):
            if name not in content and not name.startswith("__"):
                delattr(holder, name)
            elif name in content and value is not content[name]:
                setattr(holder, name, content[name])


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    nowhere, was_disabled, TOLD.disabled = io.StringIO(), TOLD.disabled, True
    with (
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            TOLD.disabled = was_disabled
