"""The console command `gridworld`: its first word names one of the commands, which gets the rest."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Sequence
from importlib import import_module

from gridworld.commands import run
from gridworld.errors import InputError
from gridworld.process.console import CONSOLE

# By name, in the order of the manual: what it does.
COMMANDS = {
    "train": "train an agent, resume a run, or run a sweep",
    "jobs": "show how the jobs of a sweep stand",
    "evaluate": "score a finished run again, exactly and by sampling",
    "diagnose": "say why a finished run is not optimal, and what to try",
    "record": "export a finished run's episodes and pictures",
    "report": "put many runs side by side, as one page",
    "export": "hand finished runs to W&B, MLflow or the Hugging Face Hub",
    "reproduce": "run a run again and compare bit for bit",
    "tune": "search an agent's settings for a task, and confirm the winner",
    "check": "check an algorithm's implementation on worlds with known answers",
    "play": "play a world with the arrow keys, beside a trained agent if you like",
    "benchmark": "measure the speed of this project beside its peers",
}
_MANUAL = """\
A Stable-Baselines3 experiment harness whose ground truth is known.

usage: {console} COMMAND ...

Commands:
{commands}

What a command takes: {console} COMMAND --help
The version: {console} --version

Examples:
  {console} train agent=dqn
  {console} evaluate runs/...
  {console} train -m agent=dqn,ppo "seed=range(20)" hydra.sweep.dir=runs/mine
  {console} report runs/mine
"""


def main() -> None:
    """Run the command line in `sys.argv`."""
    name, words = sys.argv[1] if len(sys.argv) > 1 else "", sys.argv[2:]
    if name not in COMMANDS:
        run(_without_command)
        return
    sys.argv = [f"{CONSOLE} {name}", *words]  # what the command and its messages go by
    module = import_module(f"gridworld.commands.{name}")
    if name == "train":  # Hydra has its own ways to end
        module.main()
    else:
        run(module.main)


def _without_command(words: Sequence[str]) -> None:
    """Print the manual or the version."""
    word = words[0] if words else "--help"
    if word in ("--help", "-h", "help"):
        commands = "\n".join(f"  {name:<11}{about}" for name, about in COMMANDS.items())
        print(_MANUAL.format(console=CONSOLE, commands=commands).rstrip())
    elif word == "--version":
        from gridworld import __version__

        print(f"{CONSOLE} {__version__}")
    else:
        close = difflib.get_close_matches(word.removesuffix(".py"), COMMANDS, n=1)
        advice = f"did you mean {CONSOLE} {close[0]}?" if close else f"it is one of {', '.join(COMMANDS)}"
        if not close and "=" in word:
            advice = f"settings stand after a command: {CONSOLE} train {word}"
        raise InputError(f"{CONSOLE}: there is no command {word}; {advice}")
