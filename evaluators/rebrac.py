"""ReBRAC: TD3+BC done thoroughly (Tarasov et al. 2023, arXiv 2305.09836)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import (
    Activation,
    LayerNorm,
    Linear,
    MemberRandom,
    TwinCritic,
    frozen,
    make_target,
    noisy_action,
    soft_update,
)
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config, NonNegativeFloat, PositiveFloat, PositiveInt, UnitInterval

from .actor_critic import OfflineLearner, labels, regression


@dataclass(frozen=True)
class ReBRACConfig(Config):
    """The authors' values; the two penalties are for exploratory data.

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers.
        learning_rate: of every Adam optimiser.
        discount: γ.
        critic_tau: rate at which the slow copies of actor and critics follow them.
        hidden_layers: of actor and critics.
        actor_penalty: weight of the squared distance to the data's action in the actor's loss, against a value of mean size 1.
        critic_penalty: the same of the next action, in the critics' target. The authors tune both for each dataset, from 0.001 to 0.1;
            exploratory data, whose actions are nobody's policy, want little of them.
        noise_std, noise_clip: of the next action.
        policy_delay: updates of the critics for each update of the actor and the slow copies.
    """

    batch_size: PositiveInt = 1024
    width: PositiveInt = 256
    hidden_layers: PositiveInt = 3
    learning_rate: PositiveFloat = 1e-3
    discount: UnitInterval = 0.99
    critic_tau: UnitInterval = 0.005
    actor_penalty: NonNegativeFloat = 0.01
    critic_penalty: NonNegativeFloat = 0.01
    noise_std: NonNegativeFloat = 0.2
    noise_clip: NonNegativeFloat = 0.5
    policy_delay: PositiveInt = 2


class ReBRAC(OfflineLearner):
    """TD3+BC with deeper networks, LayerNorm in the critics, and penalties of their own for actor and critics.

    The next action of the data is part of the critics' target, so that the last transition of an episode, which has none, is never drawn.
    As in the authors' code: the squared distance is summed over the action's dimensions, values are divided by their mean size in the
    actor's loss, biases start at 0.1, and the last layers near 0. Unlike it, and like TD3: the actor first moves in the second update, and
    its slow copy follows what it became, not what it was. LayerNorm's ε is PyTorch's 1e-5 (theirs is 1e-6), and next actions stay 1e-6
    inside the bounds.
    """

    config_class: ClassVar[type] = ReBRACConfig
    citation = "Tarasov et al. 2023"
    summary = "TD3+BC with deeper networks and two penalties"
    wants_next_action = True

    def build(self, random: MemberRandom) -> None:
        config = self.config
        self.actor = self._make_actor(random)
        self.target_actor = make_target(self.actor, self._make_actor(random))
        self.critic = self._make_critic(random)
        self.target_critic = make_target(self.critic, self._make_critic(random))
        self.add_optimiser("actor", [self.actor], config.learning_rate)
        self.add_optimiser("critic", [self.critic], config.learning_rate)

    def _layers(self, random: MemberRandom, inputs: int, outputs: int, norm: bool, last: float) -> nn.Sequential:
        width = self.config.width
        layers: list[nn.Module] = []
        for _ in range(self.config.hidden_layers):
            hidden = Linear(random, inputs, width, orthogonal=False)
            nn.init.constant_(hidden.bias, 0.1)
            layers += [hidden, Activation(torch.relu)]
            if norm:
                layers.append(LayerNorm(random, width))
            inputs = width
        final = Linear(random, inputs, outputs, orthogonal=False)
        for parameter in (final.weight, final.bias):
            parameter.data.mul_(last * inputs**0.5)  # from ±1/√inputs to ±last
        return nn.Sequential(*layers, final)

    def _make_actor(self, random: MemberRandom) -> nn.Sequential:
        return nn.Sequential(self._layers(random, self.observation, self.action, norm=False, last=1e-3), Activation(torch.tanh))

    def _make_critic(self, random: MemberRandom) -> TwinCritic:
        return TwinCritic(random, lambda streams: self._layers(streams, self.observation + self.action, 1, norm=True, last=3e-3))

    @property
    def policy(self) -> nn.Module:
        return self.actor

    def updates_actor(self) -> bool:
        return (self.updates + 1) % self.config.policy_delay == 0

    def learn(self, batch: Batch, plan: bool) -> dict[str, Tensor]:
        config = self.config
        assert batch.next_action is not None, "ReBRAC needs the next action"
        with torch.no_grad():
            mean = self.target_actor(batch.next_observation)
            noise = self.random["noise"].normal(*mean.shape[1:])
            action = noisy_action(mean, noise, config.noise_std, config.noise_clip)
            distance = (action - batch.next_action).square().sum(-1)
            next_value = self.target_critic(batch.next_observation, action).amin(-1) - config.critic_penalty * distance
            target = labels(batch) + config.discount * next_value
        values = self.critic(batch.observation, batch.action)
        critic_loss = regression(values, target)
        self.minimise("critic", critic_loss)
        metrics = {"q": values.detach().mean((1, 2)), "critic_loss": critic_loss.detach(), "next_distance": distance.mean(1)}
        if plan:
            metrics |= self._update_actor(batch)
        return metrics if batch.measure else {}

    def _update_actor(self, batch: Batch) -> dict[str, Tensor]:
        config = self.config
        with frozen(self.critic):
            action = self.actor(batch.observation)
            value = self.critic(batch.observation, action).amin(-1)
            distance = (action - batch.action).square().sum(-1)
            loss = (config.actor_penalty * distance - value / value.detach().abs().mean(1, keepdim=True)).mean(1)
            self.minimise("actor", loss)
        soft_update(self.actor, self.target_actor, config.critic_tau)
        soft_update(self.critic, self.target_critic, config.critic_tau)
        return {"actor_loss": loss.detach(), "bc_loss": distance.detach().mean(1)}
