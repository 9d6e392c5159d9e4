"""Registration of `GridWorld-v0` with Gymnasium by `import gridworld`, without importing Gymnasium.

Importing Gymnasium takes 0.2 s, `import gridworld` 2 ms. Where it is not imported yet, registration follows.
"""

from __future__ import annotations

import sys

from gridworld.bounds import STEP_LIMIT

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


class _GymnasiumWatch:
    """Finds no module. Python asks it at each import, until Gymnasium's registry is there."""

    def find_spec(self, *module: object) -> None:
        # The registry's module imports nothing after it has defined this name.
        if hasattr(sys.modules.get("gymnasium.envs.registration"), "register"):
            sys.meta_path = [finder for finder in sys.meta_path if finder is not self]
            register_envs()


def register_when_gymnasium_is_imported() -> None:
    """Register now if Gymnasium is there already, else as soon as it is imported."""
    watch = _GymnasiumWatch()
    sys.meta_path.insert(0, watch)
    watch.find_spec()
