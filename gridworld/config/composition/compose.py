"""Composing settings with Hydra: its schemas, its resolvers, and what it composes as dataclasses."""

from __future__ import annotations

import contextlib
import functools
import re
import secrets
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.version import VersionBase
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from gridworld.config.agents import MISSING, agent_schemas
from gridworld.config.composition.conf_folder import conf_folder
from gridworld.config.composition.hydra_errors import refuse_added_keys
from gridworld.config.composition.loader import composing_from
from gridworld.config.sweep import LAUNCHER_SCHEMAS, SweepConfig
from gridworld.config.train import TrainConfig
from gridworld.config.tune import SearchConfig
from gridworld.config.worlds import SOURCES, EnvConfig

_LONGEST_NAME = 100  # characters of a job's folder
_ONE_AT_A_TIME = threading.RLock()  # Hydra composes with variables of the process


def compose(conf: Path, overrides: list[str]) -> TrainConfig:
    """Compose the configuration that a command line would give to a run.

    It may be called in any thread, and in a program that uses Hydra itself.

    Args:
        conf: the folder of the yaml files.
        overrides: the command line's words.
    """
    with _leaving_hydra_as_it_was():
        _store_schemas()
        with composing_from(conf):
            settings = hydra.compose(config_name="train", overrides=overrides)
    return to_config(settings)


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


def without_hydra(whole: DictConfig) -> TrainConfig:
    """Convert a composition that has Hydra's own part too, which is deleted from it. See `to_config`."""
    with read_write(whole), open_dict(whole):
        del whole["hydra"]
    return to_config(whole)


def to_config(settings: DictConfig) -> TrainConfig:
    """Convert Hydra's settings to the dataclasses that everything below takes."""
    refuse_added_keys(settings)
    return cast(TrainConfig, OmegaConf.to_object(settings))


def register_schemas() -> None:
    """Register the schemas with Hydra, and with OmegaConf the functions by which `conf/` names folders."""
    _store_schemas()
    OmegaConf.register_new_resolver("slug", slug, replace=True)
    OmegaConf.register_new_resolver("world", _world_name, replace=True)
    OmegaConf.register_new_resolver("token", lambda: secrets.token_hex(3), use_cache=True, replace=True)


@functools.cache  # they stay in Hydra's store
def _store_schemas() -> None:
    """Register the schemas with Hydra."""
    store = ConfigStore.instance()
    store.store(name="train_schema", node=TrainConfig(env=EnvConfig()))
    store.store(name="tune_schema", node=SearchConfig)
    store.store(group="hydra/sweeper", name="gridworld", node=SweepConfig)
    for name, launcher in LAUNCHER_SCHEMAS.items():
        store.store(group="hydra/launcher/schema", name=name, node=launcher)
    for name, schema in agent_schemas().items():
        store.store(group="agent/schema", name=name, node=schema)
    for name, source in SOURCES.items():
        store.store(group="env/schema", name=name, node=_open(source))
    studies = {file.stem for file in (conf_folder() / "experiment").glob("*.yaml")}
    for env, agent in pairs():  # as a recipe was called before an agent in a world chose it by itself
        if (name := f"{env}_{agent}") not in studies:
            chosen = {"defaults": [{"override /env": env}, {"override /agent": agent}]}
            store.store(group="experiment", name=name, package="_global_", node=chosen)


def pairs() -> list[tuple[str, str]]:
    """Every shipped world with every shipped agent, by the names of their files in `conf`."""
    conf = conf_folder()
    envs = [file for file in sorted((conf / "env").glob("*.yaml")) if MISSING not in file.read_text("utf-8")]
    agents = sorted((conf / "agent").glob("*.yaml"))
    return [(env.stem, agent.stem) for env in envs for agent in agents]


def _world_name(env: DictConfig) -> str:
    """What folders call the world of the section `env`."""
    plain = OmegaConf.to_container(env, throw_on_missing=False)  # composing says what is missing
    schema = cast(type[EnvConfig], OmegaConf.get_type(env))
    return schema(**cast(dict[str, Any], plain)).name


def _open(source: type[EnvConfig]) -> DictConfig:
    """A source's schema whose `kwargs`, if it has them, take any name without a plus."""
    node = cast(DictConfig, OmegaConf.structured(source))
    if "kwargs" in node:
        OmegaConf.set_struct(node.kwargs, False)
    return node


def slug(text: Any) -> str:
    """Make a folder's name of a setting's value.

    Returns:
        Letters, digits and a few safe signs, of bounded length.
    """
    name = re.sub(r"[^A-Za-z0-9_.,=+-]+", "-", Path(str(text)).stem if "/" in str(text) else str(text))
    return name.strip("-.")[:_LONGEST_NAME] or "run"
