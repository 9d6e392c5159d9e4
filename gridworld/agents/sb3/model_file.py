"""Reading a model file of Stable-Baselines3 as data, without unpickling.

The file is a zip. Its `.pth` members are torch's own files: a zip again, with a pickle that names tensors and
a member for each tensor's numbers. Of the member `data`, which SB3's `load` unpickles, numbers are searched
as text. torch's `weights_only` alone would let a file ask for any amount of memory, so only those pickles are
read that name what a dictionary of tensors needs. SB3 and torch compress nothing: nothing grows in reading.
"""

from __future__ import annotations

import io
import itertools
import pickletools
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridworld.base.errors import InputError, in_short
from gridworld.base.safe_read import read_bytes

# {"policy": its state_dict, "policy.optimizer": {"0.exp_avg": ...}}
Parameters = dict[str, dict[str, Tensor]]

_LARGEST_PICKLE = 4 * 2**20  # bytes; it holds names, not numbers
_VARIABLES = "pytorch_variables.pth"  # SB3's member for single tensors
# All that a dictionary of tensors needs.
_NAMED = re.compile(
    r"collections OrderedDict|torch \w+Storage|torch\._utils _rebuild_(tensor_v2|parameter)"
    r"|torch\.nn\.parameter Parameter"
)
_NAMING = ("GLOBAL", "STACK_GLOBAL", "INST", "EXT1", "EXT2", "EXT4")
_NUMBERS = re.compile(rb'^    "(\w+)": ([0-9.eE+-]+),?$', re.MULTILINE)  # as SB3 indents its own
_MOST_NUMBERS, _CLOCK = 1000, "start_time"


def read_model(path: Path, most: int, kind: str = "a model") -> tuple[Parameters, dict[str, float]]:
    """Read a model file of at most `most` bytes: the tensors by module, and the model's own numbers by name.

    Raises:
        InputError: the file may not be opened, or is not `kind`.
    """
    content = read_bytes(path, most, copies=5)  # beside it its members, theirs, and the tensors
    try:
        members = _members(content)
        found = itertools.islice(_NUMBERS.finditer(members.get("data", b"")), _MOST_NUMBERS)
        modules = [name for name in members if name.endswith(".pth") and name != _VARIABLES]
        parameters = {name.removesuffix(".pth"): _flat(load_tensors(members[name])) for name in modules}
        return parameters, {each[1].decode(): float(each[2]) for each in found}
    except Exception as error:  # zipfile and torch, each in their way
        raise InputError(f"{path}: not {kind} that can be read ({in_short(error)})") from None


def read_weights(path: Path, most: int) -> dict[str, NDArray[Any]]:
    """See `config.train.AgentConfig.weights`; the optimiser's and the model's own numbers are among them."""
    parameters, numbers = read_model(path, most)
    own = {f"data.{name}": np.array(number) for name, number in numbers.items() if name != _CLOCK}
    return own | {
        f"{module}.{name}": tensor.numpy()
        for module, tensors in parameters.items()
        for name, tensor in tensors.items()
    }


def _members(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        infos = archive.infolist()
        if any(info.compress_type for info in infos):
            raise ValueError("it has compressed members, unlike model files")
        if sum(info.file_size for info in infos) > len(content):
            raise ValueError("its members are larger than the file")
        return {info.filename: archive.read(info) for info in infos}


def load_tensors(content: bytes) -> dict[str, Any]:
    """Read a dictionary of tensors as torch saves it; ValueError, or whatever torch raises: it is none."""
    pickles = [member for name, member in _members(content).items() if name.endswith(".pkl")]
    if len(pickles) != 1 or len(pickles[0]) > _LARGEST_PICKLE:
        raise ValueError("it has no tensors in torch's format")
    for code, argument, _ in pickletools.genops(pickles[0]):  # which does not run it
        if code.name in _NAMING and not (code.name == "GLOBAL" and _NAMED.fullmatch(str(argument))):
            raise ValueError(f"its pickle asks for {str(argument)[:80]}, which a model may not contain")
    tensors: dict[str, Any] = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return tensors


def _flat(found: dict[str, Any]) -> dict[str, Tensor]:
    if "param_groups" in found:  # an optimiser's numbers of each weight, which are counted, and its settings
        parts = found["state"] | {f"group {number}": own for number, own in enumerate(found["param_groups"])}
        found = {f"{place}.{name}": value for place, own in parts.items() for name, value in own.items()}
        plain = {name: value for name, value in found.items() if isinstance(value, int | float)}
        found |= {name: torch.tensor(value, dtype=torch.float64) for name, value in plain.items()}
    return {str(name): value.detach() for name, value in found.items() if isinstance(value, Tensor)}
