"""The world that a run keeps: a map in its manifest, or tables in its folder."""

from __future__ import annotations

import dataclasses

from gridworld.config.worlds import EnvConfig, MapConfig
from gridworld.errors import InputError
from gridworld.process.npz import COPIES
from gridworld.run.folder import MANIFEST, WORLD
from gridworld.run.reader import LARGEST_RESULT, RunReader
from gridworld.storage.safe_read import read_bytes
from gridworld.world.layout import parse
from gridworld.world.mdp import Mdp
from gridworld.world.sources.arrays import world_from_bytes


def stored_world(run: RunReader, env: EnvConfig) -> Mdp:
    """Read the world of a run, whatever its settings describe by now.

    Args:
        run: The run.
        env: Its settings of the world, whose name a map gets.

    Raises:
        InputError: It is no valid map; or its tables are missing, damaged, or not those of the manifest.
    """
    text = "\n".join(run.manifest["layout"])
    if isinstance(env, MapConfig):
        layout = parse(text, f"{run.manifest_file}: layout")
        return env.compile_on(dataclasses.replace(layout, name=env.layout))
    is_noted = WORLD in run.manifest.get(
        "sha256", {}
    )  # earlier versions noted the digest of the tables alone
    read = run.read if is_noted else read_bytes
    mdp = world_from_bytes(read(run.world_file, LARGEST_RESULT, COPIES), str(run.world_file))
    if mdp.text() != text:
        raise InputError(
            f"{run.world_file}: is not the world that {MANIFEST} names; it was damaged or changed"
        )
    return mdp
