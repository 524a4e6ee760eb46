"""APS: entropy of states, and successor features of a task vector (Liu and Abbeel 2021, arXiv 2108.13956)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch.nn.functional as F
from torch import Tensor

from cudc_bench.learning.knn import neighbour_distances, normalised_entropy_reward
from cudc_bench.learning.networks import MemberRandom, SharedTrunkCritic, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.learning.running_mean_std import RunningMeanStd
from cudc_bench.settings.config import NonNegativeFloat, PositiveInt

from .ddpg import DDPG, DDPGConfig
from .diayn import skill_of


@dataclass(frozen=True)
class APSConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        task_dim: size of the task vector and of the features.
        skill_every: environment steps that a task vector lasts.
        neighbours: of the entropy term.
        knn_exclude_self: leave a point out of its own neighbours (URLB counts it, at distance 0).
        distance_floor: subtracted from the normalised distances, which are then cut off at 0.
    """

    task_dim: PositiveInt = 10
    skill_every: PositiveInt = 5
    neighbours: PositiveInt = 12
    knn_exclude_self: bool = False
    distance_floor: NonNegativeFloat = 1e-4


class APS(DDPG):
    """Rewards rare states and states whose features point along the task vector w.

    The critics give successor features: Q_j(s, w, a) = w · ψ_j(s, w, a), learned by temporal differences of the scalar Q, as in URLB.
    The entropy is of un-normalised features, the task term of normalised ones. Unlike URLB, whose replay pairs an action with the task
    vector of the step after it (another one for a fifth of all samples), an action comes with the vector that it followed.
    """

    config_class: ClassVar[type] = APSConfig
    category = "competence"
    family = "competence and entropy"
    citation = "Liu and Abbeel 2021"
    paper = "https://arxiv.org/abs/2108.13956"

    @property
    def skill_size(self) -> int:
        return int(self.config.task_dim)

    @property
    def skill_steps(self) -> int:
        return int(self.config.skill_every)

    @property
    def critic_outputs(self) -> int:
        return int(self.config.task_dim)

    def sample_skills(self, random: MemberRandom, t: int) -> Tensor:
        return F.normalize(random.normal(self.config.task_dim), dim=-1)

    def build(self, random: MemberRandom) -> list[Trainable]:
        config = self.config
        if config.neighbours + config.knn_exclude_self > config.batch_size:
            raise ValueError(f"{config.neighbours} neighbours cannot be found in a batch_size of {config.batch_size}")
        self.features = mlp(random, self.sizes.observation, config.width, config.width, config.task_dim)
        self.moments = RunningMeanStd(random.count, self.device)
        return [self.features]

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        aligned = (skill_of(batch) * F.normalize(self.features(batch.next_observation), dim=-1)).sum(-1)
        loss = -aligned.mean(1)
        return loss, {"loss_alignment": loss.detach()}

    def represent(self, observation: Tensor) -> Tensor:
        features: Tensor = self.features(observation)
        return features

    def reward(self, batch: Batch) -> Tensor:
        config, features = self.config, self.represent(batch.next_observation)
        distances = neighbour_distances(features, config.neighbours, config.knn_exclude_self)
        self.moments.add(distances)
        entropy = normalised_entropy_reward(distances, self.moments.mean, config.distance_floor)
        return entropy + (skill_of(batch) * F.normalize(features, dim=-1)).sum(-1)

    def value(self, critic: SharedTrunkCritic, observation: Tensor, skill: Tensor | None, action: Tensor) -> Tensor:
        assert skill is not None
        successor = critic(self.with_skill(observation, skill), action)
        return (successor * skill[:, :, None]).sum(-1)
