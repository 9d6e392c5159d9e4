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
    """Read a model file of at most `most` bytes: the tensors by module, and DQN's exploration rate.

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


def flat(content: Any) -> Weights:
    """Nested tensors and plain values as arrays by their dotted names; a value is an array of its text."""
    found: Weights = {}

    def add(node: Any, name: str, depth: int) -> None:
        if depth > _DEEPEST:
            raise DamagedError(f"{name[:80]} is nested too deeply")
        if isinstance(node, dict | list | tuple):
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                add(value, f"{name}.{key}" if name else str(key), depth + 1)
            return
        if len(found) == _MOST_VALUES:
            raise DamagedError(f"it holds more than {_MOST_VALUES:,} values")
        if isinstance(node, torch.Tensor):
            if node.layout != torch.strided or node.is_quantized or node.device.type != "cpu":
                raise DamagedError(f"{name[:80]} is no plain tensor")
            found[name] = node.detach().numpy()
        elif node is None or isinstance(node, bool | int | float | str):
            found[name] = np.asarray(str(node))
        else:
            raise DamagedError(f"{name[:80]} is a {type(node).__name__}")

    add(content, "", 0)
    return found


def check_weights(found: Weights, expected: Weights) -> None:
    """Check that names, types and shapes agree and that all numbers are finite."""
    if found.keys() != expected.keys():
        odd = sorted(found.keys() ^ expected.keys())[0]
        raise DamagedError(f"{odd[:80]} is {'missing' if odd in expected else 'not part of it'}")
    for name, like in expected.items():
        array = found[name]
        if (array.dtype, array.shape) != (like.dtype, like.shape):
            is_now, must_be = (
                f"{each.dtype} {' x '.join(map(str, each.shape)) or 'a single number'}"
                for each in (array, like)
            )
            raise DamagedError(f"{name} is {is_now}, it must be {must_be}")
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            raise DamagedError(f"{name} holds numbers that are not finite")


def read_weights(path: Path, most: int) -> Weights:
    """Read the weights and the optimiser's state of a file of at most `most` bytes."""
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
    names = {info.filename for info in infos}
    for is_wrong, what in (
        (len(infos) > _MOST_MEMBERS, f"it has more than {_MOST_MEMBERS:,} members"),
        (any(info.compress_type for info in infos), "it has compressed members, a model file has none"),
        (sum(info.file_size for info in infos) > most, "its members are larger than itself"),
        (len(names) != len(infos), "it has two members of one name"),
    ):
        if is_wrong:
            raise DamagedError(what)
    return names


def _tensors(content: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        pickles = [name for name in _members(archive, len(content)) if name.endswith(".pkl")]
        if len(pickles) != 1 or archive.getinfo(pickles[0]).file_size > _LARGEST_PICKLE:
            raise DamagedError("it holds no tensors as torch writes them")
        for code, argument, _ in pickletools.genops(archive.read(pickles[0])):  # which does not run it
            is_name = code.name in ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4")
            if is_name and not (code.name == "GLOBAL" and _NAMED.fullmatch(str(argument))):
                raise DamagedError(
                    f"its pickle asks for {str(argument)[:80]}, which is not read from a model"
                )
    return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
