"""CQL: conservative Q-learning (Kumar et al. 2020, arXiv 2006.04779), as in ExORL, and with what ExORL's code gets wrong put right."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cudc_bench.learning.networks import Activation, MemberRandom, mlp, trunk
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config, NonNegativeFloat, PositiveFloat, PositiveInt, UnitInterval

from .actor_critic import ActorCritic, normal_log_prob, regression

LOG_STD = (-10.0, 2.0)
LARGEST_MULTIPLIER = 1e6


@dataclass(frozen=True)
class CQLConfig(Config):
    """ExORL's values.

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers.
        learning_rate: of every Adam optimiser.
        discount: γ.
        critic_tau: rate at which the slow copies of the critics follow them.
        penalty_weight: of the penalty on the values of actions that are not in the data.
        penalty_samples: how many uniform actions, actions of π(s) and of π(s') enter the penalty.
        lagrange: tune the weight, starting at 1, so that the penalty comes to ``penalty_target``.
        penalty_target: what the penalty is then to come to.
        squash_twice: whether the mean goes through tanh before the action does, which bounds mean actions to ±tanh 1 = ±0.76.
        sum_log_prob: add log π over the dimensions of an action, as the target entropy -A asks for, instead of treating each dimension
            as a sample.
    """

    batch_size: PositiveInt = 1024
    width: PositiveInt = 1024
    learning_rate: PositiveFloat = 1e-4
    discount: UnitInterval = 0.99
    critic_tau: UnitInterval = 0.01
    penalty_weight: NonNegativeFloat = 0.01
    penalty_samples: PositiveInt = 3
    lagrange: bool = False
    penalty_target: NonNegativeFloat = 5.0
    squash_twice: bool = True
    sum_log_prob: bool = False


class CQL(ActorCritic):
    """A soft actor-critic whose critics are pushed down at actions that the data lack.

    The penalty is logsumexp of the values of uniform actions, of actions of π(s) and π(s'), all judged at s, and of the data's, less the
    value of the data's, for both critics. As in ExORL and unlike Kumar et al.: samples are not weighted by their density, the target has no
    entropy term, the mean action is squashed twice, and log π is never summed over dimensions. ``cql-fixed`` undoes the last two.
    """

    config_class: ClassVar[type] = CQLConfig
    citation = "Kumar et al. 2020; Yarats et al. 2022"
    summary = "conservative Q-learning, as in ExORL"

    def build(self, random: MemberRandom) -> None:
        super().build(random)
        for name in ("temperature", "multiplier"):
            parameter = nn.Parameter(torch.zeros(len(self.seeds), device=self.device))
            self.register_parameter(f"log_{name}", parameter)
            self.add_optimiser(name, [parameter], self.config.learning_rate)

    log_temperature: nn.Parameter
    log_multiplier: nn.Parameter

    def make_actor(self, random: MemberRandom) -> nn.Module:
        width = self.config.width
        return nn.Sequential(trunk(random, self.observation, width), *mlp(random, width, width, 2 * self.action))

    @property
    def policy(self) -> nn.Module:
        return nn.Sequential(self.actor, Activation(self._mean_action))

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        return self._mean_action(self.actor(observation))

    def _mean_action(self, output: Tensor) -> Tensor:
        return torch.tanh(self._distribution(output)[0])

    def _distribution(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-deviation (…, A) of the normal whose tanh is the action."""
        mean, log_std = output.chunk(2, dim=-1)
        return torch.tanh(mean) if self.config.squash_twice else mean, log_std.clamp(*LOG_STD)

    def _draw(self, observation: Tensor, times: int = 1) -> tuple[Tensor, Tensor]:
        """Actions (E, times · B, A) of the policy, with gradient, and the logarithm of their density in each dimension."""
        mean, log_std = self._distribution(self.actor(observation))
        mean, log_std = mean.repeat(1, times, 1), log_std.repeat(1, times, 1)
        before = mean + log_std.exp() * self.random["noise"].normal(*mean.shape[1:])
        # log(1 - tanh² x), in the form that keeps its digits where tanh is near ±1.
        change = 2.0 * (math.log(2.0) - before - F.softplus(-2.0 * before))
        return torch.tanh(before), normal_log_prob(mean, before, log_std) - change

    def sample(self, observation: Tensor) -> Tensor:
        return self._draw(observation)[0]

    def critic_loss(self, batch: Batch, target: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        times = self.config.penalty_samples
        with torch.no_grad():
            shape = (times * batch.action.shape[1], self.action)
            uniform = self.random["noise"].uniform(*shape) * 2.0 - 1.0
            own = self._draw(batch.observation, times)[0]
            following = self._draw(batch.next_observation, times)[0]
        # All of them judged at s, in one pass, the data's actions first.
        actions = torch.cat([batch.action, uniform, own, following], dim=1)
        values = self.critic(batch.observation.repeat(1, 1 + 3 * times, 1), actions).unflatten(1, (1 + 3 * times, -1))
        of_data = values[:, 0]
        penalty = (values.logsumexp(1) - of_data).sum(-1).mean(1)
        weight = self._penalty_weight(penalty.detach())
        metrics = {"q": of_data.detach().mean((1, 2)), "penalty": penalty.detach()}
        return regression(of_data, target) + weight * penalty, metrics

    def _penalty_weight(self, penalty: Tensor) -> Tensor | float:
        if not self.config.lagrange:
            return float(self.config.penalty_weight)
        gap = penalty - self.config.penalty_target
        self.minimise("multiplier", -0.5 * self.log_multiplier.exp().clamp(max=LARGEST_MULTIPLIER) * gap)
        return self.log_multiplier.detach().exp().clamp(max=LARGEST_MULTIPLIER)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        action, log_prob = self._draw(batch.observation)
        log_prob = log_prob.sum(-1, keepdim=True) if self.config.sum_log_prob else log_prob
        # The target entropy is -A.
        self.minimise("temperature", -self.log_temperature * (log_prob.detach().mean((1, 2)) - self.action))
        temperature = self.log_temperature.detach().exp()
        value = self.critic(batch.observation, action).amin(-1)
        metrics = {"entropy": -log_prob.detach().mean((1, 2)), "temperature": temperature}
        return temperature * log_prob.mean((1, 2)) - value.mean(1), metrics


class CQLFixed(CQL):
    """CQL whose mean action is squashed once and whose log π is summed over dimensions, as in soft actor-critic."""

    values: ClassVar[Mapping[str, Any]] = {"squash_twice": False, "sum_log_prob": True}
    citation = "Kumar et al. 2020"
    summary = "CQL with ExORL's two slips put right"
