"""The tables and figures of the two pages, drawn from the CSV between the marks `<!-- atlas: NAME -->`."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from analysis import SEED, Comparison, Group, caution, groups
from plan import CLEANRL, FIXED, LIBRARIES, MARGIN, MATCHED, NOT_HERE, ROOT
from rows import Row

from gridworld.report import statistics
from gridworld.report.chart import compact, house_style, styles

_DOCS = ROOT / "docs"


def draw(rows: list[Row], docs: Path = _DOCS) -> None:
    """Fill both pages."""
    for page, blocks in (("implementations", _implementations), ("defaults", _defaults)):
        file = docs / "reference" / f"{page}.md"
        text = file.read_text("utf-8")
        for name, block in blocks(groups(rows, page), docs / "data").items():
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
    return text(found.point) + (
        "" if math.isnan(found.low) else f" ({text(found.low)} to {text(found.high)})"
    )


def _about(found: Sequence[Group]) -> dict[str, str]:
    """Caution, versions and cost, which both pages have."""
    seconds = defaultdict(list)
    for group in found:
        seconds[group.library, group.algorithm] += [row.seconds for row in group.rows]
    lines = [
        (*kind, str(len(each)), f"{np.median(each):.0f} s", f"{sum(each) / 3600:.2f} h")
        for kind, each in sorted(seconds.items())
    ]
    versions = sorted({f"- `{group.library}`: {group.rows[0].versions}" for group in found})
    return {
        "caution": caution(found) if found else "No rows yet.",
        "cost": _table(("library", "algorithm", "rows", "median of a row", "sum"), lines, 2),
        "versions": "\n".join(versions) or "No rows yet.",
    }


def _implementations(found: list[Group], figures: Path) -> dict[str, str]:
    lines, pairs = [], []
    for group in found:
        regret = np.array([row.regret for row in group.rows])
        steps = statistics.interval(statistics.median, [group.steps], SEED)
        last = statistics.interval(statistics.iqm, [regret], SEED)
        cells = (_share(group.certified), _interval(steps), _interval(last))
        lines.append((group.algorithm, group.world.name, group.library, *cells))
    for one, other in itertools.combinations(found, 2):
        if (one.algorithm, one.world.name) == (other.algorithm, other.world.name):
            pair = Comparison(one, other)
            ratio, p = pair.equivalence or (None, None)
            pairs.append(
                (
                    *(one.algorithm, one.world.name, f"{one.library} : {other.library}", pair.verdict),
                    f"{pair.identical} of {pair.seeds}",
                    _interval(pair.improvement, "{:.2f}".format),
                    "" if ratio is None else _interval(ratio, "{:.2f}".format),
                    "" if p is None else f"{p:.3f}",
                )
            )
    named = ("algorithm", "world", "library")
    tested = ("same curve", "P(first is faster)", "ratio of steps, 90 %", f"p, margin {MARGIN}")
    drawn = [_curves(name, found, figures) for name in MATCHED if any(g.algorithm == name for g in found)]
    there = {group.library for group in found}
    missing = [f"- {name}: {reason}" for name, reason in NOT_HERE.items()]
    missing += [f"- {name}: its adapter is here, no rows yet" for name in LIBRARIES if name not in there]
    return _about(found) | {
        "settings": _settings(),
        "missing": "\n".join(missing),
        "results": _table((*named, "certified for good", "median steps to it", "regret at the end"), lines),
        "pairs": _table((*named[:2], "pair", "verdict", *tested), pairs, 4),
        "figures": "\n\n".join(drawn),
    }


def _settings() -> str:
    """The matched settings by each library's names, and what no setting changes."""
    lines = []
    for algorithm, matched in MATCHED.items():
        fixed = {subject: cells for (of, subject), cells in FIXED.items() if of == algorithm}
        for name, value in matched.items():
            cells = fixed.pop(name, {})
            names = {"cleanrl": CLEANRL.get(name, name)}
            owners = [each for each in LIBRARIES if algorithm in LIBRARIES[each].algorithms]
            own = {each: cells.get(each, f"`{names.get(each, name)}`") for each in owners}
            lines.append((algorithm, f"`{name}` = {value}", *(own.get(each, "") for each in LIBRARIES)))
        lines += [
            (algorithm, subject, *(cells.get(each, "") for each in LIBRARIES))
            for subject, cells in fixed.items()
        ]
    return _table(("algorithm", "setting", *LIBRARIES), lines, 9)


def _curves(algorithm: str, found: Sequence[Group], figures: Path) -> str:
    """A panel for each world: the interquartile mean of regret over steps, with its band."""
    own = [group for group in found if group.algorithm == algorithm]
    worlds, drawn = list(dict.fromkeys(group.world.name for group in own)), styles(list(LIBRARIES))
    down, across = -(-len(worlds) // 3), min(3, len(worlds))
    with house_style(algorithm):
        size = (3.2 * across + 0.6, 2.4 * down + 0.6)
        figure, axes = plt.subplots(down, across, figsize=size, layout="constrained", squeeze=False)
        handles = {}
        for axis, world in itertools.zip_longest(axes.flat, worlds):
            axis.set_visible(world is not None)
            axis.set(title=world, xlabel="steps", ylabel="regret")
            axis.xaxis.set_major_formatter(compact)
            for group in (each for each in own if each.world.name == world):
                steps, point, low, high = group.curve()
                [handles[group.library]] = axis.plot(steps, point, **drawn[group.library])
                axis.fill_between(steps, low, high, alpha=0.2, color=drawn[group.library]["color"], lw=0)
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=len(handles))
        return _saved(figure, figures / f"atlas_{algorithm}.svg", f"Exact regret of {algorithm} over steps")


def _saved(figure: plt.Figure, path: Path, title: str) -> str:
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
    return f"![{title}](../data/{path.name})"


def _defaults(found: list[Group], figures: Path) -> dict[str, str]:
    kinds, worlds = defaultdict(list), defaultdict(dict)
    for group in found:
        kinds[group.library, group.algorithm].append(group)
        worlds[group.world][group.library, group.algorithm] = _share(group.certified)
    lines = []
    for kind, own in sorted(kinds.items()):
        each = [row for group in own for row in group.rows]
        share = statistics.share(sum(bool(row.certified_since) for row in each), len(each))
        regret = statistics.interval(statistics.mean, [_scaled(group) for group in own], SEED)
        causes = Counter(row.cause for row in each if row.cause).most_common()
        why = ", ".join(f"{cause} {count}" for cause, count in causes)
        cells = (_share(share), _interval(regret, "{:.2f}".format), why)
        lines.append((*kind, str(len(own)), str(len(each)), *cells))
    head = ("library", "algorithm", "worlds", "runs", "certified for good", "regret, share of the optimum's")
    places = [
        (
            *(world.name, "yes" if world.mdp.is_stochastic else "no", str(world.mdp.num_states)),
            f"{world.evaluator.optimum.expected_length:.1f}",
            *(by_kind.get(kind, "") for kind in sorted(kinds)),
        )
        for world, by_kind in worlds.items()
    ]
    named = [" ".join(kind) for kind in sorted(kinds)]
    return _about(found) | {
        "results": _table((*head, "causes by `diagnose`"), lines, 2),
        "worlds": _table(("world", "chance", "states", "steps of the optimum", *named), places, 2),
        "figure": _map(kinds, figures) if found else "",
    }


def _scaled(group: Group) -> np.ndarray:
    """(n,), the last regret as a share of the optimum's absolute value, at most 1."""
    scale = abs(group.world.evaluator.optimal_value)
    return np.minimum([row.regret / scale for row in group.rows], 1.0)


def _map(kinds: dict[tuple[str, str], list[Group]], figures: Path) -> str:
    """Worlds by their size and the length of the optimum's episodes; diamonds have chance, circles none."""
    with house_style("defaults"):
        size = (3.4 * len(kinds) + 0.6, 3.0)
        figure, axes = plt.subplots(1, len(kinds), figsize=size, layout="constrained", squeeze=False)
        for axis, (kind, own) in zip(axes.flat, sorted(kinds.items()), strict=True):
            for group in own:
                length, share = group.world.evaluator.optimum.expected_length, group.certified
                style = {"marker": "D" if group.world.mdp.is_stochastic else "o", "vmin": 0, "vmax": 1}
                points = axis.scatter(
                    length, group.world.mdp.num_states, c=share.count / share.total, **style
                )
            axis.set(title=" ".join(kind), xlabel="steps of the optimum", ylabel="states")
            axis.set(xscale="log", yscale="log")
        figure.colorbar(points, ax=axes, label="certified for good")
        return _saved(figure, figures / "atlas_defaults.svg", "Worlds by size, and the share certified there")
