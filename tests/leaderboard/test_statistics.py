"""Each statistic against another way to compute it, and intervals against the truth that they claim to hold."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from cudc_bench.leaderboard import statistics as ours

RNG = np.random.default_rng(7)
SCORES = RNG.random((5, 12))
BLOCKS = np.repeat([0, 1, 2], 4)
matrices = hnp.arrays(np.float64, st.tuples(st.integers(1, 6), st.integers(1, 5)), elements=st.integers(0, 8).map(lambda n: n / 8))


def test_aggregates_by_hand() -> None:
    scores = np.array([[0.0, 0.2], [0.1, 0.4], [0.9, 1.0], [0.5, 0.3]])
    # Sorted: 0, .1, .2, .3, .4, .5, .9, 1; the middle half is .2 to .5.
    assert ours.iqm(scores) == pytest.approx((0.2 + 0.3 + 0.4 + 0.5) / 4)
    assert ours.mean(scores) == pytest.approx(3.4 / 8)
    assert ours.median(scores) == pytest.approx((1.5 / 4 + 1.9 / 4) / 2)
    assert ours.optimality_gap(scores) == pytest.approx((1.0 + 0.8 + 0.9 + 0.6 + 0.1 + 0.0 + 0.5 + 0.7) / 8)
    assert ours.optimality_gap(np.array([[1.5, 0.5]])) == 0.25


@pytest.mark.parametrize("shape", [(5, 12), (1, 1), (1, 4), (5, 1), (3, 3), (10, 4)])
def test_iqm_is_scipys_trimmed_mean(shape: tuple[int, int]) -> None:
    scores = RNG.random((6, *shape))
    assert ours.iqm(scores) == pytest.approx([stats.trim_mean(one, 0.25, axis=None) for one in scores])


@pytest.mark.skipif(find_spec("rliable") is None, reason="rliable is not a dependency")
def test_rliable_has_the_same_estimates() -> None:
    from rliable import metrics

    other = RNG.random((7, 12))
    assert ours.iqm(SCORES) == pytest.approx(metrics.aggregate_iqm(SCORES))
    assert ours.median(SCORES) == pytest.approx(metrics.aggregate_median(SCORES))
    assert ours.mean(SCORES) == pytest.approx(metrics.aggregate_mean(SCORES))
    assert ours.optimality_gap(SCORES) == pytest.approx(metrics.aggregate_optimality_gap(SCORES))
    assert ours.improvement(SCORES, other) == pytest.approx(metrics.probability_of_improvement(SCORES, other))


def resampled(scores: np.ndarray, blocks: np.ndarray, draws: np.ndarray, statistic: Callable) -> np.ndarray:
    """The statistic of each resample, gathered run by run: scores (n, T), draws (B, blocks, n) -> (B, ...)."""
    return statistic(scores[draws[:, blocks].swapaxes(1, 2), np.arange(scores.shape[1])])


def iqms(scores: np.ndarray, blocks: np.ndarray, draws: np.ndarray) -> np.ndarray:
    return ours.bootstrapped(scores, blocks, ours.counted(draws))[0]


def test_resamples_keep_a_datasets_tasks_together() -> None:
    scores = np.arange(5.0)[:, None] + 100 * np.arange(4)
    blocks = np.array([0, 0, 1, 1])
    draws = ours.draw(5, 2, "a", 200)
    samples = resampled(scores, blocks, draws, np.asarray)
    assert samples.shape == (200, 5, 4)
    seeds = samples - 100 * np.arange(4)
    assert (seeds[..., 0] == seeds[..., 1]).all()
    assert (seeds[..., 2] == seeds[..., 3]).all()
    assert (seeds[..., 1] != seeds[..., 2]).any()
    by_hand = [np.mean([scores[draws[b, blocks[t], i], t] for i in range(5) for t in range(4)]) for b in range(200)]
    assert ours.bootstrapped(scores, blocks, ours.counted(draws))[2] == pytest.approx(by_hand)
    assert ours.counted(draws)[1, :, 3].tolist() == [int((draws[3, 1] == seed).sum()) for seed in range(5)]


@pytest.mark.parametrize("n", [1, 2, 5, 300])
def test_aggregates_of_counts_are_those_of_the_resamples(n: int) -> None:
    """Ties, scores beyond the largest and more seeds than a byte counts included."""
    for scores in (RNG.random((n, 12)), np.round(RNG.random((n, 12)), 1), 1.5 * RNG.random((n, 12)) - 0.2):
        for blocks in (BLOCKS, np.zeros(12, int), np.arange(12)):
            draws = ours.draw(n, blocks.max() + 1, "a", 60)
            found = ours.bootstrapped(scores, blocks, ours.counted(draws))
            for name, values in zip(ours.AGGREGATES, found, strict=True):
                expected = resampled(scores, blocks, draws, ours.AGGREGATES[name])
                assert values == pytest.approx(expected, rel=1e-11, abs=1e-13), name


def test_the_cluster_bootstrap_is_scipys_with_one_sample_of_seeds_for_each_domain() -> None:
    def statistic(*seeds: np.ndarray, axis: int) -> np.ndarray:
        assert axis == -1
        columns = [SCORES[seeds[block]][..., task] for task, block in enumerate(BLOCKS)]
        return ours.iqm(np.stack(columns, -1))

    theirs = stats.bootstrap(
        (np.arange(5),) * 3, statistic, n_resamples=20_000, vectorized=True, method="percentile", random_state=np.random.default_rng(0)
    )
    distribution = iqms(SCORES, BLOCKS, ours.draw(5, 3, "a", 20_000))
    found = ours.interval(distribution, 0.025)
    # Quantiles of 20,000 resamples: the error of each is about sqrt(.025 * .975 / 20,000) / density, here 0.001.
    assert (found.low, found.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.006)
    assert distribution.std() == pytest.approx(theirs.standard_error, rel=0.03)


def test_draws_depend_on_the_name_alone() -> None:
    assert (ours.draw(5, 2, "cudc", 50) == ours.draw(5, 2, "cudc", 50)).all()
    assert (ours.draw(5, 2, "cudc", 50) != ours.draw(5, 2, "icm", 50)).any()
    assert ours.draw(5, 2, "\udcff", 1).shape == (1, 2, 5)


def test_tail_is_that_of_students_interval() -> None:
    # One domain of 5 seeds: z * sigma_bootstrap must be t * s / sqrt(n), with sigma_bootstrap = s * sqrt(n - 1) / n.
    x = RNG.normal(size=5)
    low, high = stats.ttest_1samp(x, 0).confidence_interval()
    z = -stats.norm.ppf(ours.tail([5]))
    assert (high - low) / 2 == pytest.approx(z * np.std(x) / np.sqrt(5))
    # Two groups of 5: Student's for the difference of two means.
    y = RNG.normal(size=5)
    z = -stats.norm.ppf(ours.tail([5, 5]))
    low, high = stats.ttest_ind(x, y).confidence_interval()
    assert (high - low) / 2 == pytest.approx(z * np.sqrt((np.var(x) + np.var(y)) / 5))
    assert ours.tail([100_000]) == pytest.approx(0.025, rel=1e-3)
    assert 0 < ours.tail([2]) < ours.tail([3]) < ours.tail([5]) < ours.tail([5, 5, 5]) < 0.025


def simulated(generator: np.random.Generator, n: int, correlation: float) -> np.ndarray:
    """Bounded scores (n, 12) on three domains of four tasks whose scores go together as much as ``correlation`` says."""
    shared = np.repeat(generator.normal(size=(n, 3)), 4, axis=1)
    scores = np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * generator.normal(size=(n, 12))
    return 1 / (1 + np.exp(-0.7 * scores - np.linspace(-0.8, 0.8, 12)))


def coverage(correlation: float, repeats: int, resamples: int = 1_000) -> tuple[float, float]:
    """How often the cluster and the stratified interval of the IQM of 5 seeds hold the true one."""
    truth = float(ours.iqm(simulated(np.random.default_rng(0), 200_000, correlation)))
    generator = np.random.default_rng(1)
    hits = np.zeros(2)
    for repeat in range(repeats):
        scores = simulated(generator, 5, correlation)
        for kind, (blocks, tail) in enumerate([(BLOCKS, ours.tail([5] * 3)), (np.arange(12), 0.025)]):
            draws = ours.draw(5, blocks.max() + 1, f"{kind} {repeat}", resamples)
            found = ours.interval(iqms(scores, blocks, draws), tail)
            hits[kind] += found.low <= truth <= found.high
    return tuple(hits / repeats)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    repeats = 500
    # Three binomial standard deviations of 95 %.
    tolerance = 3 * np.sqrt(0.95 * 0.05 / repeats)
    cluster, stratified = coverage(0.7, repeats)
    print(f"tasks go together: cluster {cluster:.3f}, stratified {stratified:.3f}")
    assert cluster == pytest.approx(0.95, abs=tolerance)
    assert stratified < 0.8
    cluster, stratified = coverage(0.0, repeats)
    print(f"independent tasks: cluster {cluster:.3f}, stratified {stratified:.3f}")
    assert cluster == pytest.approx(0.95, abs=tolerance)
    assert stratified > 0.88


def test_the_p_value_errs_as_often_as_it_says_whatever_tasks_have_in_common() -> None:
    generator = np.random.default_rng(2)
    for correlation in (0.0, 0.95):
        wrong = [
            ours.improvement_p(simulated(generator, 5, correlation), simulated(generator, 5, correlation), BLOCKS) < 0.05
            for _ in range(800)
        ]
        assert np.mean(wrong) == pytest.approx(0.05, abs=3 * np.sqrt(0.05 * 0.95 / 800))


def test_the_interval_of_an_improvement_holds_the_truth() -> None:
    generator = np.random.default_rng(4)
    x, y = simulated(generator, 20_000, 0.7) + 0.08, np.sort(simulated(generator, 20_000, 0.7), axis=0)
    truth = np.mean([np.searchsorted(y[:, task], x[:, task]).mean() / len(y) for task in range(12)])
    hits, repeats = 0, 400
    for repeat in range(repeats):
        x, y = simulated(generator, 5, 0.7) + 0.08, simulated(generator, 5, 0.7)
        counts = [ours.counted(ours.draw(5, 3, f"{name} {repeat}", 1_000)) for name in "xy"]
        found = ours.improvement_interval(x, y, BLOCKS, *counts)
        hits += found.low <= truth <= found.high
    print(f"probability of improvement: {hits / repeats:.3f}")
    assert hits / repeats == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / repeats))


def test_improvement_is_mann_whitneys_u_averaged_over_tasks() -> None:
    x, y = np.round(RNG.random((5, 4)), 1), np.round(RNG.random((7, 4)), 1)
    expected = np.mean([stats.mannwhitneyu(x[:, task], y[:, task]).statistic / 35 for task in range(4)])
    assert ours.improvement(x, y) == pytest.approx(expected)
    pairs = [(a > b) + 0.5 * (a == b) for task in range(4) for a in x[:, task] for b in y[:, task]]
    assert ours.improvement(x, y) == pytest.approx(np.mean(pairs))


def test_the_interval_of_an_improvement_is_that_of_its_resamples() -> None:
    x, y, blocks = np.round(RNG.random((5, 3)), 1), np.round(RNG.random((4, 3)), 1), np.array([0, 0, 1])
    x_draws, y_draws = ours.draw(5, 2, "x", 300), ours.draw(4, 2, "y", 300)
    values = [ours.improvement(x[a[blocks].T, np.arange(3)], y[b[blocks].T, np.arange(3)]) for a, b in zip(x_draws, y_draws, strict=True)]
    found = ours.improvement_interval(x, y, blocks, ours.counted(x_draws), ours.counted(y_draws))
    tail = ours.tail([5, 5, 4, 4])
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(values, [tail, 1 - tail])))


def test_the_p_value_counts_all_permutations_of_datasets() -> None:
    for x, y in [(RNG.random((3, 3)), RNG.random((3, 3)) + 0.4), (np.round(RNG.random((4, 3)), 1), np.round(RNG.random((2, 3)), 1))]:
        blocks = np.array([0, 1, 0])
        n, total = len(x), len(x) + len(y)
        pooled = np.concatenate([x, y])
        observed, as_far, count = abs(ours.improvement(x, y) - 0.5), 0, 0
        for chosen in itertools.product(itertools.combinations(range(total), n), repeat=2):
            rest = [[i for i in range(total) if i not in one] for one in chosen]
            a = np.stack([pooled[list(chosen[block]), task] for task, block in enumerate(blocks)], -1)
            b = np.stack([pooled[rest[block], task] for task, block in enumerate(blocks)], -1)
            as_far += abs(ours.improvement(a, b) - 0.5) >= observed - 1e-12
            count += 1
        assert ours.improvement_p(x, y, blocks) == pytest.approx(as_far / count)


@pytest.mark.parametrize(("n", "m"), [(5, 5), (4, 9), (2, 2)])
def test_the_p_value_of_one_task_is_mann_whitneys(n: int, m: int) -> None:
    x, y = RNG.random((n, 1)), RNG.random((m, 1)) + 0.3
    expected = stats.mannwhitneyu(x[:, 0], y[:, 0], method="exact").pvalue
    assert ours.improvement_p(x, y, np.array([0])) == pytest.approx(expected)


def test_the_smallest_p_value_of_five_seeds() -> None:
    x, y = np.arange(5.0)[:, None] + 10, np.arange(5.0)[:, None]
    assert ours.improvement_p(x, y, np.array([0])) == pytest.approx(2 / 252)
    assert ours.improvement_p(x, x, np.array([0])) == pytest.approx(1)


def test_of_many_datasets_the_p_value_is_nearly_the_exact_one(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = simulated(np.random.default_rng(5), 25, 0.5) + 0.05, simulated(np.random.default_rng(6), 25, 0.5)
    exact = ours.improvement_p(x, y, BLOCKS)
    monkeypatch.setattr(ours, "_EXACT", 0)
    assert 0 < exact < 1
    assert ours.improvement_p(x, y, BLOCKS) == pytest.approx(exact, abs=0.01)
    assert ours.improvement_p(np.zeros((5, 12)), np.zeros((5, 12)), BLOCKS) == 1.0


def test_holm_by_hand() -> None:
    # Sorted .01, .02, .03, .04 times 4, 3, 2, 1 is .04, .06, .06, .04, made monotone.
    assert ours.holm([0.04, 0.01, 0.03, 0.02]) == pytest.approx([0.06, 0.04, 0.06, 0.06])
    assert ours.holm([0.7, 0.6]) == [1.0, 1.0]
    assert ours.holm([]) == []


@given(st.lists(st.floats(0, 1), max_size=8))
def test_holm_only_raises_and_keeps_the_order(values: list[float]) -> None:
    corrected = ours.holm(values)
    assert all(p <= q <= 1 for p, q in zip(values, corrected, strict=True))
    for i, j in itertools.permutations(range(len(values)), 2):
        assert values[i] > values[j] or corrected[i] <= corrected[j]
    level = 0.05  # Holm rejects no less than Bonferroni.
    assert all(q < level for p, q in zip(values, corrected, strict=True) if p * len(values) < level)


def test_profiles_by_hand() -> None:
    scores = np.array([[0.1, 0.5], [0.5, 0.9]])
    assert ours.profile(scores, np.array([0.0, 0.1, 0.5, 0.9])).tolist() == [1.0, 0.75, 0.25, 0.0]


def test_the_band_of_a_profile_is_that_of_its_resamples() -> None:
    thresholds = np.linspace(0, 1, 7)
    draws = ours.draw(5, 3, "a", 400)
    shares = resampled(SCORES, BLOCKS, draws, lambda one: (one[..., None] > thresholds).mean((1, 2)))
    low, high = ours.profile_band(SCORES, BLOCKS, ours.counted(draws), thresholds)
    tail = ours.tail([5] * 3)
    assert low == pytest.approx(np.quantile(shares, tail, axis=0))
    assert high == pytest.approx(np.quantile(shares, 1 - tail, axis=0))


def test_ranks_by_hand() -> None:
    distributions = np.array([[3.0, 1.0, 2.0, 2.0], [2.0, 2.0, 2.0, 1.0], [1.0, 3.0, 2.0, 2.0]])
    third = 1 / 3
    expected = np.array([[1 + 0 + third + 0.5, 0 + 0 + third + 0.5, 0 + 1 + third], [third, 1 + 1 + third, third + 1],
                         [0 + 1 + third + 0.5, third + 0.5, 1 + third]]) / 4  # fmt: skip
    assert ours.rank_shares(distributions) == pytest.approx(expected)


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 5), st.integers(1, 9)), elements=st.integers(0, 3).map(float)))
def test_ranks_are_shared_out_completely(distributions: np.ndarray) -> None:
    shares = ours.rank_shares(distributions)
    assert shares.sum(0) == pytest.approx(1)
    assert shares.sum(1) == pytest.approx(1)
    assert shares.min() >= 0


@settings(deadline=None)
@given(x=matrices, data=st.data())
def test_everything_is_within_bounds_and_no_order_matters(x: np.ndarray, data: st.DataObject) -> None:
    n, tasks = x.shape
    y = data.draw(hnp.arrays(np.float64, (data.draw(st.integers(1, 6)), tasks), elements=st.integers(0, 8).map(lambda n: n / 8)))
    blocks = np.sort(data.draw(hnp.arrays(np.int64, tasks, elements=st.integers(0, 2))))
    blocks = np.unique(blocks, return_inverse=True)[1]
    order = np.array(data.draw(st.permutations(range(n))))
    for aggregate in ours.AGGREGATES.values():
        assert 0 <= aggregate(x) <= 1
        assert aggregate(x[order]) == pytest.approx(aggregate(x))
    assert ours.mean(x) + ours.optimality_gap(x) == pytest.approx(1)
    chance, p = ours.improvement(x, y), ours.improvement_p(x, y, blocks)
    assert 0 <= chance <= 1
    assert 0 < p <= 1
    assert ours.improvement(y, x) == pytest.approx(1 - chance)
    assert ours.improvement_p(y, x, blocks) == pytest.approx(p)
    assert ours.improvement_p(x[order], y, blocks) == pytest.approx(p)
    if n > 1:
        draws = ours.draw(n, blocks.max() + 1, "x", 100)
        found = ours.interval(iqms(x, blocks, draws), ours.tail([n] * (blocks.max() + 1)))
        assert x.min() - 1e-12 <= found.low <= found.high <= x.max() + 1e-12
        low, high = ours.profile_band(x, blocks, ours.counted(draws), np.linspace(0, 1, 5))
        assert ((low >= 0) & (low <= high) & (high <= 1)).all()
