"""What a command prints when its run ends: the summary as a short table, or how much is saved."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gridworld.base.console import aligned, coloured, printable
from gridworld.base.signals import Interrupted
from gridworld.base.user_input import users_folder
from gridworld.run.folder import EVENTS, RunFolder, shell_path
from gridworld.run.reader import read_run
from gridworld.world.mdp import BY_CONSTRUCTION
from gridworld.world.metrics import METRICS
from gridworld.world.proof import at_most

Summary = dict[str, Any]

MOST_NAMED = 5  # states of a policy that loops
_ROUNDING = 1e-9  # of a probability
_MOST_SELECTED = 40  # runs: of more TensorBoard selects none


def train_and_tell(
    folder: Path, train: Callable[[], Summary], advise: Callable[[Path], list[str]]
) -> Summary:
    """Train and print the summary, with advice if the run is not certified; exits if it is interrupted."""
    try:
        summary = train()
    except Interrupted as interruption:
        run = read_run(folder)
        print(interruption_text(interruption, run, run.manifest), file=sys.stderr)
        sys.exit(interruption.exit_code)
    is_good, shown = summary["certified"], printable(verdict(summary))
    text = summary_text(summary, shell_path(folder), [] if is_good else advise(folder))
    print(text.replace(f"\n  {shown}\n", f"\n  {coloured(shown, is_good)}\n"))
    if any(folder.glob(EVENTS)):
        print(f"  curves: tensorboard --logdir {shell_path(_logs(folder.absolute()))}", flush=True)
    return summary


def _logs(folder: Path) -> Path:
    """What TensorBoard is to show of a run: the folder above, since it calls a run that is alone "."."""
    above = folder.parent
    beside = itertools.chain(above.glob(f"*/{EVENTS}"), above.glob(f"*/*/{EVENTS}"))
    are_few = len(list(itertools.islice(beside, _MOST_SELECTED + 1))) <= _MOST_SELECTED
    return above if are_few and above != users_folder() else folder


def interruption_text(interruption: Interrupted, run: RunFolder, manifest: Mapping[str, Any]) -> str:
    """How much of an interrupted run is saved, by its manifest, and the command that resumes it."""
    saved, reached = manifest.get("checkpoint"), manifest.get("reached")
    if not saved:
        what = "nothing is saved, so it will start over"
    elif saved == reached:
        what = f"all {saved:,} steps are saved"
    else:
        what = f"{saved:,} of its {reached:,} steps are saved"
    return printable(f"{interruption}: {what}; resume with  {run.resume_command(manifest['config'])}")


def summary_text(summary: Summary, folder: str, advice: Sequence[str] = ()) -> str:
    """The result beside the optimum, the verdict, what to do next, and where the files are, as lines."""
    agent, env, seed = summary["agent"], summary["env"], summary["seed"]
    steps, seconds = summary["timesteps"], summary["train_seconds"]
    rows = [
        ["", "greedy", "sampled", "optimum", ""],
        ["without a step limit:", "", "", "", ""],
        *_rows(summary, within_limit=False),
        [f"within {summary['max_episode_steps']:,} steps:", "", "", "", ""],
        *_rows(summary, within_limit=True),
    ]
    lines = [
        f"{agent} on {env}{_made_of(summary)}, seed {seed}: {steps:,} steps in {seconds:.1f} s",
        "",
        *(f"  {line}" for line in aligned(rows, ("<21", ">9", ">9", ">9", "<0"))),
        "",
        f"  {verdict(summary)}",
        *([f"  world: {scope}"] if (scope := scope_of(summary)) else []),
        *([f"  privileges: {', '.join(summary['privileges'])}"] if summary["privileges"] else []),
        *(f"  {line}" for line in advice),
        f"  files: {folder}",
    ]
    return "\n".join(map(printable, lines))


def _made_of(summary: Summary) -> str:
    """Where its settings come from, if not from the agent alone."""
    return "" if summary["recipe"] is None else f", recipe {summary['recipe']}"


def _rows(summary: Summary, within_limit: bool) -> list[list[str]]:
    rows = []
    for metric in METRICS:
        if metric.is_headline and metric.in_tables and metric.within_limit == within_limit:
            best = summary.get(f"optimal_{metric.name}", metric.known_optimum)
            found = (summary[metric.name], summary["sampled"][metric.name], best)
            rows.append([*metric.row(*found), _trade(metric.name, summary)])
    return rows


def _trade(name: str, summary: Summary) -> str:
    """Why a policy that is worse than the optimum may reach the goal more often."""
    if name != "goal_probability" or summary["certified"]:
        return ""
    is_above = summary[name] > summary[f"optimal_{name}"] + _ROUNDING
    return "  more often than the optimum, but worth less" if is_above else ""


def verdict(summary: Summary) -> str:
    """Whether the final greedy policy is optimal, in a sentence."""
    if summary["certified"]:
        # Of earlier runs it is not known, and without a discount there is no proof.
        floating = ", by floating point" if summary.get("proven_regret", "") is None else ""
        return f"certified optimal since step {summary['certified_since_step']:,}{floating}"
    count, names = len(summary["endless_cells"]), summary["endless_states"]
    if summary["optimal_length"] >= summary["max_episode_steps"]:  # then the optimum does not end either
        count = 0
    loops = circles_text(count, names, summary["timeout_probability"])
    return shortfall_text(summary["regret"], summary.get("proven_regret"), loops)


def shortfall_text(regret: float, proven: float | None, loops: str) -> str:
    """What a policy that is not certified lacks: `proven` bounds a regret that is small by floats."""
    regret = max(regret, 0.0)
    if proven is not None or not regret:
        most = "" if proven is None else f", and at most {at_most(proven)} by proof"
        return f"not proven optimal: regret {regret:.3g} by floating point{most}"
    return f"not optimal: regret {regret:.3g}{loops}"


def scope_of(summary: Summary) -> str:
    """How the tables of the world are known, which earlier runs said in fewer words; "" by construction."""
    scope = str(summary.get("scope", summary.get("truth", BY_CONSTRUCTION)))
    return "" if scope == BY_CONSTRUCTION else scope


def circles_text(count: int, names: Sequence[str], timeout_probability: float) -> str:
    """Half a sentence on a policy that loops in `count` states, the first few with `names`; "" if none."""
    if not count:
        return ""
    *others, last = [*names, f"{count - len(names)} more states"] if count > len(names) else names
    where = f"moves between {'; '.join(others)} and {last}" if others else f"stays in {last}"
    chance = "" if timeout_probability > 0.9995 else f" (probability {timeout_probability:.3g})"
    return f"; it {where} until the step limit{chance}"
