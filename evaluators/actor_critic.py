"""The backbone of ExORL's offline learners (Yarats et al. 2022, arXiv 2201.13425): twin critics with trunks of their own, and an actor.

One gradient step is: critic, actor, targets. An algorithm says what is its own: usually the actor's loss alone.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.learner import Learner
from cudc_bench.learning.networks import MemberRandom, TwinCritic, actor, frozen, make_target, mlp, noisy_action, soft_update, trunk
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config, NonNegativeFloat, PositiveFloat, PositiveInt, UnitInterval

from .base import Evaluator


class OfflineLearner(Evaluator, Learner):
    """Networks, optimisers and streams of a stack of offline agents, and a count of their updates."""

    stacks_exactly: ClassVar[bool] = True

    def __init__(self, observation: int, action: int, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        super().__init__(observation, action, config, seeds, device)
        self.observation, self.action = observation, action
        self.random["noise"] = MemberRandom(seeds, "update", device)
        self.updates = 0
        self.build(MemberRandom(seeds, "weights", device))

    @abstractmethod
    def build(self, random: MemberRandom) -> None:
        """Make the networks and their optimisers."""

    def updates_actor(self) -> bool:
        """Whether the next update moves the actor and the slow copies, too; asked before ``updates`` counts it."""
        return True

    def prepare(self) -> bool:
        plan = self.updates_actor()
        self.updates += 1
        return plan

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        return super().state_dict() | {"updates": self.updates}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        super().load_state_dict(state)
        self.updates = state["updates"]


@dataclass(frozen=True)
class ExORLConfig(Config):
    """ExORL's values, for all of its algorithms.

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers.
        learning_rate: of every Adam optimiser.
        discount: γ.
        critic_tau: rate at which the slow copies of the critics follow them.
        noise_std: of the policy around its mean, in training.
        noise_clip: bound of that noise.
    """

    batch_size: PositiveInt = 1024
    width: PositiveInt = 1024
    learning_rate: PositiveFloat = 1e-4
    discount: UnitInterval = 0.99
    critic_tau: UnitInterval = 0.01
    noise_std: NonNegativeFloat = 0.2
    noise_clip: NonNegativeFloat = 0.3


class ActorCritic(OfflineLearner):
    """Twin critics that regress on r + γ min_j Q̄_j(s', a'), a' from the policy, and an actor.

    No episode of these domains terminates: the environment's own discount is always 1.
    """

    config_class: ClassVar[type] = ExORLConfig

    def build(self, random: MemberRandom) -> None:
        config, inputs, width = self.config, self.observation + self.action, self.config.width

        def critic(streams: MemberRandom) -> nn.Sequential:
            return nn.Sequential(trunk(streams, inputs, width), *mlp(streams, width, width, 1))

        self.actor = self.make_actor(random)
        self.critic = TwinCritic(random, critic)
        self.target_critic = make_target(self.critic, TwinCritic(random, critic))
        self.add_optimiser("actor", [self.actor], config.learning_rate)
        self.add_optimiser("critic", [self.critic], config.learning_rate)

    # What an algorithm says

    def make_actor(self, random: MemberRandom) -> nn.Module:
        """The actor's network; that of a mean in (-1, 1) unless an algorithm needs another."""
        return actor(random, self.observation, self.action, self.config.width)

    @abstractmethod
    def actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss (E,), and metrics; the critics' weights take no gradient here."""

    def sample(self, observation: Tensor) -> Tensor:
        """Actions of the stochastic policy for (E, B, S), with gradient."""
        return self.around(self.actor(observation))

    def around(self, mean: Tensor) -> Tensor:
        """Actions of the stochastic policy around a mean (E, B, A)."""
        noise = self.random["noise"].normal(*mean.shape[1:])
        return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)

    def next_action(self, batch: Batch) -> Tensor:
        """a' of the critics' target."""
        return self.sample(batch.next_observation)

    def critic_loss(self, batch: Batch, target: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The critics' loss (E,) for their target (E, B), and metrics."""
        values = self.critic(batch.observation, batch.action)
        return regression(values, target), {"q": values.detach().mean((1, 2))}

    def update_targets(self) -> None:
        """Move the slow copies."""
        soft_update(self.critic, self.target_critic, self.config.critic_tau)

    # The fixed sequence

    @property
    def policy(self) -> nn.Module:
        return self.actor

    def learn(self, batch: Batch, plan: bool) -> dict[str, Tensor]:
        with torch.no_grad():
            next_value = self.target_critic(batch.next_observation, self.next_action(batch)).amin(-1)
            target = labels(batch) + self.config.discount * next_value
        loss, metrics = self.critic_loss(batch, target)
        self.minimise("critic", loss)
        metrics["critic_loss"] = loss.detach()
        if plan:
            with frozen(self.critic):
                loss, more = self.actor_loss(batch)
                self.minimise("actor", loss)
            metrics |= more | {"actor_loss": loss.detach()}
            self.update_targets()
        return metrics if batch.measure else {}


def labels(batch: Batch) -> Tensor:
    """The rewards (E, B) of a labelled batch."""
    assert batch.reward is not None, "offline learning needs a relabelled dataset"
    return batch.reward


def regression(values: Tensor, target: Tensor) -> Tensor:
    """Squared errors of both critics (E, B, 2) against one target (E, B), summed over the critics: (E,)."""
    return (values - target[..., None]).square().sum(-1).mean(1)


def normal_log_prob(mean: Tensor, action: Tensor, log_std: Tensor | float) -> Tensor:
    """log N(a; mean, std²) in each dimension of (…, A)."""
    if not isinstance(log_std, Tensor):
        # Filled on the device: a number of the host would be copied there, and waited for.
        log_std = torch.full((), log_std, device=mean.device)
    return -0.5 * ((action - mean) / log_std.exp()).square() - log_std - 0.5 * math.log(2 * math.pi)
