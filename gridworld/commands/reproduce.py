"""Run a finished run again, from its manifest, and tell whether it comes to the same, bit for bit.

First it tells what differs between then and now: commit and uncommitted changes, versions, processor,
environment variables. Then it trains again, in a temporary folder, and compares the learning curve, the final
weights, visits, summary and TensorBoard's points. A run that was made longer is made longer again; one whose
numbers depend on other runs of its sweep is trained together with these. The exit code is 0 if all are
identical, 1 if any is not, 2 if that cannot be told.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gridworld.config.train import TrainConfig
from gridworld.errors import InputError
from gridworld.process.console.command_line import program
from gridworld.process.console.progress import telling_if_slow
from gridworld.process.console.terminal import printable
from gridworld.process.memory_budget import limited
from gridworld.process.signals import Interrupted
from gridworld.restore.reproduce import Finding, check_whole, compare, lengths, population, repeat
from gridworld.restore.saved_run import settings_of
from gridworld.run.claim import check_free, check_inside
from gridworld.run.folder import MANIFEST
from gridworld.run.identity.provenance import describe, differences, source_differences
from gridworld.run.identity.stored_world import stored_world
from gridworld.run.reader import RunReader, open_run, read_run
from gridworld.training.setup import without_pictures
from gridworld.world.mdp import Mdp

DIFFERENT = 1  # exit code


@limited()
def main(arguments: Sequence[str]) -> None:
    """Train again and print the comparison; ends the program with `DIFFERENT` if anything differs."""
    options = _parser().parse_args(arguments)
    then = open_run(options.run)
    config = settings_of(then, options.trust)
    mdp = stored_world(then, config.env)
    with telling_if_slow(f"reading {options.run}"):
        check_whole(then, config)  # training may take hours
    *shorter, _ = lengths(then, config)
    members = population(then)
    if options.keep is not None:
        check_inside(options.keep, "--keep")
        check_free(options.keep, "--keep")
    print(printable(f"{options.run}: {config.agent.name} on {config.env.name}, seed {config.seed}"))
    _tell_environment(list(differences(then.manifest, _here(then.manifest))))
    _tell_resumed(then)
    if shorter:
        told = ", ".join(f"{length:,}" for length in shorter)
        print(f"  made longer: to {told} steps first, then on to {config.total_timesteps:,}", flush=True)
    if members:
        told = ", ".join(run.folder.name for run in members)
        print(f"  its numbers depend on all runs of its population, which train again: {told}", flush=True)
    try:
        if options.keep is not None:
            options.keep.mkdir(parents=True, exist_ok=True)
            same = _again(then, options.keep, config, mdp, options.trust, members)
        else:
            with tempfile.TemporaryDirectory(prefix="gridworld-") as folder:
                plain = without_pictures(config)
                same = _again(then, Path(folder), plain, mdp, options.trust, members)
    except Interrupted as interruption:
        print(str(interruption), file=sys.stderr)
        sys.exit(interruption.exit_code)
    if same is None:
        raise InputError(
            f"{options.run}: all that could be compared is identical, but not all of the run is there; put "
            "its files back to compare them too"
        )
    print("identical" if same else "different")
    if not same:
        sys.exit(DIFFERENT)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=program("reproduce"), description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="the run's folder, e.g. runs/2026-...")
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="write the new run there, with its pictures, and keep it"
    )
    parser.add_argument(
        "--trust", action="store_true", help="import the classes that the run names, wherever they are from"
    )
    return parser


def _again(
    then: RunReader,
    folder: Path,
    config: TrainConfig,
    mdp: Mdp,
    trust: bool,
    members: Sequence[RunReader],
) -> bool | None:
    """Train again and compare: whether all is identical; None: all that can be compared is."""
    try:
        repeat(then, folder, config, mdp, trust, members)
    except InputError as error:
        if not (folder / MANIFEST).exists():  # these settings cannot be run here at all
            raise
        print(f"  it did not come to its end this time: {printable(str(error))}")
        return False
    with telling_if_slow("comparing"):
        findings = list(compare(then, read_run(folder), config, mdp))
    for finding in findings:
        _tell(finding)
    verdicts = {finding.same for finding in findings}
    return next((verdict for verdict in (False, None) if verdict in verdicts), True)


def _here(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """This environment, with torch's view of the processor if the run has it."""
    processor = manifest.get("processor")
    if isinstance(processor, dict) and processor.get("torch") is not None:
        importlib.import_module("torch")
    return describe()


def _tell_environment(differences: Sequence[str]) -> None:
    print(f"  {'environment':<20}{'differs' if differences else 'the same'}", flush=True)
    for line in differences:
        print(f"    {printable(line)}")


def _tell_resumed(run: RunReader) -> None:
    """Print what differed each time that the run was resumed."""
    before = run.manifest.get("git")
    for again in run.resumptions:
        differs = again.get("differs")
        lines = [f"{line} (anyway=true)" for line in differs] if isinstance(differs, list) else []
        if "git" in again:
            lines += source_differences(before, before := again["git"])
        for line in lines:
            where = f"went on after step {again.get('step')}"
            print(f"    {printable(f'{where}: {line}')}", flush=True)


def _tell(finding: Finding) -> None:
    verdict = {True: "identical", False: "DIFFERENT", None: "UNKNOWN"}[finding.same]
    print(f"  {finding.part:<20}{verdict:<9}  {printable(finding.detail)}")
