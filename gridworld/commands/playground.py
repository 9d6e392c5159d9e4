"""Open a page in the browser that solves a world, lets tables learn in it, and looks into a run.

WORLD is a name as in env=NAME, a map file, words as for train (env=cliff env.slip=0.1), or the folder of a
finished run; without it, the default world. The page is one file that needs no server and no network.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.atomic_write import make_folder, write_text
from gridworld.base.bounds import STEP_LIMIT
from gridworld.base.console import printable, program, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.config.compose import compose, named_world
from gridworld.config.words import refuse_unclear
from gridworld.report.playground.page import GAMMA, run_page, world_page
from gridworld.run.folder import check_inside, check_writable
from gridworld.training.saved_run import SavedRun


@limited()
def main(arguments: Sequence[str]) -> None:
    """Write the page, print its path, and without --out open it."""
    options = _parser().parse_args(arguments)
    out: Path | None = options.out
    if out is not None:
        check_inside(out, "--out")
        if out.suffix != ".html" or out.is_dir():
            raise InputError(f"--out {out}: must be the name of a file that ends with .html")
        check_writable(out.parent, "--out")
    with telling_if_slow("making the page"):
        page = _page(options)
    if out is None:
        handle, name = tempfile.mkstemp(prefix="gridworld-playground-", suffix=".html")
        os.close(handle)
        path = Path(name)
    else:
        make_folder(out.parent)
        path = out
    write_text(path, page)
    print(printable(str(path)))
    if out is None and not webbrowser.open(path.absolute().as_uri()):
        print(
            printable(f"{program('playground')}: no browser found here; open {path} in yours"),
            file=sys.stderr,
        )


def _page(options: argparse.Namespace) -> str:
    words: list[str] = options.words
    alone = words[0] if len(words) == 1 else ""
    is_path = Path(alone).exists() or os.sep in alone.partition("=")[0]  # a run of a sweep may be seed=0
    name = alone if is_path or "=" not in alone else ""
    if name.endswith(os.sep) or (name and Path(name).is_dir()):
        return run_page(SavedRun(Path(name), options.trust, options.best))
    if folders := [word for word in words if Path(word).is_dir()]:
        raise InputError(f"{folders[0]}: is a folder; give it alone, since a run has its own settings")
    if os.sep in name and not Path(name).exists():
        raise InputError(f"{name}: no such run or map file")
    if options.best:
        raise InputError("--best: chooses between the models of a run; give the run's folder")
    if options.config_dir:
        words = [f"env={name}"] if name else words
        words = [*words, *(f"--config-dir={each}" for each in options.config_dir)]
    elif name or not words:
        mdp = named_world(name or "classic")
        return world_page(mdp, GAMMA, mdp.max_episode_steps or STEP_LIMIT)
    refuse_unclear(words)
    config = compose(words)
    mdp = config.env.compile()
    return world_page(mdp, config.evaluation.gamma, config.env.step_limit(mdp))


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("playground", __doc__, "--best", "--trust", "--config-dir")
    option = parser.add_argument
    option(
        "words",
        nargs="*",
        metavar="WORLD",
        help="e.g. cliff, my_map.txt, env=maze env.slip=0.1, or runs/2026-...",
    )
    option("--out", type=Path, metavar="FILE", help="write the page there (.html), and do not open it")
    return parser
