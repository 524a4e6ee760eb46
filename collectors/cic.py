"""CIC: contrastive skills with an entropy reward (Laskin, Liu, Peng, Yarats, Rajeswaran, Abbeel 2022, arXiv 2202.00161)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from cudc_bench.learning.knn import neighbour_distances, normalised_entropy_reward
from cudc_bench.learning.networks import MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.learning.running_mean_std import RunningMeanStd
from cudc_bench.settings.config import NonNegativeFloat, PositiveFloat, PositiveInt

from .ddpg import DDPG, DDPGConfig
from .diayn import skill_of


@dataclass(frozen=True)
class CICConfig(DDPGConfig):
    """The values of the authors' code.

    Attributes:
        skill_dim: size of the skill and of the embeddings.
        skill_every: environment steps that a skill lasts.
        temperature: of the contrastive loss.
        neighbours: of the entropy reward.
        knn_exclude_self: leave a point out of its own neighbours.
        distance_floor: subtracted from the normalised distances, which are then cut off at 0.
        normalise_by: what divides the distances; the authors' code divides by the running variance where the paper says the deviation.
    """

    skill_dim: PositiveInt = 64
    skill_every: PositiveInt = 50
    temperature: PositiveFloat = 0.5
    neighbours: PositiveInt = 16
    knn_exclude_self: bool = False
    distance_floor: NonNegativeFloat = 5e-4
    normalise_by: Literal["variance", "std"] = "variance"


class CIC(DDPG):
    """Learns embeddings in which skills and state changes match, and rewards states that are rare among them.

    As in the authors' code and unlike the paper: the reward is the entropy term alone, without the contrastive one, and the distances
    are between next states. Unlike that code, whose replay is URLB's and pairs an action with the skill of the step after it, an action
    comes with the skill that it followed; and the own pair's term is left out of the contrastive sum as it is, where that code subtracts
    e^(1/T), the term of a pair that matches exactly.
    """

    config_class: ClassVar[type] = CICConfig
    category = "competence"
    family = "competence and entropy"
    citation = "Laskin et al. 2022"
    paper = "https://arxiv.org/abs/2202.00161"

    @property
    def skill_size(self) -> int:
        return int(self.config.skill_dim)

    @property
    def skill_steps(self) -> int:
        return int(self.config.skill_every)

    def sample_skills(self, random: MemberRandom, t: int) -> Tensor:
        return random.uniform(self.config.skill_dim)

    def build(self, random: MemberRandom) -> list[Trainable]:
        config, width = self.config, self.config.width
        if config.neighbours + config.knn_exclude_self > config.batch_size:
            raise ValueError(f"{config.neighbours} neighbours cannot be found in a batch_size of {config.batch_size}")
        self.state_network = mlp(random, self.sizes.observation, width, width, config.skill_dim)
        self.pair_network = mlp(random, 2 * config.skill_dim, width, width, config.skill_dim)
        self.skill_network = mlp(random, config.skill_dim, width, width, config.skill_dim)
        self.moments = RunningMeanStd(random.count, self.device)
        return [self.state_network, self.pair_network, self.skill_network]

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        size = batch.observation.shape[1]
        both = self.state_network(torch.cat([batch.observation, batch.next_observation], dim=1))
        # For methods whose reward is that of this forward pass, before its step.
        batch.cache["states"] = both.detach().split(size, dim=1)
        keys = F.normalize(self.pair_network(torch.cat(both.split(size, dim=1), dim=-1)), dim=-1)
        queries = F.normalize(self.skill_network(skill_of(batch)), dim=-1)
        similarity = queries @ keys.transpose(1, 2) / self.config.temperature
        own = similarity.diagonal(dim1=1, dim2=2)
        others = similarity.masked_fill(torch.eye(size, dtype=torch.bool, device=self.device), -torch.inf)
        loss = (others.logsumexp(-1) - own).mean(1)
        return loss, {"loss_contrastive": loss.detach()}

    def represent(self, observation: Tensor) -> Tensor:
        features: Tensor = self.state_network(observation)
        return features

    @property
    def scale(self) -> Tensor:
        """What divides distances (E,)."""
        return self.moments.variance if self.config.normalise_by == "variance" else self.moments.variance.sqrt()

    def reward(self, batch: Batch) -> Tensor:
        config = self.config
        distances = neighbour_distances(self.represent(batch.next_observation), config.neighbours, config.knn_exclude_self)
        self.moments.add(distances)
        return normalised_entropy_reward(distances, self.scale, config.distance_floor)
