"""Open a page in the browser that solves a world, lets tables learn in it, and looks into a run.

WORLD is a name as in env=NAME, a map file, words as for train (env=cliff env.slip=0.1), or the folder of a
finished run; without it, the default world. The page is one file that needs no server and no network.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from gridworld.base.atomic_write import make_folder, write_text
from gridworld.base.console import printable, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import limited
from gridworld.commands import parser_of
from gridworld.report.playground.page import page_of
from gridworld.run.folder import check_inside, check_writable


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
        conf = [f"--config-dir={each}" for each in options.config_dir]
        page = page_of(options.words, conf, options.best, options.trust)
    path = out or Path(tempfile.mkdtemp(prefix="gridworld-"), "playground.html")
    make_folder(path.parent)
    write_text(path, page)
    print(printable(str(path)))
    if out is None and not webbrowser.open(path.absolute().as_uri()):
        print(printable(f"no browser found here; open {path} in yours"), file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of(
        "playground", __doc__, "--best", "--trust", "--config-dir", example="cliff --out cliff.html"
    )
    option = parser.add_argument
    example = "e.g. cliff, my_map.txt, env=maze env.slip=0.1, or runs/2026-..."
    option("words", nargs="*", metavar="WORLD", help=example)
    option("--out", type=Path, metavar="FILE", help="write the page there (.html), and do not open it")
    return parser
