"""What rows show, with intervals: two pages are filled between their marks, `<!-- atlas: NAME -->`."""

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from plan import CLEANRL, DISCOUNT, LIBRARIES, MARGIN, MATCHED, ROOT, Job, World, evaluator, worlds_of
from rows import Row
from scipy import stats

from gridworld.report import statistics
from gridworld.report.chart import INK, compact, house_style, styles

SEED = 0  # of the bootstrap
_LEVEL = 0.05  # of each one-sided test
_FEW = 10  # seeds, with fewer of which nothing is concluded
_TWO = "{:.2f}".format
_SHOWN = ("certified for good", "median steps to it", "regret at the end", "a run takes")


class Group(NamedTuple):
    """The rows of one library's algorithm in one world."""

    library: str
    algorithm: str
    world: World
    rows: list[Row]  # by seed
    steps: np.ndarray  # to certified for good; infinity where it is not
    certified: statistics.Share


def groups(rows: Sequence[Row], page: str) -> list[Group]:
    """The rows of a page as its settings are now, with each library's newest versions in the file."""
    newest = {row.library: row.versions for row in rows if row.page == page}
    kept = []
    for algorithm, world, library in itertools.product(MATCHED, worlds_of(page), LIBRARIES):
        name = (page, library, algorithm, world.name)
        own = [row for row in rows if row[:4] == name and row.versions == newest[library]]
        if own and (own := [row for row in own if row.digest == Job(*name[:3], world, 0).digest]):
            own.sort(key=lambda row: int(row.seed))
            steps = np.array([float(row.certified_since or math.inf) for row in own])
            share = statistics.share(int(np.isfinite(steps).sum()), len(own))
            kept.append(Group(library, algorithm, world, own, steps, share))
    return kept


class Comparison(NamedTuple):
    """Two libraries' same algorithm in the same world, by steps to certified for good."""

    verdict: str  # of this pair alone, without a correction for how many pairs there are
    identical: int  # on how many seeds both have the same curve, in every digit
    improvement: statistics.Interval  # the probability that a run of the first needs fewer steps
    ratio: statistics.Interval | None  # of geometric means, 90 %; None where a run was not certified
    p: float | None  # of two one-sided tests


def compare(first: Group, second: Group) -> Comparison:
    """Compare two groups."""
    least, both = min(len(first.rows), len(second.rows)), (first.steps, second.steps)
    curves = {(row.seed, row.curve, row.done) for row in first.rows}
    identical = sum((row.seed, row.curve, row.done) in curves for row in second.rows)
    ratio, p = equivalence(*both) if least > 1 and np.isfinite(np.concatenate(both)).all() else (None, None)
    apart = ratio or statistics.difference(first.certified, second.certified)
    is_apart = apart.low > (ratio is not None) or apart.high < (ratio is not None)  # than 1, than 0
    verdict = "differ" if is_apart else "undecided"
    verdict = "equal" if p is not None and p <= _LEVEL else verdict
    verdict = "too few seeds" if least < _FEW else verdict
    verdict = "the same curves" if identical == least else verdict
    return Comparison(verdict, identical, statistics.improvement([(-both[0], -both[1])], SEED), ratio, p)


def equivalence(one: np.ndarray, other: np.ndarray) -> tuple[statistics.Interval, float]:
    """The ratio of geometric means with its 90 % interval, and the p value of two one-sided Welch tests.

    D. Schuirmann, Journal of Pharmacokinetics and Biopharmaceutics 15, 1987.
    """
    logs, margin = [np.log(np.maximum(steps, 1)) for steps in (one, other)], math.log(MARGIN)
    gap, parts = logs[0].mean() - logs[1].mean(), [log.var(ddof=1) / len(log) for log in logs]
    error = math.sqrt(sum(parts))
    if error == 0:
        return statistics.Interval(*[math.exp(gap)] * 3), float(abs(gap) >= margin)
    freedom = sum(parts) ** 2 / sum(part**2 / (len(log) - 1) for part, log in zip(parts, logs, strict=True))
    half = stats.t.ppf(1 - _LEVEL, freedom) * error
    p = max(stats.t.sf((margin + side * gap) / error, freedom) for side in (1, -1))
    return statistics.Interval(*(math.exp(gap + side * half) for side in (0, -1, 1))), float(p)


def caution(found: Sequence[Group]) -> str:
    """How much so many seeds allow to say."""
    counts = sorted(len(group.rows) for group in found) or [0]
    number = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1])))) + f" seed{'s' * (counts[-1] != 1)}"
    return f"**{number}{': a smoke test, no claim' if counts[0] < _FEW else ''}.**"


def draw(rows: list[Row], docs: Path = ROOT / "docs") -> None:
    """Fill both pages."""
    for page, blocks in (("implementations", _implementations), ("defaults", _defaults)):
        file = docs / "reference" / f"{page}.md"
        text = file.read_text("utf-8")
        found = groups(rows, page)
        versions = sorted({f"- `{group.library}`: {group.rows[0].versions}" for group in found})
        shared = {"caution": caution(found), "versions": "\n".join(versions) or "No rows yet."}
        for name, block in {**shared, **blocks(found, docs / "data")}.items():
            before, mark, rest = text.partition(f"<!-- atlas: {name} -->\n")
            text = f"{before}{mark}\n{block}\n\n{rest[rest.index('<!-- end -->') :]}"
        file.write_text(text, encoding="utf-8")


def _table(head: Sequence[str], lines: Sequence[Sequence[str]], texts: int = 3) -> str:
    shape = ["---" if index < texts else "--:" for index in range(len(head))]
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, shape, *lines]) if lines else "No rows yet."


def _share(share: statistics.Share) -> str:
    return f"{share.count} of {share.total} ({share.low:.0%} to {share.high:.0%})"


def _number(value: float) -> str:
    return "never" if math.isinf(value) else compact(float(f"{value:.3g}"))


def _interval(found: statistics.Interval, text: Callable[[float], str] = _number) -> str:
    bounds = "" if math.isnan(found.low) else f" ({text(found.low)} to {text(found.high)})"
    return text(found.point) + bounds


def _seconds(found: Sequence[Group]) -> str:
    return f"{np.median([row.seconds for group in found for row in group.rows]):.0f} s"


def _implementations(found: list[Group], figures: Path) -> dict[str, str]:
    lines, pairs = [], []
    for group in found:
        regret = np.array([row.regret for row in group.rows])
        steps = statistics.interval(statistics.median, [group.steps], SEED)
        last = statistics.interval(statistics.iqm, [regret], SEED)
        cells = (_share(group.certified), _interval(steps), _interval(last), _seconds([group]))
        lines.append((group.algorithm, group.world.name, group.library, *cells))
    for one, other in itertools.combinations(found, 2):
        if (one.algorithm, one.world.name) == (other.algorithm, other.world.name):
            verdict, identical, improvement, ratio, p = compare(one, other)
            same = f"{identical} of {min(len(one.rows), len(other.rows))}"
            tested = ("", "") if ratio is None else (_interval(ratio, _TWO), f"{p:.3f}")
            place = (one.algorithm, one.world.name, f"{one.library} : {other.library}")
            pairs.append((*place, verdict, same, _interval(improvement, _TWO), *tested))
    named = ("algorithm", "world", "library")
    numbers = ("same curve", "P(first is faster)", "ratio of steps, 90 %", f"p, margin {MARGIN}")
    drawn = [_curves(name, found, figures) for name in MATCHED if any(g.algorithm == name for g in found)]
    lists = {**MATCHED, "names in CleanRL": {name: f"`{own}`" for name, own in CLEANRL.items()}}
    settings = [
        f"- {what}: {', '.join(f'`{name}` {value}' for name, value in each.items())}"
        for what, each in lists.items()
    ]
    return {
        "settings": "\n".join(settings),
        "results": _table((*named, *_SHOWN), lines),
        "pairs": _table((*named[:2], "pair", "verdict", *numbers), pairs, 4),
        "figures": "\n\n".join(drawn),
    }


def _curves(algorithm: str, found: Sequence[Group], figures: Path) -> str:
    """A panel for each world: the interquartile mean of regret over steps, with its band."""
    own = [group for group in found if group.algorithm == algorithm]
    worlds, drawn = list(dict.fromkeys(group.world.name for group in own)), styles(list(LIBRARIES))
    down, across = -(-len(worlds) // 3), min(3, len(worlds))
    with house_style(algorithm):
        size = (3.2 * across + 0.6, 2.4 * down + 0.6)
        figure, axes = plt.subplots(down, across, squeeze=False, figsize=size, layout="constrained")
        handles = {}
        for axis, world in itertools.zip_longest(axes.flat, worlds):
            axis.set_visible(world is not None)
            axis.set(title=world, xlabel="steps", ylabel="regret")
            axis.xaxis.set_major_formatter(compact)
            for group in (each for each in own if each.world.name == world):
                (steps, *_), regrets = zip(*(row.points() for row in group.rows), strict=True)
                point, low, high = statistics.bands(statistics.iqm, [np.stack(regrets, axis=1)], SEED)
                [handles[group.library]] = axis.plot(steps, point, **drawn[group.library])
                axis.fill_between(steps, low, high, alpha=0.2, color=drawn[group.library]["color"], lw=0)
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=len(handles))
        figure.savefig(figures / f"atlas_{algorithm}.svg", metadata={"Date": None})
    plt.close(figure)
    return f"![Exact regret of {algorithm} over steps](../data/atlas_{algorithm}.svg)"


def _defaults(found: list[Group], figures: Path) -> dict[str, str]:
    kinds, worlds = defaultdict(list), defaultdict[World, dict[tuple[str, str], str]](dict)
    for group in found:
        kinds[group.library, group.algorithm].append(group)
        worlds[group.world][group.library, group.algorithm] = _share(group.certified)
    lines = []
    for kind, own in sorted(kinds.items()):
        each = [row for group in own for row in group.rows]
        share = statistics.share(sum(group.certified.count for group in own), len(each))
        scales = [abs(evaluator(group.world, DISCOUNT).optimal_value) for group in own]
        shares = [np.minimum([row.regret / s for row in g.rows], 1) for g, s in zip(own, scales, strict=True)]
        regret = statistics.interval(statistics.mean, shares, SEED)
        causes = Counter(row.cause for row in each if row.cause).most_common()
        why = ", ".join(f"{cause} {count}" for cause, count in causes)
        cells = (_share(share), _interval(regret, _TWO), _seconds(own), why)
        lines.append((*kind, str(len(own)), str(len(each)), *cells))
    head = ("library", "algorithm", "worlds", "runs", *_SHOWN[::2], _SHOWN[3], "causes by `diagnose`")
    places = [
        (
            *(world.name, "yes" if world.mdp.is_stochastic else "no", str(world.mdp.num_states)),
            f"{evaluator(world, DISCOUNT).optimum.expected_length:.1f}",
            *(by_kind.get(kind, "") for kind in sorted(kinds)),
        )
        for world, by_kind in worlds.items()
    ]
    named = [" ".join(kind) for kind in sorted(kinds)]
    return {
        "figure": _map(kinds, figures) if kinds else "No rows yet.",
        "results": _table(head, lines, 2),
        "worlds": _table(("world", "chance", "states", "steps of the optimum", *named), places, 2),
    }


def _map(kinds: dict[tuple[str, str], list[Group]], figures: Path) -> str:
    """A panel for each algorithm: its worlds by their size and how far their goal is."""
    with house_style("defaults"):
        size = (2.7 * len(kinds) + 1.1, 3.2)
        figure, axes = plt.subplots(
            1, len(kinds), squeeze=False, sharey=True, figsize=size, layout="constrained"
        )
        for axis, (kind, own) in zip(axes.flat, sorted(kinds.items()), strict=True):
            axis.set(title=" ".join(kind), xlabel="steps of the optimum", xscale="log", yscale="log")
            axis.set(xticks=[1, 3, 10, 30, 100], yticks=[10, 30, 100, 300], xlim=(0.8, 120), ylim=(4, 700))
            axis.minorticks_off()
            axis.xaxis.set_major_formatter(compact)
            axis.yaxis.set_major_formatter(compact)
            for is_stochastic, marker, label in ((False, "o", "without chance"), (True, "^", "with chance")):
                some = [group for group in own if group.world.mdp.is_stochastic == is_stochastic]
                far = [evaluator(group.world, DISCOUNT).optimum.expected_length for group in some]
                sizes = [group.world.mdp.num_states for group in some]
                shares = [group.certified.count / group.certified.total for group in some]
                shown = {
                    "c": shares,
                    "cmap": "viridis",
                    "vmin": 0,
                    "vmax": 1,
                    "edgecolors": INK,
                    "linewidths": 0.6,
                }
                dots = axis.scatter(far, sizes, marker=marker, s=46, label=label, **shown)
        axes[0, 0].set_ylabel("states")
        figure.legend(*axis.get_legend_handles_labels(), loc="outside upper left", ncols=2)
        figure.colorbar(dots, ax=axes, label="share certified for good")
        figure.savefig(figures / "atlas_defaults.svg", metadata={"Date": None})
    plt.close(figure)
    return "![Worlds by size, distance and share of certified runs](../data/atlas_defaults.svg)"
