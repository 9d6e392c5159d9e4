"""The report's statistics against naive computation and known numbers."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, bootstrap, trim_mean

from gridworld.report import statistics
from gridworld.report.statistics import (
    bands,
    difference,
    improvement,
    interval,
    iqm,
    mean,
    median,
    profile,
    share,
)

numbers = st.floats(-100, 100).map(lambda x: round(x, 2))
samples = st.lists(numbers, min_size=1, max_size=30)


@given(samples)
def test_iqm_is_the_mean_of_the_middle(values: list[float]) -> None:
    cut = len(values) // 4
    middle = sorted(values)[cut : len(values) - cut]
    assert iqm(np.array(values)) == pytest.approx(sum(middle) / len(middle), abs=1e-9)
    assert iqm(np.array(values[:1]), np.array(values[1:])) == iqm(np.array(values))  # both together


def test_infinity_is_a_number_like_any_other() -> None:
    inf = math.inf
    assert interval(median, [np.array([1.0, 2.0, inf])], 0).point == 2.0
    assert interval(median, [np.array([1.0, 2.0, inf, inf])], 0).point == inf  # half were not reached
    assert interval(iqm, [np.array([1.0, 2.0, 3.0, inf])], 0).point == 2.5  # one quarter is cut off
    assert interval(iqm, [np.array([1.0, 2.0, inf, inf])], 0).point == inf
    told = interval(iqm, [np.array([1.0, 2.0, 3.0, inf])], 0)
    assert 1.0 <= told.low <= told.point <= told.high == inf
    assert interval(mean, [np.array([-inf, -inf])], 0).point == -inf
    nowhere = interval(median, [np.array([inf, inf, inf])], 0)
    assert (nowhere.point, nowhere.low, nowhere.high) == (inf, inf, inf)


def scipys(samples: list, statistic: Callable) -> list:
    """Point and bounds by `scipy.stats.bootstrap`, from the same draws."""
    options = {"n_resamples": statistics.RESAMPLES, "axis": -1, "method": "percentile"}
    seen = bootstrap(samples, statistic, **options, rng=np.random.default_rng(5))
    return [statistic(*samples), *seen.confidence_interval]


def test_intervals_are_those_of_scipy() -> None:
    rng = np.random.default_rng(3)
    tasks = [rng.normal(size=(7, 9)), rng.normal(size=(7, 6))]

    def theirs(*drawn: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.asarray(trim_mean(np.concatenate(drawn, axis=axis), 0.25, axis=axis))

    np.testing.assert_allclose(bands(iqm, tasks, 5), scipys(tasks, theirs), rtol=1e-13)


def test_improvement_over_tasks_is_a_stratified_bootstrap(monkeypatch: pytest.MonkeyPatch) -> None:
    """As rliable's: runs of either agent are drawn anew within each task."""
    rng = np.random.default_rng(2)
    sizes = ((6, 8), (5, 4), (9, 3))
    samples = [rng.integers(0, 6, size).astype(float) + 3 * k for k, two in enumerate(sizes) for size in two]

    def probability(*drawn: np.ndarray, axis: int = -1) -> np.ndarray:
        of_pairs = [(x[..., :, None], y[..., None, :]) for x, y in zip(drawn[::2], drawn[1::2], strict=True)]
        return np.mean([((x > y) + 0.5 * (x == y)).mean(axis=(-2, -1)) for x, y in of_pairs], axis=0)

    pairs = list(zip(samples[::2], samples[1::2], strict=True))
    told = improvement(pairs, 5)
    theirs = scipys(samples, probability)
    assert [told.point, told.low, told.high] == pytest.approx(theirs, rel=1e-12)
    monkeypatch.setattr(statistics, "_LARGEST_BATCH", 1000)  # in many batches: other draws
    parts = improvement(pairs, 5)
    assert [parts.point, parts.low, parts.high] == pytest.approx(theirs, abs=0.03)


def test_a_profile_is_the_mean_share_of_runs_above_each_level_with_a_stratified_bootstrap() -> None:
    rng = np.random.default_rng(4)
    tasks = [rng.random(7).round(2), 0.5 + 0.5 * rng.random(12).round(2)]
    levels = np.array([-0.1, 0.25, float(np.median(tasks[0])), 0.75, 1.0])  # one of them is a score

    def shares(*above: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.mean([each.mean(axis=axis) for each in above], axis=0)

    found = profile(tasks, levels, 5)
    above = [(task > levels[:, None]).astype(float) for task in tasks]
    np.testing.assert_allclose(found, scipys(above, shares), rtol=1e-12)
    assert [each[0] for each in found] == [1, 1, 1]
    assert found[0][-1] == 0


def test_the_bootstrap_is_stratified_and_one_run_has_no_interval() -> None:
    """Pooled resampling of 0s and 1s would spread; within strata there is nothing to draw."""
    assert interval(mean, [np.zeros(6), np.ones(6)], 0) == statistics.Interval(0.5, 0.5, 0.5)
    alone = interval(mean, [np.array([3.0])], 0)
    assert alone.point == 3.0
    assert math.isnan(alone.low)
    assert math.isnan(alone.high)


def test_points_with_the_same_values_have_the_same_draws() -> None:
    chance = np.random.default_rng(0)
    kinds = [chance.random((2, 3, count)) for count in (12, 7)]
    order = np.array([0, 2, 2, 1, 0, 2])
    repeated = bands(iqm, [kind[:, order] for kind in kinds], seed=3)
    for found, alone in zip(repeated, bands(iqm, kinds, seed=3), strict=True):
        assert np.array_equal(found, alone[:, order])


def test_improvement_without_anything_to_draw_is_exact() -> None:
    easy = (np.array([1.0, 1.0, 1.0]), np.array([0.0, 0.0]))
    even = (np.array([2.0, 2.0]), np.array([2.0, 2.0, 2.0, 2.0]))
    assert improvement([easy, even], 0) == statistics.Interval(0.75, 0.75, 0.75)
    never = np.array([-math.inf, -math.inf])
    assert improvement([(never, never)], 0).point == 0.5
    assert improvement([(np.array([-5.0, -7.0]), never)], 0).point == 1.0


def test_wilsons_interval_is_that_of_scipy() -> None:
    for total in (1, 2, 20, 999):
        for count in range(0, total + 1, 1 + total // 20):
            told, same = share(count, total), binomtest(count, total).proportion_ci(0.95, method="wilson")
            assert (told.low, told.high) == pytest.approx((same.low, same.high), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize(
    ("first", "second", "bounds"),
    [
        ((56, 70), (48, 80), (0.0524, 0.3339)),
        ((9, 10), (3, 10), (0.1705, 0.8090)),
        ((10, 10), (0, 10), (0.6075, 1.0)),
    ],
)
def test_newcombes_interval(
    first: tuple[int, int], second: tuple[int, int], bounds: tuple[float, float]
) -> None:
    told = difference(share(*first), share(*second))
    assert told.point == pytest.approx(first[0] / first[1] - second[0] / second[1])
    assert (told.low, told.high) == pytest.approx(bounds, abs=1e-4)
    back = difference(share(*second), share(*first))
    assert (back.low, back.high) == pytest.approx((-told.high, -told.low))
