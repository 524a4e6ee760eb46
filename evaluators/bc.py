"""BC: behaviour cloning, the policy that the data show, whatever their rewards."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from cudc_bench.learning.networks import MemberRandom, actor
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config, PositiveFloat, PositiveInt

from .actor_critic import OfflineLearner, normal_log_prob


@dataclass(frozen=True)
class BCConfig(Config):
    """ExORL's values.

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers.
        learning_rate: of every Adam optimiser.
        noise_std: of the policy, whose likelihood is maximised.
    """

    batch_size: PositiveInt = 1024
    width: PositiveInt = 1024
    learning_rate: PositiveFloat = 1e-4
    noise_std: PositiveFloat = 0.2


class BC(OfflineLearner):
    """Maximises log π(a | s) of the data, π normal around the actor's mean with a fixed deviation. It never looks at rewards."""

    config_class: ClassVar[type] = BCConfig
    citation = "Pomerleau 1988; Yarats et al. 2022"
    summary = "behaviour cloning, as in ExORL"

    def build(self, random: MemberRandom) -> None:
        self.actor = actor(random, self.observation, self.action, self.config.width)
        self.add_optimiser("actor", [self.actor], self.config.learning_rate)

    @property
    def policy(self) -> nn.Module:
        return self.actor

    def learn(self, batch: Batch, plan: bool) -> dict[str, Tensor]:
        likelihood = normal_log_prob(self.actor(batch.observation), batch.action, math.log(self.config.noise_std)).sum(-1)
        loss = -likelihood.mean(1)
        self.minimise("actor", loss)
        return {"actor_loss": loss.detach()} if batch.measure else {}
