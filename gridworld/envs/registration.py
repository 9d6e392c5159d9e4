"""Registration of `GridWorld-v0` with Gymnasium."""

from __future__ import annotations

from gridworld.base.bounds import STEP_LIMIT

ENV_ID = "GridWorld-v0"


def register_envs() -> None:
    """Make `GridWorld-v0` known to Gymnasium, for `make` and `make_vec`; a second call changes nothing."""
    from gymnasium.envs.registration import register, registry

    if ENV_ID not in registry:
        register(
            id=ENV_ID,
            entry_point="gridworld.envs.env:GridWorldEnv",
            vector_entry_point="gridworld.envs.vector_env:GridWorldVectorEnv",
            max_episode_steps=STEP_LIMIT,
        )
