"""ICM: curiosity as the surprise of a forward model (Pathak, Agrawal, Efros, Darrell 2017, arXiv 1705.05363)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveFloat

from .ddpg import DDPG, DDPGConfig


@dataclass(frozen=True)
class ICMConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        reward_scale: of the error inside the logarithm.
    """

    reward_scale: PositiveFloat = 1.0


class ICM(DDPG):
    """Rewards transitions that a forward model predicts badly.

    As in URLB and unlike Pathak et al.: raw observations instead of features of an inverse model (which is trained, but shapes
    nothing that the reward depends on), un-squared errors, no weights between the two losses, and the logarithm of 1 + error.
    """

    config_class: ClassVar[type] = ICMConfig
    category = "knowledge"
    family = "curiosity"
    citation = "Pathak et al. 2017"
    paper = "https://arxiv.org/abs/1705.05363"

    def build(self, random: MemberRandom) -> list[Trainable]:
        s, a, width = self.sizes.observation, self.sizes.action, self.config.width
        self.forward_model = mlp(random, s + a, width, s)
        self.inverse_model = mlp(random, 2 * s, width, a, output=torch.tanh)
        return [self.forward_model, self.inverse_model]

    def forward_error(self, batch: Batch) -> Tensor:
        """‖s' - ŝ'(s, a)‖ (E, B)."""
        predicted = self.forward_model(torch.cat([batch.observation, batch.action], dim=-1))
        return (batch.next_observation - predicted).norm(dim=-1)

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        inferred = self.inverse_model(torch.cat([batch.observation, batch.next_observation], dim=-1))
        losses = {
            "loss_forward": self.forward_error(batch).mean(1),
            "loss_inverse": (batch.action - inferred).norm(dim=-1).mean(1),
        }
        return losses["loss_forward"] + losses["loss_inverse"], {name: loss.detach() for name, loss in losses.items()}

    def reward(self, batch: Batch) -> Tensor:
        return (self.config.reward_scale * self.forward_error(batch)).log1p()
