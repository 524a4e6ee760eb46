"""ProtoRL: the entropy of states among learned prototypes (Yarats, Fergus, Lazaric, Pinto 2021, arXiv 2102.11271)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cudc_bench.learning.knn import neighbour_distances
from cudc_bench.learning.networks import Linear, MemberRandom, Trainable, make_target, mlp, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveFloat, PositiveInt, UnitInterval

from .ddpg import DDPG, DDPGConfig


@dataclass(frozen=True)
class ProtoConfig(DDPGConfig):
    """URLB's values.

    Attributes:
        feature_dim: size of the representation and of the prototypes.
        projection_hidden: hidden width of the projector.
        prototypes: how many.
        queue_size: states that are remembered for the reward.
        neighbours: the reward is the distance to the neighbour of this rank.
        temperature: of the assignments.
        sinkhorn_iterations: rounds of balancing the target assignments.
        encoder_tau: rate of the slow copy of the predictor.
    """

    feature_dim: PositiveInt = 128
    projection_hidden: PositiveInt = 512
    prototypes: PositiveInt = 512
    queue_size: PositiveInt = 2048
    neighbours: PositiveInt = 3
    temperature: PositiveFloat = 0.1
    sinkhorn_iterations: PositiveInt = 3
    encoder_tau: UnitInterval = 0.05


class Proto(DDPG):
    """Rewards states that are far from those which the prototypes have picked so far.

    As in URLB: for states instead of pixels the encoder is one linear layer, the target has no projector, the states that the prototypes
    pick come from the current minibatch, and the reward has no logarithm. The queue starts with zeros. Prototypes are put back to unit
    norm in place, before the loss and before the reward, so that the gradient is that of free vectors of norm 1.
    """

    config_class: ClassVar[type] = ProtoConfig
    category = "data"
    family = "entropy"
    citation = "Yarats et al. 2021"
    paper = "https://arxiv.org/abs/2102.11271"

    queue: Tensor
    queue_start: Tensor

    def build(self, random: MemberRandom) -> list[Trainable]:
        config, s = self.config, self.sizes.observation
        if config.queue_size % config.prototypes:
            raise ValueError(f"queue_size={config.queue_size} is no multiple of prototypes={config.prototypes}")
        if config.neighbours > config.queue_size:
            raise ValueError(f"{config.neighbours} neighbours cannot be found in a queue_size of {config.queue_size}")
        self.predictor = Linear(random, s, config.feature_dim)
        self.slow_predictor = make_target(self.predictor, Linear(random, s, config.feature_dim))
        self.projector = mlp(random, config.feature_dim, config.projection_hidden, config.feature_dim)
        drawn = Linear(random, config.feature_dim, config.prototypes).weight.detach()
        self.prototypes = nn.Parameter(F.normalize(drawn.transpose(1, 2), dim=-1).contiguous())  # (E, M, D)
        self.register_buffer("queue", torch.zeros(random.count, config.queue_size, config.feature_dim, device=self.device))
        self.register_buffer("queue_start", torch.zeros((), dtype=torch.int64, device=self.device))
        return [self.predictor, self.projector, self.prototypes]

    @torch.no_grad()
    def normalise_prototypes(self) -> None:
        """Put every prototype back to norm 1, in place."""
        self.prototypes.copy_(F.normalize(self.prototypes, dim=-1))

    def scores(self, features: Tensor) -> Tensor:
        """Products (E, B, M) of normalised features with the prototypes as they are."""
        return features @ self.prototypes.transpose(1, 2)

    def assign(self, scores: Tensor) -> Tensor:
        """Balanced assignments q (E, B, M): Sinkhorn's rounds on exp(score / temperature); each row sums to 1.

        In each round every prototype gets the same mass, then every sample does.
        """
        q = (scores / self.config.temperature).exp()
        for _ in range(self.config.sinkhorn_iterations):
            q = q / q.sum(1, keepdim=True)
            q = q / q.sum(2, keepdim=True)
        return q

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        self.normalise_prototypes()
        online = F.normalize(self.projector(self.predictor(batch.observation)), dim=-1)
        log_p = (self.scores(online) / self.config.temperature).log_softmax(-1)
        with torch.no_grad():
            q = self.assign(self.scores(F.normalize(self.slow_predictor(batch.next_observation), dim=-1)))
        loss = -(q * log_p).sum(-1).mean(1)
        return loss, {"loss_assignment": loss.detach()}

    def represent(self, observation: Tensor) -> Tensor:
        return F.normalize(self.predictor(observation), dim=-1)

    def reward(self, batch: Batch) -> Tensor:
        self.normalise_prototypes()
        y = self.represent(batch.next_observation)
        self._remember(y)
        nearest = neighbour_distances(y, self.config.neighbours, among=self.queue)
        return nearest.amax(-1)

    def _remember(self, y: Tensor) -> None:
        """Let each prototype pick a state of the minibatch, with the softmax of its scores over the minibatch, into the queue."""
        config = self.config
        chance = self.scores(y).transpose(1, 2).softmax(-1).cumsum(-1)  # (E, M, B)
        drawn = self.random["noise"].uniform(config.prototypes)[..., None] * chance[..., -1:]
        picked = torch.searchsorted(chance, drawn).clamp_(max=y.shape[1] - 1)
        rows = (self.queue_start + torch.arange(config.prototypes, device=self.device)) % config.queue_size
        self.queue[:, rows] = y.gather(1, picked.expand(-1, -1, y.shape[-1]))
        self.queue_start.add_(config.prototypes).remainder_(config.queue_size)

    def update_targets(self) -> None:
        soft_update(self.predictor, self.slow_predictor, self.config.encoder_tau)
