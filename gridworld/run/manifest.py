"""Reading a run's manifest: its seal and the types of its entries are checked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any

from gridworld.errors import InputError
from gridworld.storage.safe_read import LARGEST_JSON, read_object
from gridworld.storage.sealed_json import check_seal

# Runs that were updated at once, this one among them, so that the numbers of each depend on all: a hash of
# the settings of each (`fingerprint.settings_hash`) by its folder's name, in their order.
NUMBERS_DEPEND_ON = "numbers_depend_on"
_FIRST_SEAL = ("config", "layout", "resumed")  # the entries that a seal of the first format covers
_NEEDED = ("status", "config", "layout")


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest.

    Raises:
        InputError: As for `check_manifest`, or the file cannot be read.
    """
    return check_manifest(read_object(path, LARGEST_JSON), path)


def check_manifest(content: dict[str, Any], path: Path) -> dict[str, Any]:
    """Check a manifest's content.

    Args:
        content: The JSON object.
        path: Its file, for errors.

    Returns:
        The content.

    Raises:
        InputError: It is not what a run wrote.
    """
    check_seal(content, path, _FIRST_SEAL)
    if not content.keys() >= set(_NEEDED):
        raise InputError(f"{path}: not the manifest of a run; it lacks status, config or layout")
    for key, (fits, what) in _KINDS.items():
        if key in content and not fits(content[key]):
            raise InputError(f"{path}: {key} must be {what}")
    return content


def _is(*kinds: type) -> Callable[[Any], bool]:
    return lambda value: type(value) in kinds


def _is_list_of(kind: type) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(isinstance(each, kind) for each in value)


def _is_map(value: Any) -> bool:
    return _is_list_of(str)(value) and all(row.isprintable() for row in value)


def _is_count(value: Any) -> bool:
    return value is None or (type(value) is int and value >= 0)


def _are_sums(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(digest, str) for digest in value.values())


def _are_runs(value: Any) -> bool:
    return _are_sums(value) and all(
        name.isprintable() and PurePath(name).name == name not in ("", "..") for name in value
    )


def _are_continuations(value: Any) -> bool:
    return _is_list_of(dict)(value) and all(
        type(again.get("step")) is int and again["step"] >= 0 for again in value if "total_timesteps" in again
    )


_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "status": (_is(str), "a word"),
    "config": (_is(dict), "the run's settings; is it of another version?"),
    "layout": (_is_map, "a list of the map's rows; is it of another version?"),
    "started": (_is(str), "a date"),
    "ended": (_is(str, type(None)), "a date"),
    "error": (_is(str), "a sentence"),
    "overrides": (_is_list_of(str), "a list of what stood on the command line"),
    "sha256": (_are_sums, "a checksum for each file"),
    "resumed": (
        _are_continuations,
        "a list of when the run went on, with the step after which it was made longer",
    ),
    NUMBERS_DEPEND_ON: (_are_runs, "a hash for each run, by the name of a folder beside this one"),
    "reached": (_is_count, "a number of steps"),
    "checkpoint": (_is_count, "a number of steps"),
    "versions": (_is(dict), "a version for each package"),
}
