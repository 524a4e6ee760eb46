"""AWAC: advantage-weighted actor-critic (Nair et al. 2020, arXiv 2006.09359)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cudc_bench.evaluators.actor_critic import ActorCritic, ExORLConfig, normal_log_prob
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveFloat


@dataclass(frozen=True)
class AWACConfig(ExORLConfig):
    """The backbone's values, and what is AWAC's own.

    Attributes:
        noise_std: of the policy, whose likelihood is weighted.
        temperature: λ; the smaller, the more only the best actions count.
        largest_weight: bound of exp(A / λ).
    """

    noise_std: PositiveFloat = 0.2
    temperature: PositiveFloat = 1.0
    largest_weight: PositiveFloat = 20.0


class AWAC(ActorCritic):
    """Clones the data's actions, each with weight exp(A / λ), A = min Q(s, a) - min Q(s, a') with a' from the policy.

    Unlike Nair et al.: the policy's deviation is fixed, and weights are cut off.
    """

    config_class: ClassVar[type] = AWACConfig
    citation = "Nair et al. 2020"
    summary = "advantage-weighted cloning"

    def actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        config = self.config
        with torch.no_grad():
            better = self.critic(batch.observation, batch.action).amin(-1)
            advantage = better - self.critic(batch.observation, self.sample(batch.observation)).amin(-1)
            weight = (advantage / config.temperature).exp().clamp(max=config.largest_weight)
        deviation = torch.full((), config.noise_std, device=self.device).log()
        likelihood = normal_log_prob(self.actor(batch.observation), batch.action, deviation).sum(-1)
        return -(weight * likelihood).mean(1), {"weight": weight.mean(1)}
