"""When a run's pictures are drawn, and where they go.

Every picture (`gridworld.config.train`) is a file in the run's folder and, in a size that TensorBoard does
not have to scale, in its Images tab: the policy while it develops, the others when training is over.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridworld.base.errors import InputError
from gridworld.base.serialization import State
from gridworld.config.train import PICTURES, Picture, TrainConfig
from gridworld.envs.rendering import fitting_cell_size
from gridworld.training.learning_curve import Evaluation
from gridworld.training.tensorboard import EventWriter
from gridworld.visualization.animation import Animation
from gridworld.visualization.files import encode_gif, encode_png, save
from gridworld.visualization.picture import Draw, PolicyHistory, Subject, drawer
from gridworld.world.evaluation import Evaluator

# Pixels that pictures have in TensorBoard. It scales by skipping pixels: thin lines vanish, text frays.
_IMAGES_TAB, _TIME_SERIES_CARD = 350, 240
# TensorBoard's groups, behind the learning curve. It sorts "/" and "_" alike: policy comes before rest.
_FIRST, _OTHERS = "pictures", "pictures_rest"

_log = logging.getLogger("gridworld")


class Pictures:
    """Draws evaluations, as the run's `recording` and `logging` say; `visits` (S, A) grow meanwhile."""

    def __init__(
        self,
        config: TrainConfig,
        folder: Path,
        evaluator: Evaluator,
        visits: NDArray[np.int64],
        events: EventWriter | None,
        is_trusted: bool,
    ) -> None:
        self._config, self._folder, self._evaluator = config, folder, evaluator
        self._visits, self._events, self._is_trusted = visits, events, is_trusted
        self._history = PolicyHistory(evaluator.mdp.num_states) if config.recording.learning else None
        self._evaluations = 0
        self._shown_at: int | None = None  # the step of the newest policy in TensorBoard
        self._too_large: set[str] = set()

    def get_state(self) -> State:
        """What was kept and shown; a picture is told once to be too large."""
        return {
            "history": None if self._history is None else self._history.get_state(),
            "evaluations": self._evaluations,
            "shown_at": self._shown_at,
            "too_large": sorted(self._too_large),
        }

    def set_state(self, state: State) -> None:
        """Continue from a state."""
        if self._history is not None:
            self._history.set_state(state["history"])
        self._evaluations, self._shown_at = int(state["evaluations"]), state["shown_at"]
        self._too_large = set(state["too_large"])

    def write(self, evaluation: Evaluation) -> None:
        """Keep the policy for the animation of learning; show it in TensorBoard if that is due."""
        if self._history is not None:
            self._history.add(evaluation.step, evaluation.snapshot)
        every = self._config.logging.policy_map_every
        if every and self._evaluations % every == 0:
            self._show_development(evaluation)
        self._evaluations += 1

    def finish(self, evaluation: Evaluation) -> None:
        """Draw everything that is asked for, as training has ended with this evaluation."""
        if self._config.logging.policy_map_every and self._shown_at != evaluation.step:
            self._show_development(evaluation)
        subject, prepared = self._subject(evaluation, self._visits), dict[str, Draw]()
        for name, picture in PICTURES.items():
            if not getattr(self._config.recording, name):
                continue
            # The files of one episode are left out with one warning.
            label = picture.file if picture.caption else f"the {picture.drawer.partition('.')[0]}"
            with self._left_out_if_too_large(label):
                if picture.drawer not in prepared:
                    prepared[picture.drawer] = drawer(picture.drawer)(subject)
                draw = prepared[picture.drawer]
                save(draw(None), self._folder / picture.file, self._config.recording.fps)
                if picture.file.endswith((".png", ".gif")) and not picture.while_training:
                    self._show(picture, draw, evaluation.step)

    def _show_development(self, evaluation: Evaluation) -> None:
        self._shown_at = evaluation.step
        # Without visits: an evaluation may be written some steps after its own, when they have grown.
        subject = self._subject(evaluation, np.zeros_like(self._visits))
        for picture in PICTURES.values():
            if picture.while_training and self._events is not None:
                with self._left_out_if_too_large(f"TensorBoard's {picture.name}"):
                    self._show(picture, drawer(picture.drawer)(subject), evaluation.step)

    def _subject(self, evaluation: Evaluation, visits: NDArray[np.int64]) -> Subject:
        of_run = self._config, self._is_trusted, self._evaluator
        return Subject(*of_run, evaluation.snapshot, evaluation.step, visits, self._history)

    @contextlib.contextmanager
    def _left_out_if_too_large(self, label: str) -> Iterator[None]:
        """A picture that cannot be drawn does not fail a run that is trained."""
        try:
            yield
        except InputError as error:
            if label not in self._too_large:
                self._too_large.add(label)
                _log.warning("%s: %s is left out, %s", self._folder, label, error)

    def _show(self, picture: Picture, draw: Draw, step: int) -> None:
        if self._events is None:
            return
        side = _IMAGES_TAB if picture.is_map else _TIME_SERIES_CARD
        drawn = draw(fitting_cell_size(self._evaluator.mdp, side))
        tag = f"{_FIRST if picture.while_training else _OTHERS}/{picture.name}"
        if isinstance(drawn, Animation):
            encoded, size = encode_gif(drawn, self._config.recording.fps), drawn.size
        else:
            encoded, size = encode_png(drawn), (drawn.shape[1], drawn.shape[0])
        self._events.image(tag, encoded, size, step)
