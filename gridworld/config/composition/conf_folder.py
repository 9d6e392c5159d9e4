"""Where the yaml files are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

_PACKAGE = Path(__file__).parents[2]
_WITH_VALUE = (  # Hydra's options that the next word belongs to
    *("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--package", "-p"),
    *("--cfg", "-c", "--info", "-i", "--experimental-rerun"),
)


def conf_folder() -> Path:
    """The folder of the yaml files: of the installed package, or `conf/` of the checkout."""
    installed = _PACKAGE / "conf"
    return installed if installed.is_dir() else _PACKAGE.parent / "conf"


def own_conf_folders(words: Sequence[str]) -> Iterator[Path]:
    """The folders that `--config-dir` names in a command line."""
    for word, following in pairwise([*words, ""]):
        option, _, value = word.partition("=")
        if option in ("--config-dir", "-cd"):
            yield Path(value or following)


def is_override(words: Sequence[str], index: int) -> bool:
    """Whether a word of a command line is neither an option of Hydra's nor an option's value."""
    return not words[index].startswith("-") and (index == 0 or words[index - 1] not in _WITH_VALUE)
