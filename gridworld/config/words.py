"""A command line: the folders that it chooses from, its words as Hydra takes them, slips of the hand."""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from gridworld.base.bounds import digits
from gridworld.base.errors import InputError
from gridworld.config.fields import MISSING
from gridworld.config.settings import settings_of_a_run, takes_whole_numbers
from gridworld.config.worlds import is_id

CLASSES = ("stochastic", "large")  # of worlds, for which agents have recipes
OF_THE_COMMAND = ("experiment", "recipe", "resume", "trust", "anyway", "tuned")  # look like settings
_FLOAT = re.compile(r"(?<![\w.$'\"])[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.'\"])")
_BLANKS = re.compile(  # words, with \0 between them, that are one: agent = dqn; seed=0, 1
    r"(?<![^\0])(?:[^\0=]+(?:\0=\0?|=\0)|[^\0]*,\0(?:[^\0=]*,\0)*)[^\0=]+(?![^\0])"
)
_PACKAGE = Path(__file__).parents[1]
_WITH_VALUE = (  # Hydra's options that the next word belongs to
    *("--config-dir", "-cd", "--config-name", "-cn", "--config-path", "-cp", "--package", "-p"),
    *("--cfg", "-c", "--info", "-i", "--experimental-rerun"),
)


def conf_folder() -> Path:
    """The folder of the yaml files: of the installed package, or `conf/` of the checkout."""
    installed = _PACKAGE / "conf"
    return installed if installed.is_dir() else _PACKAGE.parent / "conf"


def key_of(word: str) -> str:
    """The key of a setting or a choice in a command line, without a plus or a tilde."""
    return word.lstrip("+~").partition("=")[0]


def own_conf_folders(words: Sequence[str]) -> Iterator[Path]:
    """The folders that `--config-dir` names in a command line."""
    for word, following in itertools.pairwise([*words, ""]):
        option, _, value = word.partition("=")
        if option in ("--config-dir", "-cd"):
            yield Path(value or following)


def split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The options of Hydra's in a command line, each with its value, and its settings and choices."""
    options, rest = list[str](), list[str]()
    for before, word in itertools.pairwise(["", *words]):
        (options if word.startswith("-") or before in _WITH_VALUE else rest).append(word)
    return options, rest


def prepared(words: Sequence[str], of_many: bool = False) -> list[str]:
    """Settings and choices as Hydra takes them: 1e5 as 100000, experiment=ENV_AGENT as the choice of the two.

    An environment by its id, or by the name of its class, is the choice env=gymnasium with that id. In the
    words `of_many` runs, a recipe stays as it is named, until these are known.
    """
    found = [] if of_many else _recipe(words)
    chosen = {key_of(word) for word in words if "=" in word}
    for word in words:
        key, _, value = word.partition("=")
        name = key.lstrip("+")
        if key[:1] == "~" and key[1:] in settings_of_a_run():
            raise InputError(f"{word}: a setting cannot be taken away; give it a value, {key[1:]}=...")
        if key == "env.id" and not chosen & {"env", "experiment"}:
            found.append("env=gymnasium")
        if key == "env" and all(map(is_id, value.split(","))):
            found += ["env=gymnasium", f"env.id={value}"]
        elif name == "experiment" and value in pairs():
            pair = zip(("env", "agent"), pairs()[value], strict=True)
            found += [f"{group}={choice}" for group, choice in pair if group not in chosen]
        elif takes_whole_numbers(name) and re.search(r"[.eE]", value):
            found.append(f"{key}={_FLOAT.sub(lambda number: digits(number.group()), value)}")
        elif of_many or key not in ("tuned", "preset"):
            found.append(word)
    return found


def _recipe(words: Sequence[str]) -> list[str]:
    """The word for the recipe that is named in a command line, maybe by a class alone.

    In earlier versions it was tuned=ENV_AGENT and, for a class of worlds, preset=CLASS.
    """
    given = dict(word.split("=", 1) for word in words if word.startswith(("tuned=", "preset=")))
    name, preset = given.get("tuned"), given.get("preset", "auto")
    if preset in CLASSES and name in (None, "none"):
        name = preset
    elif preset != "auto" and (preset != "none" or name is None):
        raise InputError(
            f"preset={preset}: a preset is a recipe now; write tuned=none for the agent's own settings, or "
            f"tuned=NAME for its recipe for a class of worlds, {' or '.join(CLASSES)}"
        )
    if name in CLASSES:
        name = f"${{agent}}/{name}"
    elif name in pairs():
        name = "/".join(reversed(pairs()[name]))
    return [] if name is None else [f"tuned={name}"]


@functools.cache
def pairs() -> dict[str, tuple[str, str]]:
    """Every shipped world with every shipped agent, by the names that experiments for them have."""
    conf = conf_folder()
    envs = [file for file in sorted((conf / "env").glob("*.yaml")) if MISSING not in file.read_text("utf-8")]
    both = itertools.product(envs, sorted((conf / "agent").glob("*.yaml")))
    studies = {file.stem for file in (conf / "experiment").glob("*.yaml")}
    found = {f"{env.stem}_{agent.stem}": (env.stem, agent.stem) for env, agent in both}
    return {name: pair for name, pair in found.items() if name not in studies}


def refuse_unclear(words: Sequence[str]) -> None:
    """Refuse slips of the hand: settings as options, in quotation marks, with blanks, without a key."""
    options, rest = split(words)
    _refuse_options(words)
    groups = sorted(file.name for file in conf_folder().iterdir() if file.is_dir())
    for folder in own_conf_folders(options):
        if folder.name in groups and not any((folder / group).is_dir() for group in groups):
            raise InputError(
                f"--config-dir={folder}: give the folder above it, which has a folder {folder.name}"
            )
    if found := _BLANKS.search("\0".join(rest)):
        word = found[0].replace("\0", "")
        many = "-m " if "," in word and "[" not in word and "-m" not in options else ""
        raise InputError(f"{' '.join(found[0].split(chr(0)))}: has blanks; write {many}{word}")
    for word in rest:
        if word[:1] in ("'", '"'):
            raise InputError(f"{word}: is in quotation marks, which the shell passed on; leave them out")
        if "=" not in word and not word.startswith("~"):
            files = [conf_folder() / group / f"{word}.yaml" for group in groups]
            choices = [f"write {file.parent.name}={word}" for file in files if word and file.is_file()]
            choices += [f"write env={word}"] if is_id(word) else ["write --help"] if word == "help" else []
            choices += ["a setting is written key=value, as in agent=dqn"]
            raise InputError(f"{word or 'an empty word'}: is not a setting; {choices[0]}")


def _refuse_options(words: Sequence[str]) -> None:
    """Refuse a setting that is written as an option, and an option as a setting."""
    known = {*OF_THE_COMMAND, *settings_of_a_run()}
    known |= {name.rpartition(".")[0] for name in known}
    for word, following in itertools.pairwise([*words, ""]):
        option, _, value = word.partition("=")
        name = option.lstrip("-").replace("-", "_")
        if name != option and name in known:
            value = value or ("" if following[:1] == "-" or "=" in following else following) or "VALUE"
            raise InputError(f"{option}: a setting is written without dashes; write {name}={value}")
        if option == "config-dir":
            raise InputError(f"{word}: is an option; write --{word}")
