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
OF_THE_COMMAND = ("experiment", "recipe", "resume", "trust", "anyway")  # words that look like settings
_FLOAT = re.compile(r"(?<![\w.$'\"])[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.'\"])")
_PACKAGE = Path(__file__).parents[1]
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
    for word, following in itertools.pairwise([*words, ""]):
        option, _, value = word.partition("=")
        if option in ("--config-dir", "-cd"):
            yield Path(value or following)


def is_override(words: Sequence[str], index: int) -> bool:
    """Whether a word of a command line is neither an option of Hydra's nor an option's value."""
    return not words[index].startswith("-") and (index == 0 or words[index - 1] not in _WITH_VALUE)


def prepared(words: Sequence[str], of_many: bool = False) -> list[str]:
    """A command line as Hydra takes it: 1e5 as 100000, experiment=ENV_AGENT as the choice of the two.

    An environment by its id, or by the name of its class, is the choice env=gymnasium with that id. A recipe
    may be named as in earlier versions, tuned=ENV_AGENT or preset=CLASS; a class alone is that of the agent.
    In the words `of_many` runs, a recipe stays as it is named, until these are known.
    """
    found: list[str] = []
    chosen = {word.lstrip("+").partition("=")[0] for word in words if "=" in word}
    for word in words:
        key, _, value = word.partition("=")
        if key[:1] == "~" and key[1:] in settings_of_a_run():
            raise InputError(f"{word}: a setting cannot be taken away; give it a value, {key[1:]}=...")
        if key == "env" and all(map(is_id, value.split(","))):
            found += ["env=gymnasium", f"env.id={value}"]
        elif of_many and key in ("tuned", "preset"):
            found.append(word)
        elif key == "tuned":
            if not (value == "none" and {f"preset={name}" for name in CLASSES} & set(words)):
                found.append(f"tuned={_recipe(value)}")
        elif key == "preset":
            found += _of_preset(word, value, [each for each in words if each.startswith("tuned=")])
        elif key.lstrip("+") == "experiment" and value in pairs():
            pair = zip(("env", "agent"), pairs()[value], strict=True)
            found += [f"{group}={name}" for group, name in pair if group not in chosen]
        elif takes_whole_numbers(key.lstrip("+")) and re.search(r"[.eE]", value):
            found.append(f"{key}={_FLOAT.sub(lambda number: digits(number.group()), value)}")
        else:
            found.append(word)
    return found


def _recipe(name: str) -> str:
    """A recipe's name from one that may be of an earlier version, or of a class alone."""
    if name in CLASSES:
        return f"${{agent}}/{name}"
    return "/".join(reversed(pairs()[name])) if name in pairs() else name


def _of_preset(word: str, value: str, tuned: list[str]) -> list[str]:
    """The words for a preset, which earlier versions had beside a recipe."""
    if value in CLASSES and not set(tuned) - {"tuned=none"}:
        return [f"tuned={_recipe(value)}"]
    if value == "auto" or (value == "none" and tuned):
        return []
    raise InputError(
        f"{word}: a preset is a recipe now; write tuned=none for the agent's own settings, or tuned=NAME for "
        f"its recipe for a class of worlds, {' or '.join(CLASSES)}"
    )


@functools.cache
def pairs() -> dict[str, tuple[str, str]]:
    """Every shipped world with every shipped agent, by the names that experiments for them have."""
    conf = conf_folder()
    envs = [file for file in sorted((conf / "env").glob("*.yaml")) if MISSING not in file.read_text("utf-8")]
    both = itertools.product(envs, sorted((conf / "agent").glob("*.yaml")))
    found = {f"{env.stem}_{agent.stem}": (env.stem, agent.stem) for env, agent in both}
    return {name: pair for name, pair in found.items() if not (conf / "experiment" / f"{name}.yaml").exists()}


def refuse_unclear(words: Sequence[str]) -> None:
    """Refuse slips of the hand: settings as options, in quotation marks, with blanks, without a key."""
    known = {*OF_THE_COMMAND, *settings_of_a_run()}
    groups = {file.name for file in conf_folder().iterdir() if file.is_dir()}
    for word, following in itertools.pairwise([*words, ""]):
        option, equals, value = word.partition("=")
        name = option.lstrip("-").replace("-", "_")
        if name != option and (name in known or any(each.startswith(f"{name}.") for each in known)):
            takes_next = not equals and following and not following.startswith("-") and "=" not in following
            given = f"{word} {following}" if takes_next else word
            value = (following if takes_next else value) or "VALUE"
            raise InputError(f"{given}: a setting is written without dashes; write {name}={value}")
        if option == "config-dir":
            raise InputError(f"{word}: is an option; write --{word}")
    for folder in own_conf_folders(words):
        if folder.name in groups and not any((folder / group).is_dir() for group in groups):
            raise InputError(
                f"--config-dir={folder}: give the folder above it, which has a folder {folder.name}"
            )
    for index, word in enumerate(words):
        if not is_override(words, index):
            continue
        if word[:1] in ("'", '"'):
            raise InputError(f"{word}: is in quotation marks, which the shell passed on; leave them out")
        rest = list(itertools.takewhile(lambda each: not each.startswith("-"), words[index:]))
        if rest[1:2] == ["="] or (word[-1:] == "=" and rest[1:] and "=" not in rest[1]):
            count = 3 if rest[1] == "=" else 2
            raise InputError(f"{' '.join(rest[:count])}: has blanks; write {''.join(rest[:count])}")
        if word.endswith(",") and rest[1:]:
            values = [word, *itertools.takewhile(lambda each: "=" not in each, rest[1:])]
            ends = next((n for n, each in enumerate(values, 1) if not each.endswith(",")), len(values))
            line = "".join(values[:ends]).rstrip(",")
            line = line if "-m" in words else f"-m {line}"
            raise InputError(f"{' '.join(values[:ends])}: has blanks after commas; write {line}")
        if "=" not in word and not word.startswith("~"):
            files = [conf_folder() / group / f"{word}.yaml" for group in sorted(groups)]
            found = [f"{file.parent.name}={word}" for file in files if file.is_file() and word]
            wanted = "a setting is written key=value, as in agent=dqn"
            wanted = f"write {[*found, '--help'][0]}" if found or word == "help" else wanted
            raise InputError(f"{word or 'an empty word'}: is not a setting; {wanted}")
