"""Tab completion in bash, `eval "$(gridworld --completion)"`: of `gridworld` and of the files in `scripts/`.

The shell's function asks `gridworld --complete LINE`. Choices and options are read from the files that have
them, since importing Hydra and the commands would take a second for each press of the key.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from gridworld.commands.shell.console import COMMANDS
from gridworld.config.composition.conf_folder import conf_folder, own_conf_folders
from gridworld.run.folder import MANIFEST, SWEEP_JSON

BASH = """\
_gridworld_complete() {
    local line=${COMP_LINE:0:COMP_POINT} IFS=$'\\n'
    [[ $1 == *python* && ! $line =~ scripts/[a-z]+\\.py[[:space:]] ]] && return
    COMPREPLY=($(gridworld --complete "$line" 2>/dev/null))
    local word=${line##*[[:space:]]}
    [[ $COMP_WORDBREAKS == *=* ]] || word=  # else bash replaces what stands after the sign
    COMPREPLY=("${COMPREPLY[@]#"${word%"${word##*=}"}"}")
    [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} != *[=./] ]] && COMPREPLY[0]+=' '
}
complete -o bashdefault -o default -o nospace -F _gridworld_complete gridworld python python3
"""
_OF_TRAIN = (  # Hydra's options
    *("--help", "--hydra-help", "--version", "--cfg", "--resolve", "--package", "--multirun"),
    *("--config-dir", "--config-name", "--config-path", "--info"),
)
_FOLDERS = ("resume", "recipe", "hydra.run.dir", "hydra.sweep.dir")
_SWEEP_KEYS = ("retry_failed", "stop_at_first_failure", "extend", "max_jobs", "paired")
_SCHEMA = re.compile(r"/agent/schema/(\w+)@agent")


def complete(line: str) -> list[str]:
    """What may stand in place of the last word of a command line.

    Args:
        line: the command line up to the cursor.

    Returns:
        Whole words, sorted. None: the shell completes files.
    """
    words = line.split()
    word = "" if not line or line[-1].isspace() else words.pop()
    if words and re.fullmatch(r"(.*/)?python[\d.]*", words[0]):
        del words[0]
    if not words:
        return []
    if not words[0].endswith(".py"):
        del words[0]
        if not words:
            return _starting([*COMMANDS, "--help", "--version", "--completion"], word)
    command = Path(words[0]).stem
    if command not in COMMANDS:
        return []
    if command in ("train", "tune") and not word.startswith("-"):
        return _overrides(word, words[1:], command)
    return _arguments(word, words[1:], command)


def _starting(names: Sequence[str], word: str) -> list[str]:
    return sorted({name for name in names if name.startswith(word)})


def _arguments(word: str, earlier: Sequence[str], command: str) -> list[str]:
    options = _options(command)
    if word.startswith("-"):
        return _starting(list(options), word)
    last = earlier[-1] if earlier else ""
    if last in options and (options[last] or last not in ("--agent", "--trust", "--open")):
        return _starting(options[last], word)
    if command == "check":
        return _starting(_groups(())["agent"], word)
    return _folders(word)


def _options(command: str) -> dict[str, list[str]]:
    """The options of a command with the values that its code names for them."""
    if command == "train":
        return {option: [] for option in _OF_TRAIN}
    found: dict[str, list[str]] = {"--help": []}
    for call in _calls(command):
        if isinstance(call.func, ast.Attribute) and call.func.attr == "add_argument":
            strings = [each.value for each in ast.walk(call) if isinstance(each, ast.Constant)]
            name = next((each for each in strings if str(each).startswith("--")), None)
            if name is not None:
                found[str(name)] = list(_choices(call))
    return found


def _calls(command: str) -> Iterator[ast.Call]:
    """The calls in a command's module, and in what it calls in that of all commands."""
    here = Path(__file__).parents[1]
    own, shared = (ast.parse((here / f"{name}.py").read_text("utf-8")) for name in (command, "__init__"))
    functions = {each.name: each for each in shared.body if isinstance(each, ast.FunctionDef)}
    unread: list[ast.AST] = [own]
    while unread:
        for call in (node for node in ast.walk(unread.pop()) if isinstance(node, ast.Call)):
            if isinstance(call.func, ast.Name) and call.func.id in functions:
                unread.append(functions[call.func.id])
            yield call


def _choices(call: ast.Call) -> Iterator[str]:
    for keyword in call.keywords:
        if keyword.arg == "choices" and isinstance(keyword.value, ast.Tuple | ast.List):
            yield from (str(each.value) for each in keyword.value.elts if isinstance(each, ast.Constant))


def _overrides(word: str, earlier: Sequence[str], command: str) -> list[str]:
    key, equals, value = word.partition("=")
    groups = _groups(earlier)
    if not equals:
        if command != "tune":
            groups.pop("tune", None)
        names = [f"{name}=" for name in (*groups, *_settings(earlier, command))]
        depth = key.count(".") + 1
        cut = [name if name.count(".") < depth else ".".join(name.split(".")[:depth]) + "." for name in names]
        return _starting(cut, word)
    if key in _FOLDERS:
        return [f"{key}={folder}" for folder in _folders(value)]
    values = groups.get(key) or _values(key)
    before = value.rpartition(",")[0] + "," if "," in value else ""  # of a sweep
    return _starting([f"{key}={before}{each}" for each in values], word)


def _groups(words: Sequence[str]) -> dict[str, list[str]]:
    """The choices of every group, those in the folder that `--config-dir` names included."""
    found = {"hydra/launcher": ["basic"]}  # Hydra's own, in no folder of ours
    for folder in (conf_folder(), *own_conf_folders(words)):
        for file in folder.glob("**/*.yaml"):
            group = file.parent.relative_to(folder).as_posix()
            if group != ".":
                found.setdefault(group, []).append(file.stem)
    return found


def _settings(words: Sequence[str], command: str) -> list[str]:
    from gridworld.config.agents import agent_schemas
    from gridworld.config.composition.setting_names import settings_of_a_run
    from gridworld.config.tune import TuneConfig

    agent = next((word[6:] for word in reversed(words) if word.startswith("agent=")), "")
    file = conf_folder() / "agent" / f"{agent}.yaml"
    schema = _SCHEMA.search(file.read_text("utf-8")) if file.is_file() else None
    names = list(settings_of_a_run())
    if schema is not None:
        own = {f"agent.{field.name}" for field in dataclasses.fields(agent_schemas()[schema.group(1)])}
        names = [name for name in names if not name.startswith("agent.") or name in own]
    if command == "tune":
        return [*names, "recipe", *(f"tune.{field.name}" for field in dataclasses.fields(TuneConfig))]
    return [*names, *_FOLDERS, *(f"hydra.sweeper.{key}" for key in _SWEEP_KEYS)]


def _values(key: str) -> list[str]:
    if key == "env.layout":
        layouts = Path(__file__).parents[2] / "layouts"
        return ["classic", *(file.stem for file in layouts.glob("*.txt"))]
    from gridworld.config.composition.setting_names import settings_of_a_run

    return ["true", "false"] if settings_of_a_run().get(key) == (bool,) else []


def _folders(start: str) -> list[str]:
    """Folders below `start`: of a run or a sweep as they are, others with a slash."""
    place, found = start.rpartition("/")[0], []
    base = f"{place}/" if "/" in start else ""
    with contextlib.suppress(OSError):
        for folder in Path(base or ".").iterdir():
            if folder.is_dir() and f"{base}{folder.name}".startswith(start) and folder.name[0] != ".":
                is_end = (folder / MANIFEST).exists() or (folder / SWEEP_JSON).exists()
                found.append(f"{base}{folder.name}" + ("" if is_end else "/"))
    return sorted(found)
