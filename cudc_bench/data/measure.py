"""The measurer of datasets: rewards, and how far observations and actions spread, as cards have them and ``stats`` has them.

Both measure the same with parameters of their own, which are named here: numbers that were published depend on them. What a card says comes
from one pass with memory for one episode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.data.reader import base_file, iterate_episodes
from cudc_bench.execution.progress import Advance

Float64 = NDArray[np.float64]

NEIGHBOUR = 12  # whose distance is taken; as in particle-based entropies of unsupervised exploration (Liu & Abbeel 2021)
_BLOCK = 500  # rows of a matrix of distances at a time, where not all are computed at once


@dataclass(frozen=True)
class Measure:
    """The parameters of a measurement.

    Attributes:
        points: among so many observations, at most, neighbours are sought.
        floor: a lower bound of their distances, whose logarithm would be minus infinity between equal observations.
        saturated: the size from which a component of an action counts as being at its bound.
        inclusive: whether one of exactly that size counts.
    """

    points: int
    floor: float
    saturated: float
    inclusive: bool

    def at_bound(self, actions: NDArray[Any]) -> NDArray[np.bool_]:
        """Which components of actions are at their bounds; of the same shape."""
        sizes = np.abs(actions)
        at: NDArray[np.bool_] = sizes >= self.saturated if self.inclusive else sizes > self.saturated
        return at


CARD = Measure(points=2_000, floor=1e-3, saturated=0.99, inclusive=True)
STATS = Measure(points=20_000, floor=1e-6, saturated=0.95, inclusive=False)


@dataclass(frozen=True)
class RewardStatistics:
    """Of the rewards of all steps, and of the returns (sums) of the episodes that have the full length.

    Attributes:
        mean, std, min, max: over steps; std is that of the population.
        episodes: of full length; the next three are None when there is none.
        return_mean, return_std, return_max: over those episodes.
    """

    mean: float
    std: float
    min: float
    max: float
    episodes: int
    return_mean: float | None
    return_std: float | None
    return_max: float | None


@dataclass(frozen=True)
class Coverage:
    """How far observations and actions spread. Resets count as observations.

    Attributes:
        mean, std, min, max: of each of the S observations (S,).
        effective_rank: exp of the Shannon entropy of the eigenvalues, divided by their sum, of the observations' covariance matrix (Roy &
            Vetterli 2007): 1 when all spread lies on a line, S when it is the same in all directions.
        points: how many observations, evenly spaced in collection order, the next number is from.
        log_distance: the mean over these of the natural logarithm of the Euclidean distance to the 12th-nearest other one of them,
            distances below 1e-3 counting as that: up to scale and offset a nearest-neighbour estimate of the entropy of the
            observations. None for 12 points or fewer.
        action_size: mean of |a| over all steps and actuators; 0.5 for uniform actions.
        saturated: share of all action components with |a| of 0.99 or more; 0.01 for uniform actions.
    """

    mean: Float64
    std: Float64
    min: Float64
    max: Float64
    effective_rank: float
    points: int
    log_distance: float | None
    action_size: float
    saturated: float


class _Moments:
    """Mean (D,), covariance (D, D), minimum and maximum (D,) of rows (n, D) that come in parts."""

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean, self._scatter = np.zeros(size), np.zeros((size, size))
        self.min, self.max = np.full(size, np.inf), np.full(size, -np.inf)

    def add(self, rows: Float64) -> None:
        # Means and scatter of parts put together (Chan, Golub & LeVeque 1979): exact also where the mean is far from 0.
        count, centre = len(rows), rows.mean(0)
        offset, centred = centre - self.mean, rows - centre
        self._scatter += centred.T @ centred + np.outer(offset, offset) * (self.count * count / (self.count + count))
        self.mean = self.mean + offset * (count / (self.count + count))
        self.count += count
        self.min, self.max = np.minimum(self.min, rows.min(0)), np.maximum(self.max, rows.max(0))

    @property
    def covariance(self) -> Float64:
        return self._scatter / self.count


class EvenlySpaced:
    """Some of a dataset's observations (n, S), evenly spaced in collection order; resets count.

    Args:
        manifest: of the dataset.
        most: how many, at most.
    """

    def __init__(self, manifest: Manifest, most: int) -> None:
        self._stride = math.ceil((manifest.steps + manifest.episodes) / most)
        self._seen = 0
        self._parts: list[NDArray[Any]] = []

    def add(self, observations: NDArray[Any]) -> None:
        """Those of the next episode (T+1, S)."""
        # A view would keep the whole episode.
        self._parts.append(observations[-self._seen % self._stride :: self._stride].copy())
        self._seen += len(observations)

    def together(self) -> NDArray[Any]:
        """All that were chosen."""
        return np.concatenate(self._parts)


def reward_statistics(file: Path, manifest: Manifest) -> RewardStatistics:
    """Read a dataset's rewards.

    Args:
        file: its HDF5 file, which may still be in its staging folder.
        manifest: what it is.
    """
    from cudc_bench.envs import check_domain

    length = check_domain(manifest.domain).episode_length
    moments, sums = _Moments(1), []
    for episode in iterate_episodes(file, ("rewards",), manifest.episodes):
        rewards = episode["rewards"].astype(np.float64)
        moments.add(rewards[:, None])
        if len(rewards) == length:
            sums.append(rewards.sum())
    returns = np.array(sums)
    return RewardStatistics(
        mean=float(moments.mean[0]),
        std=float(np.sqrt(moments.covariance[0, 0])),
        min=float(moments.min[0]),
        max=float(moments.max[0]),
        episodes=len(returns),
        return_mean=float(returns.mean()) if len(returns) else None,
        return_std=float(returns.std()) if len(returns) else None,
        return_max=float(returns.max()) if len(returns) else None,
    )


def measure_coverage(file: Path, manifest: Manifest, advance: Advance | None = None) -> Coverage:
    """Read a dataset's observations and actions.

    Args:
        file, manifest: as for :func:`reward_statistics`.
        advance: is told of the steps that were read.
    """
    moments: _Moments | None = None
    points = EvenlySpaced(manifest, CARD.points)
    actions, size, saturated = 0, 0.0, 0
    for episode in iterate_episodes(file, ("observations", "actions"), manifest.episodes, base_file(manifest)):
        observations = episode["observations"].astype(np.float64)
        moments = moments or _Moments(observations.shape[1])
        points.add(observations)
        moments.add(observations)
        sizes = np.abs(episode["actions"])
        actions += sizes.size
        size += float(sizes.sum(dtype=np.float64))
        saturated += int(CARD.at_bound(sizes).sum())
        if advance is not None:
            advance(len(sizes))
    assert moments is not None
    chosen = points.together()
    return Coverage(
        mean=moments.mean,
        std=np.sqrt(np.diag(moments.covariance)),
        min=moments.min,
        max=moments.max,
        effective_rank=_effective_rank(moments.covariance),
        points=len(chosen),
        # All rows at once: the sums of a matrix product depend on its shape, to the last bit.
        log_distance=mean_log_distance(chosen - chosen.mean(0), CARD, len(chosen)) if len(chosen) > NEIGHBOUR else None,
        action_size=size / actions,
        saturated=saturated / actions,
    )


def shannon_entropy(weights: NDArray[Any]) -> float:
    """The Shannon entropy in nats of weights of 0 or more, divided by their sum; 0 when all are 0."""
    positive = weights[weights > 0]
    shares = positive / positive.sum()
    # Without the sum with 0.0, the entropy of a single share would be -0.0.
    return float(0.0 - (shares * np.log(shares)).sum())


def _effective_rank(covariance: Float64) -> float:
    return math.exp(shannon_entropy(np.linalg.eigvalsh(covariance).clip(min=0.0)))


def mean_log_distance(points: NDArray[Any], how: Measure, block: int = _BLOCK) -> float:
    """The mean over points (n, S), of which there are more than 12, of the logarithm of the distance to the 12th-nearest other one.

    Args:
        points: around 0, where the differences of squares lose the fewest digits.
        how: has the lower bound of distances.
        block: for so many of them at a time distances are in memory.
    """
    distances = _neighbour_distances(points, block).clip(min=how.floor)
    return float(np.log(distances).mean(dtype=np.float64))


def _neighbour_distances(points: NDArray[Any], block: int) -> NDArray[Any]:
    """To the 12th-nearest other point (n,), by matrix products of a block of rows at a time."""
    squares = (points**2).sum(1)
    found = np.empty(len(points), points.dtype)
    for start in range(0, len(points), block):
        rows = slice(start, start + block)
        squared = squares[rows, None] + squares[None] - 2.0 * (points[rows] @ points.T)
        # Each point is among its own neighbours, at a distance of 0 but for rounding.
        squared[np.arange(len(squared)), np.arange(start, start + len(squared))] = np.inf
        found[rows] = np.sqrt(np.partition(squared, NEIGHBOUR - 1, axis=1)[:, NEIGHBOUR - 1].clip(min=0.0))
    return found
