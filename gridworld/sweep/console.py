"""Terminal output of a sweep at its start and at its end."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from pathlib import Path

from gridworld.errors import reason
from gridworld.process.console import command_line, duration, printable, tell_error
from gridworld.sweep.job_table import DONE, FAILED, INTERRUPTED, JOBS_CSV, PENDING, RUNNING, STATUSES, JobRow
from gridworld.sweep.results import results_lines

_MOST_LISTED = 50  # of a kind, on the terminal; jobs.csv has them all


def counts_text(rows: Iterable[JobRow]) -> str:
    """The number of jobs by status: "3 jobs: 2 done, 1 failed"."""
    counts = Counter(row.status for row in rows)
    parts = [f"{counts[status]} {status}" for status in STATUSES if counts[status]]
    return f"{counts.total()} {'job' if counts.total() == 1 else 'jobs'}: {', '.join(parts)}"


def tell_start(folder: Path, rows: Sequence[JobRow], to_run: int) -> None:
    """Print how the jobs stand and how many of them are run now."""
    print(f"sweep {shell_path(folder)}: {counts_text(rows)}; {to_run} to run", file=sys.stderr, flush=True)


def tell_end(
    folder: Path, rows: Sequence[JobRow], seconds: float, stopped: str, mistakes: Container[str]
) -> None:
    """Print the results, how the jobs stand, why some did not end well, and how to go on with the rest.

    Args:
        folder: the sweep's folder.
        rows: of the jobs that were asked for.
        seconds: how long it took.
        stopped: why the sweep was stopped, or "".
        mistakes: jobs that would fail again, as their settings are wrong.
    """
    print(f"sweep {shell_path(folder)}: {counts_text(rows)}, in {duration(seconds)}")
    results = results_lines(folder, rows)
    for line in ("", *results[: _MOST_LISTED + 1], "") if results else ():
        print(printable(f"  {line}".rstrip()))
    if len(results) > _MOST_LISTED + 1:
        print(f"  and {len(results) - _MOST_LISTED - 1} more; the report has all")
    print(f"  jobs: {shell_path(folder / JOBS_CSV)}\n  curves: tensorboard --logdir {shell_path(folder)}")
    if results:
        print(f"  report: {_report_command(folder)}")
    sys.stdout.flush()
    failed = [row for row in rows if row.status == FAILED]
    halted = [row for row in rows if row.error and row.status in (PENDING, INTERRUPTED)]
    _list("interrupted", halted)
    _list("failed", failed)
    if stopped:
        print(f"{stopped}; go on with: {resume_command(folder)}", file=sys.stderr)
    elif any(row.job not in mistakes for row in failed):
        retry = "hydra.sweeper.retry_failed=true"
        print(f"to try them again: {resume_command(folder, retry)}", file=sys.stderr)
    elif any(row.status == RUNNING for row in rows):
        print(f"the rest runs elsewhere; to see how it goes: {resume_command(folder)}", file=sys.stderr)
    elif any(row.status not in (DONE, FAILED) for row in rows):
        print(f"the rest did not come to its end; go on with: {resume_command(folder)}", file=sys.stderr)
    sys.stderr.flush()


def _list(what: str, rows: Sequence[JobRow]) -> None:
    if rows:
        print(f"{what}:", file=sys.stderr)
    for row in rows[:_MOST_LISTED]:
        print(printable(f"  {row.overrides}: {row.error}"), file=sys.stderr)
    if len(rows) > _MOST_LISTED:
        print(f"  and {len(rows) - _MOST_LISTED} more; {JOBS_CSV} has all", file=sys.stderr)


def tell_stopped_by(error: OSError, folder: Path) -> None:
    """Print why the sweep cannot go on, such as a full disk, and how to go on once that is put right."""
    tell_error(
        f"{shell_path(folder)}: {reason(error)}; put that right, then go on with: {resume_command(folder)}"
    )


def resume_command(folder: Path, *more: str) -> str:
    """This command line with `more` words, and with the folder if it does not name it."""
    words = command_line()
    if not any(word.startswith("hydra.sweep.dir=") for word in words):
        more = (f"hydra.sweep.dir={folder}", *more)
    return printable(shlex.join([*words, *(word for word in more if word not in words)]))


def _report_command(folder: Path) -> str:
    words = command_line()
    if words[0] == "python":
        words[1] = str(Path(words[1]).with_name("report.py"))
    else:
        words[1] = "report"
    return f"{printable(shlex.join(words[:2]))} {shell_path(folder)}"


def shell_path(folder: Path) -> str:
    """The folder as a user would type it here, quoted where a shell needs it."""
    path = folder.absolute()
    here = Path.cwd()
    return printable(shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path)))
