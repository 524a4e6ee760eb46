"""What a dataset's card says in numbers: its rewards, and how far its observations and actions spread.

Each comes from one pass with memory for one episode.
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
_POINTS = 2_000  # among which neighbours are sought, at most
_NEAREST = 1e-3  # a lower bound of distances, whose logarithm would be minus infinity between equal observations
SATURATED = 0.99  # the size from which an action counts as being at its bound


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
    stride = math.ceil((manifest.steps + manifest.episodes) / _POINTS)
    moments: _Moments | None = None
    points: list[Float64] = []
    actions, size, saturated = 0, 0.0, 0
    for episode in iterate_episodes(file, ("observations", "actions"), manifest.episodes, base_file(manifest)):
        observations = episode["observations"].astype(np.float64)
        moments = moments or _Moments(observations.shape[1])
        # A view would keep the whole episode.
        points.append(observations[-moments.count % stride :: stride].copy())
        moments.add(observations)
        sizes = np.abs(episode["actions"])
        actions += sizes.size
        size += float(sizes.sum(dtype=np.float64))
        saturated += int((sizes >= SATURATED).sum())
        if advance is not None:
            advance(len(sizes))
    assert moments is not None
    chosen = np.concatenate(points)
    return Coverage(
        mean=moments.mean,
        std=np.sqrt(np.diag(moments.covariance)),
        min=moments.min,
        max=moments.max,
        effective_rank=_effective_rank(moments.covariance),
        points=len(chosen),
        log_distance=_log_distance(chosen) if len(chosen) > NEIGHBOUR else None,
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


def _log_distance(points: Float64) -> float:
    centred = points - points.mean(0)
    squares = (centred**2).sum(1)
    squared = squares[:, None] + squares[None, :] - 2.0 * (centred @ centred.T)
    np.fill_diagonal(squared, np.inf)
    distances = np.sqrt(np.partition(squared, NEIGHBOUR - 1, axis=1)[:, NEIGHBOUR - 1].clip(min=0.0))
    return float(np.log(distances.clip(min=_NEAREST)).mean())
