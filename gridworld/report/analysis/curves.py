"""Curves over seeds on a shared grid of environment steps, the last observation carried forward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gridworld.report.analysis import statistics
from gridworld.report.evidence.curve_reader import ONLINE
from gridworld.report.evidence.run_reader import Evidence
from gridworld.world.mdp import FloatArray

GRID_POINTS = 101  # from step 0 to the end of the task's longest run


@dataclass(frozen=True, eq=False)
class Band:
    """A curve over seeds, (points,) each."""

    steps: FloatArray
    point: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    whole_until: int  # environment steps that all runs reach; later, ended runs keep their last value


def grid_for(runs: Sequence[Evidence], logarithmic: bool = False) -> FloatArray:
    """The steps at which all of a task's curves are evaluated, (points,).

    They go from 0 to the end of the longest run, evenly spread, where asked for on a logarithmic axis too.
    """
    end = max(run.steps for run in runs)
    points = np.linspace(0, end, GRID_POINTS)
    first = min((run.curve["step"][1] for run in runs if run.steps > 0), default=0.0)
    if logarithmic and first > 0:
        points = np.concatenate([[0.0], points[points >= first], np.geomspace(first, end, GRID_POINTS)])
    return np.unique(np.round(points))


def on_grid(run: Evidence, column: str, grid: FloatArray) -> FloatArray:
    """A column's newest value at each of the grid's steps, (points,): NaN before the first one."""
    steps, values = run.curve["step"], run.curve[column]
    told = ~np.isnan(values)
    steps, values = steps[told], values[told]
    index = np.searchsorted(steps, grid, side="right") - 1
    return np.where(index >= 0, values[np.maximum(index, 0)], math.nan) if len(values) else grid * math.nan


def band(runs: Sequence[Evidence], column: str, grid: FloatArray, seed: int) -> Band:
    """IQM and mean of a column over runs, with the IQM's 95 % bootstrap band.

    It goes from the first step at which every run has a value to the end of the last run.
    """
    grid, whole_until = _until_the_end(runs, grid)
    values = np.stack([on_grid(run, column, grid) for run in runs], axis=-1)
    told = ~np.isnan(values).any(axis=-1)  # from the step on at which every run has a value
    grid, values = grid[told], values[told]
    point, low, high = statistics.bands(statistics.iqm, [values], seed)
    return Band(grid, point, values.mean(axis=-1), low, high, whole_until)


def certificates(runs: Sequence[Evidence], grid: FloatArray) -> Band:
    """The share of runs that are certified at each step of the grid, with Wilson's 95 % interval."""
    grid, whole_until = _until_the_end(runs, grid)
    counts = np.sum([on_grid(run, "certified", grid) for run in runs], axis=0)
    shares = [statistics.share(int(count), len(runs)) for count in counts]
    mean = counts / len(runs)
    low, high = np.array([s.low for s in shares]), np.array([s.high for s in shares])
    return Band(grid, mean, mean, low, high, whole_until)


def online(runs: Sequence[Evidence], grid: FloatArray, seed: int) -> Band | None:
    """The band of the on-line return; None unless all runs have it."""
    if not all(ONLINE in run.curve and np.isfinite(run.curve[ONLINE]).any() for run in runs):
        return None
    return band(runs, ONLINE, grid, seed)


def _until_the_end(runs: Sequence[Evidence], grid: FloatArray) -> tuple[FloatArray, int]:
    ends = [run.steps for run in runs]
    grid = grid[grid <= max(ends)]
    if grid[-1] < max(ends):
        grid = np.append(grid, max(ends))
    return grid, min(ends)
