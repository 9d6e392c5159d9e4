"""`recipe=FILE`: a recipe that somebody else may have written, as overrides for the command line.

What `tune.py` leaves in a study is a yaml that Hydra could compose. From Hydra, a yaml may ask for callbacks,
for log files, for environment variables. Here it is data: names of an agent, a world and an observation, and
settings that the schema has. What comes out are plain overrides, quoted.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import OmegaConf

from gridworld.base.bounds import LARGEST_INTEGER
from gridworld.base.errors import InputError
from gridworld.base.safe_read import as_text, read_bytes
from gridworld.config.fields import MISSING, Text
from gridworld.config.messages import not_yaml
from gridworld.config.recipes import CHOSEN
from gridworld.config.settings import check_foreign, settings_of_a_run
from gridworld.config.words import split

KEY = "recipe"
TRUST = "trust"
IN_A_STUDY = ("experiment", "winner.yaml")
_EARLIER = "preset"  # in studies of earlier versions; `prepared` reads it
_LARGEST = 2**16  # bytes
_DEEPEST = 20  # levels
_CHOICE = re.compile(Text.CHOICE.value[0])
# text as it is
_BARE = re.compile(
    r"(?!(?:true|false|null|nan|inf)$)([a-z_]|/|\.\.?/)[\w./:-]*( [\w./:-]+)*", re.ASCII | re.IGNORECASE
)
_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


def with_recipe(words: Sequence[str]) -> list[str]:
    """Replace `recipe=FILE` in a command line by what the recipe says, before the user's own overrides."""
    given = [word for word in words if word.startswith(f"{KEY}=")]
    if not given:
        return list(words)
    if len(given) > 1:
        raise InputError(f"{given[1]}: {KEY} is given twice; give it once")
    rest = [word for word in words if word != given[0]]
    for word in rest:
        if word.lstrip("+").startswith("experiment="):
            raise InputError(f"{word}: is a second recipe after {given[0]}; give one of them")
    truths = [word for word in rest if word.startswith(f"{TRUST}=")]
    if not set(truths) <= {f"{TRUST}=true", f"{TRUST}=false"}:
        raise InputError(f"{truths[0]}: must be true or false")
    options, rest = split([word for word in rest if word not in truths])
    return [*options, *overrides(_file(given[0]), f"{TRUST}=true" in truths), *rest]


def _file(word: str) -> Path:
    given = word.partition("=")[2].strip("'\"")
    path, study = Path(given), Path(given, IN_A_STUDY[0])
    if not given or not path.exists():
        missing = "no such file; " if given else ""
        raise InputError(f"{word}: {missing}must be a recipe's yaml, or the folder of a study")
    if not path.is_dir():
        return path
    if study.is_symlink():
        raise InputError(f"{study}: is a symbolic link, which is not followed out of a study")
    if not study.exists():
        raise InputError(f"{word}: is not the folder of a study, it has no {'/'.join(IN_A_STUDY)}")
    return path.joinpath(*IN_A_STUDY)


def overrides(path: Path, trust: bool = False) -> list[str]:
    """The overrides of a recipe, choices first; with `trust` it may run code and read files."""
    text = as_text(read_bytes(path, _LARGEST), path)
    try:
        _check_plain(text, path)
        content: Any = OmegaConf.to_container(OmegaConf.create(text)) if text.strip() else None
    except InputError:
        raise
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{path}: {not_yaml(error)}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: contains no settings")
    choices = list(_choices(content.pop("defaults", []), path))
    values = list(_values(content, path))
    if not trust:
        check_foreign(content, str(path), f"{TRUST}=true")
    return [*choices, *values]


def _check_plain(text: str, path: Path) -> None:
    """Refuse what is larger, once it is read, than it is written."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        at = f"{path}: line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise InputError(f"{at}: has an anchor or an alias; write the value out")
        if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
            raise InputError(f"{at}: has the interpolation {event.value[:80]!r}; write the value out")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise InputError(f"{at}: is nested too deeply, more than {_DEEPEST} levels")


def _choices(defaults: Any, path: Path) -> Iterator[str]:
    for entry in defaults if isinstance(defaults, list) else [str(defaults)]:
        if entry == "_self_":
            continue
        named = entry if isinstance(entry, dict) and len(entry) == 1 else {"": None}
        ((key, choice),) = named.items()
        group = str(key).removeprefix("override /")
        is_known = key != group and group in (*CHOSEN, _EARLIER)
        if not is_known or not isinstance(choice, str) or not _CHOICE.fullmatch(choice):
            raise InputError(
                f"{path}: defaults has {str(entry)[:80]!r}; a recipe chooses {', '.join(CHOSEN)} by their "
                "names, as in 'override /agent: dqn'"
            )
        yield f"{group}={choice}"


def _values(content: dict[Any, Any], path: Path, section: str = "") -> Iterator[str]:
    """An override for every setting; Hydra checks its type."""
    for key, value in content.items():
        name = f"{section}{str(key)[:80]}"
        if name in settings_of_a_run():
            if name in CHOSEN and not isinstance(value, str):
                raise InputError(f"{path}: {name}={str(value)[:80]}: must be the name of a choice")
            # What is in no schema has no entry yet that could be changed.
            yield f"{'++' if isinstance(value, dict) else ''}{name}={literal(value, f'{path}: {name}')}"
        elif not any(known.startswith(f"{name}.") for known in settings_of_a_run()):
            raise InputError(f"{path}: has an unknown key {name!r}; a recipe has the settings of a run only")
        elif isinstance(value, dict):
            yield from _values(value, path, f"{name}.")
        else:
            raise InputError(f"{path}: {name}={str(value)[:80]}: must be settings")


def literal(value: Any, where: str) -> str:
    """Write a plain value in Hydra's grammar of overrides; `where` is for the message."""
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str) or not _NAME.fullmatch(key):
                raise InputError(f"{where}: has the key {str(key)[:80]!r}, which is not a name")
        return f"{{{','.join(f'{key}:{literal(v, where)}' for key, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{','.join(literal(item, where) for item in value)}]"
    if isinstance(value, str):
        if value == MISSING:
            raise InputError(f"{where}: has no value")
        bare = _BARE.fullmatch(value)
        return value if bare else str(QuotedString(value, Quote.single).with_quotes())
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, int) and abs(value) >= LARGEST_INTEGER:
        raise InputError(f"{where}: is too large a number")
    if not isinstance(value, int | float):
        raise InputError(f"{where}: must be plain values, has a {type(value).__name__}")
    return repr(value)
