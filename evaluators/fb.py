"""FB: forward-backward representations of the successor measures of all policies (Touati and Ollivier 2021; Touati et al. 2023)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import Activation, MemberRandom, frozen, make_target, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeFloat, PositiveInt

from .zero_shot import (
    ConditionedActor,
    ForwardMap,
    Labelled,
    NoisyZeroShotConfig,
    ZeroShotLearner,
    features,
    measures,
    normalised,
    off_diagonal,
    on_diagonal,
    orthonormality,
    weighted_sums,
)


@dataclass(frozen=True)
class FBConfig(NoisyZeroShotConfig):
    """The values of controllable_agent, Touati et al.'s code for ExORL's data.

    Attributes:
        feature_width: of the hidden layers of B.
        ortho: weight of B's orthonormality.
        shared_embeddings: whether both forward maps have their embeddings in common.
        reduce: what is taken of the two forward maps, in targets and by the actor: the smaller (controllable_agent), or the mean
            (metamotivo, for dm_control).
    """

    feature_width: PositiveInt = 526
    ortho: NonNegativeFloat = 1.0
    shared_embeddings: bool = True
    reduce: Literal["min", "mean"] = "min"


class FB(ZeroShotLearner):
    """F(s, z, a)ᵀ B(s') is the successor measure of π(·, z), relative to the data's, and π maximises F(s, z, a)ᵀ z.

    As in controllable_agent: the smaller of two forward maps in each entry of the target's matrix and for the actor, which share their
    embeddings; B normalised; z of states of the minibatch for half of it; an orthonormality loss of 2 (½ off[C²] − diag(C)). Its additional
    regression of F(s, z, a)ᵀ z (``q_loss``, off there) is left out. Episodes do not terminate.
    """

    config_class: ClassVar[type] = FBConfig
    citation = "Touati and Ollivier 2021; Touati et al. 2023"
    paper = "https://arxiv.org/abs/2209.14935"
    summary = "forward-backward representations, as in controllable_agent"
    rule = "normalised mean of r B(s')"

    def build(self, random: MemberRandom) -> None:
        config, s, a = self.config, self.observation, self.action

        def forward_map() -> ForwardMap:
            return ForwardMap(random, s, config.z_dim, a, config.z_dim, config.width, config.shared_embeddings)

        def backward_map() -> nn.Module:
            return nn.Sequential(features(random, s, config.feature_width, config.z_dim), Activation(normalised))

        self.actor = ConditionedActor(random, s, config.z_dim, a, config.width)
        self.forward_map, self.backward_map = forward_map(), backward_map()
        self.target_forward_map = make_target(self.forward_map, forward_map())
        self.target_backward_map = make_target(self.backward_map, backward_map())
        self.add_optimiser("maps", [self.forward_map, self.backward_map], config.learning_rate)
        self.add_optimiser("actor", [self.actor], config.learning_rate)

    @torch.no_grad()
    def direction(self, labelled: Labelled) -> Tensor:
        return weighted_sums(labelled.reward, self.backward_map(labelled.next_observation)) / labelled.reward.shape[-1]

    def _one(self, both: Tensor) -> Tensor:
        """Of what both forward maps say (E, 2, ...), (E, ...)."""
        return both.amin(1) if self.config.reduce == "min" else both.mean(1)

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        config, following = self.config, batch.next_observation
        with torch.no_grad():
            z = self.task_vectors(self.backward_map(batch.observation))
            later = self.target_forward_map(following, z, self.sample(following, z))
            target = self._one(measures(later, self.target_backward_map(following)))
        ahead, back = self.forward_map(batch.observation, z, batch.action), self.backward_map(following)
        found = measures(ahead, back)
        fb_loss = (0.5 * off_diagonal((found - config.discount * target[:, None]).square()) - on_diagonal(found)).sum(1)
        ortho_loss = 2.0 * orthonormality(back)
        self.minimise("maps", fb_loss + config.ortho * ortho_loss)

        with frozen(self.forward_map):
            values = (self.forward_map(batch.observation, z, self.sample(batch.observation, z)) * z[:, None]).sum(-1)
            values = self._one(values)
            actor_loss = -values.mean(1)
            self.minimise("actor", actor_loss)
        soft_update(self.forward_map, self.target_forward_map, config.target_tau)
        soft_update(self.backward_map, self.target_backward_map, config.target_tau)
        if not batch.measure:
            return {}
        return {
            "fb_loss": fb_loss.detach(), "ortho_loss": ortho_loss.detach(), "actor_loss": actor_loss.detach(),
            "measure": on_diagonal(found.detach()).mean(1), "q": values.detach().mean(1),
        }  # fmt: skip
