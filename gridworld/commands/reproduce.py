"""Repeat a finished run from its manifest, and compare the results bit for bit.

It prints what has changed since then: commit and uncommitted changes, versions, processor, environment
variables. Then it trains again in a temporary folder and compares the learning curve, final weights, visits,
summary and TensorBoard points. A lengthened run is lengthened again. Repeated after a kill, a command with
--keep continues its run.
Exit code: 0 if everything is identical, 1 if not, 2 if undecided.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from gridworld.base.console import printable, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.run.folder import check_inside, claimed
from gridworld.run.provenance import describe, differences, source_differences
from gridworld.run.reader import RunReader, check_free, find_run, open_run, read_run, stored_world
from gridworld.training.reproduce import check_whole, compare, lengths, repeat
from gridworld.training.saved_run import settings_of
from gridworld.training.setup import without_pictures

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
    if options.keep is not None:
        check_inside(options.keep, "--keep")
        kept = find_run(options.keep)  # begun before the run had ended, it is the run itself or a copy
        is_later = kept is not None and str(kept.manifest.get("started")) > str(then.manifest.get("ended"))
        check_free(options.keep, "--keep", is_later)
    print(printable(f"{options.run}: {config.agent.name} on {config.env.name}, seed {config.seed}"))
    for line in _circumstances(then):
        print(f"  {printable(line)}", flush=True)
    if shorter:
        steps = ", ".join(f"{length:,}" for length in shorter)
        print(f"  made longer: to {steps} steps first, then on to {config.total_timesteps:,}", flush=True)
    with (
        tempfile.TemporaryDirectory(prefix="gridworld-") as temporary,
        claimed(folder := options.keep or Path(temporary) / "again"),
    ):
        if (before := find_run(folder)) and before.is_finished:
            print(printable(f"  continues the run in {folder}, which had finished"))
        again = config if options.keep is not None else without_pictures(config)
        try:
            repeat(then, folder, again, mdp, options.trust)
        except InputError as error:
            now = find_run(folder)
            if now is None or (before and now.manifest == before.manifest):  # nothing was trained
                raise
            print(f"  it did not finish this time: {printable(str(error))}\ndifferent")
            sys.exit(DIFFERENT)
        with telling_if_slow("comparing"):
            findings = list(compare(then, read_run(folder), again, mdp))
    for finding in findings:
        verdict = {True: "identical", False: "DIFFERENT", None: "UNKNOWN"}[finding.same]
        print(f"  {finding.part:<20}{verdict:<9}  {printable(finding.detail)}")
    verdicts = {finding.same for finding in findings}
    if False in verdicts:
        print("different")
        sys.exit(DIFFERENT)
    if None in verdicts:
        raise InputError(
            f"{options.run}: everything that could be compared is identical, but files of the run are "
            "missing; restore them to compare them too"
        )
    print("identical")


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("reproduce", __doc__, "run", "--trust", example="runs/mine --keep runs/again")
    kept = "write the new run to this folder, with its pictures, and keep it"
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help=kept)
    return parser


def _circumstances(run: RunReader) -> Iterator[str]:
    """What differs between then and now, and what differed each time that the run was resumed."""
    processor = run.manifest.get("processor")
    if isinstance(processor, dict) and processor.get("torch") is not None:
        importlib.import_module("torch")  # whose view of the processor is compared too
    found = list(differences(run.manifest, describe()))
    yield f"{'environment':<20}{'differs' if found else 'the same'}"
    yield from (f"  {line}" for line in found)
    before = run.manifest.get("git")
    for again in run.resumptions:
        differs = again.get("differs")
        lines = [f"{line} (anyway=true)" for line in differs] if isinstance(differs, list) else []
        if "git" in again:
            lines += source_differences(before, before := again["git"])
        yield from (f"  resumed after step {again.get('step')}: {line}" for line in lines)
