"""Composing settings with Hydra: its schemas, its resolvers, and what it composes as dataclasses."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import re
import secrets
import threading
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, flag_override, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from gridworld.base.errors import InputError
from gridworld.config.messages import meant, sentence
from gridworld.config.recipe_file import literal, with_recipe
from gridworld.config.recipes import MAY_NEED, Chosen, with_recipe_by_rule
from gridworld.config.settings import agent_schemas
from gridworld.config.sweep import LAUNCHER_SCHEMAS, SearchConfig, SweepConfig
from gridworld.config.train import TrainConfig
from gridworld.config.words import conf_folder, own_conf_folders, prepared, split
from gridworld.config.worlds import SOURCES, EnvConfig, GymnasiumConfig, MapConfig, World, compiled, is_id

if TYPE_CHECKING:  # importing numpy takes longer than `--help` does
    from gridworld.world.mdp import Mdp

VERSION_BASE = "1.3"
_LONGEST_NAME = 100  # characters of a job's folder
_ONE_AT_A_TIME = threading.RLock()  # Hydra composes with variables of the process
_LAUNCHERS = {name: f"gridworld.sweeps.launchers.{name}" for name in LAUNCHER_SCHEMAS}
_LAUNCHERS["basic"] = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_OURS = {"launcher": _LAUNCHERS, "sweeper": {"gridworld": SweepConfig._target_}}  # by their names
_NO_SINGLE_RUN = {  # with these of Hydra's options, a command line is not that of a run in the shipped `conf`
    *("-m", "--multirun", "--hydra-help", "--info", "-i", "--shell-completion", "-sc"),
    *("--config-name", "-cn", "--config-path", "-cp", "--experimental-rerun"),
}


def compose(words: Sequence[str], world: World = compiled) -> TrainConfig:
    """Compose the configuration that a command line of these words would give to a run.

    It may have `--config-dir` and `recipe=`. It may be called in any thread, and in a program that uses Hydra
    itself. `world` compiles the world, by which a recipe is chosen.
    """
    options, rest = split(words)
    values = [*search_path(list(own_conf_folders(options))), *with_recipe(rest)]
    try:
        with _leaving_hydra_as_it_was():
            _store_schemas()
            return compose_run(values, world)[0]
    except (HydraException, OmegaConfBaseException, YAMLError, OSError, ValueError) as error:
        raise InputError(sentence(error)) from None


def named_world(name: str, **settings: Any) -> Mdp:
    """Compile the world that `env=NAME` means on a command line, an id of Gymnasium's, or a map's file.

    `settings` change keys of `env`. The world has the step limit of the settings as `max_episode_steps`.
    """
    env: EnvConfig
    if is_id(name):
        env = GymnasiumConfig(id=name)
    elif name.endswith(".txt"):
        env = MapConfig(layout=name)
    else:
        env = compose([f"env={literal(name, 'env')}", "tuned=none"]).env
    known = {field.name for field in dataclasses.fields(env)} - {"source"}
    if wrong := sorted(set(settings) - known):
        raise InputError(f"{wrong[0]}: is not a setting of env={name}{meant(wrong[0], sorted(known))}")
    env = dataclasses.replace(env, **settings)
    mdp = env.compile()
    return dataclasses.replace(mdp, max_episode_steps=env.step_limit(mdp))


def compose_whole(name: str, words: Sequence[str]) -> DictConfig:
    """Compose `name` with Hydra's own part."""
    with hydra.initialize_config_dir(version_base=VERSION_BASE, config_dir=str(conf_folder())):
        return hydra.compose(name, prepared(words), return_hydra_config=True)


def compose_run(words: Sequence[str], world: World = compiled) -> tuple[TrainConfig, Chosen, list[str]]:
    """Compose a run's settings with the recipe that fits; what it chooses; the word for that recipe."""

    def composed(words: Sequence[str]) -> tuple[TrainConfig, Chosen]:
        whole = compose_whole("train", words)
        chosen = Chosen.of(whole.hydra)
        return to_config(whole), chosen

    return with_recipe_by_rule(prepared(words), composed, world)


def refuse_unused(own: DictConfig, but: Collection[str] = ()) -> None:
    """Refuse a launcher or a sweeper that is not ours, or one of `but`; `own` is Hydra's part."""
    runtime = own.runtime
    files = [Path(s.path, g, f"{c}.yaml") for s in runtime.config_sources for g, c in runtime.choices.items()]
    for kind, ours in _OURS.items():
        known, target = sorted(ours.keys() - set(but)), own[kind].get("_target_")
        if target not in map(ours.get, known):
            word = f"hydra/{kind}={runtime.choices[f'hydra/{kind}']}"
            found = [f", in {at}" for at in files if at.is_file() and f"{kind}:" in at.read_text("utf-8")]
            where = found[0] if found and word not in own.overrides.hydra else ""
            raise InputError(f"{word}{where}: {target} is not used here; choose from {', '.join(known)}")


def completed(words: Sequence[str], world: World = compiled) -> list[str]:
    """A command line as Hydra takes it, options first, with the word that chooses a single run's recipe."""
    options, rest = split(words)
    named = {option.partition("=")[0] for option in options}
    rest = prepared(with_recipe(rest), of_many=bool(named & {"-m", "--multirun"}))
    own = list(own_conf_folders(options))
    if named & _NO_SINGLE_RUN or not (own or any(map(MAY_NEED.match, rest))):
        return [*options, *rest]
    with contextlib.suppress(OmegaConfBaseException):  # an interpolation may need what only Hydra's job knows
        _, chosen, added = compose_run([*search_path(own), *rest], world)
        rest = [*(word.replace("tuned=${agent}", f"tuned={chosen.agent}") for word in rest), *added]
    return [*options, *rest]


def search_path(folders: Sequence[Path]) -> list[str]:
    """The word by which Hydra searches these folders too, if there are any."""
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"--config-dir {folder}: no such folder")
    places = [f"file://{folder.resolve()}" for folder in folders]
    return [f"hydra.searchpath={literal(places, 'hydra.searchpath')}"] if folders else []


@contextlib.contextmanager
def _leaving_hydra_as_it_was() -> Iterator[None]:
    """Have Hydra's variables of the process to oneself, and put them back after the block."""
    with _ONE_AT_A_TIME:
        whole, version = GlobalHydra.instance(), VersionBase.instance()
        own, base = whole.hydra, version.getbase()
        whole.clear()
        try:
            yield
        finally:
            GlobalHydra.set_instance(whole)  # Hydra puts a copy in its place
            VersionBase.set_instance(version)
            whole.hydra = own
            version.version_base = base


def drop_hydra(whole: DictConfig) -> DictConfig:
    """Delete Hydra's own part from a composition, if it is there."""
    with read_write(whole), open_dict(whole):
        whole.pop("hydra", None)
    return whole


def to_config(settings: DictConfig) -> TrainConfig:
    """Convert what Hydra composed to dataclasses; its own part is deleted."""
    config = cast(TrainConfig, OmegaConf.to_object(drop_hydra(settings)))
    _refuse_added_keys(config)
    return config


def _refuse_added_keys(section: Any, prefix: str = "") -> None:
    """Refuse keys that `+key=value` added, which gets past the schema while Hydra composes."""
    known = [field.name for field in dataclasses.fields(section)]
    for key, value in vars(section).items():
        if key not in known:
            raise InputError(f"{prefix}{key}: no such setting{meant(key, sorted(known))}")
        if dataclasses.is_dataclass(value):
            _refuse_added_keys(value, f"{prefix}{key}.")


def register_schemas() -> None:
    """Register the schemas with Hydra, and with OmegaConf the functions by which `conf/` names folders."""
    _store_schemas()
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("world", _world_name, replace=True)
    OmegaConf.register_new_resolver("token", lambda: secrets.token_hex(3), use_cache=True, replace=True)


@functools.cache  # they stay in Hydra's store
def _store_schemas() -> None:
    store = ConfigStore.instance()
    run = cast(DictConfig, OmegaConf.structured(TrainConfig(env=EnvConfig())))
    with flag_override(run, ["struct"], False):
        run.pop("recipe")  # which no file and no word can set
    store.store(name="train_schema", node=run)
    store.store(name="tune_schema", node=SearchConfig)
    store.store(group="hydra/sweeper", name="gridworld", node=SweepConfig)
    for name, launcher in LAUNCHER_SCHEMAS.items():
        store.store(group="hydra/launcher/schema", name=name, node=launcher)
    for name, schema in agent_schemas().items():
        store.store(group="agent/schema", name=name, node=schema)
    for name, source in SOURCES.items():
        node = cast(DictConfig, OmegaConf.structured(source))
        for key in {"kwargs", "rewards"}.intersection(node):
            OmegaConf.set_struct(node[key], False)  # which takes any name without a plus
        store.store(group="env/schema", name=name, node=node)


def _world_name(env: DictConfig) -> str:
    """What folders call the world of the section `env`."""
    plain = OmegaConf.to_container(env, throw_on_missing=False)  # composing says what is missing
    schema = cast(type[EnvConfig], OmegaConf.get_type(env))
    return schema(**cast(dict[str, Any], plain)).name


def slug(text: Any) -> str:
    """A folder's name made of a setting's value: letters, digits and a few safe signs."""
    name = re.sub(r"[^A-Za-z0-9_.,=+-]+", "-", Path(str(text)).stem if "/" in str(text) else str(text))
    return name.strip("-.")[:_LONGEST_NAME] or "run"
