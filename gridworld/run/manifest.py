"""Reading a run's manifest: its seal and the types of its entries are checked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any

from gridworld.errors import InputError
from gridworld.storage.sealed_json import read_sealed

# Runs that were updated at once, this one among them, so that the numbers of each depend on all: a hash of
# the settings of each (`provenance.settings_hash`) by its folder's name, in their order.
NUMBERS_DEPEND_ON = "numbers_depend_on"


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a manifest; an `InputError` where it is not what a run wrote."""
    content = read_sealed(path)
    if not content.keys() >= {"status", "config", "layout"}:
        raise InputError(f"{path}: not the manifest of a run; it lacks status, config or layout")
    for key, (fits, what) in _KINDS.items():
        if key in content and not fits(content[key]):
            raise InputError(f"{path}: {key} must be {what}")
    return content


def _is(*kinds: type) -> Callable[[Any], bool]:
    return lambda value: type(value) in kinds


def _is_list_of(kind: type, fits: Callable[[Any], bool] = lambda each: True) -> Callable[[Any], bool]:
    return lambda value: (
        isinstance(value, list) and all(isinstance(each, kind) and fits(each) for each in value)
    )


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _are_sums(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(digest, str) for digest in value.values())


def _are_runs(value: Any) -> bool:
    return _are_sums(value) and all(
        name.isprintable() and PurePath(name).name == name not in ("", "..") for name in value
    )


def _is_continuation(value: dict[str, Any]) -> bool:
    return "total_timesteps" not in value or _is_count(value.get("step"))


_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "status": (_is(str), "a word"),
    "config": (_is(dict), "the run's settings; is it of another version?"),
    "layout": (_is_list_of(str, str.isprintable), "a list of the map's rows; is it of another version?"),
    "started": (_is(str), "a date"),
    "ended": (_is(str, type(None)), "a date"),
    "error": (_is(str), "a sentence"),
    "overrides": (_is_list_of(str), "a list of what stood on the command line"),
    "sha256": (_are_sums, "a checksum for each file"),
    "resumed": (
        _is_list_of(dict, _is_continuation),
        "a list of when the run went on, with the step after which it was made longer",
    ),
    NUMBERS_DEPEND_ON: (_are_runs, "a hash for each run, by the name of a folder beside this one"),
    "reached": (lambda value: value is None or _is_count(value), "a number of steps"),
    "checkpoint": (lambda value: value is None or _is_count(value), "a number of steps"),
    "versions": (_is(dict), "a version for each package"),
}
