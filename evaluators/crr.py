"""CRR: critic-regularised regression (Wang et al. 2020, arXiv 2006.15134), as in ExORL."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cudc_bench.learning.networks import noisy_action
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveFloat, PositiveInt

from .actor_critic import ActorCritic, ExORLConfig, normal_log_prob


@dataclass(frozen=True)
class CRRConfig(ExORLConfig):
    """ExORL's values.

    Attributes:
        value_samples: actions of the policy that estimate a state's value.
        weight: of a data action, as a function of its advantage A: 1 where A > 0, exp(A) up to ``largest_weight``, or A itself.
        largest_weight: bound of exp(A).
    """

    noise_std: PositiveFloat = 0.2
    value_samples: PositiveInt = 10
    weight: Literal["indicator", "exp", "identity"] = "indicator"
    largest_weight: PositiveFloat = 20.0


class CRR(ActorCritic):
    """Clones the data's actions that its critics find better than its own.

    A = min Q(s, a) - mean of min Q(s, a_j) over actions a_j of the policy. As in ExORL and unlike Wang et al.: the online critics judge,
    there are two of them, they are not distributional, and the policy's deviation is fixed.
    """

    config_class: ClassVar[type] = CRRConfig
    citation = "Wang et al. 2020; Yarats et al. 2022"
    summary = "clones what the critics find better, as in ExORL"

    def weights(self, advantage: Tensor) -> Tensor:
        """Of the data's actions (E, B)."""
        if self.config.weight == "indicator":
            return (advantage > 0).to(advantage.dtype)
        return advantage.exp().clamp(max=self.config.largest_weight) if self.config.weight == "exp" else advantage

    def actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        config, samples = self.config, self.config.value_samples
        mean = self.actor(batch.observation)
        with torch.no_grad():
            # The data's action and the policy's, judged in one pass: (E, (1 + samples) B, A).
            means = mean.repeat(1, samples, 1)
            noise = self.random["noise"].normal(*means.shape[1:])
            actions = torch.cat([batch.action, noisy_action(means, noise, config.noise_std, config.noise_clip)], dim=1)
            judged = self.critic(batch.observation.repeat(1, 1 + samples, 1), actions).amin(-1).unflatten(1, (1 + samples, -1))
            advantage = judged[:, 0] - judged[:, 1:].mean(1)
            weight = self.weights(advantage)
        likelihood = normal_log_prob(mean, batch.action, math.log(config.noise_std)).sum(-1)
        return -(weight * likelihood).mean(1), {"advantage": advantage.mean(1), "weight": weight.mean(1)}
