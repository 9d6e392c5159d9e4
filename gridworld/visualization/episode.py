"""The final greedy policy's episode as an animation.

An environment of Gymnasium shows its states itself. Any other world is drawn: see `animation_of_states`.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence

import numpy as np
from PIL import Image

from gridworld.config.worlds import GymnasiumConfig
from gridworld.envs.real_env import RealEnvFrames
from gridworld.envs.rendering import Frame, frame_size
from gridworld.envs.rollout import play_episode
from gridworld.errors import InputError
from gridworld.visualization.animation import Animation, animation_of_photos, animation_of_states
from gridworld.visualization.picture import TIME_SERIES_CARD, Draw, Subject
from gridworld.world.mdp import IntArray, Mdp

TENSORBOARD_SIDE: int | None = TIME_SERIES_CARD

_MOST_FRAMES = 500  # of an episode that finds no end; by then a greedy one goes round in circles

_log = logging.getLogger("gridworld")


def draw(subject: Subject) -> Draw:
    """Play one episode on the run's seed; its own cell size is `recording.cell_size`."""
    mdp, limit = subject.evaluator.mdp, subject.evaluator.max_episode_steps
    states = play_episode(mdp, subject.snapshot.greedy_policy(), limit, subject.config.seed)[:_MOST_FRAMES]
    return film(subject, [states])


def film(subject: Subject, episodes: Sequence[IntArray]) -> Draw:
    """Show the agent in one state after the other.

    Args:
        subject: the agent and its world.
        episodes: (steps + 1,) each, its states.
    """
    photos = _by_the_environment(subject, episodes)
    if photos is not None:
        mdp = subject.evaluator.mdp
        return functools.cache(lambda cell_size: animation_of_photos(_fitting(photos, mdp, cell_size)))
    states = np.concatenate(episodes)

    @functools.cache  # several files show the same
    def animation(cell_size: int | None) -> Animation:
        return animation_of_states(
            subject.evaluator.mdp, states, cell_size or subject.config.recording.cell_size
        )

    return animation


def _by_the_environment(subject: Subject, episodes: Sequence[IntArray]) -> list[Frame] | None:
    """The frames of the world's own environment; None where it has none, or cannot be asked here."""
    env = subject.config.env
    if not isinstance(env, GymnasiumConfig) or ":" in env.id:  # which would import a module of that name
        return None
    try:
        real = RealEnvFrames(env.id, env.kwargs)
        shown = (real.episode(subject.evaluator.mdp, states.tolist()) for states in episodes)
        return [frame for frames in shown for frame in frames]
    except InputError as error:
        _log.warning("the episode is drawn without its environment: %s", error)
        return None


def _fitting(frames: list[Frame], mdp: Mdp, cell_size: int | None) -> list[Frame]:
    """The frames as they are, or no larger than the world with such cells would be drawn."""
    height, width = frames[0].shape[:2]
    scale = 1.0 if cell_size is None else max(frame_size(mdp, cell_size)) / max(height, width)
    if scale >= 1:
        return frames
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return [np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BOX)) for frame in frames]
