"""Reading a run's folder: its manifest, and the files with its result, verified.

`read_run` reads a run whatever its status, `open_run` a finished one. `run.recovery` also reads a run whose
manifest is lost, from a checkpoint's copy.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from gridworld.errors import InputError
from gridworld.run.folder import MANIFEST, PICTURES, RunFolder
from gridworld.run.manifest import read_manifest
from gridworld.storage.safe_read import LARGEST_JSON, as_object, file_sha256, read_bytes, sha256

LARGEST_RESULT = 2**30  # bytes of a file


class RunReader(RunFolder):
    """A run that another process wrote.

    Args:
        folder: The run's folder.
        manifest: The manifest's content, as `manifest.check_manifest` accepts it.
    """

    def __init__(self, folder: Path, manifest: dict[str, Any]) -> None:
        super().__init__(folder)
        self.manifest = manifest

    @property
    def is_finished(self) -> bool:
        """Whether the run came to its end."""
        return bool(self.manifest["status"] == "finished")

    @property
    def resumptions(self) -> list[dict[str, Any]]:
        """What the manifest says of each time that the run was resumed."""
        found: list[dict[str, Any]] = self.manifest.get("resumed", [])
        return found

    @property
    def git(self) -> Any:
        """The source tree of the last attempt, as `provenance.git` describes it."""
        attempts = [self.manifest, *self.resumptions]
        return next((attempt["git"] for attempt in reversed(attempts) if "git" in attempt), None)

    def read(self, path: Path, most: int, copies: int = 1) -> bytes:
        """Read a file with a part of the result.

        Only a finished run has checksums; the files of another are read unverified.

        Args:
            path: One of the run's files.
            most: The largest size allowed, in bytes.
            copies: How often the content will be in memory, for the memory budget.

        Returns:
            The whole content.

        Raises:
            InputError: The file is missing, too large, or not the one that the run wrote.
        """
        content = read_bytes(path, most, copies)
        if self.is_finished:
            self._check(path, sha256(content))
        return content

    def read_summary(self) -> dict[str, Any]:
        """The content of summary.json, verified as by `read`.

        Raises:
            InputError: As for `read`, or the file is no JSON object.
        """
        return as_object(self.read(self.summary_file, LARGEST_JSON), self.summary_file)

    def verify(self, path: Path) -> None:
        """Compare a file's checksum with the manifest's.

        Raises:
            InputError: The file is not the one that the run wrote.
        """
        self._check(path, file_sha256(path, LARGEST_RESULT))

    def pictures(self) -> dict[str, str | None]:
        """The checksum of each picture that the run drew; None where the manifest's format has none."""
        if self.manifest.get("format", 1) == 1:
            return dict.fromkeys(PICTURES)
        sums = self.manifest.get("sha256", {})
        return {name: sums[name] for name in PICTURES if name in sums}

    def _check(self, path: Path, digest: str) -> None:
        noted = self.manifest.get("sha256", {}).get(path.name)
        if noted is None:
            raise InputError(
                f"{self.manifest_file}: has no checksum (sha256) of {path.name}; was the run written by "
                "another version, or the file added to it?"
            )
        if digest != noted:
            raise InputError(
                f"{path}: is not the file that the run wrote, its checksum is not the one in {MANIFEST}; "
                "it was damaged or changed"
            )


def open_run(folder: Path) -> RunReader:
    """Read a finished run.

    Raises:
        InputError: As for `read_run`, or the run is not finished.
    """
    run = read_run(folder)
    if not run.is_finished:
        raise InputError(
            f"{folder}: this run is {run.manifest['status']!r}; only a finished one can be looked at"
        )
    return run


def read_run(folder: Path) -> RunReader:
    """Read a run, finished or not.

    Raises:
        InputError: The folder holds no run, or its manifest was damaged or changed.
    """
    check_is_run(folder)
    return RunReader(folder, read_manifest(folder / MANIFEST))


def check_is_run(folder: Path) -> None:
    """Check that a folder has a manifest, whatever is in it.

    Raises:
        InputError: It has none, or there is no such folder.
    """
    if not folder.exists():
        raise InputError(f"{folder}: no such folder; give the folder of a run, e.g. one in runs/")
    if not os.path.lexists(folder / MANIFEST):
        raise InputError(f"{folder}: not a run's folder, it has no {MANIFEST}")
