"""METRA: skills that move apart in a space of temporal distances (Park, Rybkin, Levine 2024, arXiv 2310.08887)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from cudc_bench.learning.networks import MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from .ddpg import DDPG, DDPGConfig
from .diayn import one_hot_skills, skill_of


@dataclass(frozen=True)
class METRAConfig(DDPGConfig):
    """The authors' values for the skills; the agent's are those of all methods here, but for the horizon.

    Attributes:
        horizon: k, the steps between s and s' in a minibatch, which are at most 1 apart in φ; the authors' is 1.
        skill_dim: size of the skill and of φ.
        discrete: whether skills are one-hot codes, or points of the unit sphere.
        skill_every: environment steps that a skill lasts; 0 for whole episodes.
        slack: up to how much a transition that keeps to the bound counts.
        multiplier: λ at the start.
    """

    horizon: PositiveInt = 1
    skill_dim: Annotated[int, Field(ge=2, le=10_000)] = 4
    discrete: bool = False
    skill_every: NonNegativeInt = 0
    slack: NonNegativeFloat = 1e-3
    multiplier: PositiveFloat = 30.0


class METRA(DDPG):
    """Rewards (φ(s') - φ(s)) · z: how far a step leads along the skill z in a space where states are no farther apart than in time.

    φ maximises the same, less λ times how much steps exceed the bound, and λ rises while they do (dual gradient descent on log λ). As in
    the authors' code: the bound is of the mean of the squared differences over the dimensions of φ, where the paper has the norm; a
    one-hot skill is centred and scaled; φ and λ take their step first, and the reward is that of the φ after it. Unlike it: DDPG, noise
    around a deterministic actor and no entropy, in place of SAC; a skill lasts for an episode of the domain, five times as long as
    theirs on Walker and Quadruped; an update follows every few steps instead of 50 every 8 episodes.
    """

    config_class: ClassVar[type] = METRAConfig
    category = "competence"
    family = "competence"
    citation = "Park et al. 2024"
    paper = "https://arxiv.org/abs/2310.08887"

    @property
    def skill_size(self) -> int:
        return int(self.config.skill_dim)

    @property
    def skill_steps(self) -> int:
        return int(self.config.skill_every)

    def sample_skills(self, random: MemberRandom, t: int) -> Tensor:
        size = self.config.skill_dim
        return one_hot_skills(random, size) if self.config.discrete else F.normalize(random.normal(size), dim=-1)

    def build(self, random: MemberRandom) -> list[Trainable]:
        width = self.config.width
        self.state_network = mlp(random, self.sizes.observation, width, width, self.config.skill_dim)
        start = math.log(self.config.multiplier)
        self.log_multiplier = nn.Parameter(torch.full((random.count, 1, 1), start, device=self.device))
        return [self.state_network, self.log_multiplier]

    def represent(self, observation: Tensor) -> Tensor:
        features: Tensor = self.state_network(observation)
        return features

    def steps(self, batch: Batch) -> Tensor:
        """φ(s') - φ(s) (E, B, D)."""
        size = batch.observation.shape[1]
        before, after = self.represent(torch.cat([batch.observation, batch.next_observation], dim=1)).split(size, dim=1)
        return after - before

    def along(self, steps: Tensor, skill: Tensor) -> Tensor:
        """How far steps lead along skills (E, B)."""
        if self.config.discrete:
            size = self.config.skill_dim
            skill = (skill - skill.mean(-1, keepdim=True)) * size / (size - 1)
        return (steps * skill).sum(-1)

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        steps = self.steps(batch)
        kept = (1.0 - steps.square().mean(-1)).clamp(max=self.config.slack)
        multiplier = self.log_multiplier[:, 0].detach().exp()
        loss = -(self.along(steps, skill_of(batch)) + multiplier * kept).mean(1)
        # One Adam takes both steps: neither loss has a gradient to the other's parameters.
        dual = self.log_multiplier[:, 0, 0] * kept.detach().mean(1)
        return loss + dual, {"loss_skill": loss.detach(), "multiplier": multiplier[:, 0], "excess": -kept.detach().mean(1)}

    def reward(self, batch: Batch) -> Tensor:
        return self.along(self.steps(batch), skill_of(batch))
