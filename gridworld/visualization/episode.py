"""Episodes as animations: of the real environment's frames, on the world's board, or in text."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence

import numpy as np

from gridworld.config.worlds import EnvConfig, GymnasiumConfig
from gridworld.envs.board import board_of
from gridworld.envs.real_env import RealEnvFrames
from gridworld.envs.rendering import Frame, frame_size
from gridworld.envs.rollout import Episode, play
from gridworld.errors import InputError
from gridworld.process.console import printable, tell
from gridworld.visualization.animation import (
    Animation,
    animation_of_cards,
    animation_of_rendered,
    animation_of_states,
)
from gridworld.visualization.picture import TIME_SERIES_CARD, Draw, Subject
from gridworld.world.mdp import Mdp

TENSORBOARD_SIDE: int | None = TIME_SERIES_CARD

_MOST_FRAMES = 500  # of an episode that finds no end; by then a greedy one goes round in circles

_log = logging.getLogger("gridworld")


def draw(subject: Subject) -> Draw:
    """Play one greedy episode on the run's seed; its own cell size is `recording.cell_size`."""
    config, mdp = subject.config, subject.evaluator.mdp
    policy, limit = subject.snapshot.greedy_policy(), subject.evaluator.max_episode_steps
    episode = play(mdp, policy, limit, config.seed).beginning(_MOST_FRAMES)
    drawn = film(config.env, mdp, [episode], subject.is_trusted)
    return functools.cache(  # several files show the same
        lambda cell_size: drawn(cell_size or config.recording.cell_size)
    )


def film(
    env: EnvConfig, mdp: Mdp, episodes: Sequence[Episode], is_trusted: bool
) -> Callable[[int | None], Animation]:
    """Prepare an animation of episodes, one after the other, as a function of a cell size in pixels.

    The frames are those of the environment that `env` names, where `is_trusted` allows to make it; they are
    scaled down where they are larger than the board would be with cells of that size.
    """
    frames = _by_the_environment(env, mdp, episodes, is_trusted)
    if frames is not None:

        def rendered(cell_size: int | None) -> Animation:
            longest = None if cell_size is None else max(frame_size(mdp, cell_size))
            return animation_of_rendered(frames, range(len(frames)), longest)

        return rendered
    if board_of(mdp).panels:
        states = np.concatenate([each.states for each in episodes])
        return lambda cell_size: animation_of_states(mdp, states, cell_size)
    return lambda cell_size: animation_of_cards(mdp, episodes, cell_size)


def _by_the_environment(
    env: EnvConfig, mdp: Mdp, episodes: Sequence[Episode], is_trusted: bool
) -> list[Frame] | None:
    """The frames of the world's own environment; None where it has none, or cannot be asked here."""
    if not isinstance(env, GymnasiumConfig):
        return None
    if not is_trusted:
        tell(
            printable(f"the episode is drawn from the run's tables; {env.id} itself is made with trust only")
        )
        return None
    try:
        real = RealEnvFrames(env.id, env.kwargs)
        return [frame for each in episodes for frame in real.episode(mdp, each.states.tolist())]
    except InputError as error:
        _log.warning("the episode is drawn without its environment: %s", error)
        return None
