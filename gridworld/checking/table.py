"""The findings as text."""

from __future__ import annotations

import textwrap

from gridworld.checking.run import CheckResult, Finding
from gridworld.process.console.terminal import aligned

_WIDTH = 100
_WORDS = {True: "passed", False: "FAILED", None: "-"}


def row(finding: Finding) -> str:
    """One finding, and below it what a failure means."""
    seeds = "" if finding.seeds == 1 else f" ({finding.seeds} seeds)"
    cells = [finding.name, _WORDS[finding.passed], f"{finding.seconds:.1f} s", f" {finding.found}{seeds}"]
    (line,) = aligned([cells], ("<12", "<7", ">7", "<0"))
    if finding.passed is False:
        line += "\n" + textwrap.indent(textwrap.fill(finding.meaning, _WIDTH), " " * 4)
    return line


def verdict(result: CheckResult) -> str:
    """The last line."""
    asked = sum(finding.passed is not None for finding in result.findings)
    if result.passed:
        return f"{result.name}: passed all {asked} probes, {result.seconds:.0f} s"
    return (
        f"{result.name}: failed {len(result.failed)} of {asked} probes ({', '.join(result.failed)}), "
        f"{result.seconds:.0f} s"
    )


def text(result: CheckResult) -> str:
    """The whole table."""
    return "\n".join([*map(row, result.findings), verdict(result)])
