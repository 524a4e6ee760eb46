"""Statistics of several methods over several tasks, from scores as arrays; :mod:`.overall` says which scores enter.

Sources. Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (NeurIPS; their library is rliable):
interquartile mean, optimality gap, performance profiles, probability of improvement, the stratified bootstrap. Patterson et al. 2024,
"Empirical Design in Reinforcement Learning" (JMLR 25), for the unit of replication. Miller 1974, "The jackknife: a review" (Biometrika
61), for the variance of any statistic and Student's t around it (Tukey's proposal); Satterthwaite 1946 and Welch 1947 for its degrees of
freedom over several groups; Newcombe 2006, "Confidence intervals for an effect size measure based on the Mann-Whitney statistic. Part 2"
(Statistics in Medicine 25, method 5), Wilson 1927, and Zou and Donner 2008 (Statistics in Medicine 27) for shares that no seed changes.

The unit of replication is the dataset. All tasks of a domain are labelled from the same dataset, so that their scores rise and fall with
it: a method has a group of independent datasets for each domain, each with all of its domain's tasks. Intervals are Student's around the
jackknife, which leaves out one dataset at a time. Percentiles of a bootstrap over few datasets hold the truth less often than they say:
docs/explanation/statistics.md has both. rliable's *stratified* bootstrap draws the runs of each task by themselves, as though every task
had datasets of its own; where the tasks of a dataset go together its intervals are too narrow. It is computed for comparison with other
papers' numbers only.

Scores are one array (n, T) for each domain: n datasets by the domain's T tasks. Domains may have different n.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from math import comb, inf, lcm, prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Counts = NDArray[np.unsignedinteger[Any]]
Scores = Sequence[Floats]
RESAMPLES = 10_000
CONFIDENCE = 0.95
SIGNIFICANCE = 0.05
_SEED = 20240220
_EXACT = 60  # Up to so many datasets in a pair its permutations are all counted,
_MOST_SUMS = 2_000_000  # if their sums over domains are no more than that.


@dataclass(frozen=True)
class Interval:
    """Where a value lies with a confidence of 95 %."""

    low: float
    high: float


@dataclass(frozen=True)
class Spread:
    """How far a statistic of independent groups may be from the truth.

    Attributes:
        variance: its estimated variance.
        freedom: the degrees of freedom of that estimate.
    """

    variance: float
    freedom: float

    def interval(self, value: float, lowest: float = -inf, highest: float = inf) -> Interval:
        """Student's interval around the statistic's value, cut off at what is possible; of seeds that do not differ it is the value."""
        reach = self.reach
        return Interval(min(value, max(value - reach, lowest)), max(value, min(value + reach, highest)))

    @property
    def reach(self) -> float:
        """Half the length of Student's interval."""
        return _student(self.freedom) * self.variance**0.5

    def draws(self, value: float, name: str, number: int = RESAMPLES) -> Floats:
        """Where the truth may be, (number,): Student's distribution around the value, whose middle 95 % are the interval.

        The generator is seeded by ``name``: what is drawn for a method depends neither on other methods nor on the order of records.
        """
        return value + self.variance**0.5 * _generator(name).standard_t(self.freedom, number)


def iqm(scores: Scores) -> float:
    """Interquartile mean: the mean without the lowest and highest quarter of all runs.

    As rliable's ``aggregate_iqm``: of N runs int(N / 4) are cut off at either end (``scipy.stats.trim_mean`` of 0.25 over runs x tasks).
    Where domains have different numbers of seeds every task still weighs the same, as if each run were repeated until all had as many.
    """
    values, kept = _trimmed(scores)
    return float((values * kept).sum() / kept.sum())


def _trimmed(scores: Scores) -> tuple[Floats, Floats]:
    """All runs, domain after domain, and the weight that the interquartile mean leaves of each: (N,), (N,)."""
    tasks = sum(block.shape[1] for block in scores)
    weights = np.concatenate([np.full(block.size, 1 / (len(block) * tasks)) for block in scores])
    values = np.concatenate([block.ravel() for block in scores])
    repeated = lcm(*map(len, scores)) * tasks
    cut = (repeated // 4) / repeated
    order = np.argsort(values, kind="stable")
    ends = np.cumsum(weights[order])
    kept = np.empty_like(weights)
    # Where a quarter ends exactly between two runs, rounding must keep nothing of the outer one.
    left = np.minimum(ends, 1 - cut) - np.maximum(ends - weights[order], cut)
    kept[order] = np.where(left > 1e-9 * weights[order], left, 0.0)
    return values, kept


def median(scores: Scores) -> float:
    """Median over tasks of the mean over seeds, as rliable's ``aggregate_median``."""
    return float(np.median(_task_means(scores)))


def mean(scores: Scores) -> float:
    """Mean over tasks of the mean over seeds."""
    return float(_task_means(scores).mean())


def optimality_gap(scores: Scores) -> float:
    """Mean of max(0, 1 - score): by how much a score of 1 is missed. Smaller is better."""
    return mean([np.maximum(0.0, 1.0 - block) for block in scores])


def _task_means(scores: Scores) -> Floats:
    return np.concatenate([block.mean(0) for block in scores])


# The first one leads. The mean weighs every task alike, for every method; an interquartile mean over tasks of unequal scale cuts off the
# easiest and the hardest task rather than runs that went astray, and which tasks these are differs from method to method.
AGGREGATES: Mapping[str, Callable[[Scores], float]] = {"mean": mean, "iqm": iqm, "median": median, "optimality_gap": optimality_gap}


def jackknife(groups: Scores, statistic: Callable[[Scores], float], freedom: Sequence[float] | None = None) -> Spread | None:
    """The spread of a statistic of independent groups by leaving out one row at a time; None if a group has a single one.

    Args:
        groups: (n, T) each, rows being datasets.
        statistic: of all groups.
        freedom: degrees of freedom of each group; n - 1 unless given.

    Returns:
        The sum of each group's jackknife variance, (n - 1) / n times the sum of squared deviations of the n statistics without a row, and
        its degrees of freedom after Welch and Satterthwaite. For means this is the usual variance of a mean, to the last digits.
    """
    if min(map(len, groups)) < 2:
        return None
    variances = []
    for index, group in enumerate(groups):
        parts = list(groups)
        without = np.empty(len(group))
        for row in range(len(group)):
            parts[index] = np.concatenate((group[:row], group[row + 1 :]))
            without[row] = statistic(parts)
        variances.append((len(group) - 1) * float(without.var()))
    return combined(variances, freedom or [len(group) - 1 for group in groups])


def combined(variances: Sequence[float], freedom: Sequence[float]) -> Spread:
    """The spread of a sum of independent statistics, each with its variance and the degrees of freedom of that."""
    total = sum(variances)
    below = sum(variance**2 / of for variance, of in zip(variances, freedom, strict=True))
    return Spread(total, total**2 / below if below > 0 else float(sum(freedom)))


def aggregate_spread(scores: Scores, name: str) -> Spread | None:
    """The spread of one of :data:`AGGREGATES`; None if a domain has a single seed.

    Of an interquartile mean only datasets count of which a run is left (Yuen 1974 counts the same for trimmed means of single values).
    """
    freedom = None
    if name == "iqm":
        _, kept = _trimmed(scores)
        ends = np.cumsum([block.size for block in scores])[:-1]
        left = [part.reshape(block.shape).any(1).sum() for part, block in zip(np.split(kept, ends), scores, strict=True)]
        freedom = [max(int(count) - 1, 1) for count in left]
    return jackknife(scores, AGGREGATES[name], freedom)


def aggregate_interval(scores: Scores, name: str, lowest: Scores, highest: Scores) -> Interval | None:
    """The 95 % interval of one of :data:`AGGREGATES`; None if a domain has a single seed.

    Args:
        scores: (n, T) for each domain.
        name: which aggregate.
        lowest, highest: the least and the largest possible score of each task, (1, T) for each domain.
    """
    spread = aggregate_spread(scores, name)
    ends = sorted(AGGREGATES[name](one) for one in (lowest, highest))
    return None if spread is None else spread.interval(AGGREGATES[name](scores), *ends)


def relative(x: Floats, y: Floats) -> float | None:
    """Scores of one method as a share of another's: (n_x, T), (n_y, T) -> the mean over tasks of the ratios of means over seeds.

    None if a mean of ``y`` is not above 0: there is no share of it.
    """
    below = y.mean(0)
    return float((x.mean(0) / below).mean()) if (below > 0).all() else None


def relative_interval(x: Floats, y: Floats) -> Interval | None:
    """The 95 % interval of :func:`relative`.

    None if either has a single seed, or if without one of its seeds a mean of ``y`` is not above 0, so that the share has no bound.
    """
    value = relative(x, y)
    if value is None or min(len(x), len(y)) < 2 or any(relative(x, np.delete(y, row, 0)) is None for row in range(len(y))):
        return None
    spread = jackknife((x, y), lambda groups: relative(*groups) or 0.0)
    return None if spread is None else spread.interval(value)


def paired_share(groups: Scores) -> float | None:
    """The mean over tasks of the ratios of means of two learners on the same datasets: (n, 2 T) each, the first T columns those of the one
    whose share it is.

    None if a mean of the other is not above 0: there is no share of it.
    """
    halves = [np.split(group.mean(0), 2) for group in groups]
    over, below = (np.concatenate(side) for side in zip(*halves, strict=True))
    return float((over / below).mean()) if (below > 0).all() else None


def paired_share_interval(groups: Scores) -> Interval | None:
    """The 95 % interval of :func:`paired_share`.

    None if a group has a single dataset, or if without one of them a mean is not above 0, so that the share has no bound.
    """
    value = paired_share(groups)
    without = [
        paired_share([np.delete(one, row, 0) if one is group else one for one in groups])
        for group in groups if len(group) > 1 for row in range(len(group))
    ]  # fmt: skip
    if value is None or min(map(len, groups)) < 2 or any(one is None for one in without):
        return None
    spread = jackknife(groups, lambda parts: paired_share(parts) or 0.0)
    return None if spread is None else spread.interval(value)


def student(mean: float, std: float, n: int) -> Interval:
    """The 95 % interval of a mean over n > 1 seeds by Student's t, from their sample standard deviation."""
    return Spread(std**2 / n, n - 1).interval(mean)


def _student(freedom: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, (1 + CONFIDENCE) / 2))


def _share_interval(share: float, spread: Spread, otherwise: Callable[[], Interval]) -> Interval:
    """Student's interval of the logarithm of a share's odds, which keeps within 0 and 1 and is lopsided near them, as shares are.

    Where seeds do not differ their spread says nothing of what others might do; ``otherwise`` gives the interval then.
    """
    if not 0 < share < 1 or spread.variance < 1e-18:
        return otherwise()
    reach = spread.reach / (share * (1 - share))
    odds = np.log(share / (1 - share))
    low, high = (float(1 / (1 + np.exp(-(odds + side)))) for side in (-reach, reach))
    return Interval(low, high)


def _recovered(shares: Sequence[float], intervals: Sequence[Interval], weights: Sequence[float]) -> Interval:
    """The interval of a weighted sum of shares from those of each (Zou and Donner 2008)."""
    value = sum(weight * share for weight, share in zip(weights, shares, strict=True))
    reach = [
        sum((weight * side(share, one)) ** 2 for weight, share, one in zip(weights, shares, intervals, strict=True)) ** 0.5
        for side in (lambda share, one: share - one.low, lambda share, one: one.high - share)
    ]
    return Interval(max(0.0, value - reach[0]), min(1.0, value + reach[1]))


def wilson(share: float, n: int) -> Interval:
    """Wilson's score interval of a share of n, which exists for none and for all of them."""
    z = _student(inf)
    middle, reach = share + z**2 / (2 * n), z * (share * (1 - share) / n + z**2 / (4 * n**2)) ** 0.5
    return Interval(max(0.0, (middle - reach) / (1 + z**2 / n)), min(1.0, (middle + reach) / (1 + z**2 / n)))


def newcombe(share: float, n: int, m: int) -> Interval:
    """The interval of the probability that one of n is above one of m, from the share of pairs in which it was; it exists for all of them.

    Newcombe's method 5: those probabilities from which the share is no further than 1.96 of the deviations that it would have if they were
    the truth. For 5 against 5 of which each is above each it begins at 0.64.
    """
    from scipy.optimize import brentq

    z, half = _student(inf), (n + m) / 2 - 1

    def beyond(truth: float) -> float:
        variance = truth * (1 - truth) * (1 + half * (1 - truth) / (2 - truth) + half * truth / (1 + truth)) / (n * m)
        return float(abs(share - truth) - z * variance**0.5)

    # At the share itself the deviation is not beyond, unless it is 0 or 1, where it is none; at the ends it is.
    near = 1e-12
    low = 0.0 if share <= near else float(brentq(beyond, 0.0, share - near))
    high = 1.0 if share >= 1 - near else float(brentq(beyond, share + near, 1.0))
    return Interval(low, high)


def profile(scores: Scores, thresholds: Floats) -> Floats:
    """Share of runs whose score is above each threshold, every task weighing the same: (k,) -> (k,)."""
    return np.asarray(np.concatenate([(block[..., None] > thresholds).mean(0) for block in scores]).mean(0))


def profile_band(scores: Scores, thresholds: Floats) -> tuple[Floats, Floats]:
    """Lower and upper border, (k,) each, of pointwise 95 % intervals of :func:`profile` at ascending thresholds, for several seeds.

    Where no dataset differs from the others, Wilson's interval stands, with as many trials as there are datasets. No border rises: the true
    profile cannot, so that what holds it at one threshold bounds it at all further ones.
    """
    tasks = sum(block.shape[1] for block in scores)
    above = [(block[..., None] > thresholds).mean(1) for block in scores]  # (n, k): the share of each dataset's tasks
    weights = [block.shape[1] / tasks for block in scores]
    shares = [of.mean(0) for of in above]
    variances = [weight**2 * of.var(0, ddof=1) / len(of) for weight, of in zip(weights, above, strict=True)]
    total = sum(weight * share for weight, share in zip(weights, shares, strict=True))
    found = [
        _share_interval(
            float(np.asarray(total)[at]),
            combined([float(of[at]) for of in variances], [len(of) - 1 for of in above]),
            partial(_wilsons, [float(of[at]) for of in shares], [len(of) for of in above], weights),
        )
        for at in range(len(thresholds))
    ]
    low, high = np.array([one.low for one in found]), np.array([one.high for one in found])
    return np.maximum.accumulate(low[::-1])[::-1], np.minimum.accumulate(high)


def _wilsons(shares: Sequence[float], counts: Sequence[int], weights: Sequence[float]) -> Interval:
    return _recovered(shares, [wilson(share, n) for share, n in zip(shares, counts, strict=True)], weights)


def rank_shares(distributions: Floats) -> Floats:
    """How probable each rank is for each method, (methods, B) -> (methods, ranks), the largest value having rank 1 (column 0).

    Methods that tie share their ranks evenly. Each row and each column adds up to 1.
    """
    methods, resamples = distributions.shape
    shares = np.zeros((methods, methods))
    for method, values in enumerate(distributions):
        first = (distributions > values).sum(0)
        ties = (distributions == values).sum(0)
        for number in np.unique(ties):
            starts = np.bincount(first[ties == number], minlength=methods)
            for shift in range(number):
                shares[method, shift:] += starts[: methods - shift] / (number * resamples)
    return shares


def _wins(x: Scores, y: Scores) -> list[Floats]:
    """For each domain, over its tasks, the sum of the sign of x_i - y_j: (n_x, n_y) each."""
    return [np.sign(a[:, None] - b[None]).sum(-1) for a, b in zip(x, y, strict=True)]


def improvement(x: Scores, y: Scores) -> float:
    """Probability that a run of x is better than one of y on the same task, 0 to 1, ties counting ½.

    Mann and Whitney's U over n_x n_y on each task, averaged over tasks (Agarwal et al. 2021, section 4.3; rliable's
    ``probability_of_improvement``).
    """
    tasks = sum(block.shape[1] for block in x)
    return float(0.5 + 0.5 * sum(of.mean() for of in _wins(x, y)) / tasks)


def improvement_interval(x: Scores, y: Scores) -> Interval | None:
    """The 95 % interval of :func:`improvement`; None if either has a single seed in a domain.

    Where no dataset's wins differ from another's, as where every run of x is better than every run of y, Newcombe's interval stands, with
    as many trials as there are datasets: five seeds that are better than five others do not show that all seeds are.
    """
    if min(map(len, (*x, *y))) < 2:
        return None
    weights = [block.shape[1] / sum(one.shape[1] for one in x) for block in x]
    chances = [0.5 + 0.5 * of / block.shape[1] for of, block in zip(_wins(x, y), x, strict=True)]
    variances, freedom = [], []
    for weight, of in zip(weights, chances, strict=True):
        for axis in (0, 1):
            # The jackknife of a mean of pairs.
            n = of.shape[axis]
            variances.append(weight**2 * float(of.mean(1 - axis).var(ddof=1)) / n)
            freedom.append(n - 1)
    shares = [float(of.mean()) for of in chances]

    def otherwise() -> Interval:
        return _recovered(shares, [newcombe(share, *of.shape) for share, of in zip(shares, chances, strict=True)], weights)

    return _share_interval(improvement(x, y), combined(variances, freedom), otherwise)


def improvement_p(x: Scores, y: Scores) -> float:
    """Two-sided p-value of the hypothesis that both methods' datasets come from one distribution, tested on :func:`improvement`.

    A permutation test with datasets as its units: within each domain the n_x + n_y datasets, each with all of its tasks, could have been
    anybody's. The statistic is then a sum over datasets of whole numbers (for one task it is Wilcoxon's rank sum), and its distribution
    over all permutations is counted exactly; of more than 60 datasets in a domain it is taken for normal, with the variance of the
    permutations. :func:`least_p` says what it cannot go below.
    """
    pooled = [np.concatenate([a, b]) for a, b in zip(x, y, strict=True)]
    sums = [of.sum(1).astype(np.int64) for of in _wins(pooled, pooled)]  # a (n_x + n_y,) for each domain, with mean 0
    # Of domains with other numbers of seeds each task still weighs the same.
    pairs = [len(a) * len(b) for a, b in zip(x, y, strict=True)]
    common = lcm(*pairs)
    scales = [common // number for number in pairs]
    observed = abs(sum(scale * int(of[: len(a)].sum()) for scale, of, a in zip(scales, sums, x, strict=True)))
    found = _permuted(sums, [len(a) for a in x], scales) if max(map(len, pooled)) <= _EXACT and common < 2**40 else None
    if found is None:
        from scipy.special import ndtr

        variance = sum(
            scale**2 * len(a) * len(b) / (len(of) * (len(of) - 1)) * float((of**2).sum())
            for scale, of, a, b in zip(scales, sums, x, y, strict=True)
        )
        return float(2 * ndtr(-observed / np.sqrt(variance))) if variance else 1.0
    values, chances = found
    # Probabilities are sums of products; they may exceed 1 by rounding.
    return min(1.0, float(chances[np.abs(values) >= observed].sum()))


def least_p(counts: Sequence[tuple[int, int]]) -> float:
    """The smallest p-value that :func:`improvement_p` can give with so many datasets of either method in each domain.

    Every run of one method is better than every run of the other then, which is one of all ways to choose its datasets in each domain. Of
    equal numbers the other method's choice is as far from one half: with five against five in one domain it is 2 / 252.
    """
    ways = 2 if all(n == m for n, m in counts) else 1
    return ways / prod(comb(n + m, n) for n, m in counts)


def _permuted(sums: Sequence[Integers], sizes: Sequence[int], scales: Sequence[int]) -> tuple[Integers, Floats] | None:
    """The distribution of the statistic over all permutations: its values and their probabilities; None if they are too many."""
    values: Integers = np.zeros(1, np.int64)
    chances: Floats = np.ones(1)
    for of, size, scale in zip(sums, sizes, scales, strict=True):
        more = _choices(of, size)
        reached = np.flatnonzero(more)
        if len(values) * len(reached) > _MOST_SUMS:
            return None
        places = np.asarray(scale * (reached - len(more) // 2), np.int64)
        together = values[:, None] + places
        weights = np.multiply.outer(chances, more[reached]).ravel()
        least, span = int(together.min()), int(np.ptp(together))
        if span < together.size:
            # To sort them takes ten times as long.
            chances = np.asarray(np.bincount((together - least).ravel(), weights, span + 1), np.float64)
            values = np.flatnonzero(chances) + least
            chances = chances[chances > 0]
        else:
            values, index = np.unique(together, return_inverse=True)
            chances = np.asarray(np.bincount(index.ravel(), weights), np.float64)
    return values, chances


def _choices(values: Integers, size: int) -> Floats:
    """The distribution of the sum of ``size`` of some whole numbers drawn without replacement, at -m, …, m in the middle of (2m + 1,)."""
    reach = int(np.sort(np.abs(values))[-size:].sum())
    # ways[k, s]: number of choices of k values with the sum s - reach; doubles are exact beyond any count that matters.
    ways = np.zeros((size + 1, 2 * reach + 1))
    ways[0, reach] = 1.0
    for value in values:
        shifted = np.zeros_like(ways[:-1])
        if value >= 0:
            shifted[:, value:] = ways[:-1, : ways.shape[1] - value]
        else:
            shifted[:, :value] = ways[:-1, -value:]
        ways[1:] += shifted
    return np.asarray(ways[size] / ways[size].sum())


def rank_correlation(x: Floats, y: Floats) -> float | None:
    """Spearman's rank correlation of two measures of some datasets on each task, mean over tasks: (n, T), (n, T) -> -1 to 1.

    Ties have the mean of their ranks. Tasks on which one of both is the same for all datasets, or is NaN for one of them, do not count;
    None if that is all of them.
    """
    (found,) = _rank_correlations(x, y, np.ones((len(x), 1)))
    return None if np.isnan(found) else float(found)


def rank_correlation_interval(x: Floats, y: Floats, clusters: Sequence[str], name: str, resamples: int = 2_000) -> Interval | None:
    """The 95 % interval of :func:`rank_correlation`: percentiles of a cluster bootstrap; None where no resample has a correlation.

    Clusters are drawn with replacement, each with all of its datasets and these with all tasks. Resamples in which one of both is the same
    throughout do not count.

    Args:
        x, y: as there.
        clusters: to which each of the datasets belongs (n,): those of one are alike.
        name: what the draws are of, see :func:`draw`.
        resamples: how many; there are hundreds of such intervals beside each other.
    """
    names, belongs = np.unique(clusters, return_inverse=True)
    counts = counted(draw(len(names), 1, name, resamples))[0, belongs].astype(np.float64)
    found = _rank_correlations(x, y, counts)
    found = found[~np.isnan(found)]
    return Interval(*_ends(found, (1 - CONFIDENCE) / 2)) if len(found) else None


def _rank_correlations(x: Floats, y: Floats, counts: Floats) -> Floats:
    """The mean over tasks, in which each dataset is so often in each resample: (n, T), (n, T), (n, B) -> (B,); NaN where there is none."""
    found = []
    for columns in zip(x.T, y.T, strict=True):
        # Twice the distance of each mean rank from the middle one: how many are below, less how many are above.
        first, second = (np.sign(column[:, None] - column) @ counts for column in columns)
        scale = np.sqrt((counts * first**2).sum(0) * (counts * second**2).sum(0))
        found.append(np.divide((counts * first * second).sum(0), scale, out=np.full(counts.shape[1], np.nan), where=scale > 0))
    together = np.stack(found)
    there = ~np.isnan(together)
    return np.divide(np.where(there, together, 0.0).sum(0), there.sum(0), out=np.full(counts.shape[1], np.nan), where=there.any(0))


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values corrected for their number by Holm's step-down method (Holm 1979), in the given order."""
    order = sorted(range(len(p_values)), key=lambda index: p_values[index])
    corrected, largest = [0.0] * len(p_values), 0.0
    for position, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - position) * p_values[index]))
        corrected[index] = largest
    return corrected


def stratified(scores: Floats, name: str) -> dict[str, Interval]:
    """Intervals of :data:`AGGREGATES` as rliable makes them, plain percentiles of resamples that draw each task's runs by themselves.

    Args:
        scores: (n, T) with n > 1.
        name: what the draws are of, see :func:`draw`.
    """
    n, tasks = scores.shape
    found = bootstrapped(scores, _drawn(draw, n, tasks, name))
    return {aggregate: Interval(*_ends(values, (1 - CONFIDENCE) / 2)) for aggregate, values in zip(AGGREGATES, found, strict=True)}


@lru_cache(maxsize=64)
def _drawn(draw: Callable[[int, int, str], Integers], n: int, tasks: int, name: str) -> Counts:
    """How often each seed is drawn; the same for a method in all comparisons of as many seeds and tasks, of which there are many."""
    counts = counted(draw(n, tasks, name))
    counts.setflags(write=False)
    return counts


def draw(n: int, tasks: int, name: str, resamples: int = RESAMPLES) -> Integers:
    """Indices of resampled seeds, (resamples, tasks, n): n of n with replacement, separately for each task.

    The generator is seeded by ``name``: what is drawn for a method depends neither on other methods nor on the order of records, and
    different names draw independently.
    """
    return _generator(name).integers(0, n, (resamples, tasks, n))


def _generator(name: str) -> np.random.Generator:
    digest = hashlib.sha256(name.encode("utf-8", "backslashreplace")).digest()
    return np.random.default_rng([_SEED, *np.frombuffer(digest, np.uint32).tolist()])


def counted(draws: Integers) -> Counts:
    """How often each seed was drawn: (B, tasks, n) -> (tasks, n, B), resamples last, over which everything else then runs at once."""
    resamples, tasks, n = draws.shape
    rows = resamples * (n * np.arange(tasks)[:, None] + draws) + np.arange(resamples)[:, None, None]
    counts = np.bincount(rows.ravel(), minlength=draws.size).reshape(tasks, n, resamples)
    return counts.astype(np.min_scalar_type(n))


def bootstrapped(scores: Floats, counts: Counts) -> Floats:
    """Every aggregate of each resample, in the order of :data:`AGGREGATES`: scores (n, T), counts (T, n, B) -> (4, B).

    The same as the aggregates of the resampled scores, but of how often each score is in a resample: nothing has to be gathered and sorted
    again. Sums run over runs in a fixed order, so that they are the same on every machine.
    """
    n, tasks = scores.shape
    means, gaps = np.zeros((2, tasks, counts.shape[-1]))
    for task in range(tasks):
        for count, score in zip(counts[task], scores[:, task], strict=True):
            means[task] += count * (score / n)
            gaps[task] += count * (max(0.0, 1.0 - score) / n)
    return np.stack([means.mean(0), _iqms(scores, counts), np.median(means, axis=0), gaps.mean(0)])


def _iqms(scores: Floats, counts: Counts) -> Floats:
    """The IQM of each resample: a walk up the sorted scores that adds each step times the kept runs that lie above it."""
    flat = scores.ravel()
    order = np.argsort(flat, kind="stable")
    cut = flat.size // 4
    kept = flat.size - 2 * cut
    below = np.zeros(counts.shape[-1], np.int32)
    found = np.full(counts.shape[-1], flat[order[0]])
    for run, following in pairwise(order):
        seed, task = divmod(int(run), scores.shape[1])
        below += counts[task, seed]
        if step := float(flat[following] - flat[run]):
            found += (kept - np.clip(below - cut, 0, kept)) * (step / kept)
    return found


def _ends(values: Floats, share: float) -> tuple[float, float]:
    """``numpy.quantile`` of a share and of the rest; to sort takes a tenth of its time."""
    ordered = np.sort(values)

    def at(share: float) -> float:
        place = share * (len(ordered) - 1)
        lower = int(place)
        below, above = (float(ordered[min(index, len(ordered) - 1)]) for index in (lower, lower + 1))
        return below + (above - below) * (place - lower)

    return at(share), at(1 - share)
