"""Behavioral Entropy: APT's exploration with another notion of entropy (Suttle, Suresh, Nieto-Granda 2025, arXiv 2502.04141)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from cudc_bench.config import PositiveFloat
from cudc_bench.replay import Batch

from .apt import APT, APTConfig


@dataclass(frozen=True)
class BEConfig(APTConfig):
    """APT's values and the shape of the entropy.

    Attributes:
        alpha: exponent of Prelec's probability weighting; 1 gives Shannon's entropy, and so APT's reward.
    """

    alpha: PositiveFloat = 0.5


class BE(APT):
    """Rewards APT's neighbour distances by the behavioural entropy's integrand.

    The entropy is -∫ w(p) log w(p) with w(p) = exp(-β (-log p)^α) and β = (log M)^(1-α), M the size of the representation. With the
    density of a particle estimated as 1 / (1 + R) from its mean neighbour distance R, the term of one particle, -w log w / p, is

        r = (1 + R) β (log(1 + R))^α exp(-β (log(1 + R))^α),

    which is APT's log(1 + R) for α = 1. The reward is derived here from the definition of the entropy; it was not checked against an
    implementation by the authors.
    """

    config_class: ClassVar[type] = BEConfig
    family = "entropy"
    citation = "Suttle et al. 2025"

    def reward(self, batch: Batch) -> Tensor:
        surprise = self.distance(batch).log1p()  # -log p
        beta = math.log(self.config.feature_dim) ** (1.0 - self.config.alpha)
        weighted = beta * surprise.pow(self.config.alpha)  # -log w(p)
        return (surprise - weighted).exp() * weighted
