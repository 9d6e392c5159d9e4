"""What a user names, and how much memory may go to what somebody else wrote.

A user names files, and classes or functions of their own by import paths. What opens a run, which may be
anybody's, is `limited`, and so is a command that reads sweeps or studies. Whoever then allocates by a number
that was read calls `check_memory` first. The variable `GRIDWORLD_BUDGET` raises the budget. Time has no
limit: `console.telling_if_slow` says what takes long. Training has neither.
"""

from __future__ import annotations

import importlib
import io
import math
import os
import re
import stat
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import module_from_spec, spec_from_file_location
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from gridworld.base.errors import OLD_GYM, InputError, install_command

if TYPE_CHECKING:
    from numpy.typing import NDArray

VARIABLE = "GRIDWORLD_BUDGET"
_called_from: list[Path] = []  # nothing, or the folder that `called_from` names
_BYTES = {"MB": 1e6, "GB": 1e9}

_memory: ContextVar[float | None] = ContextVar("memory", default=None)  # bytes; None: no limit yet

DAMAGED = (  # what numpy and zipfile raise for a file that is none of theirs
    *(OSError, ValueError, TypeError, LookupError, ArithmeticError, EOFError, SyntaxError, MemoryError),
    *(RuntimeError, struct.error, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
COPIES = 3  # the file, its arrays, and what is computed while they are checked
LIBRARIES = (  # of classes that an agent is made of, which anybody's run may name
    *("torch.nn.", "torch.optim.", "stable_baselines3.", "sb3_contrib."),
    *("gridworld.agents.sb3.features.", "gridworld.agents.sb3.replay_counts."),
)
_EXTRAS = {"sb3_contrib": ("sb3-contrib", "contrib")}  # of modules: the package, and what installs it


class BudgetError(InputError):
    """Something would take more than the budget."""


@contextmanager
def limited(is_own: bool = False) -> Iterator[None]:
    """Apply the user's budget to the block, or to the function that this decorates.

    For what is this process's own there is none, nor for what is `limited` in the block.
    """
    text = os.environ.get(VARIABLE) or "1GB"
    found = re.fullmatch(r"([1-9]\d{0,5})(MB|GB)", text.strip().upper(), re.ASCII)
    if found is None:
        raise InputError(f"{VARIABLE}={text[:80]}: must be an amount of memory, e.g. 500MB or 8GB")
    most = math.inf if is_own or _memory.get() == math.inf else int(found[1]) * _BYTES[found[2]]
    token = _memory.set(most)
    try:
        yield
    finally:
        _memory.reset(token)


def is_limited() -> bool:
    """Whether a budget applies here."""
    return _memory.get() not in (None, math.inf)


def check_memory(what: object, size: float) -> None:
    """Raise `BudgetError` for more bytes than the budget, if there is one; `what` is for the message."""
    most = _memory.get()
    if most is not None and size > most:
        enough = min(math.ceil(size / 1e9), 999_999)
        raise BudgetError(
            f"{what}: would take about {_shown(size)} of memory, but the budget is {_shown(most)}; if you "
            f"trust it and have the memory, set {VARIABLE}={enough}GB"
        )


def _shown(size: float) -> str:
    unit, factor = ("GB", 1e9) if size >= 1e9 else ("MB", 1e6)
    return f"{size / factor:,.3g} {unit}" if size < 1e15 else "more than a million GB"


def as_path(name: str, value: Any) -> Path:
    """An argument that is a path, as one; refuses anything else."""
    text = os.fspath(value) if isinstance(value, str | PathLike) else None
    if not isinstance(text, str) or "\0" in text:
        raise InputError(f"{name}={str(value)[:50]}: must be a path, a str or a Path")
    return Path(os.path.expanduser(text))


@contextmanager
def called_from(folder: Path) -> Iterator[None]:
    """In this block the command counts as called from `folder`, whatever the current folder is."""
    before = _called_from.copy()
    _called_from[:] = [folder]
    try:
        yield
    finally:
        _called_from[:] = before


def users_folder() -> Path:
    """The folder from which the user names files: the current one, unless a job has changed that."""
    return _called_from[0] if _called_from else Path.cwd()


def read_users_file(key: str, value: Any, kind: str, most: int) -> bytes:
    """Read a file that a setting names, relative to the folder that the program was started in.

    It must be an ordinary file of at most `most` bytes; messages say that it must be `kind`.
    """
    path = users_folder() / as_path(key, value)
    try:
        with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise InputError(f"{key}={value}: is not an ordinary file; give {kind}")
            if found.st_size > most:
                raise InputError(f"{key}={value}: is larger than {most / 2**20:,.0f} MiB; give a smaller one")
            check_memory(value, 2 * found.st_size)
            return file.read(most)
    except OSError as error:
        raise InputError(f"{key}={value}: cannot be read ({error.strerror}); give {kind}") from None


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as the content of a file, uncompressed, in their order: the same arrays make the same bytes."""
    import numpy as np  # here, since `train.py --help` does not need it

    content = io.BytesIO()
    np.savez(content, **dict[str, Any](arrays))
    return content.getvalue()


def npz_arrays(
    where: object, content: bytes | memoryview, kind: str, most: int | None = None
) -> dict[str, NDArray[Any]]:
    """Read all arrays of an .npz from its content, and nothing pickled; else an `InputError`.

    `where` is the file, and `kind` what it must be, for messages. They may have `most` bytes in memory; None:
    as many as the file has, which then must not be compressed.
    """
    import numpy as np

    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
        size = sum(info.file_size for info in infos)
        # What is compressed, or there twice, could grow in reading.
        if most is None and (size > len(content) or any(info.compress_type for info in infos)):
            raise ValueError("its members are larger than the file")
        if most is not None and size > most:
            raise ValueError(f"its arrays have {size / 2**20:,.0f} MiB, more than {most / 2**20:,.0f}")
        check_memory(where, COPIES * size)
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except InputError:
        raise
    except DAMAGED as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{where}: not {kind} that can be read ({reason})") from None


def named_object(where: str, name: str) -> Any:
    """What `module.NAME`, `module:NAME` or `folder/module.py:NAME` names; None: its module has no such name.

    A module that is not of `LIBRARIES` may be in the current folder, too: a person typed its name, or trusts
    whoever did.
    """
    place, _, attribute = name.rpartition(":" if ":" in name else ".")
    if attribute == "py":
        raise InputError(f"{where}: names a file; add what to take from it, as {name}:NAME")
    file = (users_folder() / place).resolve() if place.endswith(".py") else None
    if file is not None and not file.is_file():
        raise InputError(f"{where}: no file {place}; give module:NAME or folder/module.py:NAME")
    folder = str(users_folder() if file is None else file.parent)
    if not name.startswith(LIBRARIES) and folder not in sys.path:
        sys.path.append(folder)  # after all that is installed
    importlib.invalidate_caches()
    try:
        return getattr(import_module(place) if file is None else _of_file(file.stem, file), attribute, None)
    except ModuleNotFoundError as error:
        if error.name in _EXTRAS:
            package, extra = _EXTRAS[error.name]
            raise InputError(f"{where}: needs {package}; {install_command(extra)}") from None
        missing = f"no module {error.name}; install it, or add its folder to PYTHONPATH"
        raise InputError(f"{where}: {OLD_GYM if error.name == 'gym' else missing}") from None
    except (ValueError, TypeError):  # no path at all
        return None
    except (Exception, SystemExit) as error:  # a module of the user's own may raise anything
        what = f"{place} cannot be imported ({type(error).__name__}: {error})"
        raise InputError(f"{where}: {what}") from error


def _of_file(name: str, file: Path) -> ModuleType:
    """The module in a file, by its own name unless that is another module's."""
    spec = sys.modules[name].__spec__ if name in sys.modules else PathFinder.find_spec(name)
    if spec is not None and spec.origin == str(file):
        return import_module(name)
    name = f"{name}_{zlib.crc32(bytes(file)):08x}"
    if name not in sys.modules:
        spec = spec_from_file_location(name, file)
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
