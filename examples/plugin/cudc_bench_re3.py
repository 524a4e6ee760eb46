"""RE3: the entropy of states as a frozen random encoder sees them (Seo et al. 2021, arXiv 2102.09430)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.collectors.ddpg import DDPG, DDPGConfig
from cudc_bench.learning.knn import neighbour_distances
from cudc_bench.learning.networks import MemberRandom, Trainable, mlp, trunk
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveInt


@dataclass(frozen=True)
class RE3Config(DDPGConfig):
    """The authors' values, beside the backbone's.

    Attributes:
        feature_dim: size of the random representation.
        neighbours: k of the k-th nearest neighbour.
    """

    feature_dim: PositiveInt = 50
    neighbours: PositiveInt = 3


class RE3(DDPG):
    """Rewards log(1 + distance to the k-th nearest neighbour) between features of an encoder that is never trained.

    Unlike Seo et al.: observations are states, so that a hidden layer stands where their encoder has convolutions; neighbours are
    searched in the minibatch and not in the whole replay memory; and there is no reward of a task to which this one is added. The
    logarithm is the paper's; the authors' code for dm_control divides the distance by its running deviation instead.
    """

    config_class: ClassVar[type] = RE3Config
    category = "data"
    family = "entropy"
    citation = "Seo et al. 2021"

    def build(self, random: MemberRandom) -> list[Trainable]:
        config = self.config
        if config.neighbours >= config.batch_size:
            raise ValueError(f"{config.neighbours} neighbours cannot be found in a batch_size of {config.batch_size}")
        hidden = mlp(random, self.sizes.observation, config.width, output=torch.relu)
        self.encoder = nn.Sequential(hidden, trunk(random, config.width, config.feature_dim)).requires_grad_(False)
        return []  # nothing to train: there is no auxiliary model

    def reward(self, batch: Batch) -> Tensor:
        distances = neighbour_distances(self.encoder(batch.observation), self.config.neighbours, exclude_self=True)
        return distances.amax(-1).log1p()
