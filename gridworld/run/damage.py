"""Which files of a finished run are not the ones that it wrote."""

from __future__ import annotations

from gridworld.config.worlds import MapConfig, schema_of
from gridworld.errors import InputError
from gridworld.run.folder import PICTURES, RESULTS, WORLD
from gridworld.run.identity.stored_world import stored_world
from gridworld.run.reader import RunReader


def damage(run: RunReader) -> dict[str, str]:
    """Read every file that the manifest vouches for, and compare.

    Args:
        run: A finished run.

    Returns:
        By the file's name, a sentence for each that is missing, unreadable or another.
    """
    found, sums = {}, run.manifest.get("sha256", {})
    for name in (*RESULTS, *PICTURES):
        try:
            if name in sums:
                run.verify(run.folder / name)
        except InputError as error:
            found[name] = str(error)
    source = schema_of(run.manifest["config"].get("env"))
    if not issubclass(source, MapConfig):
        try:
            stored_world(run, source())  # of tables, the manifest has a checksum of its own
        except InputError as error:
            found[WORLD] = str(error)
    return found
