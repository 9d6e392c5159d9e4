"""Progress of a search: trials.csv, and a line on standard error."""

from __future__ import annotations

import sys
import time

import optuna

from gridworld.process.console.progress import ProgressLine, time_left
from gridworld.sweep.console import shell_path
from gridworld.tune.search.storage import count_trials
from gridworld.tune.study_folder import write_trials
from gridworld.tune.study_spec import StudySpec

_SECONDS_BETWEEN_TABLES = 2.0


class SearchProgress:
    """Keeps trials.csv and the line up to date."""

    def __init__(self, asked: StudySpec, study: optuna.Study) -> None:
        self._asked = asked
        self._study = study
        self._line = ProgressLine(asked.base.logging.progress)
        self._started = self._wrote = time.monotonic()
        self._ended_before = count_trials(study).ended

    def begin(self) -> None:
        """Print what is searched."""
        settings, trials = self._asked.settings, self._asked.settings.trials
        more = f", {self._ended_before} of them there already" if self._ended_before else ""
        print(
            f"study {self._asked.name} in {shell_path(self._asked.folder)}: {trials} trials of "
            f"{len(self._asked.seeds)} seeds{more}, {settings.workers * (settings.together or 1)} at once",
            file=sys.stderr,
            flush=True,
        )

    def look(self) -> None:
        """Write what is due; to be called often."""
        if time.monotonic() - self._wrote < _SECONDS_BETWEEN_TABLES:
            return
        self._wrote = time.monotonic()
        write_trials(self._asked.folder, self._study, self._asked.space)
        self._line.show(self._text)

    def end(self) -> None:
        """Write the table as it stands, and remove the line from a terminal."""
        self._line.clear()
        write_trials(self._asked.folder, self._study, self._asked.space, durable=True)

    def _text(self) -> str:
        counts = count_trials(self._study)
        trials = self._asked.settings.trials
        text = f"tune: {counts.ended} of {trials} trials, {counts.pruned} pruned, {counts.running} running"
        if counts.failed:
            text += f", {counts.failed} failed"
        if counts.complete:
            text += f", best score {self._study.best_value:.4f}"
        seconds = time.monotonic() - self._started
        return text + time_left(counts.ended - self._ended_before, trials - counts.ended, seconds)
