"""C-TeC: states whose future is hard to tell, by contrastive temporal similarity (Mohamed et al. 2026, arXiv 2603.02008)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cudc_bench.learning.networks import MemberRandom, Trainable, mlp
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeFloat, PositiveInt

from .ddpg import DDPG, DDPGConfig


@dataclass(frozen=True)
class CTeCConfig(DDPGConfig):
    """The values of the authors' code for the embeddings; the agent's are those of all methods here.

    Attributes:
        embedding_dim: size of the embeddings.
        logsumexp_weight: of the squared log of each row's sum in the contrastive loss; the authors' published runs have 0.
    """

    embedding_dim: PositiveInt = 64
    logsumexp_weight: NonNegativeFloat = 0.1


class CTeC(DDPG):
    """Rewards ‖u(s, a) - v(g)‖₁, by which embeddings of a state with its action and of a later state g of the same episode are apart.

    The embeddings are trained to tell by it which g of the minibatch belongs to which (s, a). Both have length 1, and a learnt temperature
    divides u. The steps to g are geometric (0.99) as far as the episode lasts. The reward is that of the forward pass before its step, of
    the same g.

    Written from the formulas alone, since the authors' code has no licence. Unlike there: DDPG instead of SAC, and k-step transitions, as
    in all methods here; all of an observation as g, where they also pick out positions; embeddings of the agent's width and learning rate,
    in its own minibatches, where the authors reward a whole batch of trajectories before several steps.
    """

    config_class: ClassVar[type] = CTeCConfig
    category = "knowledge"
    family = "reachability"
    citation = "Mohamed et al. 2026"
    paper = "https://arxiv.org/abs/2603.02008"
    wants_future = "within"

    def build(self, random: MemberRandom) -> list[Trainable]:
        s, a, width, size = self.sizes.observation, self.sizes.action, self.config.width, self.config.embedding_dim
        self.pair_encoder = mlp(random, s + a, width, width, size)
        self.state_encoder = mlp(random, s, width, width, size)
        self.log_temperature = nn.Parameter(torch.zeros(random.count, 1, 1, device=self.device))
        return [self.pair_encoder, self.state_encoder, self.log_temperature]

    def represent(self, observation: Tensor) -> Tensor:
        return F.normalize(self.state_encoder(observation), dim=-1)

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        assert batch.future_observation is not None, "C-TeC needs later states"
        pairs = F.normalize(self.pair_encoder(torch.cat([batch.observation, batch.action], dim=-1)), dim=-1)
        # (E, B, B); on CUDA its backward pass has a buffer of (E, B, B, D), a quarter of a gigabyte for each member at these values.
        distances = torch.cdist(pairs * (-self.log_temperature).exp(), self.represent(batch.future_observation), p=1.0)
        own, log_sum = distances.diagonal(dim1=1, dim2=2), (-distances).logsumexp(-1)
        batch.cache["distance"] = own.detach()
        losses = {
            "loss_contrastive": (log_sum + own).mean(1),
            "loss_logsumexp": self.config.logsumexp_weight * log_sum.square().mean(1),
        }
        return losses["loss_contrastive"] + losses["loss_logsumexp"], {name: loss.detach() for name, loss in losses.items()}

    def reward(self, batch: Batch) -> Tensor:
        distance: Tensor = batch.cache["distance"]
        return distance
