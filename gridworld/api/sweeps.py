"""Many runs from Python: sweeps, tuning studies, reports and recordings, each by its command.

A command runs in a process of its own, as on a command line. So it works in a notebook and in a plain script,
whatever these have imported or started.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import secrets
import signal
import subprocess
import sys
from collections.abc import Sequence
from datetime import datetime
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

from gridworld.api.runs import RunResult, open_run
from gridworld.api.settings import Override, command_words
from gridworld.base.console import ProgressLine, printable
from gridworld.base.errors import InputError
from gridworld.base.user_input import as_path, limited
from gridworld.config.recipe_file import literal
from gridworld.report.tuning_study import TuningStudy, find_tunings
from gridworld.report.writer import PAGE
from gridworld.run.reader import read_run
from gridworld.sweeps import folder as sweep_folder
from gridworld.sweeps.console import counts_text, results_lines

# What the process does: it ends with this one, and gets Ctrl-C from this one alone.
_CALL = """\
import sys
from gridworld.__main__ import main
from gridworld.base.processes import end_with
end_with(int(sys.argv.pop(1)))
main()
"""
_PROGRESS = re.compile(r"(sweep|tune): \d")
_ERROR = re.compile(r"(?:gridworld \w+: )?error: (.*)")


class SweepResult:
    """A sweep, by its `folder`: what `sweep` and `open_sweep` return. A notebook shows its results."""

    def __init__(self, folder: Path) -> None:
        self.folder = as_path("SweepResult: folder", folder)
        self._sweep = sweep_folder.open_sweep(self.folder)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """For each job its settings, `status`, and the numbers of its summary if it is done."""
        rows = []
        for entry, row in zip(self._sweep.entries.values(), self._jobs(), strict=True):
            words = (word.partition("=") for word in entry.overrides)
            content: dict[str, Any] = {key.lstrip("+"): _value(text) for key, _, text in words}
            content |= {"status": row.status, "error": row.error, "folder": str(self.folder / row.job)}
            if row.status == sweep_folder.DONE:
                summary = read_run(self.folder / row.job).read_summary()
                content |= {k: each for k, each in summary.items() if not isinstance(each, dict | list)}
                if summary["certified"]:
                    content["regret"] = 0.0  # but for rounding
            rows.append(content)
        return rows

    @property
    def table(self) -> Any:
        """The rows as a DataFrame of pandas."""
        try:
            pandas = importlib.import_module("pandas")
        except ImportError:
            raise InputError("table: needs pandas, which is not installed; `rows` has the same") from None
        return pandas.DataFrame(self.rows)

    @property
    def runs(self) -> list[RunResult]:
        """Those that are done, in the order in which they were asked for."""
        return [open_run(self.folder / row.job) for row in self._jobs() if row.status == sweep_folder.DONE]

    def report(self) -> Path:
        """Write the report to the folder, as the command `report` does, and return its page."""
        _run_command("report", [str(self.folder)], progress=False)
        return self.folder / "report" / PAGE

    def _jobs(self) -> list[sweep_folder.JobRow]:
        return list(self._sweep.rows().values())

    def __repr__(self) -> str:
        return f"SweepResult({str(self.folder)!r}, {counts_text(self._jobs())})"

    def _repr_html_(self) -> str:
        table = "\n".join(map(printable, results_lines(self.folder, self._jobs())))
        return f"<p>{escape(repr(self))}</p><pre>{escape(table)}</pre>"


def sweep(
    *overrides: Override, folder: str | PathLike[str] | None = None, progress: bool = True, **settings: Any
) -> SweepResult:
    """Train one run for each combination of settings, as `train -m` does: the same jobs, the same numbers.

    Ctrl-C stops it as it stops the command; the same call with the same folder does the rest.

    Args:
        overrides: words as on the command line, `"agent=dqn,ppo"`, `"hydra.launcher.n_jobs=2"`, or
            dictionaries, `{"agent.gamma": [0.9, 0.99]}`.
        folder: the sweep's; new, or that of a sweep to complete. None: a new one in `runs/`.
        progress: whether to show progress.
        settings: settings whose name has no dot; a list or a range is several values: `seed=range(3)`.

    Raises:
        InputError: a mistake in the settings or the folder, found before training.
        KeyboardInterrupt: Ctrl-C.

    Example:
        >>> sweep("agent=q_learning,sarsa", seed=range(3), folder="runs/two")
        SweepResult('runs/two', 6 jobs: 6 done)
    """
    new = f"runs/{datetime.now():%Y-%m-%d_%H-%M-%S}_sweep_{secrets.token_hex(3)}"
    path = as_path("sweep: folder", folder or new)
    words = [*command_words(overrides, settings, of_many=True), _word("hydra.sweep.dir", path)]
    _run_command("train", ["-m", *words], progress)
    return SweepResult(path)


@limited()
def open_sweep(folder: str | PathLike[str]) -> SweepResult:
    """Open a sweep, finished or not. Its files are read as data.

    Raises:
        InputError: the folder holds no sweep, or its list of jobs was changed.
    """
    return SweepResult(as_path("open_sweep: folder", folder))


def tune(
    *overrides: Override, folder: str | PathLike[str], progress: bool = True, **settings: Any
) -> TuningStudy:
    """Search an agent's settings for a task and confirm the winner, as the command `tune` does.

    The same call resumes a study that was stopped. `train(recipe=folder)` trains with what was found.

    Args:
        overrides: as for `sweep`, `"tune.trials=25"` among them; and so `folder`, `progress` and `settings`.

    Returns:
        The study, with the winner's `values`, and the verdict as a `sentence`.

    Raises:
        InputError: a mistake in the settings or the folder; no trial came to a score; no Optuna.
        KeyboardInterrupt: Ctrl-C.
    """
    path = as_path("tune: folder", folder)
    words = [*command_words(overrides, settings, of_many=True), _word("tune.folder", path)]
    _run_command("tune", words, progress)
    return find_tunings([path])[0][0]


def record(
    run: RunResult | str | PathLike[str], *format: str, out: str | PathLike[str] | None = None, **options: Any
) -> Path:
    """Draw episodes and maps of a run as files, as the command `record` does, and return their folder.

    Args:
        run: one with a folder, or the folder.
        format: any of "png", "gif", "apng", "mp4" for the episodes, "policy", "q_error", "visits" for maps.
        out: the folder to write to; None: `recording` in the run's.
        options: the command's other options: `episodes=3`, `policy="sampled"`, `best=True`, `cell_size=40`.

    Raises:
        InputError: a mistake in the arguments, or no finished run.
    """
    folder = run.folder if isinstance(run, RunResult) else as_path("record: run", run)
    if folder is None:
        raise InputError("run: has no folder, so that its files are gone; train it with folder=...")
    place = as_path("record: out", out or folder / "recording")
    words = [str(folder), "--out", str(place.absolute()), "--format", *(format or ("png", "gif"))]
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", str(value)][
            : 1 if value is True else 2 * (value is not False)
        ]
    _run_command("record", words, progress=False)
    return place


def _run_command(name: str, words: Sequence[str], progress: bool) -> None:
    """Run a command to its end, and print what it has to say on standard error.

    Raises `InputError` with its error, and `KeyboardInterrupt` where Ctrl-C has stopped it.
    """
    lines, line = list[str](), ProgressLine(progress)
    is_over = is_stopped = False
    process = subprocess.Popen(
        [sys.executable, "-c", _CALL, str(os.getpid()), name, *words],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,  # what is returned says the same
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        process_group=0,
    )
    with process:
        while not is_over:
            try:
                for text in process.stderr or ():
                    if _PROGRESS.match(text):
                        line.show(text.strip)
                        continue
                    lines.append(text)
                    if progress and not _ERROR.match(text):
                        line.clear()
                        print(text, end="", file=sys.stderr, flush=True)
                is_over = True
            except KeyboardInterrupt:
                is_stopped = True
                process.send_signal(signal.SIGINT)
    line.clear()
    if is_stopped:
        raise KeyboardInterrupt("stopped; the same call with this folder does the rest")
    if errors := [found[1] for found in map(_ERROR.match, lines) if found]:
        raise InputError(re.sub(r"hydra\.sweep\.dir|tune\.folder", "folder", errors[-1]))
    if process.returncode and not progress:
        print(*lines, sep="", end="", file=sys.stderr)
    if process.returncode not in (0, 1):
        raise InputError(f"{name}: its process was ended from outside (exit code {process.returncode})")


def _word(key: str, path: Path) -> str:
    return f"{key}={literal(str(path.absolute()), key)}"


def _value(text: str) -> Any:
    """A number or a truth value of a command line; another text as it is."""
    try:
        return json.loads(text)
    except ValueError:
        return text
