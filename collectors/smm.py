"""SMM: state marginal matching (Lee, Eysenbach, Parisotto, Xing, Levine, Salakhutdinov 2019, arXiv 1906.05274)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import Linear, MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Finite, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from .ddpg import DDPGConfig
from .diayn import OneHotSkills, skill_cross_entropy, skill_of


@dataclass(frozen=True)
class SMMConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        skills: how many.
        skill_every: environment steps that a skill lasts; 0 for whole episodes, as in the paper.
        vae_hidden: hidden width of the density model. latent_dim: its latent size.
        vae_learning_rate, discriminator_learning_rate: of these two.
        kl_weight: of the density model's prior term.
        novelty_weight, latent_weight, discriminator_weight: of the reward's three terms.
    """

    skills: PositiveInt = 4
    skill_every: NonNegativeInt = 0
    vae_hidden: PositiveInt = 150
    latent_dim: PositiveInt = 128
    vae_learning_rate: PositiveFloat = 1e-2
    discriminator_learning_rate: PositiveFloat = 1e-3
    kl_weight: NonNegativeFloat = 0.5
    novelty_weight: NonNegativeFloat = 1.0
    latent_weight: NonNegativeFloat = 1.0
    discriminator_weight: Finite = 1.0


class SMM(OneHotSkills):
    """Rewards states of low density under the own skill's past, by the reconstruction error of a variational autoencoder.

    r = ‖(s, z) - reconstruction‖² + log K - log q(z|s). The last term has URLB's sign: Lee et al. reward skills that can be recognised
    (+ log q), the reference code the opposite; ``discriminator_weight=-1`` gives the paper's. Skills last for an episode as in the
    paper; in URLB a flag is inverted, and its search for a skill runs during exploration. The target distribution is uniform. An action
    comes with the skill that it followed, where URLB's replay takes that of the step after it.
    """

    config_class: ClassVar[type] = SMMConfig
    category = "competence"
    family = "density"
    citation = "Lee et al. 2019"
    paper = "https://arxiv.org/abs/1906.05274"

    def build(self, random: MemberRandom) -> list[Trainable]:
        config = self.config
        inputs, hidden = self.sizes.observation + config.skills, config.vae_hidden
        # Mean and log-variance are layers of their own, computed as one.
        heads = Linear(random, hidden, 2 * config.latent_dim, blocks=2)
        self.encoder = nn.Sequential(*mlp(random, inputs, hidden, hidden, output=torch.relu_), heads)
        self.decoder = mlp(random, config.latent_dim, hidden, hidden, inputs)
        self.discriminator = mlp(random, self.sizes.observation, config.width, config.width, config.skills)
        rate = config.vae_learning_rate
        return [(self.encoder, rate), (self.decoder, rate), (self.discriminator, config.discriminator_learning_rate)]

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        skill = skill_of(batch)
        seen = torch.cat([batch.observation, skill], dim=-1)
        mean, log_variance = self.encoder(seen).chunk(2, dim=-1)
        noise = self.random["noise"].normal(*mean.shape[1:])
        squared = (seen - self.decoder(mean + (0.5 * log_variance).exp() * noise)).square()
        divergence = 0.5 * (log_variance.exp() + mean.square() - 1.0 - log_variance).sum(-1)
        unrecognised = skill_cross_entropy(self.discriminator(batch.observation), skill)
        # The reward is that of this forward pass, before its step, as in URLB.
        batch.cache = {"novelty": squared.detach().sum(-1), "unrecognised": unrecognised.detach()}
        losses = {
            "loss_reconstruction": squared.mean((1, 2)),
            "loss_divergence": self.config.kl_weight * divergence.mean(1),
            "loss_discriminator": unrecognised.mean(1),
        }
        total = losses["loss_reconstruction"] + losses["loss_divergence"] + losses["loss_discriminator"]
        return total, {name: loss.detach() for name, loss in losses.items()}

    def reward(self, batch: Batch) -> Tensor:
        config, kept = self.config, batch.cache
        constant = config.latent_weight * math.log(config.skills)
        return config.novelty_weight * kept["novelty"] + constant + config.discriminator_weight * kept["unrecognised"]
