"""RND: novelty as the error against a frozen random network (Burda, Edwards, Storkey, Klimov 2018, arXiv 1810.12894)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.learning.running_mean_std import RunningMeanStd
from cudc_bench.settings.config import PositiveFloat, PositiveInt

from .ddpg import DDPG, DDPGConfig

_EPSILON = 1e-5  # of PyTorch's batch normalisation


@dataclass(frozen=True)
class RNDConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        feature_dim: outputs of the two networks.
        observation_clip: bound of the normalised observations.
        reward_scale: of the normalised error.
    """

    feature_dim: PositiveInt = 512
    observation_clip: PositiveFloat = 5.0
    reward_scale: PositiveFloat = 1.0


class RND(DDPG):
    """Rewards states on which a trained network does not yet agree with a frozen one.

    As in URLB and unlike Burda et al.: the current state instead of the next one, observations normalised by the minibatch instead of
    by running statistics, and no separate value function for the intrinsic reward.
    """

    config_class: ClassVar[type] = RNDConfig
    category = "knowledge"
    family = "novelty"
    citation = "Burda et al. 2018"
    paper = "https://arxiv.org/abs/1810.12894"

    def build(self, random: MemberRandom) -> list[Trainable]:
        sizes = (self.sizes.observation, self.config.width, self.config.width, self.config.feature_dim)
        self.predictor = mlp(random, *sizes)
        self.random_network = mlp(random, *sizes).requires_grad_(False)
        self.moments = RunningMeanStd(random.count, self.device)
        return [self.predictor]

    def error(self, batch: Batch) -> Tensor:
        """Mean squared error (E, B) over the features, for the current states."""
        if "target" not in batch.cache:
            observation = batch.observation
            variance, mean = torch.var_mean(observation, dim=1, keepdim=True, unbiased=False)
            clip = self.config.observation_clip
            normalised = ((observation - mean) / (variance + _EPSILON).sqrt()).clamp(-clip, clip)
            batch.cache = {"normalised": normalised, "target": self.random_network(normalised)}
        return (batch.cache["target"] - self.predictor(batch.cache["normalised"])).square().mean(-1)

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        loss = self.error(batch).mean(1)
        return loss, {"loss_prediction": loss.detach()}

    def reward(self, batch: Batch) -> Tensor:
        error = self.error(batch)
        self.moments.add(error)
        return self.config.reward_scale * error / (self.moments.variance.sqrt() + 1e-8)[:, None]
