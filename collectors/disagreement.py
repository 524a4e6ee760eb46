"""Disagreement: exploration where an ensemble of models disagrees (Pathak, Gandhi, Gupta 2019, arXiv 1906.04161)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from cudc_bench.learning.networks import Ensemble, MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch

from .ddpg import DDPG, DDPGConfig


@dataclass(frozen=True)
class DisagreementConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        models: size of the ensemble.
    """

    models: Annotated[int, Field(ge=2, le=1000)] = 5


class Disagreement(DDPG):
    """Rewards the variance among the predictions of several forward models.

    As in URLB and unlike Pathak et al.: raw observations, all models see the same minibatches, un-squared errors, and the reward is
    maximised by DDPG instead of being differentiated through.
    """

    config_class: ClassVar[type] = DisagreementConfig
    category = "knowledge"
    family = "uncertainty"
    citation = "Pathak et al. 2019"
    paper = "https://arxiv.org/abs/1906.04161"

    def build(self, random: MemberRandom) -> list[Trainable]:
        s, a, width = self.sizes.observation, self.sizes.action, self.config.width
        # PyTorch's default start, so that the models differ in their biases, too.
        self.models = Ensemble(random, self.config.models, lambda streams: mlp(streams, s + a, width, s, orthogonal=False))
        return [self.models]

    def predictions(self, batch: Batch) -> Tensor:
        """ŝ' of each model (E, N, B, S)."""
        return self.models(torch.cat([batch.observation, batch.action], dim=-1))

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        loss = (batch.next_observation[:, None] - self.predictions(batch)).norm(dim=-1).mean((1, 2))
        return loss, {"loss_forward": loss.detach()}

    def reward(self, batch: Batch) -> Tensor:
        return self.predictions(batch).var(dim=1).mean(-1)
