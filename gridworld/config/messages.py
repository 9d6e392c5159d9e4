"""What Hydra and OmegaConf say of a mistake, in a sentence.

Hydra says what went wrong over several lines and advises to append an unknown key with `+`, which the
schema would refuse as well. `sentence` keeps the fact, and adds what would have been right.
"""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Iterable
from pathlib import Path

from gridworld.base.errors import InputError, failure
from gridworld.config.settings import all_settings
from gridworld.config.train import AgentConfig
from gridworld.config.words import OF_THE_COMMAND, pairs
from gridworld.config.worlds import EnvConfig

_SENTENCES = (  # a pattern of a message of Hydra's: what is said instead
    (
        r"Config group override must be a string|^argument of type '\w+' is not iterable$",
        "a choice must be a name, not null; write tuned=none, or ~experiment",
    ),
    (
        r"Interpolation key '([^']*)' not found",
        "{}: is missing, but other settings refer to it; give it a value",
    ),
    (
        r"Error resolving interpolation '\$\{agent\}/\$\{env\}'",
        "agent and env: every run needs both; give agent=... and env=..., not ~agent or ~env",
    ),
    (
        r"Multiple values for (\S+)\. To override a value use 'override \S+: (.*)'",
        "+{0}={1}: {0} is always chosen, so it takes no plus; write {0}={1}",
    ),
    (r"Invalid plugin 'gridworld\.", "hydra/sweeper: another one needs hydra/launcher=basic, or its own"),
)
_HINTS = (  # a pattern of what is said: what would have been right
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
    (
        r"^In '[^']*': .*Key '(agent|env|evaluation|n_envs|total_timesteps)' not in",
        "; the file's first line must be  # @package _global_",
    ),
    (
        r"Key '\w+' not in 'AgentConfig'",
        "; its defaults must name a schema, as [/agent/schema/dqn@agent, _self_]",
    ),
    ("str is not a ListConfig", "; must be a list, such as [a,b]"),
    (
        r"'tune\.space.* not in struct|tune\.space=",
        "; a search space is a yaml file in conf/tune, or in tune/ of --config-dir, chosen by tune=NAME",
    ),
    ("'SB3ClassConfig'", "; an argument of the class is written as +agent.arguments.gamma=0.9"),
    ("'DimensionConfig'", "; a line of a search space is agent.gamma: {type: float, low: 0, high: 1}, say"),
    ("'tune/.* in 'TuneConfig'", "; the first line of a search space is  # @package tune.space"),
)
_REWRITTEN = (  # a pattern of what is said: what is put in its place
    (r"Could not override '(agent\.[^']*)': Key '[^']*' not in '(\w+)Config'", r"\1: no such setting of \2"),
    (r"Could not override '([^']*)': Key '[^']*' not in '\w+'", r"\1: no such setting"),
    (r"Could not override '([^']*)': Key '([^']*)' is not in struct", r"\1: has no \2"),
    (r"^In '([^']+)': \w+ raised while composing config: ", r"\1.yaml: "),
    (r"Key '([^']*)' not in '\w+'", r"\1: no such key"),
    (
        r": (mismatched input|no viable alternative|extraneous input|token recog).*",
        ": is not valid syntax; is a comma, a bracket or a quotation mark missing or left over?",
    ),
    (r"^LexerNoViableAltException: (.*)", r"\1: a quotation mark has no partner"),
)
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
    message = str(error)
    if isinstance(error, InputError):
        return message
    if isinstance(error, OSError) and error.strerror:
        return failure(error)
    if (mark := getattr(error, "problem_mark", None)) is not None:  # of yaml
        problem = getattr(error, "problem", None)
        return f"{mark.name}: line {mark.line + 1}, column {mark.column + 1}: is not valid YAML: {problem}"
    if missing := re.search(r"[Mm]issing mandatory value: (\S+)", message):
        key = missing[1] if "." in missing[1] else getattr(error, "full_key", None) or missing[1]
        word = "" if key.startswith("tune.space.") else f"give {key}=..., or "
        return f"{key}: has no value; {word}set it in a yaml file"
    for pattern, words in _SENTENCES:
        if found := re.search(pattern, message):
            return words.format(*found.groups())
    if "Could not find" in message and "Available options in" in message:
        return _unknown_choice(message)
    lines = message.splitlines() or [type(error).__name__]
    facts = lines[: 2 if lines[0].endswith(":") or lines[0].startswith("Error parsing") else 1]
    facts[0] = facts[0].removeprefix("Error merging override ").removeprefix("Error parsing override ")
    facts += str(error.__cause__ or "").splitlines()[:1]
    override = getattr(error, "override", None)
    if override and override not in facts[0]:
        facts.insert(0, override)
    text = ": ".join(fact.strip().rstrip(".:") for fact in facts)
    for pattern, words in _REWRITTEN:
        text = re.sub(pattern, words, text)
    return text + _suggestion(" ".join(facts), message, error)


def unreadable_file(error: Exception, folders: Iterable[Path]) -> str:
    """A sentence on the first yaml file that raises an error like this one, for which Hydra names no file.

    It is a `UnicodeDecodeError` or a `RecursionError`.
    """
    from omegaconf import OmegaConf  # here, since --help takes no longer than it must

    for file in sorted(file for folder in folders for file in folder.rglob("*.yaml")):
        try:
            OmegaConf.load(file)
        except type(error) as found:
            if isinstance(found, UnicodeDecodeError):
                return f"{file}: byte {found.start + 1} is not UTF-8"
            return f"{file}: is nested too deeply, or contains itself"
        except Exception:
            continue  # which would name its file itself
    return sentence(error)


def _unknown_choice(message: str) -> str:
    missing = re.search(r"Could not find '([^']*)'", message)
    group = re.search(r"Available options in '([^']*)':((?:\n\t\S+)*)", message)
    assert missing is not None
    choices = group.group(2).split() if group else []
    where, _, name = missing.group(1).rpartition("/")
    if group and missing.group(1).startswith(f"{group.group(1)}/"):
        where, name = group.group(1), missing.group(1)[len(group.group(1)) + 1 :]
    if where == "experiment":
        choices = sorted({*choices, *pairs()})
    fact = f"{where}={name}: no such choice"
    if len(choices) <= _LISTED:
        hint = meant(name, choices)
        if where == "agent" and name.lower() in _CONTINUOUS:
            hint = "; it learns continuous actions, which these worlds do not have"
        elif not hint and where in ("agent", "env"):
            hint = "; a yaml file of your own needs --config-dir FOLDER"
        return f"{fact}; choose from {', '.join(choices)}{hint}"
    near = [choice for choice in choices if choice.startswith(name)]
    near = near or difflib.get_close_matches(name, choices)
    hint = f"; close matches: {', '.join(near)}" if near else ""
    return f"{fact}{hint}; --help lists them all"


def _suggestion(facts: str, message: str, error: BaseException) -> str:
    for pattern, hint in _HINTS:
        if re.search(pattern, facts):
            return hint
    if added := re.search(r"Could not override '([^']*)'.*Key '([^']*)' is not in struct", facts, re.DOTALL):
        place, name = added.groups()
        entry = place if place.endswith(f".{name}") else f"{place}.{name}"
        return f"; a new entry of a dictionary needs a plus: +{entry}=..."
    if unknown := re.search(r"Key '([^']*)' not in '\w+'", facts):
        if unknown[1] == "tune":
            return "; that is a setting of tune.py"
        place = re.search(r"full_key: (\S+)", message + facts) or re.search(r"override '([^']*)'", facts)
        return _alike((place or unknown)[1], unknown[1], _not_chosen(error))
    return ""


def _not_chosen(error: BaseException) -> set[str]:
    """The settings of other agents and worlds than those in which OmegaConf found an error."""
    from omegaconf import DictConfig, OmegaConf  # here, since --help takes no longer than it must

    found = (getattr(each, "parent_node", None) for each in (error, error.__cause__))
    nodes = [each for each in found if isinstance(each, DictConfig)]
    others = set[str]()
    for section, schema in (("agent", AgentConfig), ("env", EnvConfig)):
        for node in (*nodes, *(node[section] for node in nodes if section in node)):
            kind = OmegaConf.get_type(node)
            if isinstance(kind, type) and issubclass(kind, schema):
                own = {field.name for field in dataclasses.fields(kind)}
                places = (name.split(".") for name in all_settings())
                others |= {".".join(name) for name in places if name[0] == section and name[1] not in own}
    return others


def _alike(name: str, key: str, others: set[str]) -> str:
    """The settings in the section of `name` that look like `key`, or else those in other sections."""
    if key in _OTHER_NAMES:
        return _or([_OTHER_NAMES[key]])
    known = {*all_settings(), *OF_THE_COMMAND} - {name} - others
    section = name.rpartition(".")[0]
    own = [each[len(section) + bool(section) :] for each in known if each.startswith(section)]
    if near := meant(key, sorted({each.partition(".")[0] for each in own} - {key})):
        return near
    last = {each: each.rpartition(".")[2] for each in known if each.partition(".")[0] != section}
    alike = _similar(key, sorted(set(last.values())), n=1, cutoff=0.8)
    return _or(sorted(each for each, part in last.items() if [part] == alike)) or "; --cfg job shows all keys"


def meant(key: str, known: list[str]) -> str:
    """The names that `key` looks like, is the initials or the end of, as a question; "" if there is none."""
    longer = [name for name in known if name.endswith(key) and len(key) > 3]
    return _or(_similar(key, known) or longer)


def _similar(key: str, known: list[str], n: int = 3, cutoff: float = 0.6) -> list[str]:
    if (named := _OTHER_NAMES.get(key)) in known:
        return [str(named)]
    initials = [name for name in known if "_" in name and "".join(w[:1] for w in name.split("_")) == key]
    return initials or difflib.get_close_matches(key.lower(), known, n, cutoff)


def _or(names: list[str]) -> str:
    return f"; did you mean {' or '.join(names)}?" if names else ""
