"""`preset=auto`: settings for worlds that the agents' own numbers are not made for, chosen by one rule.

The agents' yaml files are made for the default world. `conf/preset/settings` has plain numbers of each agent
for stochastic and for larger worlds. Where `preset` is `auto`, as it is unless the command line says otherwise:

1. `none` where the command line gives `total_timesteps` or `n_envs`, which the numbers of a preset rest on, and
   where Stable-Baselines3's own loop trains, for which they are too large;
2. `none` with a recipe in the world that it was made for; a recipe for a world that the command line makes
   stochastic is left out;
3. `stochastic` where an action may have several outcomes;
4. `large` where there are more states than in the default world;
5. `none`.

What is chosen becomes a word of the run's command line, as if it had been typed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.plain_settings import has_own_code
from gridworld.config.train import AUTO, TrainConfig
from gridworld.config.worlds import EnvConfig, compiled
from gridworld.errors import InputError

if TYPE_CHECKING:  # importing numpy takes longer than `--help` does
    from gridworld.world.mdp import Mdp

STOCHASTIC, LARGE = "stochastic", "large"
_DEFAULT_STATES = 30  # of the default world
_ENGINE = "tabulated"  # the only one for which the numbers are made
_SIZE = re.compile(r"\+*(total_timesteps|n_envs)=")
_WORLD = re.compile(r"\+*env\.(?!max_episode_steps=)")  # makes it another world than its yaml has
_WITHOUT_RECIPE = "tuned=none"


def preset_words(
    config: TrainConfig | DictConfig, words: Sequence[str], world: Callable[[EnvConfig], Mdp] = compiled
) -> list[str]:
    """What to add to a command line for the preset that `preset=auto` comes to.

    Args:
        config: what the command line composes to, as dataclasses or as Hydra has it.
        words: the command line.
        world: makes the configured world, or returns one that there is.

    Returns:
        Overrides; none where no preset is needed.
    """
    has_recipe = config.recipe is not None
    if config.preset != AUTO or any(map(_SIZE.match, words)):
        return []
    if has_recipe and not any(map(_WORLD.match, words)):
        return []
    preset = fitting_preset(config, world)
    if preset is None or (has_recipe and preset != STOCHASTIC):
        return []
    return [*([_WITHOUT_RECIPE] if has_recipe else []), f"preset={preset}"]


def fitting_preset(
    config: TrainConfig | DictConfig, world: Callable[[EnvConfig], Mdp] = compiled
) -> str | None:
    """The preset that is made for the configured world; arguments as for `preset_words`.

    Returns:
        Its name; None: the agent's own settings are made for the world, the agent has no such preset, the
        world is not known before the run, or the settings make none, which the check before training says.
    """
    callbacks = config.callbacks
    plain = OmegaConf.to_container(callbacks) if OmegaConf.is_config(callbacks) else callbacks
    if getattr(config.agent, "engine", _ENGINE) != _ENGINE or has_own_code(plain):
        return None
    try:
        env: Any = OmegaConf.to_object(config.env) if isinstance(config.env, DictConfig) else config.env
        if not env.compiles_quickly:
            return None
        mdp = world(env)
    except (InputError, OmegaConfBaseException, TypeError, ValueError, OSError):
        return None
    name = STOCHASTIC if mdp.is_stochastic else LARGE if mdp.num_states > _DEFAULT_STATES else None
    settings = conf_folder() / "preset" / "settings" / f"{config.agent.name}_{name}.yaml"
    return name if settings.exists() else None
