"""Building a run from its settings: the world, the environments, and the checks before training."""

from __future__ import annotations

import functools
from collections.abc import Callable

from gridworld.agents import TrainingContext, WriteScalars, family
from gridworld.config.train import TrainConfig, check
from gridworld.config.worlds import EnvConfig, compiled
from gridworld.envs.observations import ObservationTable
from gridworld.envs.rendering import frame_size
from gridworld.envs.statistics_env import StatisticsVectorEnv
from gridworld.visualization.video import require_video
from gridworld.world.mdp import Mdp


def make_context(
    config: TrainConfig,
    mdp: Mdp,
    observation: ObservationTable,
    write_scalars: WriteScalars | None = None,
) -> TrainingContext:
    """Make the environments that an agent of this configuration learns in.

    Args:
        config: the settings of the run.
        mdp: its world.
        observation: what the agent sees of each state.
        write_scalars: takes the agent's own training metrics.

    Returns:
        `config.n_envs` fresh environments and what else the agent's family builds it from.
    """
    limit, share = config.env.step_limit(mdp), config.exploring_starts
    trained_in = _with_exploring_starts(mdp, share) if share else mdp
    envs = StatisticsVectorEnv(config.n_envs, max_episode_steps=limit, mdp=trained_in)
    return TrainingContext(
        envs, observation, config.seed, config.device, config.threads, write_scalars, config.callbacks
    )


@functools.lru_cache(maxsize=4)  # the runs of a population share a world
def _with_exploring_starts(mdp: Mdp, share: float) -> Mdp:
    return mdp.with_exploring_starts(share)


def check_settings(config: TrainConfig, world: Callable[[EnvConfig], Mdp] = compiled) -> Mdp:
    """Check everything that can be checked without the agent's library.

    Args:
        config: the settings of a run.
        world: makes the world, or returns one that several runs share.

    Returns:
        The run's world.

    Raises:
        InputError: for a mistake in the settings.
    """
    check(config)
    family(config.agent).check(config)
    mdp = world(config.env)
    config.env.step_limit(mdp)
    check_recording(config, mdp)
    return mdp


def check_recording(config: TrainConfig, mdp: Mdp) -> None:
    """Check that the episode can be drawn as the settings ask for.

    Raises:
        InputError: where the cells are too large, or the video library is missing.
    """
    wanted = config.recording
    if wanted.mp4:
        require_video()
    if (wanted.frames or wanted.gif or wanted.mp4) and wanted.cell_size is not None:
        frame_size(mdp, wanted.cell_size)
