"""The final greedy policy's episode as an animation."""

from __future__ import annotations

import functools

from gridworld.envs.rollout import play_episode
from gridworld.visualization.animation import Animation, animation_of_states
from gridworld.visualization.picture import TIME_SERIES_CARD, Draw, Subject

TENSORBOARD_SIDE: int | None = TIME_SERIES_CARD

_MOST_FRAMES = 500  # of an episode that finds no end; by then a greedy one goes round in circles


def draw(subject: Subject) -> Draw:
    """Play one episode on the run's seed; its own cell size is `recording.cell_size`."""
    config, mdp = subject.config, subject.evaluator.mdp
    policy, limit = subject.snapshot.greedy_policy(), subject.evaluator.max_episode_steps
    states = play_episode(mdp, policy, limit, config.seed)[:_MOST_FRAMES]

    @functools.cache  # several files show the same
    def animation(cell_size: int | None) -> Animation:
        return animation_of_states(mdp, states, cell_size or config.recording.cell_size)

    return animation
