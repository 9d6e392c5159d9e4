"""Which files of a finished run are not the ones that it wrote."""

from __future__ import annotations

from gridworld.errors import InputError
from gridworld.run.folder import CHECKED
from gridworld.run.reader import RunReader


def damage(run: RunReader) -> dict[str, str]:
    """Read every file that the manifest vouches for, and compare.

    Args:
        run: A finished run.

    Returns:
        By the file's name, a sentence for each that is missing, unreadable or another.
    """
    found, sums = {}, run.manifest.get("sha256", {})
    for name in CHECKED:
        try:
            if name in sums:
                run.verify(run.folder / name)
        except InputError as error:
            found[name] = str(error)
    return found
