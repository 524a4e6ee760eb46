"""Behavioral Entropy: APT's exploration with another notion of entropy (Suttle, Suresh, Nieto-Granda 2025, arXiv 2502.04141)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, Trainable
from cudc_bench.learning.replay import Batch
from cudc_bench.learning.running_mean_std import RunningMeanStd
from cudc_bench.settings.config import ADDED_LATER, NonNegativeFloat, PositiveFloat

from .apt import APT, APTConfig


@dataclass(frozen=True)
class BEConfig(APTConfig):
    """APT's values and the shape of the entropy.

    Attributes:
        alpha: exponent of Prelec's probability weighting; 1 gives Shannon's entropy, and so APT's reward while the two switches below
            are at their defaults.
        particle_weight: what a particle's -w log w counts with: 1 / p = 1 + R, or R.
        normalise_by: what divides R: nothing, or the running mean of all R so far.
        distance_floor: subtracted from R after that; what falls below 0 becomes 0.
    """

    alpha: PositiveFloat = 0.5
    particle_weight: Literal["one_plus_distance", "distance"] = field(default="one_plus_distance", metadata=ADDED_LATER)
    normalise_by: Literal["none", "running_mean"] = field(default="none", metadata=ADDED_LATER)
    distance_floor: NonNegativeFloat = field(default=0.0, metadata=ADDED_LATER)


class BE(APT):
    """Rewards APT's neighbour distances by the behavioural entropy's integrand.

    The entropy is -∫ w(p) log w(p) with w(p) = exp(-β (-log p)^α) and β = (log M)^(1-α), M the size of the representation. With the
    density of a particle estimated as 1 / (1 + R) from its mean neighbour distance R, the term of one particle, -w log w / p, is

        r = (1 + R) β (log(1 + R))^α exp(-β (log(1 + R))^α),

    which is APT's log(1 + R) for α = 1. This is derived here from the definition of the entropy. No code of the authors is public; a
    third party's, whose comments say that it follows theirs, counts with R in place of 1 + R and divides R by its running mean:
    ``particle_weight=distance`` and ``normalise_by=running_mean``. For large R both weights agree, for small R theirs behaves as
    R^(1+α) where this one behaves as R^α; and without the division the scale of the representation moves what α does. Which of the two
    the paper's results rest on is not known.
    """

    config_class: ClassVar[type] = BEConfig
    family = "entropy"
    citation = "Suttle et al. 2025"
    paper = "https://arxiv.org/abs/2502.04141"

    def build(self, random: MemberRandom) -> list[Trainable]:
        trained = super().build(random)
        if self.config.normalise_by == "running_mean":
            self.moments = RunningMeanStd(random.count, self.device)
        return trained

    def reward(self, batch: Batch) -> Tensor:
        config, distance = self.config, self.distance(batch)
        if config.normalise_by == "running_mean":
            self.moments.add(distance)
            distance = distance / self.moments.mean[:, None]
        distance = (distance - config.distance_floor).clamp(min=0.0)
        surprise = distance.log1p()  # -log p
        beta = math.log(config.feature_dim) ** (1.0 - config.alpha)
        weighted = beta * surprise.pow(config.alpha)  # -log w(p)
        count = (-weighted).exp() * weighted
        return count * (1.0 + distance if config.particle_weight == "one_plus_distance" else distance)
