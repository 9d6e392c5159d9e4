"""JSON files with a seal, which is a checksum over all of their content.

A seal finds damage and changes. It finds no forgery: whoever writes a file can seal it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.storage.safe_read import read_object, sha256

FORMAT = 2


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content with its format and its seal; those that it had are replaced."""
    whole = {"format": FORMAT} | {key: content[key] for key in content if key not in ("format", "seal")}
    return whole | {"seal": _seal(json.loads(json.dumps(whole)))}  # as it will be read


def read_sealed(path: Path) -> dict[str, Any]:
    """Read the object in a file and check its seal."""
    content = read_object(path)
    found = content.get("format")
    if type(found) is not int or found != FORMAT:
        raise InputError(
            f"{path}: has format {str(found)[:20]}, this version reads {FORMAT}; "
            "was it made by an older version?"
        )
    if content.get("seal") != _seal(content):
        raise InputError(
            f"{path}: was changed or damaged, its seal is not that of its content; put back a good copy"
        )
    return content


def _seal(content: Mapping[str, Any]) -> str:
    unsealed = {key: value for key, value in content.items() if key != "seal"}
    return sha256(json.dumps(unsealed, sort_keys=True).encode())
