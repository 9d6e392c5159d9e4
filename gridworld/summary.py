"""A run's summary as a short table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gridworld.terminal import printable

Summary = dict[str, Any]

_ROWS = (
    ("value", "value", "optimal_value"),
    ("goal probability", "goal_probability", "optimal_goal_probability"),
    ("episode length", "length", "optimal_length"),
)


def summary_text(summary: Summary, folder: str) -> str:
    """What was reached beside what could be, the verdict, and where everything is."""
    agent, env, seed = summary["agent"], summary["env"], summary["seed"]
    steps, seconds = summary["timesteps"], summary["train_seconds"]
    lines = [
        f"{agent} on {env}, seed {seed}: {steps:,} steps in {seconds:.1f} s",
        "",
        f"  {'':<18}{'greedy':>10}{'sampled':>10}{'optimum':>10}",
    ]
    for label, key, optimal in _ROWS:
        numbers = (summary[key], summary["sampled"][key], summary[optimal])
        lines.append(f"  {label:<18}" + "".join(f"{number:>10.4g}" for number in numbers))
    regrets = (max(0.0, summary["regret"]), max(0.0, summary["sampled"]["regret"]))
    lines.append(f"  {'regret':<18}" + "".join(f"{regret:>10.3g}" for regret in regrets) + f"{0:>10}")
    look = f"tensorboard --logdir {folder}"
    lines += ["", f"  {verdict(summary)}", f"  files: {folder}", f"  curves: {look}"]
    return "\n".join(map(printable, lines))


def verdict(summary: Summary) -> str:
    """Whether the final greedy policy is optimal, in a sentence."""
    if summary["certified"]:
        return f"certified optimal since step {summary['certified_since_step']:,}"
    circles = circles_text(summary["endless_cells"], summary["timeout_probability"])
    return f"not optimal: regret {summary['regret']:.3g}{circles}"


def circles_text(cells: Sequence[Sequence[int]], timeout_probability: float) -> str:
    """Half a sentence on a policy that never ends, or nothing."""
    if not cells:
        return ""
    shown = ", ".join(f"({row},{col})" for row, col in cells[:8])
    more = f" and {len(cells) - 8} more" if len(cells) > 8 else ""
    return (
        f"; it walks in circles until the time is out (probability {timeout_probability:.3g}), "
        f"in cells (row,column) {shown}{more}"
    )
