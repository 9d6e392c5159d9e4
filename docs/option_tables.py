"""The tables of options on the page `reference/options`, read from where the options are declared.

A setting is a field of a dataclass; its meaning is in the comment at the field or, where there is none, at
the key in the yaml file that ships its value. A command's options are those of its parser.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import io
import re
import tokenize
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from gridworld.commands import COMMANDS
from gridworld.config.settings import agent_schemas
from gridworld.config.sweep import LAUNCHER_SCHEMAS, DimensionConfig, SweepConfig, TuneConfig
from gridworld.config.train import AgentConfig, TrainConfig
from gridworld.config.words import conf_folder
from gridworld.config.worlds import SOURCES, EnvConfig
from gridworld.envs.env import GridWorldEnv
from gridworld.envs.vector_env import GridWorldVectorEnv
from gridworld.world.layout import shipped_layouts

Row = tuple[str, ...]

_NOT_SHOWN = {"_target_", "source"}
_NOQA = re.compile(r"\s*noqa: [\w, ]+")
_ARGUMENT = re.compile(r"^\s*- ((?:`\w+`(?:, )?)+): (.*?)(?=^\s*- `|^\s*$)", re.MULTILINE | re.DOTALL)


def fill(text: str) -> str:
    """Replace the lines `<!-- table: NAME -->` by the tables."""
    return re.sub(r"<!-- table: ([\w/ ]+) -->", lambda found: TABLES[found[1]](), text)


def environment_rows() -> list[Row]:
    """(name, default, meaning) of each argument of `gym.make` and `gym.make_vec`."""
    meanings: dict[str, str] = {}
    for names, meaning in _ARGUMENT.findall(inspect.getdoc(GridWorldEnv) + "\n\n"):
        meanings |= dict.fromkeys(re.findall(r"\w+", names), " ".join(meaning.split()))
    meanings |= {
        "num_envs": "`make_vec` alone: environments that step together",
        "autoreset_mode": "`make_vec` alone: what follows an episode's end, see `GridWorldVectorEnv`",
        "stratified": "`make_vec` alone: whether environments share out outcomes, see `GridWorldVectorEnv`",
        "max_episode_steps": "`make` and `make_vec`: the step limit of an episode",
    }
    defaults: dict[str, Any] = {}
    for kind in (GridWorldEnv, GridWorldVectorEnv):
        for name, parameter in list(inspect.signature(kind.__init__).parameters.items())[1:]:
            defaults.setdefault(name, parameter.default)
    defaults["autoreset_mode"] = defaults["autoreset_mode"].value
    return [(f"`{name}`", f"`{default}`", meanings[name].rstrip(".")) for name, default in defaults.items()]


def setting_rows(schema: type, prefix: str = "") -> Iterator[Row]:
    """(key, type, default, meaning) of each setting; `prefix` is what its key begins with."""
    hints, meanings, default = get_type_hints(schema), _comments(schema), schema()
    for each in fields(schema):
        key, value = f"{prefix}{each.name}", getattr(default, each.name)
        if is_dataclass(value) and not isinstance(value, AgentConfig | EnvConfig):
            yield from setting_rows(type(value), f"{key}.")
        elif each.name not in _NOT_SHOWN and not isinstance(value, AgentConfig | EnvConfig):
            meaning = meanings.get(each.name) or _yaml_comments().get(key) or _of_sb3(schema)
            yield f"`{key}`", f"`{_type(hints[each.name])}`", _value(value), _cell(meaning)


def _of_sb3(schema: type) -> str:
    return "as in Stable-Baselines3" if schema.__module__.startswith("gridworld.agents.sb3") else ""


def command_rows(name: str) -> Iterator[Row]:
    """(option, meaning) of each option of a command."""
    module = importlib.import_module(f"gridworld.commands.{name}")
    parser = module._parser(conf_folder()) if name == "tune" else module._parser()
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        shown = ", ".join(action.option_strings) or str(action.metavar or action.dest)
        if action.choices is not None:
            shown += f" {{{','.join(map(str, action.choices))}}}"
        yield f"`{shown}`", _cell(action.help or "")


def _agents() -> str:
    parts = []
    for name, schema in sorted(agent_schemas().items()):
        rows = setting_rows(schema, "agent.")
        parts.append(f"### `{name}`\n\n{inspect.getdoc(schema)}\n\n{_settings(rows)}")
    return "\n\n".join(parts)


def _worlds() -> str:
    parts = []
    for name, schema in SOURCES.items():
        parts.append(f"### `{name}`\n\n{inspect.getdoc(schema)}\n\n{_settings(setting_rows(schema, 'env.'))}")
    return "\n\n".join(parts)


def _commands() -> str:
    parts = []
    for name, about in COMMANDS.items():
        table = (
            "Settings of the tables above, and `--config-dir`, `-m`, `--cfg job`, ... of Hydra's."
            if name == "train"
            else _table(("option", ""), command_rows(name))
        )
        parts.append(f"### `{name}`\n\n{about[0].upper()}{about[1:]}.\n\n{table}")
    return "\n\n".join(parts)


def _launchers() -> str:
    return "\n\n".join(
        f"### `hydra/launcher={name}`\n\n{_settings(setting_rows(schema, 'hydra.launcher.'))}"
        for name, schema in LAUNCHER_SCHEMAS.items()
    )


def _settings(rows: Any) -> str:
    return _table(("key", "type", "default", ""), rows)


def _table(head: Row, rows: Any) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _comments(schema: type) -> dict[str, str]:
    """By field: the comment behind it or, where there is none, the comment lines above it."""
    found: dict[str, str] = {}
    for kind in reversed(schema.__mro__[:-1]):
        source = inspect.cleandoc(inspect.getsource(kind))
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        comments = {token.start[0]: token.string for token in tokens if token.type == tokenize.COMMENT}
        lines = source.splitlines()
        [body] = ast.parse(source).body
        assert isinstance(body, ast.ClassDef)
        for node in body.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                behind = " ".join(
                    _NOQA.sub("", comments[line]).strip("# ")
                    for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
                    if line in comments
                ).strip()
                above = (
                    comments.get(node.lineno - 1, "") if lines[node.lineno - 2].lstrip()[:1] == "#" else ""
                )
                text = behind or above.strip("# ")
                if text:
                    found[node.target.id] = text
    return found


@cache
def _yaml_comments() -> dict[str, str]:
    """By dotted key: the comment at its line in a yaml file that ships settings."""
    conf, found = conf_folder(), {}
    files = {conf / "train.yaml": "", conf / "tune.yaml": ""}
    files |= {conf / "hydra" / "launcher" / f"{name}.yaml": "hydra.launcher." for name in LAUNCHER_SCHEMAS}
    for file, prefix in files.items():
        above: list[tuple[int, str]] = []
        for line in file.read_text("utf-8").splitlines():
            match = re.match(r"^( *)([\w]+):(?:[^#]*?)(?:  # (.*))?$", line)
            if not match:
                continue
            depth, name, comment = len(match[1]), match[2], match[3]
            above = [(d, n) for d, n in above if d < depth] + [(depth, name)]
            if comment:
                found[prefix + ".".join(n for _, n in above)] = comment
    return found


def _type(hint: Any) -> str:
    """`int or null`, of `Optional[int]`."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    names = ("null" if kind is type(None) else str(getattr(kind, "__name__", kind)) for kind in kinds)
    return " or ".join(names)


def _value(value: Any) -> str:
    return "null" if value is None else _cell(f"`{value}`")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


TABLES = {
    "environment": lambda: _table(("argument", "default", ""), environment_rows()),
    "maps": lambda: ", ".join(f"`{name}`" for name in shipped_layouts()),
    "train": lambda: _settings(setting_rows(TrainConfig)),
    "worlds": _worlds,
    "agents": _agents,
    "sweeps": lambda: _settings(setting_rows(SweepConfig, "hydra.sweeper.")),
    "launchers": _launchers,
    "tune": lambda: _settings(setting_rows(TuneConfig, "tune.")),
    "dimension": lambda: _settings(setting_rows(DimensionConfig)),
    "commands": _commands,
}
