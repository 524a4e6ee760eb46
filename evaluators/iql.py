"""IQL: implicit Q-learning, which never asks for the value of an action outside the data (Kostrikov et al. 2021, arXiv 2110.06169)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import MemberRandom, TwinCritic, make_target, mlp, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config, NonNegativeFloat, PositiveFloat, PositiveInt, UnitInterval

from .actor_critic import OfflineLearner, labels, normal_log_prob, regression

LOG_STD = (-20.0, 2.0)


@dataclass(frozen=True)
class IQLConfig(Config):
    """CORL's values for locomotion (Tarasov et al. 2022), which are those of Kostrikov et al.

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers.
        learning_rate: of every Adam optimiser.
        discount: γ.
        critic_tau: rate at which the slow copies of the critics follow them.
        expectile: of Q that V estimates; 0.5 is the mean.
        beta: how much better actions count more when cloning.
        largest_weight: of exp(β A).
        schedule_steps: gradient steps over which the actor's learning rate falls to 0 along a cosine; those of the run.
    """

    batch_size: PositiveInt = 256
    width: PositiveInt = 256
    learning_rate: PositiveFloat = 3e-4
    discount: UnitInterval = 0.99
    critic_tau: UnitInterval = 0.005
    expectile: UnitInterval = 0.7
    beta: NonNegativeFloat = 3.0
    largest_weight: PositiveFloat = 100.0
    schedule_steps: PositiveInt = 500_000


class IQL(OfflineLearner):
    """V is an expectile of Q on the data, Q regresses on r + γ V(s'), and the actor clones with weights exp(β (Q - V)).

    As in CORL: plain networks with two hidden layers, and a normal policy with a state-independent deviation. Unlike CORL, and like
    every other algorithm here, it normalises neither observations nor rewards.
    """

    config_class: ClassVar[type] = IQLConfig
    citation = "Kostrikov et al. 2021"
    summary = "implicit Q-learning, as in CORL"

    def build(self, random: MemberRandom) -> None:
        config, s, a = self.config, self.observation, self.action
        width = config.width

        def plain(streams: MemberRandom, inputs: int, outputs: int) -> nn.Sequential:
            return mlp(streams, inputs, width, width, outputs, orthogonal=False)

        self.actor = mlp(random, s, width, width, a, output=torch.tanh, orthogonal=False)
        self.log_std = nn.Parameter(torch.zeros(len(self.seeds), 1, a, device=self.device))
        self.critic = TwinCritic(random, lambda streams: plain(streams, s + a, 1))
        self.target_critic = make_target(self.critic, TwinCritic(random, lambda streams: plain(streams, s + a, 1)))
        self.value = plain(random, s, 1)
        self.add_optimiser("actor", [self.actor, self.log_std], config.learning_rate)
        self.add_optimiser("critic", [self.critic], config.learning_rate)
        self.add_optimiser("value", [self.value], config.learning_rate)

    @property
    def policy(self) -> nn.Module:
        return self.actor

    def prepare(self) -> bool:
        config = self.config
        progress = min(self.updates / config.schedule_steps, 1.0)
        self.set_learning_rate("actor", config.learning_rate * 0.5 * (1.0 + math.cos(math.pi * progress)))
        return super().prepare()

    def learn(self, batch: Batch, plan: bool) -> dict[str, Tensor]:
        config = self.config
        with torch.no_grad():
            target_q = self.target_critic(batch.observation, batch.action).amin(-1)
            # V before its own step, as its advantage is; the two passes are one.
            next_value = self.value(batch.next_observation).squeeze(-1)
        advantage = target_q - self.value(batch.observation).squeeze(-1)
        weight = torch.where(advantage < 0, 1.0 - config.expectile, config.expectile)
        value_loss = (weight * advantage.square()).mean(1)
        self.minimise("value", value_loss)

        values = self.critic(batch.observation, batch.action)
        critic_loss = 0.5 * regression(values, labels(batch) + config.discount * next_value)
        self.minimise("critic", critic_loss)
        soft_update(self.critic, self.target_critic, config.critic_tau)

        advantage = advantage.detach()
        weight = (config.beta * advantage).exp().clamp(max=config.largest_weight)
        likelihood = normal_log_prob(self.actor(batch.observation), batch.action, self.log_std.clamp(*LOG_STD)).sum(-1)
        actor_loss = -(weight * likelihood).mean(1)
        self.minimise("actor", actor_loss)
        if not batch.measure:
            return {}
        return {
            "q": values.detach().mean((1, 2)), "critic_loss": critic_loss.detach(), "value_loss": value_loss.detach(),
            "actor_loss": actor_loss.detach(), "advantage": advantage.mean(1), "weight": weight.mean(1),
        }  # fmt: skip
