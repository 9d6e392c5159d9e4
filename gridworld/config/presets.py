"""`preset=auto`: settings for worlds that the agents' own numbers are not made for, chosen by one rule.

The agents' yaml files are made for the default world. `conf/preset/settings` has plain numbers of some agents
for stochastic and for larger worlds. `preset=auto`, the default, becomes `stochastic` where an action may
have several outcomes, or else `large` where there are more states than in the default world. It stays `auto`

- where the command line or an experiment gives `total_timesteps` or `n_envs`, which the numbers rest on, or
  chooses a recipe; and where Stable-Baselines3's own loop trains, for which the numbers are too large;
- with a recipe in its own world, or in one that is only larger; in a stochastic one the recipe is left out.

The choice becomes a word of the run's command line, as if it had been typed.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import yaml

from gridworld.base.errors import InputError
from gridworld.config.settings import has_own_code
from gridworld.config.train import AUTO, TrainConfig
from gridworld.config.words import conf_folder
from gridworld.config.worlds import EnvConfig, compiled

if TYPE_CHECKING:  # importing numpy takes longer than `--help` does
    from gridworld.world.mdp import Mdp

STOCHASTIC, LARGE = "stochastic", "large"
_WITHOUT_RECIPE = "tuned=none"
_DEFAULT_STATES = 30  # of the default world
_ENGINE = "tabulated"  # the only one for which the numbers are made
_SIZE = ("total_timesteps", "n_envs")
_CHOSEN_BY_HAND = re.compile(rf"\+*({'|'.join(_SIZE)}|tuned)=|preset=(?!auto$)")
_OF_A_WORLD = re.compile(r"[+~]*(env|experiment|hydra)\b")


def may_need_preset(words: Sequence[str]) -> bool:
    """Whether a command line may choose another world than the default one, and leaves the preset open."""
    return not any(map(_CHOSEN_BY_HAND.match, words)) and any(map(_OF_A_WORLD.match, words))


def with_preset(
    config: TrainConfig,
    words: Sequence[str],
    compose: Callable[[list[str]], TrainConfig],
    world: Callable[[EnvConfig], Mdp] = compiled,
) -> tuple[TrainConfig, list[str]]:
    """Compose a command line again with the preset that `preset=auto` becomes.

    `config` is what the command line's `words` compose to; `compose` takes further words. Returns the
    settings, and the words that were added.
    """
    if config.preset != AUTO or any(map(_CHOSEN_BY_HAND.match, words)):
        return config, []
    env, recipe = config.env, config.recipe
    if recipe is not None and is_recipe_for(recipe, config.agent.name, env):
        return config, []
    preset = fitting_preset(config, lambda: world(env) if env.compiles_quickly else None)
    if preset is None or (recipe is not None and preset != STOCHASTIC):
        return config, []
    chosen = [*([_WITHOUT_RECIPE] if recipe is not None else []), f"preset={preset}"]
    again, numbers = compose(chosen), _numbers(config.agent.name, preset)
    is_whole = all(getattr(again, key) == numbers.get(key, getattr(config, key)) for key in _SIZE)
    return (again, chosen) if is_whole else (config, [])


def fitting_preset(config: TrainConfig, world: Callable[[], Mdp | None]) -> str | None:
    """The preset that the agent has for a world; None for none.

    That is so as well where `world` returns none, or the settings make none, which the check before training
    says.
    """
    if getattr(config.agent, "engine", _ENGINE) != _ENGINE or has_own_code(config.callbacks):
        return None
    try:
        mdp = world()
    except (InputError, TypeError, ValueError, OSError):
        return None
    is_large = mdp is not None and mdp.num_states > _DEFAULT_STATES
    name = STOCHASTIC if mdp is not None and mdp.is_stochastic else LARGE if is_large else ""
    return name if _numbers(config.agent.name, name) else None


def is_recipe_for(recipe: str, agent: str, env: EnvConfig) -> bool:
    """Whether a recipe was made for a world; of a user's own recipe it is assumed."""
    name = recipe.removesuffix(f"_{agent}")
    return is_world(env, name) or not (conf_folder() / "env" / f"{name}.yaml").is_file()


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
    """The preset's settings of the agent, if it has any; the agent's name may be a stranger's."""
    files = {file.stem: file for file in (conf_folder() / "preset" / "settings").glob("*.yaml")}
    file = files.get(f"{agent}_{preset}")
    return {} if file is None else dict(yaml.safe_load(file.read_text("utf-8")))
