"""What a command prints when its run ends: the summary as a short table, or how much is saved."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gridworld.process.console.columns import aligned
from gridworld.process.console.terminal import printable
from gridworld.process.signals import Interrupted
from gridworld.run.folder import EVENTS, RunFolder, shown
from gridworld.run.reader import read_run
from gridworld.world.metrics import METRICS

Summary = dict[str, Any]


def train_and_tell(folder: Path, train: Callable[[], Summary]) -> Summary:
    """Train, and print what comes of it; ends the program if training is interrupted.

    Args:
        folder: The run's folder.
        train: Trains in it.

    Returns:
        The run's summary.
    """
    try:
        summary = train()
    except Interrupted as interruption:
        run = read_run(folder)
        print(interruption_text(interruption, run, run.manifest), file=sys.stderr)
        sys.exit(interruption.exit_code)
    try:
        place = shlex.quote(shown(folder))
        print(summary_text(summary, place))
        if any(folder.glob(EVENTS)):
            print(printable(f"  curves: tensorboard --logdir {place}"), flush=True)
    except BrokenPipeError:  # the reader has left, as `| head` does; the files are written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return summary


def interruption_text(interruption: Interrupted, run: RunFolder, manifest: Mapping[str, Any]) -> str:
    """How much of an interrupted run is saved, by its manifest, and the command that resumes it."""
    saved, reached = manifest.get("checkpoint"), manifest.get("reached")
    if not saved:
        what = "nothing is saved, so that it will begin anew"
    elif saved == reached:
        what = f"all {saved:,} steps are saved"
    else:
        what = f"saved are {saved:,} of its {reached:,} steps"
    return printable(f"{interruption}: {what}; go on with  {run.resume_command(manifest['config'])}")


def summary_text(summary: Summary, folder: str) -> str:
    """The result beside the optimum, the verdict, and where the files are.

    Args:
        summary: The content of summary.json.
        folder: The run's folder, quoted for a shell.

    Returns:
        Several lines, printable.
    """
    agent, env, seed = summary["agent"], summary["env"], summary["seed"]
    steps, seconds = summary["timesteps"], summary["train_seconds"]
    rows = [
        ["", "greedy", "sampled", "optimum"],
        ["without a step limit:", "", "", ""],
        *_rows(summary, within_limit=False),
        [f"within {summary['max_episode_steps']:,} steps:", "", "", ""],
        *_rows(summary, within_limit=True),
    ]
    lines = [
        f"{agent} on {env}, seed {seed}: {steps:,} steps in {seconds:.1f} s",
        "",
        *(f"  {line}" for line in aligned(rows, ("<21", ">9", ">9", ">9"))),
        "",
        f"  {verdict(summary)}",
        f"  files: {folder}",
    ]
    return "\n".join(map(printable, lines))


def _rows(summary: Summary, within_limit: bool) -> list[list[str]]:
    rows = []
    for metric in METRICS:
        if metric.is_headline and metric.in_tables and metric.within_limit == within_limit:
            best = summary.get(f"optimal_{metric.name}", metric.known_optimum)
            found = (summary[metric.name], summary["sampled"][metric.name], best)
            rows.append([*metric.row(*found)])
    return rows


def verdict(summary: Summary) -> str:
    """Whether the final greedy policy is optimal, in a sentence."""
    truth = f" (world: {summary['truth']})" if "truth" in summary else ""
    if summary["certified"]:
        return f"certified optimal since step {summary['certified_since_step']:,}{truth}"
    circles = circles_text(summary["endless_cells"], summary["timeout_probability"])
    return f"not optimal: regret {summary['regret']:.3g}{circles}{truth}"


def circles_text(cells: Sequence[Sequence[int]], timeout_probability: float) -> str:
    """Half a sentence on a policy that never ends; "" where it does.

    Args:
        cells: the states in which it walks for ever: (row, column) on a map, else (number,).
        timeout_probability: How probable it is that an episode is cut off by the step limit.
    """
    if not cells:
        return ""
    are_of_a_map = len(cells[0]) == 2
    shown = ", ".join(f"({each[0]},{each[1]})" if are_of_a_map else str(each[0]) for each in cells[:8])
    more = f" and {len(cells) - 8} more" if len(cells) > 8 else ""
    return (
        f"; it walks in circles until the time is out (probability {timeout_probability:.3g}), "
        f"in {'cells (row,column)' if are_of_a_map else 'states'} {shown}{more}"
    )
