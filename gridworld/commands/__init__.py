"""A module per command, behind the console command `gridworld` and the files in `scripts/`.

A module has `main(words)`, which gets the words of the command line.
"""

from __future__ import annotations

import argparse
import difflib
import math
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from gridworld.base.bounds import Bounds, digits
from gridworld.base.console import CONSOLE, as_called, prepare, printing, program, tell_error
from gridworld.base.errors import DISTRIBUTION, EXIT_CODE, InputError, failure
from gridworld.base.signals import Interrupted, at_work

# By name, in the order of the manual: what it does.
COMMANDS = {
    "train": "train an agent, resume a run, or run a sweep",
    "jobs": "show the status of a sweep's jobs",
    "evaluate": "score a finished run again, exactly and by sampling",
    "verify": "prove how good finished runs are, by certificates that anybody can check",
    "diagnose": "explain why a finished run is not optimal, and what to try",
    "record": "draw a finished run's episodes and maps",
    "report": "compare many runs on one page",
    "export": "export finished runs to W&B, MLflow or the Hugging Face Hub",
    "reproduce": "repeat a finished run and compare it bit for bit",
    "tune": "tune an agent's settings for a task, and confirm the winner",
    "check": "check an algorithm's implementation on worlds with known answers",
    "examine": "examine an environment: why nothing learns in it",
    "play": "play a world yourself, next to a trained agent if you like",
    "playground": "draw worlds and watch Q-learning at work, in the browser",
}
_MANUAL = """\
Train Stable-Baselines3 agents on worlds small enough to solve exactly, and know
whether they are optimal, and if not, why.

usage: {console} COMMAND ...

Commands:
{commands}

Help for a command: {console} COMMAND --help

Version: {console} --version

Examples:
  {console} train agent=dqn
  {console} evaluate runs/...
  {console} train -m agent=dqn,ppo "seed=range(20)" hydra.sweep.dir=runs/mine
  {console} report runs/mine"""
_WIDEST = 112  # columns of a help text
_BEST = "use the model with the lowest exact regret, not the last one"
_TRUST = "import the classes that the run names, from any package, and let its environment draw"
_POLICY = "the best action, or the distribution that it explores with"
_SHARED: dict[str, dict[str, Any]] = {  # arguments that several commands have
    "run": {"type": Path, "metavar": "RUN", "help": "the run's folder, e.g. runs/2026-..."},
    "runs": {"type": Path, "nargs": "+", "metavar": "RUNS", "help": "folders, searched for runs"},
    "--policy": {"choices": ("greedy", "sampled"), "default": "greedy", "help": _POLICY},
    "--best": {"action": "store_true", "help": _BEST},
    "--trust": {"action": "store_true", "help": _TRUST},
    "--config-dir": {"action": "append", "default": [], "help": "a folder with your own yaml files"},
}


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise InputError(f"{self.prog}: {message}; see {self.prog} --help")


def parser_of(
    command: str, about: str | None, *shared: str, example: str = "", epilog: str = ""
) -> argparse.ArgumentParser:
    """The parser of a command that has these of the `_SHARED` arguments; its help ends with an `example`."""
    if example:
        epilog += f"\n\nExample:\n  python scripts/{command}.py {example}"
    parser = _Parser(
        prog=program(command),
        description=folded(about or ""),
        epilog=folded(epilog),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name in shared:
        parser.add_argument(name, **_SHARED[name])
    return parser


def folded(text: str) -> str:
    """A help text as wide as the terminal: paragraphs are filled, and what a table says hangs in its column.

    Command lines, which are to be copied, stay whole.
    """
    width, shown = min(shutil.get_terminal_size((_WIDEST, 0)).columns, _WIDEST) - 2, list[str]()
    fill = partial(textwrap.fill, width=width, break_long_words=False, break_on_hyphens=False)
    for line in re.sub(r"(?m)^(\S.*)\n(?=\S)", r"\1 ", as_called(text)).splitlines():
        name, gap, meaning = re.findall(r"( *(?:\S.*?(?=  |$))?)( *)(.*)", line)[0]
        hang = len(name + gap) if meaning else len(line) - len(line.lstrip())
        if re.match(rf" +({CONSOLE}|python) ", line):
            shown.append(line)
        elif hang > width / 2:
            shown += [name, fill(meaning, initial_indent=" " * 8, subsequent_indent=" " * 8)]
        else:
            shown.append(fill(line, subsequent_indent=" " * hang))
    return "\n".join(shown)


def whole(low: float = -math.inf, high: float = math.inf) -> Callable[[str], int]:
    """The type of an option that takes a whole number, which may be written as 1e5, within bounds."""

    def number(text: str) -> int:
        try:
            found = int(digits(text))
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a whole number, not {text}") from None
        if not low <= found <= high:
            raise argparse.ArgumentTypeError(f"{text}: must be {Bounds(low, high)}")
        return found

    return number


_OUT_OF_MEMORY = re.compile("failed to map|cannot allocate memory", re.IGNORECASE)  # of a library, at import


def call(command: str) -> None:
    """Run a command with the words in `sys.argv`."""
    run(import_module(f"gridworld.commands.{command}").main)


def run(main: Callable[[Sequence[str]], None]) -> None:
    """Call a command's `main`; a user's mistake ends the program with one sentence and no traceback.

    So does output that could not be written, whatever exit code `main` ends with.
    """
    prepare()
    try:
        with at_work(), printing():
            main(sys.argv[1:])
    except (InputError, OSError) as error:
        tell_error(str(error) if isinstance(error, InputError) else failure(error))
        sys.exit(EXIT_CODE)
    except (MemoryError, ImportError) as error:
        if not isinstance(error, MemoryError) and not _OUT_OF_MEMORY.search(str(error)):
            raise
        tell_error(
            f"there is not enough memory ({str(error)[:80] or 'MemoryError'}); free some, or raise ulimit -v"
        )
        sys.exit(EXIT_CODE)
    except Interrupted as interruption:
        print(str(interruption), file=sys.stderr)
        sys.exit(interruption.exit_code)
    except KeyboardInterrupt:
        sys.exit(130)


def console() -> None:
    """Run `gridworld`'s command line in `sys.argv`: its first word names a command, which gets the rest."""
    name, words = sys.argv[1] if len(sys.argv) > 1 else "", sys.argv[2:]
    if name not in COMMANDS:
        run(_without_command)
        return
    sys.argv = [f"{CONSOLE} {name}", *words]  # what the command and its messages go by
    call(name)


def _without_command(words: Sequence[str]) -> None:
    """Print the manual or the version."""
    word = words[0] if words else "--help"
    if word in ("--help", "-h", "help"):
        commands = "\n".join(f"  {name:<12}{about}" for name, about in COMMANDS.items())
        print(folded(_MANUAL.format(console=CONSOLE, commands=commands)))
        return
    if word == "--version":
        from importlib.metadata import version

        print(f"{CONSOLE} {version(DISTRIBUTION)}")
        return
    close = difflib.get_close_matches(word.removesuffix(".py"), COMMANDS, n=1)
    advice = f"did you mean {CONSOLE} {close[0]}?" if close else f"it is one of {', '.join(COMMANDS)}"
    if not close and "=" in word:
        advice = f"settings come after a command: {CONSOLE} train {word}"
    course = "marking is a script of the course: python docs/course/grade.py"
    advice = {"sweep": f"a sweep is {CONSOLE} train -m", "grade": course}.get(word, advice)
    raise InputError(f"{CONSOLE}: unknown command {word}; {advice}")
