"""Each statistic against another way to compute it, and intervals against the truth that they claim to hold."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import optimize, special, stats

from cudc_bench.leaderboard.numbers import statistics as ours

RNG = np.random.default_rng(7)
SCORES = RNG.random((5, 12))
BLOCKS = [SCORES[:, :4], SCORES[:, 4:8], SCORES[:, 8:]]
RAGGED = [RNG.random((5, 4)), RNG.random((3, 3)), RNG.random((4, 4))]
_START = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def same_draws() -> None:
    """Every test draws the same numbers, whichever were run before it in this process."""
    RNG.bit_generator.state = _START


REPEATS = int(os.environ.get("REPEATS", "500"))  # of the simulations below; docs/explanation/statistics.md has more
matrices = hnp.arrays(np.float64, st.tuples(st.integers(1, 6), st.integers(1, 5)), elements=st.integers(0, 8).map(lambda n: n / 8))


# Aggregates


def test_aggregates_by_hand() -> None:
    scores = [np.array([[0.0, 0.2], [0.1, 0.4], [0.9, 1.0], [0.5, 0.3]])]
    # Sorted: 0, .1, .2, .3, .4, .5, .9, 1; the middle half is .2 to .5.
    assert ours.iqm(scores) == pytest.approx((0.2 + 0.3 + 0.4 + 0.5) / 4)
    assert ours.mean(scores) == pytest.approx(3.4 / 8)
    assert ours.median(scores) == pytest.approx((1.5 / 4 + 1.9 / 4) / 2)
    assert ours.optimality_gap(scores) == pytest.approx((1.0 + 0.8 + 0.9 + 0.6 + 0.1 + 0.0 + 0.5 + 0.7) / 8)
    assert ours.optimality_gap([np.array([[1.5, 0.5]])]) == 0.25
    assert next(iter(ours.AGGREGATES)) == "mean"


@pytest.mark.parametrize("shape", [(5, 12), (1, 1), (1, 4), (5, 1), (3, 3), (10, 4), (7, 3)])
def test_iqm_is_scipys_trimmed_mean(shape: tuple[int, int]) -> None:
    for scores in RNG.random((6, *shape)):
        assert ours.iqm([scores]) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None), rel=1e-12)
    if shape[1] > 1:
        assert ours.iqm([scores[:, :1], scores[:, 1:]]) == pytest.approx(ours.iqm([scores]), rel=1e-12)


def test_domains_with_fewer_seeds_weigh_the_same() -> None:
    """The same as if each run were there so often that all domains had as many."""
    repeated = np.concatenate([np.repeat(block, 60 // len(block), axis=0) for block in RAGGED], axis=1)
    assert repeated.shape == (60, 11)
    for aggregate in ours.AGGREGATES.values():
        assert aggregate(RAGGED) == pytest.approx(aggregate([repeated]))
    assert ours.mean(RAGGED) == pytest.approx(np.mean([value for block in RAGGED for value in block.mean(0)]))
    thresholds = np.linspace(0, 1, 7)
    assert ours.profile(RAGGED, thresholds) == pytest.approx(ours.profile([repeated], thresholds))
    many = [RNG.random((n, 1)) for n in (7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61)]  # whose common multiple is enormous
    assert min(map(np.min, many)) < ours.iqm(many) < max(map(np.max, many))


@pytest.mark.skipif(find_spec("rliable") is None, reason="rliable is not a dependency")
def test_rliable_has_the_same_estimates() -> None:
    from rliable import metrics

    other = RNG.random((7, 12))
    assert ours.iqm(BLOCKS) == pytest.approx(metrics.aggregate_iqm(SCORES))
    assert ours.median(BLOCKS) == pytest.approx(metrics.aggregate_median(SCORES))
    assert ours.mean(BLOCKS) == pytest.approx(metrics.aggregate_mean(SCORES))
    assert ours.optimality_gap(BLOCKS) == pytest.approx(metrics.aggregate_optimality_gap(SCORES))
    assert ours.improvement([SCORES], [other]) == pytest.approx(metrics.probability_of_improvement(SCORES, other))


# rliable's bootstrap


def resampled(scores: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Each resample, gathered run by run: scores (n, T), draws (B, T, n) -> (B, n, T)."""
    return scores[draws.swapaxes(1, 2), np.arange(scores.shape[1])]


@pytest.mark.parametrize("n", [1, 2, 5, 300])
def test_aggregates_of_counts_are_those_of_the_resamples(n: int) -> None:
    """Ties, scores beyond the largest and more seeds than a byte counts included."""
    for scores in (RNG.random((n, 12)), np.round(RNG.random((n, 12)), 1), 1.5 * RNG.random((n, 12)) - 0.2):
        draws = ours.draw(n, 12, "a", 60)
        found = ours.bootstrapped(scores, ours.counted(draws))
        for name, values in zip(ours.AGGREGATES, found, strict=True):
            expected = [ours.AGGREGATES[name]([one]) for one in resampled(scores, draws)]
            assert values == pytest.approx(expected, rel=1e-11, abs=1e-13), name


def test_the_stratified_bootstrap_is_scipys_with_a_sample_for_each_task() -> None:
    def statistic(*tasks: np.ndarray, axis: int) -> np.ndarray:
        assert axis == -1
        flat = np.sort(np.concatenate(tasks, -1), -1)
        return flat[..., 15:45].mean(-1)

    theirs = stats.bootstrap(
        tuple(SCORES.T), statistic, n_resamples=20_000, vectorized=True, method="percentile", random_state=np.random.default_rng(0)
    )
    found = ours.stratified(SCORES, "a")["iqm"]
    # Quantiles of 10,000 resamples: the error of each is about sqrt(.025 * .975 / 10,000) / density, here 0.001.
    assert (found.low, found.high) == pytest.approx(tuple(theirs.confidence_interval), abs=0.006)


def test_draws_depend_on_the_name_alone() -> None:
    assert (ours.draw(5, 2, "cudc", 50) == ours.draw(5, 2, "cudc", 50)).all()
    assert (ours.draw(5, 2, "cudc", 50) != ours.draw(5, 2, "icm", 50)).any()
    assert ours.draw(5, 2, "\udcff", 1).shape == (1, 2, 5)
    spread = ours.Spread(1.0, 4.0)
    assert (spread.draws(0.0, "cudc", 50) == spread.draws(0.0, "cudc", 50)).all()
    assert (spread.draws(0.0, "cudc", 50) != spread.draws(0.0, "icm", 50)).any()


# Intervals


def test_the_interval_of_a_mean_is_students() -> None:
    x = RNG.normal(size=(5, 3))
    low, high = stats.ttest_1samp(x.mean(1), 0).confidence_interval()
    spread = ours.aggregate_spread([x], "mean")
    assert spread is not None
    assert spread.freedom == pytest.approx(4)
    found = spread.interval(ours.mean([x]))
    assert (found.low, found.high) == pytest.approx((low, high))
    one, theirs = ours.student(x[:, 0].mean(), x[:, 0].std(ddof=1), 5), stats.ttest_1samp(x[:, 0], 0).confidence_interval()
    # SciPy adds in another order, which can move the last digit.
    assert (one.low, one.high) == pytest.approx(tuple(theirs), rel=1e-12)


def test_over_two_domains_it_is_welchs() -> None:
    x, y = RNG.normal(size=(5, 1)), 3 * RNG.normal(size=(8, 1))
    theirs = stats.ttest_ind(2 * x[:, 0], -2 * y[:, 0], equal_var=False)
    spread = ours.aggregate_spread([x, y], "mean")
    assert spread is not None
    assert spread.freedom == pytest.approx(theirs.df)
    found = spread.interval(ours.mean([x, y]))
    # Half the sum of both means is a quarter of the difference between twice one and minus twice the other.
    assert (found.low, found.high) == pytest.approx(tuple(end / 4 for end in theirs.confidence_interval()))


def test_the_jackknife_is_that_of_its_definition() -> None:
    def ratio(groups: Sequence[np.ndarray]) -> float:
        return float(groups[0].mean() / groups[1].mean())

    x, y = 1 + RNG.random((6, 2)), 2 + RNG.random((4, 3))
    left_out = [[ratio((np.delete(x, i, 0), y)) for i in range(6)], [ratio((x, np.delete(y, i, 0))) for i in range(4)]]
    parts = [(len(one) - 1) / len(one) * sum((value - np.mean(one)) ** 2 for value in one) for one in left_out]
    found = ours.jackknife((x, y), ratio)
    assert found is not None
    assert found.variance == pytest.approx(sum(parts))
    assert found.freedom == pytest.approx(sum(parts) ** 2 / (parts[0] ** 2 / 5 + parts[1] ** 2 / 3))
    assert ours.jackknife((x, y[:1]), ratio) is None


def test_of_an_interquartile_mean_only_datasets_count_that_are_left() -> None:
    # Of five single runs one is cut off at either end, as in Yuen's test of trimmed means.
    spread = ours.aggregate_spread([np.arange(5.0)[:, None] ** 2], "iqm")
    assert spread is not None
    assert spread.freedom == pytest.approx(2)
    spread = ours.aggregate_spread([np.arange(20.0).reshape(4, 5).T], "iqm")
    assert spread is not None
    assert spread.freedom == pytest.approx(4)


def ends(scores: Sequence[np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The least and the largest possible score of each task."""
    return [np.zeros((1, block.shape[1])) for block in scores], [np.ones((1, block.shape[1])) for block in scores]


@pytest.mark.parametrize("name", ours.AGGREGATES)
def test_one_seed_has_no_interval_and_seeds_that_do_not_differ_a_finite_one(name: str) -> None:
    for scores in ([np.full((1, 4), 0.3)], [np.full((5, 4), 0.3), np.full((1, 4), 0.3)]):
        assert ours.aggregate_interval(scores, name, *ends(scores)) is None
    for scores in ([np.full((5, 4), 0.3)], [np.full((2, 1), 0.3)], [np.full((3, 2), 0.0), np.full((4, 2), 1.0)]):
        found = ours.aggregate_interval(scores, name, *ends(scores))
        value = ours.AGGREGATES[name](scores)
        assert found is not None
        assert (found.low, found.high) == pytest.approx((value, value), abs=1e-12)
        assert found.low <= value <= found.high


def test_intervals_end_where_scores_do() -> None:
    scores = [np.array([[0.0, 0.1], [0.9, 1.0]])]
    for name in ours.AGGREGATES:
        found = ours.aggregate_interval(scores, name, *ends(scores))
        assert found is not None
        assert (found.low, found.high) == pytest.approx((0, 1))
    wide = ours.aggregate_interval(scores, "mean", *([np.full((1, 2), end)] for end in (-1.0, 3.0)))
    assert wide is not None
    assert (wide.low, wide.high) == pytest.approx((-1, 3))


def simulated(generator: np.random.Generator, n: int, correlation: float, domains: int = 3, lopsided: bool = False) -> list[np.ndarray]:
    """Bounded scores, (n, 4) for each domain, whose four tasks go together as much as ``correlation`` says.

    ``lopsided`` ones are low for most datasets and far above that for a few.
    """
    shared = generator.normal(size=(n, domains, 1))
    scores = np.sqrt(correlation) * shared + np.sqrt(1 - correlation) * generator.normal(size=(n, domains, 4))
    levels = np.linspace(-0.8, 0.8, 4 * domains).reshape(4, domains).T
    found = np.minimum(0.1 * np.exp(0.8 * scores + 0.3 * levels), 1) if lopsided else 1 / (1 + np.exp(-0.7 * scores - levels))
    return list(found.swapaxes(0, 1))


SEEDS = (2, 3, 4, 5, 8, 12)


def coverage(name: str, seeds: int, correlation: float, domains: int, kind: str) -> float:
    """How often the interval of an aggregate holds the true one; ``uneven``: with two seeds more in the first domain."""
    lopsided, uneven = kind == "lopsided", kind == "uneven"
    truth = ours.AGGREGATES[name](simulated(np.random.default_rng(0), 100_000, correlation, domains, lopsided))
    generator = np.random.default_rng(1)
    hits, repeats = 0, REPEATS if domains == 1 else REPEATS // 2
    for _ in range(repeats):
        scores = simulated(generator, seeds + 2 * uneven, correlation, domains, lopsided)
        if uneven:
            scores = [scores[0], *(block[:seeds] for block in scores[1:])]
        found = ours.aggregate_interval(scores, name, *ends(scores))
        hits += found is not None and found.low <= truth <= found.high
    return hits / repeats


def error(share: float, repeats: int = REPEATS) -> float:
    """Three binomial standard deviations of a simulated share."""
    return 3 * float(np.sqrt(share * (1 - share) / repeats))


CASES = [
    *(("mean", *case) for case in ((1, 0.7, "even"), (1, 0.0, "even"), (3, 0.7, "even"), (3, 0.7, "uneven"), (1, 0.7, "lopsided"))),
    *(("iqm", *case) for case in ((1, 0.7, "even"), (1, 0.0, "even"), (3, 0.7, "uneven"))),
    ("median", 1, 0.7, "even"),
    ("optimality_gap", 1, 0.7, "even"),
]


@pytest.mark.parametrize(("name", "domains", "correlation", "kind"), CASES)
def test_intervals_hold_the_truth_as_often_as_they_say(name: str, domains: int, correlation: float, kind: str) -> None:
    """With five seeds or more; what they hold with fewer is printed."""
    held = {n: coverage(name, n, correlation, domains, kind) for n in SEEDS}
    shown = "  ".join(f"{n}: {100 * share:.1f}" for n, share in held.items())
    print(f"coverage, {name}, domains {domains}, correlation {correlation}, {kind}: {shown}")
    if kind == "lopsided":
        # Nothing in five such datasets says that a sixth may be far above them.
        assert 0.8 < held[5] < 0.95
    else:
        off = error(0.95, REPEATS if domains == 1 else REPEATS // 2)
        assert all(share > 0.95 - off for n, share in held.items() if n >= 5)
        assert held[12] < 0.95 + off


def test_other_intervals_of_few_seeds_hold_it_less_often() -> None:
    """Why it is Student's: five seeds of one domain, by percentiles of resampled datasets, and by rliable's bootstrap."""
    truth = ours.mean(simulated(np.random.default_rng(0), 100_000, 0.7, 1))
    generator = np.random.default_rng(1)
    percentiles = stratified = 0
    for repeat in range(REPEATS):
        (scores,) = simulated(generator, 5, 0.7, 1)
        resamples = scores.mean(1)[generator.integers(0, 5, (1_000, 5))].mean(1)
        low, high = np.quantile(resamples, (0.025, 0.975))
        percentiles += low <= truth <= high
        draws = ours.counted(ours.draw(5, 4, f"{repeat}", 1_000))
        low, high = np.quantile(ours.bootstrapped(scores, draws)[0], (0.025, 0.975))
        stratified += low <= truth <= high
    shown = f"percentiles of datasets {100 * percentiles / REPEATS:.1f}, rliable's {100 * stratified / REPEATS:.1f}"
    print(f"coverage, mean, domains 1, correlation 0.7, 5 seeds: {shown}")
    assert percentiles / REPEATS < 0.9
    assert stratified / REPEATS < 0.75


# One method against another


def test_the_p_value_errs_as_often_as_it_says_whatever_tasks_have_in_common() -> None:
    generator = np.random.default_rng(2)
    for correlation in (0.0, 0.95):
        wrong = [ours.improvement_p(simulated(generator, 5, correlation), simulated(generator, 5, correlation)) < 0.05 for _ in range(800)]
        assert np.mean(wrong) == pytest.approx(0.05, abs=3 * np.sqrt(0.05 * 0.95 / 800))


@pytest.mark.parametrize(("domains", "lead"), [(1, 0.0), (1, 0.15), (1, 0.4), (3, 0.15)])
def test_the_interval_of_an_improvement_holds_the_truth(domains: int, lead: float) -> None:
    generator = np.random.default_rng(4)
    first, second = simulated(generator, 20_000, 0.7, domains), simulated(generator, 20_000, 0.7, domains)
    columns = [(a + lead, np.sort(b)) for x, y in zip(first, second, strict=True) for a, b in zip(x.T, y.T, strict=True)]
    truth = np.mean([np.searchsorted(b, a).mean() / len(b) for a, b in columns])
    held = {}
    for seeds in SEEDS:
        hits = 0
        for _ in range(REPEATS):
            x, y = [block + lead for block in simulated(generator, seeds, 0.7, domains)], simulated(generator, seeds, 0.7, domains)
            found = ours.improvement_interval(x, y)
            hits += found is not None and found.low <= truth <= found.high
        held[seeds] = hits / REPEATS
    shown = "  ".join(f"{n}: {100 * share:.1f}" for n, share in held.items())
    print(f"coverage, probability of improvement {truth:.2f}, domains {domains}: {shown}")
    assert all(share > 0.95 - error(0.95) for share in held.values())


def test_what_five_seeds_show_of_a_method_that_is_always_better() -> None:
    """It is within rounding where five of five exponential runs are above five of five others in one case of forty."""
    x, y = [np.arange(20.0).reshape(5, 4) + 100], [np.arange(20.0).reshape(5, 4)]
    found = ours.improvement_interval(x, y)
    assert found is not None
    assert found.high == 1
    # Of exponential runs with rates 1 and k the chance is k / (k + 1), and that of all above all has a closed form.
    rate = optimize.brentq(lambda k: 5 / k * special.beta(5 / k, 6) - 0.025, 0.5, 20)
    assert found.low == pytest.approx(rate / (rate + 1), abs=0.02)
    assert ours.improvement_interval(y, x) == ours.Interval(1 - found.high, pytest.approx(1 - found.low))
    three = ours.improvement_interval([x[0], x[0], x[0]], [y[0], y[0], y[0]])
    assert three is not None
    assert three.low == pytest.approx(1 - (1 - found.low) / 3**0.5)
    assert ours.improvement_interval([x[0][:1]], y) is None


def test_newcombes_interval_is_where_the_deviation_is_that_of_the_truth() -> None:
    for share, n, m in ((0.7, 5, 5), (0.98, 12, 3), (0.5, 4, 9)):
        found = ours.newcombe(share, n, m)
        for truth in (found.low, found.high):
            half = (n + m) / 2 - 1
            variance = truth * (1 - truth) * (1 + half * (1 - truth) / (2 - truth) + half * truth / (1 + truth)) / (n * m)
            assert abs(share - truth) == pytest.approx(1.959964 * variance**0.5, rel=1e-5)
        assert found.low < share < found.high
    assert ours.newcombe(0.0, 5, 5).low == 0
    assert ours.newcombe(0.0, 5, 5).high == pytest.approx(1 - ours.newcombe(1.0, 5, 5).low)


def test_wilsons_interval_is_scipys() -> None:
    for won, n in ((0, 5), (3, 5), (12, 12), (7, 40)):
        theirs = stats.binomtest(won, n).proportion_ci(method="wilson")
        found = ours.wilson(won / n, n)
        assert (found.low, found.high) == pytest.approx((theirs.low, theirs.high))


def test_improvement_is_mann_whitneys_u_averaged_over_tasks() -> None:
    x, y = np.round(RNG.random((5, 4)), 1), np.round(RNG.random((7, 4)), 1)
    expected = np.mean([stats.mannwhitneyu(x[:, task], y[:, task]).statistic / 35 for task in range(4)])
    assert ours.improvement([x], [y]) == pytest.approx(expected)
    pairs = [(a > b) + 0.5 * (a == b) for task in range(4) for a in x[:, task] for b in y[:, task]]
    assert ours.improvement([x], [y]) == pytest.approx(np.mean(pairs))
    # The second task in a domain of its own, of which each has other seeds.
    expected = (stats.mannwhitneyu(x[:, 0], y[:, 0]).statistic / 35 + stats.mannwhitneyu(x[:3, 1], y[:4, 1]).statistic / 12) / 2
    assert ours.improvement([x[:, :1], x[:3, 1:2]], [y[:, :1], y[:4, 1:2]]) == pytest.approx(expected)


def permutations(x: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> float:
    """The share of all ways to give the datasets of each domain to two methods that are as far from one half as what was observed."""
    pooled = [np.concatenate(pair) for pair in zip(x, y, strict=True)]
    observed, as_far, count = abs(ours.improvement(x, y) - 0.5), 0, 0
    for chosen in itertools.product(*(itertools.combinations(range(len(of)), len(a)) for of, a in zip(pooled, x, strict=True))):
        rest = [[i for i in range(len(of)) if i not in one] for one, of in zip(chosen, pooled, strict=True)]
        found = ours.improvement([of[list(one)] for one, of in zip(chosen, pooled, strict=True)],
                                 [of[one] for one, of in zip(rest, pooled, strict=True)])  # fmt: skip
        as_far += abs(found - 0.5) >= observed - 1e-12
        count += 1
    return as_far / count


def test_the_p_value_counts_all_permutations_of_datasets() -> None:
    for shift, decimals, sizes in (
        (0.4, 9, ((3, 3), (3, 3))),
        (0.0, 1, ((4, 2), (4, 2))),
        (0.3, 9, ((4, 3), (2, 4))),
        (0.2, 1, ((3, 2), (4, 4))),
    ):
        x = [np.round(RNG.random((n, tasks)) + shift, decimals) for (n, _), tasks in zip(sizes, (2, 1), strict=True)]
        y = [np.round(RNG.random((m, tasks)), decimals) for (_, m), tasks in zip(sizes, (2, 1), strict=True)]
        assert ours.improvement_p(x, y) == pytest.approx(permutations(x, y))


@pytest.mark.parametrize(("n", "m"), [(5, 5), (4, 9), (2, 2)])
def test_the_p_value_of_one_task_is_mann_whitneys(n: int, m: int) -> None:
    x, y = RNG.random((n, 1)), RNG.random((m, 1)) + 0.3
    expected = stats.mannwhitneyu(x[:, 0], y[:, 0], method="exact").pvalue
    assert ours.improvement_p([x], [y]) == pytest.approx(expected)


def test_the_least_p_value_is_that_of_methods_that_share_no_score() -> None:
    x, y = np.arange(5.0)[:, None] + 10, np.arange(5.0)[:, None]
    assert ours.improvement_p([x], [y]) == pytest.approx(2 / 252)
    assert ours.improvement_p([x], [x]) == pytest.approx(1)
    for counts in ([(5, 5)], [(3, 3)], [(2, 4), (3, 3)], [(1, 1)], [(2, 2)] * 3, [(5, 3), (4, 4)]):
        apart = [(10 + RNG.random((n, 2)), RNG.random((m, 2))) for n, m in counts]
        assert ours.least_p(counts) == pytest.approx(ours.improvement_p(*map(list, zip(*apart, strict=True))))


def test_of_many_datasets_the_p_value_is_nearly_the_exact_one(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = simulated(np.random.default_rng(5), 25, 0.5), simulated(np.random.default_rng(6), 25, 0.5)
    x = [block + 0.05 for block in x]
    uneven = [x[0][:9], x[1][:11], x[2][:8]], [y[0][:10], y[1][:7], y[2][:13]]
    exact = ours.improvement_p(x, y), ours.improvement_p(*uneven)
    monkeypatch.setattr(ours, "_MOST_SUMS", 0)
    assert all(0 < p < 1 for p in exact)
    assert ours.improvement_p(x, y) == pytest.approx(exact[0], abs=0.01)
    assert ours.improvement_p(*uneven) == pytest.approx(exact[1], abs=0.02)
    assert ours.improvement_p([np.zeros((5, 12))], [np.zeros((5, 12))]) == 1.0
    assert 0 <= ours.improvement_p([np.zeros((40, 2))], [RNG.random((40, 2))]) < 1e-10


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


# Profiles and ranks


def test_profiles_by_hand() -> None:
    scores = [np.array([[0.1, 0.5], [0.5, 0.9]])]
    assert ours.profile(scores, np.array([0.0, 0.1, 0.5, 0.9])).tolist() == [1.0, 0.75, 0.25, 0.0]


def test_the_band_of_a_profile_holds_the_truth() -> None:
    thresholds = np.linspace(0.02, 0.98, 13)
    for domains in (1, 3):
        truth = ours.profile(simulated(np.random.default_rng(0), 100_000, 0.7, domains), thresholds)
        generator = np.random.default_rng(1)
        hits = np.zeros(len(thresholds))
        for _ in range(REPEATS // 4):
            low, high = ours.profile_band(simulated(generator, 5, 0.7, domains), thresholds)
            hits += (low <= truth) & (truth <= high)
        print(f"coverage, profile, domains {domains}, 5 seeds: {np.round(100 * hits / (REPEATS // 4), 1).tolist()}")
        assert (hits / (REPEATS // 4)).mean() > 0.95 - error(0.95)
        assert (hits / (REPEATS // 4)).min() > 0.95 - 2 * error(0.95)


def test_the_band_of_a_profile_exists_where_no_seed_differs() -> None:
    low, high = ours.profile_band([np.full((5, 4), 0.5)], np.array([0.2, 0.8]))
    assert (low, high) == (pytest.approx([ours.wilson(1.0, 5).low, 0]), pytest.approx([1, ours.wilson(0.0, 5).high]))


def test_a_rank_is_as_probable_as_students_distributions_say() -> None:
    """Of two means with the same spread: the difference of two of Student's variables, whose distribution is integrated here."""
    spread = ours.Spread(0.01, 4.0)
    drawn = np.stack([spread.draws(value, name) for value, name in ((0.5, "a"), (0.35, "b"))])
    grid = np.linspace(-60, 60, 240_001)
    expected = np.trapezoid(stats.t.pdf(grid, 4) * stats.t.cdf(grid + 1.5, 4), grid)
    assert ours.rank_shares(drawn)[0, 0] == pytest.approx(expected, abs=3 * np.sqrt(0.25 / 10_000))
    sure = ours.Spread(0.0, 4.0)
    assert sure.draws(0.5, "a", 3).tolist() == [0.5] * 3


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


# Whatever the scores


@settings(deadline=None, max_examples=50)
@given(x=matrices, data=st.data())
def test_everything_is_within_bounds_and_no_order_matters(x: np.ndarray, data: st.DataObject) -> None:
    n, tasks = x.shape
    m = data.draw(st.integers(1, 6))
    y = data.draw(hnp.arrays(np.float64, (m, tasks), elements=st.integers(0, 8).map(lambda n: n / 8)))
    cut = data.draw(st.integers(0, tasks - 1))
    fewer = data.draw(st.integers(1, n)), data.draw(st.integers(1, m))
    xs, ys = ([z[:, cut:]] if cut == 0 else [z[:, :cut], z[:few, cut:]] for z, few in zip((x, y), fewer, strict=True))
    order = [np.array(data.draw(st.permutations(range(len(block))))) for block in xs]
    shuffled = [block[one] for block, one in zip(xs, order, strict=True)]
    for name, aggregate in ours.AGGREGATES.items():
        assert -1e-12 <= aggregate(xs) <= 1 + 1e-12
        assert aggregate(shuffled) == pytest.approx(aggregate(xs))
        found = ours.aggregate_interval(xs, name, *ends(xs))
        assert (found is None) == (min(map(len, xs)) < 2)
        if found is not None:
            assert -1e-12 <= found.low <= aggregate(xs) <= found.high <= 1 + 1e-12
    assert ours.mean(xs) + ours.optimality_gap(xs) == pytest.approx(1)
    chance, p = ours.improvement(xs, ys), ours.improvement_p(xs, ys)
    assert -1e-12 <= chance <= 1 + 1e-12
    assert 0 < p <= 1
    assert p >= ours.least_p([(len(a), len(b)) for a, b in zip(xs, ys, strict=True)]) * (1 - 1e-9)
    assert ours.improvement(ys, xs) == pytest.approx(1 - chance)
    assert ours.improvement_p(ys, xs) == pytest.approx(p)
    assert ours.improvement_p(shuffled, ys) == pytest.approx(p)
    within = ours.improvement_interval(xs, ys)
    assert (within is None) == (min(map(len, (*xs, *ys))) < 2)
    if within is not None:
        assert 0 <= within.low <= chance + 1e-12
        assert chance - 1e-12 <= within.high <= 1
    if min(map(len, xs)) > 1:
        low, high = ours.profile_band(xs, np.linspace(0, 1, 5))
        share = ours.profile(xs, np.linspace(0, 1, 5))
        assert ((low >= 0) & (low <= share + 1e-12) & (share - 1e-12 <= high) & (high <= 1)).all()


# Rank correlations


def test_rank_correlations_by_hand() -> None:
    """Of 1 2 3 4 5 and 2 1 4 3 5: 1 - 6 (1 + 1 + 1 + 1) / (5 x 24)."""
    x, y = np.array([[1.0], [2.0], [3.0], [4.0], [5.0]]), np.array([[2.0], [1.0], [4.0], [3.0], [5.0]])
    assert ours.rank_correlation(x, y) == pytest.approx(0.8)
    assert ours.rank_correlation(x, -np.exp(x)) == pytest.approx(-1.0)
    assert ours.rank_correlation(np.hstack([x, x]), np.hstack([y, -x])) == pytest.approx(-0.1)
    # A task on which one of both is always the same says nothing.
    assert ours.rank_correlation(np.hstack([x, x]), np.hstack([y, np.ones((5, 1))])) == pytest.approx(0.8)
    assert ours.rank_correlation(np.hstack([x, x]), np.hstack([y, np.array([[1.0, 2.0, np.nan, 4.0, 5.0]]).T])) == pytest.approx(0.8)
    assert ours.rank_correlation(x, np.ones((5, 1))) is None


def test_rank_correlations_are_scipys_also_of_ties() -> None:
    for _ in range(20):
        x, y = RNG.integers(0, 4, (2, 9, 3)).astype(float)
        expected = np.mean([stats.spearmanr(a, b).statistic for a, b in zip(x.T, y.T, strict=True)])
        assert ours.rank_correlation(x, y) == pytest.approx(expected, abs=1e-12)


def test_a_cluster_is_drawn_with_all_its_datasets() -> None:
    """The percentiles of correlations of datasets that are gathered one resample after the other."""
    x, y = RNG.normal(size=(2, 9, 2))
    clusters = ["b", "a", "b", "c", "a", "d", "e", "e", "e"]
    names = sorted(set(clusters))
    values = []
    for drawn in ours.draw(5, 1, "name", 400)[:, 0]:
        rows = [row for one in drawn for row, cluster in enumerate(clusters) if cluster == names[one]]
        values.append(np.mean([stats.spearmanr(x[rows, task], y[rows, task]).statistic for task in range(2)]))
    found = ours.rank_correlation_interval(x, y, clusters, "name", 400)
    assert found is not None
    assert (found.low, found.high) == pytest.approx(np.nanquantile(values, (0.025, 0.975)), abs=1e-9)
    assert ours.rank_correlation_interval(x, np.ones((9, 2)), clusters, "name", 50) is None


@pytest.mark.parametrize("collectors", [5, 15])
@pytest.mark.parametrize("strength", [0.0, 0.6, 0.9])
def test_the_interval_of_a_rank_correlation_holds_the_truth(collectors: int, strength: float) -> None:
    """Of collectors with five datasets each, whose measures, and scores on four tasks, have nine tenths of their variance in common.

    Drawing datasets as if each were a collector of its own holds it less often.
    """
    generator, shared = np.random.default_rng(6), 0.9

    def drawn() -> tuple[np.ndarray, np.ndarray]:
        def part() -> np.ndarray:
            common, own = generator.normal(size=(collectors, 1)), generator.normal(size=(collectors, 5))
            return (shared**0.5 * common + (1 - shared) ** 0.5 * own).ravel()

        x, dataset = part(), part()
        tasks = [strength * x + (1 - strength**2) ** 0.5 * (0.6**0.5 * dataset + 0.4**0.5 * part()) for _ in range(4)]
        return np.stack([x] * 4, 1), np.stack(tasks, 1)

    # Two normal variables of this correlation (Pearson 1907).
    truth = 6 / np.pi * np.arcsin(strength / 2)
    repeats, names = REPEATS // 5, [f"{one}" for one in range(5 * collectors)]
    held = {"collectors": 0, "datasets": 0}
    for repeat in range(repeats):
        x, y = drawn()
        for kind, clusters in (("collectors", [names[place // 5] for place in range(len(x))]), ("datasets", names)):
            found = ours.rank_correlation_interval(x, y, clusters, f"{repeat}", 400)
            held[kind] += found is not None and found.low <= truth <= found.high
    shown = ", ".join(f"{kind} {100 * hits / repeats:.1f}" for kind, hits in held.items())
    print(f"coverage, rank correlation {truth:.2f}, {collectors} collectors: {shown}")
    assert held["collectors"] / repeats > 0.92 - error(0.92, repeats)
    assert held["datasets"] / repeats < 0.87
