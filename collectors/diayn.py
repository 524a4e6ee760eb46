"""DIAYN: skills that can be told apart by the states they visit (Eysenbach, Gupta, Ibarz, Levine 2018, arXiv 1802.06070)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeInt

from .ddpg import DDPG, DDPGConfig


@dataclass(frozen=True)
class DIAYNConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        skills: how many.
        skill_every: environment steps that a skill lasts, at most until the end of the episode; 0 for whole episodes.
    """

    skills: Annotated[int, Field(ge=2, le=10_000)] = 16
    skill_every: NonNegativeInt = 50


class OneHotSkills(DDPG):
    """Some skills, all equally likely, as one-hot codes; for configurations with ``skills`` and ``skill_every``."""

    @property
    def skill_size(self) -> int:
        return int(self.config.skills)

    @property
    def skill_steps(self) -> int:
        return int(self.config.skill_every)

    def sample_skills(self, random: MemberRandom, t: int) -> Tensor:
        return one_hot_skills(random, self.config.skills)


class DIAYN(OneHotSkills):
    """Rewards states from which a discriminator recognises the skill: log q(z|s') - log p(z), with p uniform.

    As in URLB and unlike Eysenbach et al.: DDPG instead of a maximum-entropy policy, and skills that change within an episode. Unlike
    URLB, whose replay pairs an action with the skill of the step after it, an action comes with the skill that it followed.
    """

    config_class: ClassVar[type] = DIAYNConfig
    category = "competence"
    family = "competence"
    citation = "Eysenbach et al. 2018"
    paper = "https://arxiv.org/abs/1802.06070"

    def build(self, random: MemberRandom) -> list[Trainable]:
        width = self.config.width
        self.discriminator = mlp(random, self.sizes.observation, width, width, self.config.skills)
        return [self.discriminator]

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        logits, skill = self.discriminator(batch.next_observation), skill_of(batch)
        loss = skill_cross_entropy(logits, skill).mean(1)
        right = (logits.argmax(-1) == skill.argmax(-1)).float().mean(1)
        return loss, {"loss_discriminator": loss.detach(), "accuracy": right}

    def reward(self, batch: Batch) -> Tensor:
        logits = self.discriminator(batch.next_observation)
        return math.log(self.config.skills) - skill_cross_entropy(logits, skill_of(batch))


def skill_of(batch: Batch) -> Tensor:
    """The skills (E, B, K) of a minibatch of a method with skills."""
    assert batch.skill is not None
    return batch.skill


def one_hot_skills(random: MemberRandom, count: int) -> Tensor:
    """One of so many skills for each member (E, K), all equally likely, as one-hot codes."""
    return F.one_hot((random.uniform() * count).long().clamp_(max=count - 1), count).float()


def skill_cross_entropy(logits: Tensor, skill: Tensor) -> Tensor:
    """-log q(z|s) (E, B) of one-hot skills (E, B, K)."""
    return -(logits.log_softmax(-1) * skill).sum(-1)
