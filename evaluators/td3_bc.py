"""TD3+BC: TD3 that stays near the data (Fujimoto and Gu 2021, arXiv 2106.06860), as in ExORL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeFloat

from .td3 import TD3, TD3Config


@dataclass(frozen=True)
class TD3BCConfig(TD3Config):
    """ExORL's values.

    Attributes:
        alpha: weight of the value against the distance to the data.
    """

    alpha: NonNegativeFloat = 2.5


class TD3BC(TD3):
    """TD3 whose actor minimises -λ Q + (mean action - data action)², λ = α / mean |Q|.

    Departs from Fujimoto and Gu as ExORL's TD3 does from TD3's paper, and does not normalise observations.
    """

    config_class: ClassVar[type] = TD3BCConfig
    citation = "Fujimoto and Gu 2021; Yarats et al. 2022"
    summary = "TD3 that stays near the data, as in ExORL"

    def actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        mean = self.actor(batch.observation)
        value = self.actor_value(batch, mean)
        scale = self.config.alpha / value.detach().abs().mean(1)
        distance = (mean - batch.action).square().mean((1, 2))
        return distance - scale * value.mean(1), {"bc_loss": distance.detach(), "actor_value": value.detach().mean(1)}
