"""Reading a model file of Stable-Baselines3 as data, without unpickling.

The file is a zip. Its `.pth` members are torch's own files: a zip again, with a pickle that names tensors and
a member for each tensor's numbers. SB3's `load` also unpickles the member `data`, which can run anything; it
is not touched here but for one number. Of torch's pickles only those are read that build dictionaries of
tensors; torch's `weights_only` alone would let a file ask for any amount of memory. No member is compressed
(neither SB3 nor torch does that), so nothing grows in reading.
"""

from __future__ import annotations

import io
import pickletools
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gridworld.errors import InputError
from gridworld.storage.safe_read import read_bytes

Parameters = dict[str, Any]  # {"policy": its state_dict, "policy.optimizer": ...}
Weights = dict[str, NDArray[Any]]  # flat: {"policy.q_net.0.weight": ...}

_MOST_MEMBERS = 10_000
_LARGEST_PICKLE = 4 * 2**20  # bytes; it holds names, not numbers
_MOST_VALUES = 100_000
_DEEPEST = 8
_VARIABLES = "pytorch_variables"  # an SB3 file's own name for single tensors

# All that a dictionary of tensors needs.
_NAMED = re.compile(
    r"collections OrderedDict|torch \w+Storage|torch\._utils _rebuild_(tensor_v2|parameter)"
    r"|torch\.nn\.parameter Parameter"
)
_RATE = re.compile(rb'^    "exploration_rate": ([0-9.eE+-]+),?$', re.MULTILINE)  # as SB3 indents it


class DamagedError(Exception):
    """The file is no model file, or asks for more than one may."""


def read_parameters(path: Path, most: int) -> tuple[Parameters, float | None]:
    """Read a model file.

    Args:
        path: the file.
        most: bytes; a larger file is refused.

    Returns:
        The tensors by module; the exploration rate, where there is one.

    Raises:
        InputError: the file may not be opened.
        DamagedError: its content. Also whatever zipfile or torch raise.
    """
    content = read_bytes(path, most, copies=4)  # beside it a member, a tensor of it, the whole
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = _members(archive, len(content))
        modules = [name.removesuffix(".pth") for name in members if name.endswith(".pth")]
        parameters = {name: _tensors(archive.read(f"{name}.pth")) for name in modules if name != _VARIABLES}
        rate = _RATE.search(archive.read("data")) if "data" in members else None
    return parameters, None if rate is None else float(rate.group(1))


def flatten(content: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, NDArray[Any]]]:
    """Flatten nested tensors and plain values.

    Returns:
        (dotted name, array) of each; a plain value is an array of its text.

    Raises:
        DamagedError: anything else is in it.
    """
    if depth > _DEEPEST:
        raise DamagedError(f"{name[:80]} is nested too deeply")
    if isinstance(content, dict):
        items = [(str(key), value) for key, value in content.items()]
    elif isinstance(content, list | tuple):
        items = [(str(index), value) for index, value in enumerate(content)]
    elif isinstance(content, torch.Tensor):
        if content.layout != torch.strided or content.is_quantized or content.device.type != "cpu":
            raise DamagedError(f"{name[:80]} is no plain tensor")
        yield name, content.detach().numpy()
        return
    elif content is None or isinstance(content, bool | int | float | str):
        yield name, np.asarray(str(content))
        return
    else:
        raise DamagedError(f"{name[:80]} is a {type(content).__name__}")
    for key, value in items:
        yield from flatten(value, f"{name}.{key}" if name else key, depth + 1)


def flat(content: Any) -> Weights:
    """`flatten` as a dictionary.

    Raises:
        DamagedError: as `flatten`, or too many values.
    """
    found: Weights = {}
    for name, value in flatten(content):
        if len(found) == _MOST_VALUES:
            raise DamagedError(f"it holds more than {_MOST_VALUES:,} values")
        found[name] = value
    return found


def check_weights(found: Weights, expected: Weights) -> None:
    """Check that names, types and shapes agree and that all numbers are finite.

    Raises:
        DamagedError: they do not.
    """
    if found.keys() != expected.keys():
        odd = sorted(found.keys() ^ expected.keys())[0]
        raise DamagedError(f"{odd[:80]} is {'missing' if odd in expected else 'not part of it'}")
    for name, like in expected.items():
        array = found[name]
        if (array.dtype, array.shape) != (like.dtype, like.shape):
            raise DamagedError(
                f"{name} is {array.dtype} {_shape(array)}, it must be {like.dtype} {_shape(like)}"
            )
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            raise DamagedError(f"{name} holds numbers that are not finite")


def read_weights(path: Path, most: int) -> Weights:
    """Read all that training changed: the weights and the optimiser's state.

    Args:
        path: the model file.
        most: bytes; a larger file is refused.
    """
    try:
        return flat(read_parameters(path, most)[0])
    except InputError:
        raise
    except Exception as error:  # zipfile, torch and DamagedError, each in their way
        raise InputError(f"{path}: not a model file that can be read ({reason(error)})") from None


def reason(error: Exception) -> str:
    """The first line of an exception's message."""
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def _members(archive: zipfile.ZipFile, most: int) -> set[str]:
    """Names, once it is clear that they can be read: none compressed, all of them together no larger."""
    infos = archive.infolist()
    if len(infos) > _MOST_MEMBERS:
        raise DamagedError(f"it has more than {_MOST_MEMBERS:,} members")
    if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
        raise DamagedError("it has compressed members, a model file has none")
    if sum(info.file_size for info in infos) > most:
        raise DamagedError("its members are larger than itself")
    names = {info.filename for info in infos}
    if len(names) != len(infos):
        raise DamagedError("it has two members of one name")
    return names


def _tensors(content: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        pickles = [name for name in _members(archive, len(content)) if name.endswith(".pkl")]
        if len(pickles) != 1 or archive.getinfo(pickles[0]).file_size > _LARGEST_PICKLE:
            raise DamagedError("it holds no tensors as torch writes them")
        _check_pickle(archive.read(pickles[0]))
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def _check_pickle(content: bytes) -> None:
    """Looks at the pickle without running it."""
    for code, argument, _ in pickletools.genops(content):
        if code.name == "GLOBAL" and _NAMED.fullmatch(str(argument)):
            continue
        if code.name in ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4"):
            raise DamagedError(f"its pickle asks for {str(argument)[:80]}, which is not read from a model")


def _shape(array: NDArray[Any]) -> str:
    return " x ".join(map(str, array.shape)) or "a single number"
