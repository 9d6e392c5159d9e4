"""What Hydra and OmegaConf say of a mistake, in a sentence.

Hydra says what went wrong over several lines and advises to append an unknown key with `+`, which the
schema would refuse as well. `sentence` keeps the fact, and adds what would have been right.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Sequence
from typing import Any

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from gridworld.base.errors import InputError, failure
from gridworld.config.settings import all_settings, flat
from gridworld.config.train import AgentConfig, TrainConfig
from gridworld.config.words import OF_THE_COMMAND, pairs

_SPACE = "; a search space is a yaml file in conf/tune, or in tune/ of --config-dir, chosen by tune=NAME"
_SENTENCES = (  # a pattern of what is said: what is said instead, or after a semicolon, what would be right
    (
        r"Config group override must be a string.*|^argument of type '\w+' is not iterable$",
        "a choice must be a name, not null; write tuned=none, or ~experiment",
    ),
    (
        r"Error resolving interpolation '\$\{agent\}/\$\{env\}'.*",
        "agent and env: every run needs both; give agent=... and env=..., not ~agent or ~env",
    ),
    (
        r"Interpolation key '([^']*)' not found",
        r"\1: is missing, but other settings refer to it; give it a value",
    ),
    (
        r"Multiple values for (\S+)\. To override a value use 'override \S+: (.*)'",
        r"+\1=\2: \1 is always chosen, so it takes no plus; write \1=\2",
    ),
    (r"Invalid plugin 'gridworld.*", "hydra/sweeper: another one needs hydra/launcher=basic, or its own"),
    ("Ambiguous value", "; to run one job for each of the values, add -m"),
    ("Could not append to config", "; leave out the plus"),
    ("Could not override 'preset'", "; a preset is a recipe now: leave this line out"),
    (
        r"'\d+\.0' of type 'float' could not be converted to Integer",
        "; in YAML, write whole numbers without a decimal point or exponent",
    ),
    (r"Value '\d+(\.\.|-)\d+'", "; a range, for -m, is range(1,6)"),
    ("of type 'str' could not be converted to Integer", "; must be a whole number, such as 30000 or 3e4"),
    ("'[^']*%' of type 'str' could not be converted to Float", "; must be a number, such as 0.1 for 10 %"),
    ("of type 'str' could not be converted to Float", "; must be a number"),
    ("str is not a ListConfig", "; must be a list, such as [a,b]"),
    (r"^tune\.space=", _SPACE),
)
_OF_SCHEMAS = {  # what to write where a schema lacks a key
    "AgentConfig": "its defaults must name a schema, as [/agent/schema/dqn@agent, _self_]",
    "SB3ClassConfig": "an argument of the class is written as +agent.arguments.gamma=0.9",
    "DimensionConfig": "a line of a search space is agent.gamma: {type: float, low: 0, high: 1}, say",
}
_OF_GROUPS = {  # what else a choice may be
    "agent": "; a yaml file of your own needs --config-dir FOLDER",
    "env": "; or give a Gymnasium id such as FrozenLake-v1, or module:NAME of a class or a function; "
    "a yaml file of your own needs --config-dir FOLDER",
}
_OTHER_NAMES = {  # what people and other libraries call a setting or a choice: what it is called here
    "size": "env.num_rows and env.num_cols",
    "width": "env.num_cols",
    "height": "env.num_rows",
    "net_arch": "agent.policy_kwargs.net_arch",
    "lr": "agent.learning_rate",
    "discount": "agent.gamma",
    **dict.fromkeys(("n_timesteps", "timesteps", "steps"), "total_timesteps"),
    **dict.fromkeys(("n_trials", "trials"), "tune.trials"),
    **dict.fromkeys(("pixels", "rgb", "rgb_array"), "image"),
}
_CONTINUOUS = ("sac", "td3", "ddpg", "tqc", "crossq")  # agents for continuous actions
_LISTED = 24  # choices of a group that are listed at most; of more, those with a similar name


def sentence(error: BaseException) -> str:
    """Put the facts of an exception, Hydra's or any other, into one line."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, MissingConfigException):
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        choices = {*(error.options or ()), *(pairs() if group == "experiment" else ())}
        return no_such(group, name, sorted(choices))
    if isinstance(error, OSError) and error.strerror:
        return failure(error)
    if (mark := getattr(error, "problem_mark", None)) is not None:
        return f"{mark.name}: {not_yaml(error)}"
    if isinstance(error, OverrideParseException):
        what = "is a comma, a bracket or a quotation mark missing or left over?"
        return f"{error.override}: is not valid syntax; {what}"
    if missing := re.search(r"[Mm]issing mandatory value: (\S+)", str(error)):
        key = missing[1] if "." in missing[1] else getattr(error, "full_key", None) or missing[1]
        return f"{key}: has no value; give {key}=..., or set it in a yaml file"
    lines = [line.strip().rstrip(".:") for line in str(error).splitlines()] or [type(error).__name__]
    file = re.match(r"In '([^']+)': \w+ raised while composing config$", lines[0])
    place = f"{file[1]}.yaml: " if file else ""
    within = error.__cause__ or (error.__context__ if file else error)
    if isinstance(within, ConfigKeyError | ConfigAttributeError):
        return place + _unknown_key(within, bool(file))
    text = lines[1] if file else lines[0].removeprefix("Error merging override ")
    if not file and within is not error and isinstance(within, OmegaConfBaseException):
        text += f": {str(within).splitlines()[0].rstrip('.')}"
    for pattern, words in _SENTENCES:
        if found := re.search(pattern, text):
            text = text + words if words.startswith(";") else found.expand(words)
            break
    return place + text


def not_yaml(error: BaseException) -> str:
    """Say what a text lacks to be YAML, and where, in one line."""
    mark = getattr(error, "problem_mark", None)
    where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark is not None else ""
    return f"{where}is not valid YAML: {' '.join(str(getattr(error, 'problem', error)).split())[:200]}"


def no_such(group: str, name: str, choices: Sequence[str]) -> str:
    """Say that a group of files has no such choice, and which one may be meant."""
    fact = f"{group}={name}: no such {'recipe' if group == 'tuned' else 'choice'}"
    if len(choices) > _LISTED:
        near = [choice for choice in choices if choice.startswith(name)]
        near = near or difflib.get_close_matches(name, choices)
        return f"{fact}{'; close matches: ' if near else ''}{', '.join(near)}; --help lists them all"
    hint = meant(name, choices) or _OF_GROUPS.get(group, "")
    if group == "agent" and name.lower() in _CONTINUOUS:
        hint = "; it learns continuous actions, which these worlds do not have"
    return f"{fact}; choose from {', '.join(choices)}{hint}"


def _unknown_key(error: ConfigKeyError | ConfigAttributeError, in_a_file: bool) -> str:
    """Which key a schema lacks, and what it may be: a name like it there, or else in other sections."""
    key, place, kind = str(error.key), str(error.full_key or error.key), error.object_type
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        plus = f"; a new entry of a dictionary needs a plus: +{place}=..."
        return f"{place}: no such setting{_SPACE if place.startswith('tune.') else plus}"
    of = f" of {kind.__name__.removesuffix('Config')}" if issubclass(kind, AgentConfig) else ""
    fact = f"{place}: no such setting{of}"
    own = sorted({each.name for each in dataclasses.fields(kind)} - {key})
    if in_a_file and key in (each.name for each in dataclasses.fields(TrainConfig)):
        return f"{fact}; the file's first line must be  # @package _global_"
    if in_a_file and kind.__name__ == "TuneConfig":
        return f"{fact}; the first line of a search space is  # @package tune.space"
    if hint := _OF_SCHEMAS.get(kind.__name__):
        return f"{fact}; {hint}"
    if key == "tune":
        return f"{fact}; that is a setting of tune.py"
    if near := _or([_OTHER_NAMES[key]]) if key in _OTHER_NAMES else meant(key, own):
        return fact + near
    known = {name for name in all_settings() if not name.startswith(f"{place.partition('.')[0]}.")}
    if kind is TrainConfig:
        composed: Any = OmegaConf.to_container(error.parent_node)
        known = {name for name, _ in flat(composed)}
    last = {name: name.rpartition(".")[2] for name in known.union(OF_THE_COMMAND) - {key}}
    alike = difflib.get_close_matches(key.lower(), sorted(set(last.values())), 1, 0.8)
    return fact + (_or(sorted(name for name in last if last[name] in alike)) or "; --cfg job shows all keys")


def meant(key: str, known: Sequence[str]) -> str:
    """The names that `key` looks like, or the one that it has elsewhere, as a question; "" for none."""
    named = [name for name in known if name == _OTHER_NAMES.get(key)]
    return _or(named or difflib.get_close_matches(key.lower(), known))


def _or(names: list[str]) -> str:
    return f"; did you mean {' or '.join(names)}?" if names else ""
