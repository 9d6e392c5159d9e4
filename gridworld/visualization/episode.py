"""Episodes as animations: of the real environment's frames, on the world's board, or in text."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
from PIL import Image

from gridworld.base.console import tell
from gridworld.base.errors import InputError, in_short
from gridworld.config.worlds import EnvConfig, GymnasiumConfig
from gridworld.envs.rendering import Frame, Kind, board_of, frame_size, import_pygame
from gridworld.envs.rollout import Episode, play
from gridworld.visualization.animation import (
    Animation,
    Caption,
    animation_of_cards,
    animation_of_rendered,
    animation_of_states,
)
from gridworld.visualization.canvas import directions
from gridworld.visualization.picture import Draw, Subject
from gridworld.world.mdp import Mdp
from gridworld.world.sources.environment import make_env
from gridworld.world.sources.gymnasium_table import has_table

_MOST_FRAMES = 500  # of an episode that finds no end; by then a greedy one goes round in circles
_MOST_PIXELS = 512 * 512  # of a frame that another environment renders
_OFF_SCREEN = {"SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy"}

_log = logging.getLogger("gridworld")


def episode(subject: Subject) -> Draw:
    """Play one greedy episode on the run's seed; its own cell size is `recording.cell_size`."""
    config, mdp = subject.config, subject.evaluator.mdp
    policy, limit = subject.snapshot.greedy_policy(), subject.evaluator.max_episode_steps
    played = play(mdp, policy, limit, config.seed).beginning(_MOST_FRAMES)
    drawn = film(config.env, mdp, [played], subject.is_trusted, limit)
    return functools.cache(  # several files show the same
        lambda cell_size: drawn(cell_size or config.recording.cell_size)
    )


def film(
    env: EnvConfig, mdp: Mdp, episodes: Sequence[Episode], is_trusted: bool, max_episode_steps: int
) -> Callable[[int | None], Animation]:
    """Prepare an animation of episodes, one after the other, as a function of a cell size in pixels.

    The frames are those of the environment that `env` names, where `is_trusted` allows to make it; they are
    scaled down where they are larger than the board would be with cells of that size. Captions say what
    happens.
    """
    captions = [lines for episode in episodes for lines in _captions(mdp, episode, max_episode_steps)]
    if isinstance(env, GymnasiumConfig) and not is_trusted:
        tell(f"the episode is drawn from the run's tables; {env.id} itself is only drawn with trust")
    elif isinstance(env, GymnasiumConfig):
        try:
            frames = rendered_frames(env, mdp, episodes)
        except InputError as error:
            _log.warning("the episode is drawn from the tables, not by its environment: %s", error)
        else:
            return lambda cell_size: animation_of_rendered(
                frames, None if cell_size is None else max(frame_size(mdp, cell_size)), captions
            )
    states = np.concatenate([each.states for each in episodes])
    show = animation_of_states if board_of(mdp).panels else animation_of_cards
    return lambda cell_size: show(mdp, states, cell_size, captions)


def _captions(mdp: Mdp, episode: Episode, max_episode_steps: int) -> Iterator[Caption]:
    """What an episode has come to at each of its states, and what happens there."""
    earned = np.concatenate([[0.0], np.cumsum(episode.rewards)]).tolist()
    states, actions, ways = episode.states.tolist(), episode.actions.tolist(), directions(mdp)
    last = "the goal" if mdp.goal[states[-1]] else "a trap" if mdp.trap[states[-1]] else "the end"
    if not mdp.terminal[states[-1]]:
        last = "out of steps" if len(actions) == max_episode_steps else "and so on"
    moves = [
        _move(mdp, ways[state, action].tolist(), mdp.action_names[action], state, following)
        for action, (state, following) in zip(actions, pairwise(states), strict=True)
    ]
    for step, what in enumerate([*moves, last]):
        yield f"step {step} of {max_episode_steps}, return {earned[step]:.6g}", what


def _move(mdp: Mdp, way: list[int], name: str, state: int, following: int) -> str:
    """What an action with an arrow that points that `way` did."""
    board = board_of(mdp)
    if not any(way):
        return f"action {name}"
    place, reached = board.cell[state], board.cell[following]
    if (reached == place + way).all():
        return f"moves {name}"
    if (reached != place).any():
        return f"moves {name}, comes to {mdp.state_name(following)}"
    row, col = (place + way).tolist()
    is_inside = 0 <= row < board.rows and 0 <= col < board.cols
    kind = board.kind[row, col] if is_inside else Kind.BLANK
    if kind == Kind.BLANK:
        return f"moves {name} into the border"
    is_wall = kind == Kind.WALL or (kind != Kind.UNREACHABLE and not mdp.is_stochastic)
    return f"moves {name} into a wall" if is_wall else f"moves {name}, but stays"  # slips, or falls back


def rendered_frames(env: GymnasiumConfig, mdp: Mdp, episodes: Sequence[Episode]) -> list[Frame]:
    """The environment's own frames (height, width, 3), RGB, of whole episodes.

    An environment with a transition table is put into each state. In others the episode's actions are taken.
    """
    frames = []
    with _off_screen(), closing(RealEnv(env, mdp)) as real:
        for episode in episodes:
            first, *states = episode.states.tolist()
            real.reset(first)
            frames.append(real.frame())
            for state, action in zip(states, episode.actions.tolist(), strict=True):
                real.follow(state, None if real.has_table else action)
                frames.append(real.frame())
    return frames


class RealEnv:
    """An environment of Gymnasium that draws the states of its world."""

    def __init__(self, env: GymnasiumConfig, mdp: Mdp) -> None:
        self._id, self._mdp = env.id, mdp
        with closing(make_env(env.id, dict(env.kwargs))) as plain:
            self.has_table = has_table(plain.unwrapped)
            draws = "rgb_array" in (plain.metadata.get("render_modes") or ())
        if not self.has_table and (mdp.is_stochastic or len(mdp.start_states) > 1):
            raise InputError(
                f"env.id={env.id}: its steps are random, so it cannot be led through the states of an episode"
            )
        if not draws:
            raise InputError(f"env.id={env.id}: draws no pictures; rgb_array is not among its render_modes")
        self._env = make_env(env.id, dict(env.kwargs), render_mode="rgb_array")

    def reset(self, state: int) -> None:
        """Start an episode in a start state."""
        with self._rendering():
            self._env.reset(seed=0)
            if self.has_table:
                self.follow(state)

    def follow(self, state: int, action: int | None = None) -> None:
        """Go on to a state: by the table, else by the action that leads there."""
        real: Any = self._env.unwrapped
        if self.has_table:
            real.s, real.lastaction = int(self._mdp.number[state]), action
            return
        with self._rendering():
            self._env.step(action)

    def frame(self) -> Frame:
        """Its picture (height, width, 3), RGB, scaled down where it has more pixels."""
        with self._rendering():
            frame = np.asarray(self._env.render(), dtype=np.uint8)
            height, width = frame.shape[:2]
        if height * width <= _MOST_PIXELS:
            return frame.copy()
        scale = (_MOST_PIXELS / (height * width)) ** 0.5
        size = max(1, int(width * scale)), max(1, int(height * scale))
        return np.asarray(Image.fromarray(frame).resize(size, Image.Resampling.BOX))

    @contextmanager
    def _rendering(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # whatever it raises
            raise InputError(f"env.id={self._id}: cannot be rendered: {in_short(error)}") from error

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


@contextmanager
def _off_screen() -> Iterator[None]:
    """Without a display and a sound card, which environments look for, unless pygame has a display."""
    pygame = import_pygame()
    if pygame.display.get_init():
        yield
        return
    before = {name: os.environ.get(name) for name in _OFF_SCREEN}
    os.environ.update(_OFF_SCREEN)
    try:
        yield
    finally:
        pygame.quit()
        for name, value in before.items():
            os.environ.pop(name)
            os.environ.update({} if value is None else {name: value})
