"""One-step FB: forward-backward representations of the data's own policy (Zheng, Jayanth and Eysenbach 2026)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import Activation, Ensemble, Linear, MemberRandom, frozen, make_target, mlp, soft_update, trunk
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeFloat

from .zero_shot import (
    Labelled,
    ZeroShotConfig,
    ZeroShotLearner,
    measures,
    normalised,
    off_diagonal,
    on_diagonal,
    orthonormality,
    weighted_sums,
)


@dataclass(frozen=True)
class OneStepFBConfig(ZeroShotConfig):
    """The authors' values for ExORL's Walker.

    Attributes:
        ortho: weight of B's orthonormality; the authors have 1 for Cheetah, and 0.03 for Quadruped and Jaco.
        temperature: of the softmax over rewards that weighs labelled transitions; the authors have 3 for Cheetah.
        maximise: what the actor maximises, the mean of both forward maps or the smaller; the authors have ``min`` for Quadruped and Jaco.
        squash: whether actions are tanh of the actor's outputs, or these clipped to [-1, 1]; the authors have tanh for Quadruped and Jaco.
    """

    ortho: NonNegativeFloat = 0.1
    temperature: NonNegativeFloat = 10.0
    maximise: Literal["mean", "min"] = "mean"
    squash: bool = False


class OneStepFB(ZeroShotLearner):
    """F(s, a)ᵀ B(s⁺, a⁺) is the discounted occupancy of the policy that collected, relative to the data; π(·, z) is one step better for z.

    The next action is the data's, so that the last transition of an episode, which has none, is never drawn. As in the authors' code:
    targets with the mean of two forward maps, (1 − γ) on the diagonal, values divided by their mean size in the actor's loss, no noise on
    actions; the actor's step looks at the forward maps of before theirs. Their cloning term, which they switch off for ExORL, is left
    out. Unlike theirs: the weights at the start are orthogonal (the actor's last layer a tenth of that, as theirs is of their
    initialisation), slow copies follow what the networks became, not what they were, and LayerNorm's ε is 1e-5 (1e-6).
    """

    config_class: ClassVar[type] = OneStepFBConfig
    citation = "Zheng et al. 2026"
    paper = "https://arxiv.org/abs/2602.11399"
    summary = "forward-backward representations of the data's policy"
    has_goals = False  # B is of a state and an action
    rule = "normalised mean of softmax(r) r B(s, a)"
    wants_next_action = True

    def build(self, random: MemberRandom) -> None:
        config, inputs = self.config, self.observation + self.action

        def forward_map() -> Ensemble:
            return Ensemble(random, 2, lambda streams: deep(streams, inputs, config.width, config.z_dim))

        def backward_map() -> nn.Sequential:
            return deep(random, inputs, config.feature_width, config.z_dim)

        self.actor = _Actor(random, self.observation + config.z_dim, self.action, config.width, config.squash)
        self.forward_map, self.backward_map = forward_map(), backward_map()
        self.target_forward_map = make_target(self.forward_map, forward_map())
        self.target_backward_map = make_target(self.backward_map, backward_map())
        self.add_optimiser("maps", [self.forward_map, self.backward_map], config.learning_rate)
        self.add_optimiser("actor", [self.actor], config.learning_rate)

    @torch.no_grad()
    def direction(self, labelled: Labelled) -> Tensor:
        weights = (self.config.temperature * labelled.reward).softmax(-1) * labelled.reward
        return weighted_sums(weights, self.backward_map(torch.cat([labelled.observation, labelled.action], -1)))

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        config = self.config
        assert batch.next_action is not None, "one-step FB needs the next action"
        pair, following = torch.cat([batch.observation, batch.action], -1), torch.cat([batch.next_observation, batch.next_action], -1)
        back = self.backward_map(pair)
        z = self.task_vectors(normalised(back.detach()))

        with frozen(self.forward_map):
            own = torch.cat([batch.observation, self.actor(batch.observation, z)], -1)
            both = (self.forward_map(own) * z[:, None]).sum(-1)
            values = both.mean(1) if config.maximise == "mean" else both.amin(1)
            actor_loss = -values.mean(1) / values.detach().abs().mean(1)
            self.minimise("actor", actor_loss)

        with torch.no_grad():
            target = measures(self.target_forward_map(following), self.target_backward_map(pair)).mean(1)
        found = measures(self.forward_map(pair), back)
        errors = 0.5 * off_diagonal((found - config.discount * target[:, None]).square())
        fb_loss = (errors - (1.0 - config.discount) * on_diagonal(found)).mean(1)
        ortho_loss = orthonormality(back)
        self.minimise("maps", fb_loss + config.ortho * ortho_loss)
        soft_update(self.forward_map, self.target_forward_map, config.target_tau)
        soft_update(self.backward_map, self.target_backward_map, config.target_tau)
        if not batch.measure:
            return {}
        return {
            "fb_loss": fb_loss.detach(), "ortho_loss": ortho_loss.detach(), "actor_loss": actor_loss.detach(),
            "measure": on_diagonal(found.detach()).mean(1), "q": values.detach().mean(1),
        }  # fmt: skip


def deep(random: MemberRandom, inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Linear, LayerNorm, tanh, and two more hidden layers with ReLU."""
    return nn.Sequential(trunk(random, inputs, width), *mlp(random, width, width, width, outputs))


class _Actor(nn.Module):
    """The mean action of (s, z): hidden layers with tanh, ReLU, ReLU."""

    def __init__(self, random: MemberRandom, inputs: int, action: int, width: int, squash: bool) -> None:
        super().__init__()
        first, hidden, last = Linear(random, inputs, width), mlp(random, width, width, width), Linear(random, width, action)
        last.weight.data.mul_(0.1)
        self.layers = nn.Sequential(
            first, Activation(torch.tanh), *hidden, Activation(torch.relu_), last, Activation(torch.tanh if squash else _clipped)
        )

    def forward(self, observation: Tensor, z: Tensor) -> Tensor:
        """(E, B, S), (E, B, d) -> (E, B, A)."""
        actions: Tensor = self.layers(torch.cat([observation, z], -1))
        return actions


def _clipped(actions: Tensor) -> Tensor:
    return actions.clamp(-1.0, 1.0)
