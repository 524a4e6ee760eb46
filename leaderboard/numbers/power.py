"""What so many seeds can show at all: the least p-value of a comparison's test, and the lead that it finds in most cases.

Found is what is called an improvement: by a two-sided permutation of datasets within domains on the probability of improvement, below 0.05
after Holm's correction, whose strictest step multiplies p by the number of comparisons (:func:`~.statistics.improvement_p`), and with the
whole of that probability's interval above ½ (:func:`~.statistics.improvement_interval`).

The lead is simulated. Scores of a dataset's tasks are normal around their method's, with the covariance that was measured between seeds,
pooled over methods; one of two methods leads on every task by as much; both have so many datasets in each domain. The same draws serve
every lead. The permutations of one domain with up to six datasets each are all counted; of more, and of several domains, their distribution
is taken for normal, with the permutations' own variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from .statistics import CONFIDENCE, SIGNIFICANCE, Floats, Interval, Scores, improvement_interval, least_p

FOUND = 0.8  # the share of cases that a lead's size is given for
SEEDS = (3, 5, 8, 12)  # of designs that are shown beside one's own
_FREEDOM = 8  # With fewer degrees of freedom a deviation is hardly known: its 95 % interval is wider than 0.68 to 1.92 times itself.
_REPEATS = 1000
_STEPS = 8  # of a bisection: to less than the simulation itself is known to
_COUNTED = comb(12, 6)
_SEED = 20240221


@dataclass(frozen=True)
class Design:
    """So many seeds of each method in each domain.

    Attributes:
        seeds: how many.
        least: the least p-value that the test can give.
        corrected: the same after Holm's correction.
        lead: in scores a task, found in 8 of 10 cases; None if none is.
    """

    seeds: int
    least: float
    corrected: float
    lead: float | None


@dataclass(frozen=True)
class Power:
    """What the seeds of a comparison, and other numbers of them, can show.

    Attributes:
        comparisons: of a method with others, which Holm's correction is for.
        deviation: standard deviation between seeds of the mean score over tasks, one seed in each domain; pooled over methods.
        within: its 95 % interval.
        freedom: its degrees of freedom.
        designs: one's own, and others by number of seeds.
        own: how many seeds there are.
    """

    comparisons: int
    deviation: float
    within: Interval
    freedom: int
    designs: tuple[Design, ...]
    own: int

    @property
    def design(self) -> Design:
        """One's own."""
        return next(one for one in self.designs if one.seeds == self.own)


def power_of(scores: Sequence[Scores]) -> Power | None:
    """The power of a comparison of methods' scores, (n, T) for each domain, as :mod:`.overall` compares them.

    Returns:
        None for fewer than two methods with several seeds in each domain, and where these say too little of how much seeds differ, or that
        they do not differ at all.
    """
    tested = [one for one in scores if min(map(len, one)) > 1]
    if len(tested) < 2:
        return None
    covariances, freedoms = [], []
    for blocks in zip(*tested, strict=True):
        freedom = sum(len(block) - 1 for block in blocks)
        residuals = [block - block.mean(0) for block in blocks]
        covariances.append(sum(part.T @ part for part in residuals) / freedom)
        freedoms.append(freedom)
    tasks = sum(len(one) for one in covariances)
    deviation = float(sum(one.sum() for one in covariances) / tasks**2) ** 0.5
    freedom = min(freedoms)
    if freedom < _FREEDOM or deviation < 1e-9:
        return None
    comparisons = len(tested) - 1
    own = min(len(block) for one in tested for block in one)
    designs = [_design(covariances, seeds, comparisons, deviation) for seeds in sorted({own, *SEEDS})]
    return Power(comparisons, deviation, _deviation_interval(deviation, freedom), freedom, tuple(designs), own)


def _deviation_interval(deviation: float, freedom: int) -> Interval:
    from scipy.special import chdtri

    ends = [float(deviation * (freedom / chdtri(freedom, share)) ** 0.5) for share in (0.025, 0.975)]
    return Interval(*ends)


def _design(covariances: Sequence[Floats], seeds: int, comparisons: int, deviation: float) -> Design:
    least = least_p([(seeds, seeds)] * len(covariances))
    corrected = min(1.0, comparisons * least)
    lead = None if corrected >= SIGNIFICANCE else smallest_lead(covariances, seeds, comparisons, deviation)
    return Design(seeds, least, corrected, lead)


def smallest_lead(covariances: Sequence[Floats], seeds: int, comparisons: int, deviation: float) -> float | None:
    """The lead in each task's score that is found in 8 of 10 cases; None if it is larger than 30 standard deviations.

    Args:
        covariances: between seeds, (T, T) of each domain's tasks.
        seeds: of each of two methods in each domain.
        comparisons: for which p-values are corrected.
        deviation: of the mean over tasks.
    """
    noise = _noise(covariances, seeds)
    low, high = 0.0, 0.0
    while _share(noise, high, comparisons) < FOUND:
        low, high = high, max(2 * high, 2 * deviation)
        if high > 30 * deviation:
            return None
    for _ in range(_STEPS):
        middle = (low + high) / 2
        if _share(noise, middle, comparisons) < FOUND:
            low = middle
        else:
            high = middle
    return high


def _noise(covariances: Sequence[Floats], seeds: int) -> list[tuple[Floats, Floats]]:
    """Scores of both methods without a lead, (repeats, seeds, T) each, for each domain."""
    draw = np.random.default_rng(_SEED)
    found = []
    for covariance in covariances:
        # The symmetric root, which is the same whatever signs a library gives to eigenvectors.
        values, vectors = np.linalg.eigh(covariance)
        root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        x, y = draw.normal(size=(2, _REPEATS, seeds, len(covariance))) @ root
        found.append((x, y))
    return found


def _share(noise: Sequence[tuple[Floats, Floats]], lead: float, comparisons: int) -> float:
    """In how many cases a lead is found; 0 if in too few by the permutation test alone."""
    scores = []
    for x, y in noise:
        pooled = np.concatenate([x + lead, y], 1)
        # Of how many a dataset is above and not below, over tasks; no two scores are equal.
        ranks = pooled.argsort(1, kind="stable").argsort(1, kind="stable")
        scores.append((2.0 * ranks - (pooled.shape[1] - 1)).sum(2))
    seeds = noise[0][0].shape[1]
    observed = sum(of[:, :seeds].sum(1) for of in scores)
    p = _counted(scores, seeds, observed) if comb(2 * seeds, seeds) ** len(scores) <= _COUNTED else _normal(scores, observed)
    passed = p * comparisons < SIGNIFICANCE
    # Only of those that are near it is the other half worth its time.
    return float(_above_half([(x[passed], y[passed]) for x, y in noise], lead).sum()) / _REPEATS if passed.mean() >= FOUND else 0.0


def _above_half(noise: Sequence[tuple[Floats, Floats]], lead: float) -> NDArray[np.bool_]:
    """In which cases the interval of the probability of improvement is above ½: that of ``improvement_interval``, of all cases at once."""
    from scipy.special import logit, stdtrit

    tasks = sum(x.shape[2] for x, _ in noise)
    seeds = noise[0][0].shape[1]
    chance, variance, below = np.zeros((3, len(noise[0][0])))
    for x, y in noise:
        wins = 0.5 * x.shape[2] / tasks + 0.5 * np.sign(x[:, :, None] + lead - y[:, None]).sum(3) / tasks
        chance += wins.mean((1, 2))
        for axis in (1, 2):
            part = wins.mean(axis).var(1, ddof=1) / seeds
            variance += part
            below += part**2 / (seeds - 1)
    differ = (variance > 1e-18) & (chance < 1)
    reach = np.zeros(len(chance))
    reach[differ] = stdtrit(variance[differ] ** 2 / below[differ], 1 - (1 - CONFIDENCE) / 2) * np.sqrt(variance[differ])
    found = differ & (logit(np.clip(chance, 1e-9, 1 - 1e-9)) > reach / np.maximum(chance * (1 - chance), 1e-18))
    apart = improvement_interval([np.ones((seeds, x.shape[2])) for x, _ in noise], [np.zeros((seeds, x.shape[2])) for x, _ in noise])
    return np.asarray(found | ((chance > 1 - 1e-9) & bool(apart and apart.low > 0.5)))


def _counted(scores: Sequence[Floats], seeds: int, observed: Floats) -> Floats:
    chosen = np.zeros((comb(2 * seeds, seeds), 2 * seeds))
    for row, members in enumerate(combinations(range(2 * seeds), seeds)):
        chosen[row, list(members)] = 1.0
    sums = np.zeros((len(observed), 1))
    for of in scores:
        sums = (sums[:, :, None] + (of @ chosen.T)[:, None]).reshape(len(observed), -1)
    return np.asarray((np.abs(sums) >= np.abs(observed)[:, None]).mean(1))


def _normal(scores: Sequence[Floats], observed: Floats) -> Floats:
    from scipy.special import ndtr

    variance = sum((of**2).sum(1) / (4 * (1 - 1 / of.shape[1])) for of in scores)
    return np.asarray(2 * ndtr(-np.abs(observed) / np.sqrt(variance)))
