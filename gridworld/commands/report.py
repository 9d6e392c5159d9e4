"""Compare many runs on one page: statistics over seeds with intervals, curves and tables.

RUNS are folders of runs or sweeps, or any above them. Exit code: 0 if every run is complete and counted, 1 if
the report has warnings (an unfinished run, two contradictory runs, a damaged file), 2 if there is nothing to
report.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import webbrowser
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from gridworld.base.console import printable, telling_if_slow
from gridworld.base.errors import InputError
from gridworld.base.user_input import limited
from gridworld.commands import parser_of, whole
from gridworld.report.analysis import Reason, Reasons, first_ones, gather
from gridworld.report.grouping import Group
from gridworld.report.writer import FORMATS, MARKERS, around_markers, check_out, write_readme, write_report
from gridworld.run.folder import check_inside
from gridworld.training.saved_run import SavedRun

_MOST_DIAGNOSED = 10


@limited()
def main(arguments: Sequence[str]) -> None:
    """Write the report and print its path."""
    options = _parser().parse_args(arguments)
    if options.out is not None:
        check_inside(options.out, "--out")
    is_one = len(options.runs) == 1 and options.runs[0].is_dir()
    out = options.out or (options.runs[0] / "report" if is_one else Path("runs/report"))
    check_out(out)
    if options.readme is not None:
        around_markers(options.readme)
    with telling_if_slow("reading the runs"):
        report = gather(options.runs, options.seed, options.log_steps)
    with telling_if_slow("diagnosing runs that are not certified"):
        found, left_out = reasons(report.study.groups, options.diagnose)
        report = replace(report, reasons=found, notes=(*report.notes, *left_out))
    with telling_if_slow("writing the report"):
        page = write_report(report, out, options.formats)
    if options.readme is not None:
        write_readme(report, options.readme)
    sentences = report.sentences()
    lines = [f"warning: {printable(each)}" for each in first_ones(sentences, ", all in the report")]
    lines += [f"note: {printable(note)}" for note in (*report.study.notes, *report.notes)]
    for line in lines:
        print(line, file=sys.stderr)
    print(printable(str(page)))
    if options.open and not webbrowser.open(page.absolute().as_uri()):
        print(printable(f"--open: no browser found here; open {page} in yours"), file=sys.stderr)
    if sentences:
        sys.exit(1)


def _parser() -> argparse.ArgumentParser:
    parser = parser_of("report", __doc__, "runs", example="runs/mine --open")
    option = parser.add_argument
    option(
        "--out",
        type=Path,
        help="folder to write to (default: report/ in the only folder given, or runs/report)",
    )
    option("--open", action="store_true", help="show the page in the browser")
    readme = f"also write the results into this Markdown file, between its lines {' and '.join(MARKERS)}"
    option("--readme", type=Path, help=readme)
    formats = f"formats of the figures, any of {' '.join(FORMATS)}; none without a word (default: all)"
    option("--formats", nargs="*", choices=FORMATS, default=FORMATS, metavar="FORMAT", help=formats)
    logarithm = "curves on a logarithmic step axis (automatic where one agent is ten times slower)"
    option("--log-steps", action="store_true", help=logarithm)
    most = f"diagnose at most so many runs that are not certified (default {_MOST_DIAGNOSED}, 0 for none)"
    option("--diagnose", type=whole(0), default=_MOST_DIAGNOSED, metavar="COUNT", help=most)
    option("--seed", type=whole(0), default=0, help="seed of the bootstrap (default 0)")
    return parser


def reasons(groups: Iterable[Group], most: int) -> tuple[Reasons, list[str]]:
    """Why runs are not certified, of so many at most: the first seed of each group before the second of any.

    Also a sentence for each run of which a file is damaged.
    """
    found, problems = {}, []
    columns = ([run for run in group.runs if not run.certified] for group in groups)
    in_turn = (run for row in itertools.zip_longest(*columns) for run in row if run is not None)
    for run in itertools.islice(in_turn, most):
        try:
            if (reason := _reason(run.folder)) is not None:
                found[run.folder] = reason
        except InputError as error:
            problems.append(f"{run.folder}: is not diagnosed; {error}")
    return found, problems


def _reason(folder: Path) -> Reason | None:
    # Here, since of most reports nothing is to be diagnosed.
    from gridworld.diagnosis.evidence import Evidence
    from gridworld.diagnosis.verdict import diagnose

    found = diagnose(Evidence.of(SavedRun(folder)))
    return None if found.phrase is None else Reason(found.phrase, found.first_change)
