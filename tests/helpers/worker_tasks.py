"""Tasks for the workers of a search. A worker imports this module, and nothing of a test's."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Killed:
    """Kills its worker as often as asked, each time but the last noted in a file; then returns its name."""

    name: str
    times: int
    folder: Path

    def __call__(self, ask: Any) -> str:
        marks = len(list(self.folder.glob(f"{self.name}-*")))
        if marks < self.times:
            (self.folder / f"{self.name}-{marks}").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return f"{self.name} {ask(self.name)}"
