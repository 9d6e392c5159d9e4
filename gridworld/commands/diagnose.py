"""Explain why a finished run is not optimal: where its regret comes from, its cause, and what to try."""

from __future__ import annotations

import argparse
import shutil
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import replace

from gridworld.base.console import aligned, duration, printable, tell, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.safe_read import check_no_link
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.config.compose import compose
from gridworld.diagnosis.evidence import Evidence
from gridworld.diagnosis.verdict import (
    Diagnosis,
    check_trusted,
    diagnose,
    draw_diagnosis,
    trials_folder,
    try_offers,
)
from gridworld.run.folder import shown
from gridworld.training.saved_run import SavedRun
from gridworld.visualization.files import save

PICTURE = "diagnosis.png"
_MOST_ROWS = 8
_NARROW, _WIDE = 80, 100  # columns of what is read
_OTHER_COLUMNS = 56  # of a table, beside the states' names
_NONE = 1  # the exit code


@limited()
def main(arguments: Sequence[str]) -> None:
    """Print the diagnosis, and draw it in the run's folder; code 1 where nothing tried is certified."""
    options = _parser().parse_args(arguments)
    with telling_if_slow(f"diagnosing {options.run}"):
        saved = SavedRun(options.run, options.trust)
        run = Evidence.of(saved)
        found = diagnose(run)
    print(printable(f"greedy policy of {options.run} on {saved.mdp.name}"))
    width = min(max(shutil.get_terminal_size().columns, _NARROW), _WIDE)
    if found.findings:
        print(_table(found, width))
    print(*textwrap.wrap(printable(found.sentence()), width, break_on_hyphens=False), sep="\n")
    if found.findings and saved.omission:
        print(printable(saved.omission))
    elif found.commands:
        print("Try, one at a time:")
        for line, words in zip(found.commands, found.offers, strict=True):
            print(printable(f"  {line}"))  # whole, to be copied
            print(_price(saved, run, words), end="")
    if found.findings:
        path = options.run / PICTURE
        try:
            check_no_link(path)
            save(draw_diagnosis(found), path, fps=1)
            print(f"{shown(path)} shows where the regret comes from")
        except (InputError, OSError) as error:  # the diagnosis is of use without it
            tell(f"{path}: not drawn ({error})")
    if options.try_offers and found.findings:
        check_trusted(saved, found, options.trust)
        if not _is_any_certified(saved, found, options):
            sys.exit(_NONE)


def _price(saved: SavedRun, run: Evidence, words: Sequence[str]) -> str:
    """A line with the steps of an offer, and about how long they take by the run's own speed.

    Time grows with the updates and with the steps of the batch of environments, of which an update takes
    about as long as four. Nothing where the words cannot be composed here.
    """
    try:
        offer = replace(run, config=compose(words, lambda env: saved.mdp))
    except InputError:
        return ""
    work, own = (each.updates + each.steps / each.config.n_envs / 4 for each in (offer, run))
    summary = saved.run.read_summary()
    share = min(summary["timesteps"] / run.steps, 1.0)  # it may have ended early
    seconds = summary["train_seconds"] * work / own / max(share, 1e-9)
    return f"    {offer.steps:,} steps, about {duration(max(seconds, 1.0))}\n"


def _is_any_certified(saved: SavedRun, found: Diagnosis, options: argparse.Namespace) -> bool:
    """Train what there is to try, and print the results."""
    print("Trying:")
    certified = False
    for trial in try_offers(saved, found, trials_folder(options.run), options.trust):
        certified = trial.certified
        end = trial.why or ("certified optimal" if certified else f"regret {trial.regret:.3g}, not certified")
        print(printable(f"  {trial.command}"))
        print(printable(f"    {end}: {shown(trial.folder)}"), flush=True)
    if not certified:
        print("None of them is certified.")
    return certified


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("diagnose", __doc__, "run", "--trust", example="runs/mine --try")
    tried = "train the suggestions, in RUN-tried, until one is certified; exit code 1 if none is"
    parser.add_argument("--try", dest="try_offers", action="store_true", help=tried)
    return parser


def _table(found: Diagnosis, width: int) -> str:
    """The states that cost most, with their cause."""
    room = width - _OTHER_COLUMNS
    split = found.split
    rows = [["state", "takes", "visits", "lost", "regret", "cause"]]
    costly = [state for state in (-split.cost).argsort(kind="stable").tolist() if found.cause_of[state] >= 0]
    for state in costly[:_MOST_ROWS]:
        action = found.mdp.action_names[found.greedy[state]]
        numbers = [f"{each[state]:.3g}" for each in (split.visits, split.lost, split.cost)]
        cause = found.findings[found.cause_of[state]].cause
        name = found.mdp.state_name(state)
        name = name if len(name) <= room else f"{name[: room - 3]}..."
        rows.append([name, action, *numbers, f" {cause}"])
    if len(costly) > _MOST_ROWS:
        rest = float(split.cost[costly[_MOST_ROWS:]].sum())
        rows.append([f"and {len(costly) - _MOST_ROWS:,} more", "", "", "", f"{rest:.3g}", ""])
    return "\n".join(printable(f"  {line}") for line in aligned(rows, ("<14", "<8", ">9", ">9", ">9", "<14")))
