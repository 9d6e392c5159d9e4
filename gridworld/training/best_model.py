"""The model of the best greedy policy so far, kept in memory until the run's files are written."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gridworld.storage.serialization import State
from gridworld.world.exact.evaluation import Score


class BestModel:
    """The one of the lowest exact regret, the earliest of equals; all certified policies are equals.

    Attributes:
        step: environment steps at its evaluation; -1: there was none yet.
        regret: of its greedy policy.
        content: of its model file.
    """

    def __init__(self) -> None:
        self.step, self.regret, self.content = -1, float("inf"), b""

    def is_beaten_by(self, score: Score) -> bool:
        """Whether a policy with this score is better."""
        return self.step < 0 or score.shortfall < self.regret

    def offer(self, step: int, score: Score, model_file: Callable[[], bytes]) -> None:
        """Take a model if it is better.

        Args:
            step: environment steps so far.
            score: of its greedy policy.
            model_file: gives the content of its file, which is only then asked for.
        """
        if self.is_beaten_by(score):
            self.step, self.regret, self.content = step, score.shortfall, model_file()

    def get_state(self) -> State:
        """The attributes."""
        content = np.frombuffer(self.content, np.uint8)
        return {"step": self.step, "regret": self.regret, "content": content}

    def set_state(self, state: State) -> None:
        """Mirrors `get_state`."""
        self.step, self.regret = int(state["step"]), float(state["regret"])
        self.content = state["content"].tobytes()
