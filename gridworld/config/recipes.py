"""Which recipe goes into a run's settings: one rule, by the names that were chosen and the world they make.

A recipe is a yaml file of settings that were tuned for an agent: `conf/tuned/AGENT/WORLD.yaml` for a world,
`conf/tuned/AGENT/stochastic.yaml` and `large.yaml` for a class of worlds. Unless `tuned=...` is given, it is

1. the agent's own for the world, or that of a world which the file in `conf/env` names in `recipes_of`; but
   not where other settings than the file's make a stochastic world and the agent has a recipe for these;
2. the agent's for the world's class: `stochastic` where an action may have several outcomes, or else `large`
   where there are more states than in the default world; but not where the command line or an experiment
   gives `total_timesteps` or `n_envs`, which its numbers rest on, nor where Stable-Baselines3's own loop
   trains, for which they are too large;
3. none: the agent's own settings.

Hydra brings in the recipe of the two names by itself. Where the rule says another, the words are composed
once more with `tuned=` it, as if it had been typed. Names of files count, never the labels in them.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from gridworld.base.errors import InputError
from gridworld.config.fields import Effect
from gridworld.config.settings import effect_of, has_own_code
from gridworld.config.train import TrainConfig
from gridworld.config.words import CLASSES, conf_folder, key_of
from gridworld.config.worlds import EnvConfig, World, compiled

if TYPE_CHECKING:  # importing numpy takes longer than `--help` does
    from gridworld.world.mdp import Mdp

CHOSEN = ("agent", "env", "observation", "tuned")  # groups of files, by their names
GROUP, NONE = "tuned", "none"
STOCHASTIC, LARGE = CLASSES
_DEFAULT_WORLD, _DEFAULT_STATES = "classic", 30
_ENGINE = "tabulated"  # the only one for which the numbers of a class are made
_SIZE = ("total_timesteps", "n_envs")
MAY_NEED = re.compile(rf"[+~]*(env|experiment|hydra|{GROUP})\b")  # words that may lead to a recipe
_OTHER_WORLD = re.compile(r"[+~]*(env\.(?!max_episode_steps\b)|env=\{|experiment\b)")
_WITH = " with "  # AGENT with ANOTHER/WORLD
_MEASURED = frozenset({Effect.LEARNING, Effect.LENGTH, Effect.TASK})  # on what a measurement depends


@dataclass(frozen=True)
class Chosen:
    """The files that a command line chooses, by their names."""

    agent: str
    env: str
    observation: str
    tuned: str
    folders: tuple[Path, ...]  # of yaml files
    hydra: Any  # Hydra's own part of the composition

    @classmethod
    def of(cls, hydra: Any) -> Chosen:
        """Read Hydra's own part of a composition."""
        agent, env, observation, tuned = (str(hydra.runtime.choices.get(group)) for group in CHOSEN)
        places = (Path(each.path) for each in hydra.runtime.config_sources if each.schema == "file")
        return cls(agent, env, observation, tuned, tuple(places), hydra)

    @property
    def recipe(self) -> str | None:
        """The recipe, if its file exists: a missing one is left out by Hydra."""
        return self.tuned if self.tuned != NONE and self.file(self.tuned) else None

    @property
    def is_open(self) -> bool:
        """Whether no experiment chooses the recipe."""
        return self.tuned == f"{self.agent}/{self.env}"

    def file(self, recipe: str) -> Path | None:
        """The file of a recipe, if there is one."""
        files = (folder / GROUP / f"{recipe}.yaml" for folder in self.folders)
        return next(filter(Path.is_file, files), None)

    def has_its_sizes(self, config: TrainConfig) -> bool:
        """Whether settings have what the numbers of a class's recipe rest on as its file has it."""
        file = self.file(self.tuned)
        if file is None or file.stem not in CLASSES:
            return True
        content = yaml.safe_load(file.read_text("utf-8"))
        return all(getattr(config, key) == content.get(key, getattr(config, key)) for key in _SIZE)

    def check(self) -> None:
        """Refuse a missing recipe, and one of the user's own that is not in its agent's folder."""
        for tuned in (folder / GROUP for folder in self.folders):
            if self.is_open and (old := tuned / f"{self.env}_{self.agent}.yaml").is_file():
                place = f"{tuned / self.tuned}.yaml"
                raise InputError(f"{old}: a recipe is in its agent's folder; move it to {place}")
        if self.is_open or self.tuned in (NONE, "None") or self.file(self.tuned):
            return
        from gridworld.config.messages import no_such  # here, with Hydra, which takes its time

        groups = [folder / GROUP for folder in self.folders]
        files = [(file, group) for group in groups for file in group.rglob("*.yaml")]
        known = sorted(file.relative_to(group).with_suffix("").as_posix() for file, group in files)
        raise InputError(no_such(GROUP, self.tuned, known))

    def settle(self, config: TrainConfig, words: Iterable[str]) -> TrainConfig:
        """Set what the names say and no file can: the recipe, and whether it is known to fail as used."""
        config.recipe, measured = self.agent, _DEFAULT_WORLD
        if (name := self.recipe) is not None:
            config.recipe = name if name.startswith(f"{self.agent}/") else f"{self.agent}{_WITH}{name}"
            measured = name.rpartition("/")[2]
        keys = set(map(key_of, words)) - {"agent", "env", GROUP}
        is_changed = any(effect_of(key) in _MEASURED for key in keys if not key.startswith("hydra"))
        if is_changed or measured not in (self.env, *config.env.recipes_of):
            config.known_failure = None
        return config


def agent_and_recipe(config: TrainConfig) -> tuple[str, str | None]:
    """The names of the agent, "" if it is not known, and of its recipe, None for none."""
    text = config.recipe or ""
    agent, other, name = text.partition(_WITH)
    return (agent, name) if other else (text.partition("/")[0], text if "/" in text else None)


def with_recipe_by_rule(
    words: Sequence[str],
    compose: Callable[[Sequence[str]], tuple[TrainConfig, Chosen]],
    world: World = compiled,
) -> tuple[TrainConfig, Chosen, list[str]]:
    """Compose a command line, and once more where the rule says another recipe than Hydra brought in.

    Returns the settings, what is chosen, and the words added.
    """
    config, chosen = compose(words)
    chosen.check()
    if chosen.is_open and GROUP not in map(key_of, words):
        for name in _in_order(config, chosen, words, world):
            if name == chosen.recipe:
                break
            word = f"{GROUP}={name or NONE}"
            again, others = compose([*words, word])
            if name is None or others.has_its_sizes(again):
                return others.settle(again, words), others, [word]
    return chosen.settle(config, words), chosen, []


def _in_order(
    config: TrainConfig, chosen: Chosen, words: Sequence[str], world: World
) -> Iterator[str | None]:
    """The recipes that fit, the best one first; the next one is for where an experiment has its own sizes."""
    names = [f"{chosen.agent}/{name}" for name in (chosen.env, *config.env.recipes_of)]
    own = next(filter(chosen.file, names), None)
    is_changed = any(map(_OTHER_WORLD.match, words)) and not is_world(config.env, chosen.env)
    is_changed = is_changed and chosen.file(f"{chosen.agent}/{STOCHASTIC}") is not None
    if own is not None and not (is_changed and _class_of(lambda: world(config.env)) == STOCHASTIC):
        yield own
    elif not any(key in _SIZE for key in map(key_of, words)):
        yield recipe_of_class(chosen.agent, config, lambda: world(config.env), chosen.file)
    yield None


def recipe_of_class(
    agent: str,
    config: TrainConfig,
    world: Callable[[], Mdp],
    file: Callable[[str], object] = lambda name: (conf_folder() / GROUP / f"{name}.yaml").is_file(),
) -> str | None:
    """The agent's recipe for the world's class; None where it has none, or the settings make no world."""
    known = [name for name in CLASSES if file(f"{agent}/{name}")]
    if not known or getattr(config.agent, "engine", _ENGINE) != _ENGINE or has_own_code(config.callbacks):
        return None
    name = _class_of(world)
    return f"{agent}/{name}" if name in known else None


def _class_of(world: Callable[[], Mdp]) -> str | None:
    """The class of a world; None where the settings make none, too: the check before training says why."""
    try:
        mdp = world()
    except (InputError, TypeError, ValueError, OSError):
        return None
    return STOCHASTIC if mdp.is_stochastic else LARGE if mdp.num_states > _DEFAULT_STATES else None


def is_world(env: EnvConfig, name: str) -> bool:
    """Whether a world is the one that `env=name` chooses of the shipped ones, whatever the step limit."""
    file = conf_folder() / "env" / f"{name}.yaml"
    if not file.is_file():
        return False
    own = dataclasses.asdict(type(env)()) | yaml.safe_load(file.read_text("utf-8"))
    given = dataclasses.asdict(env)
    keys = (own.keys() | given.keys()) - {"defaults", "max_episode_steps", "recipes_of"}
    return all(key in given and own[key] == given[key] for key in keys)
