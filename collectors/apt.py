"""APT: the entropy of states in a learned representation (Liu and Abbeel 2021, arXiv 2103.04551)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cudc_bench.learning.knn import neighbour_distances
from cudc_bench.learning.networks import MemberRandom, Trainable, mlp, trunk
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveInt

from .ddpg import DDPG, DDPGConfig


@dataclass(frozen=True)
class APTConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        feature_dim: size of the representation.
        neighbours: how many nearest neighbours in the minibatch.
        knn_exclude_self: leave a point out of its own neighbours (URLB counts it, at distance 0).
    """

    feature_dim: PositiveInt = 512
    neighbours: PositiveInt = 12
    knn_exclude_self: bool = False


class APT(DDPG):
    """Rewards states that are far from others of the minibatch.

    This is URLB's ``icm_apt``, which is what the paper compares with. Unlike Liu and Abbeel's: the representation is that of a forward
    and an inverse model instead of a contrastive one, a point counts among its own neighbours, and no running mean divides the
    distances.
    """

    config_class: ClassVar[type] = APTConfig
    category = "data"
    family = "entropy"
    citation = "Liu and Abbeel 2021"
    paper = "https://arxiv.org/abs/2103.04551"

    def build(self, random: MemberRandom) -> list[Trainable]:
        config = self.config
        if config.neighbours + config.knn_exclude_self > config.batch_size:
            raise ValueError(f"{config.neighbours} neighbours cannot be found in a batch_size of {config.batch_size}")
        a, z, width = self.sizes.action, config.feature_dim, config.width
        self.encoder = trunk(random, self.sizes.observation, z)
        self.forward_model = mlp(random, z + a, width, z)
        self.inverse_model = mlp(random, 2 * z, width, a, output=torch.tanh)
        return [self.encoder, self.forward_model, self.inverse_model]

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        size = batch.observation.shape[1]
        z, z_next = self.encoder(torch.cat([batch.observation, batch.next_observation], dim=1)).split(size, dim=1)
        predicted = self.forward_model(torch.cat([z, batch.action], dim=-1))
        inferred = self.inverse_model(torch.cat([z, z_next], dim=-1))
        # The gradient flows into the encoder through both states.
        losses = {
            "loss_forward": (z_next - predicted).norm(dim=-1).mean(1),
            "loss_inverse": (batch.action - inferred).norm(dim=-1).mean(1),
        }
        return losses["loss_forward"] + losses["loss_inverse"], {name: loss.detach() for name, loss in losses.items()}

    def represent(self, observation: Tensor) -> Tensor:
        features: Tensor = self.encoder(observation)
        return features

    def distance(self, batch: Batch) -> Tensor:
        """Mean distance (E, B) of each state to its nearest neighbours in the minibatch."""
        z = self.represent(batch.observation)
        return neighbour_distances(z, self.config.neighbours, self.config.knn_exclude_self).mean(-1)

    def reward(self, batch: Batch) -> Tensor:
        return self.distance(batch).log1p()
