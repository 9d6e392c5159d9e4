"""`preset=auto`: settings for worlds that the agents' own numbers are not made for, chosen by one rule.

The agents' yaml files are made for the default world. `conf/preset/settings` has plain numbers of each agent
for stochastic and for larger worlds. Where `preset` is `auto`, which is the default:

1. `none` with a recipe in the world that it was made for; where that is made another, stochastic one, the
   recipe is left out;
2. `stochastic` where an action may have several outcomes;
3. `large` where there are more states than in the default world, and no recipe;
4. `none` otherwise; and where the command line or an experiment gives `total_timesteps` or `n_envs`, which a
   preset's numbers rest on, or has Stable-Baselines3's own loop train, for which they are too large.

What is chosen becomes a word of the run's command line, as if it had been typed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import yaml
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
_WITHOUT_RECIPE = "tuned=none"
_DEFAULT_STATES = 30  # of the default world
_ENGINE = "tabulated"  # the only one for which the numbers are made
_SIZE = ("total_timesteps", "n_envs")

Settings = TypeVar("Settings", TrainConfig, DictConfig)


def with_preset(
    config: Settings,
    compose: Callable[[list[str]], Settings],
    world: Callable[[EnvConfig], Mdp] = compiled,
) -> tuple[Settings, list[str]]:
    """Compose a command line again with the preset that `preset=auto` comes to.

    Args:
        config: what the command line composes to, as dataclasses or as Hydra has it.
        compose: composes the command line with further words.
        world: makes the configured world, or returns one that there is.

    Returns:
        The settings; the words that were added, none where no preset is needed.
    """
    if config.preset != AUTO:
        return config, []
    try:
        env: Any = OmegaConf.to_object(config.env) if isinstance(config.env, DictConfig) else config.env
    except OmegaConfBaseException:  # something is missing, which composing says
        return config, []
    recipe: str | None = config.recipe
    if recipe is not None and is_world(env, recipe.removesuffix(f"_{config.agent.name}")):
        return config, []
    preset = fitting_preset(config, lambda: world(env) if env.compiles_quickly else None)
    if preset is None or (recipe is not None and preset != STOCHASTIC):
        return config, []
    words = [*([_WITHOUT_RECIPE] if recipe is not None else []), f"preset={preset}"]
    again = compose(words)
    numbers = _numbers(config.agent.name, preset)
    is_whole = all(getattr(again, key) == numbers.get(key, getattr(config, key)) for key in _SIZE)
    return (again, words) if is_whole else (config, [])


def fitting_preset(config: TrainConfig | DictConfig, world: Callable[[], Mdp | None]) -> str | None:
    """The preset that is made for a world.

    Args:
        config: the settings, as dataclasses or as Hydra has them.
        world: makes the world; None: it is not known before the run.

    Returns:
        Its name; None: the agent's own settings are made for the world, the agent has no such preset, or the
        settings make no world, which the check before training says.
    """
    callbacks = config.callbacks
    plain = OmegaConf.to_container(callbacks) if OmegaConf.is_config(callbacks) else callbacks
    if getattr(config.agent, "engine", _ENGINE) != _ENGINE or has_own_code(plain):
        return None
    try:
        mdp = world()
    except (InputError, TypeError, ValueError, OSError):
        return None
    if mdp is None:
        return None
    name = STOCHASTIC if mdp.is_stochastic else LARGE if mdp.num_states > _DEFAULT_STATES else ""
    return name if _numbers(config.agent.name, name) else None


def is_world(env: EnvConfig, name: str) -> bool:
    """Whether a world is the one that `env=name` chooses, whatever the step limit."""
    file = conf_folder() / "env" / f"{name}.yaml"
    if not file.is_file():
        return False
    chosen = yaml.safe_load(file.read_text("utf-8"))
    own = dataclasses.asdict(env) | {"max_episode_steps": None}
    plain = dataclasses.asdict(type(env)()) | chosen | {"max_episode_steps": None}
    return own == {key: value for key, value in plain.items() if key != "defaults"}


def _numbers(agent: str, preset: str) -> dict[str, Any]:
    """What the preset says of the agent; nothing where it says nothing."""
    file = conf_folder() / "preset" / "settings" / f"{agent}_{preset}.yaml"
    return dict(yaml.safe_load(file.read_text("utf-8"))) if file.is_file() else {}
