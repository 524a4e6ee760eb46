"""The backbone of every learning collector: DDPG with twin critics, as URLB configures it for states.

One update is one fixed sequence: believe, reward, critic, actor, targets. A method says only what is its own: what it believes
(``build`` and ``auxiliary_loss``), what it rewards (``reward``), and, for some, its horizon, its sample weights, or its skills
(``skill_size``, ``skill_steps`` and ``sample_skills``), which actor and critic then see beside the observation.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from cudc_bench.learning.learner import Learner
from cudc_bench.learning.networks import MemberRandom, SharedTrunkCritic, Trainable, actor, frozen, make_target, noisy_action, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config, NonNegativeFloat, PositiveFloat, PositiveInt, UnitInterval

from .base import Collector, Sizes


@dataclass(frozen=True)
class DDPGConfig(Config):
    """URLB's values for states (Laskin et al. 2021), which the paper prints as common hyperparameters.

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers.
        learning_rate: of every Adam optimiser.
        discount: γ.
        critic_tau: rate at which the slow copies of the critics follow them.
        noise_std: of the Gaussian noise around the actor's actions, while it collects and in updates.
        noise_clip: bound of that noise in updates.
        horizon: k, the steps between s and s' in a minibatch; CUDC's is the one to start from.
        td_discount: of the critic's target, γ^k or γ.
    """

    batch_size: PositiveInt = 1024
    width: PositiveInt = 1024
    learning_rate: PositiveFloat = 1e-4
    discount: UnitInterval = 0.99
    critic_tau: UnitInterval = 0.01
    noise_std: NonNegativeFloat = 0.2
    noise_clip: NonNegativeFloat = 0.3
    horizon: PositiveInt = 3
    td_discount: Literal["gamma_pow_k", "gamma"] = "gamma_pow_k"


class DDPG(Collector, Learner):
    """A stack of E agents that maximise an intrinsic reward.

    The critic's target is r + γ^k min_j Q̄_j(s', a') with a' from the online actor (there is no target actor); the actor maximises
    min_j Q_j. Both use clipped Gaussian noise (spec of URLB's ``ddpg``).
    """

    config_class: ClassVar[type] = DDPGConfig

    def __init__(self, sizes: Sizes, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        super().__init__(sizes, config, seeds, device)
        # A method may add its own.
        self.random = {
            "act": MemberRandom(seeds, "act", device),
            "noise": MemberRandom(seeds, "update", device),
            "skill": MemberRandom(seeds, "skill", device),
        }
        weights = MemberRandom(seeds, "weights", device)
        inputs = sizes.observation + self.skill_size
        self.actor = actor(weights, inputs, sizes.action, config.width)
        self.critic = SharedTrunkCritic(weights, inputs + sizes.action, config.width, self.critic_outputs)
        self.target_critic = make_target(self.critic, SharedTrunkCritic(weights, inputs + sizes.action, config.width, self.critic_outputs))
        self.add_optimiser("actor", [self.actor], config.learning_rate)
        self.add_optimiser("critic", [self.critic], config.learning_rate)
        members = len(seeds)
        self.register_buffer("updates", torch.zeros((), dtype=torch.int64, device=self.device))
        self.register_buffer("k", torch.full((members,), config.horizon, dtype=torch.int64, device=self.device))
        self.register_buffer("skill", torch.zeros(members, self.skill_size, device=self.device))
        if trained := self.build(weights):
            self.add_optimiser("belief", trained, config.learning_rate)

    # What a method says

    @property
    def skill_steps(self) -> int:
        """How many environment steps a skill lasts; 0 for whole episodes."""
        return 0

    @property
    def critic_outputs(self) -> int:
        """How many numbers each critic gives; ``value`` turns them into one."""
        return 1

    def build(self, random: MemberRandom) -> list[Trainable]:
        """Make the method's own networks; return those that ``auxiliary_loss`` trains, in one Adam."""
        return []

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss (E,) of the method's own networks, and metrics."""
        raise NotImplementedError(f"{type(self).__name__} trains networks but has no auxiliary_loss")

    @abstractmethod
    def reward(self, batch: Batch) -> Tensor:
        """The intrinsic reward (E, B), after the auxiliary step, without gradient."""

    def sample_weight(self, batch: Batch) -> Tensor | None:
        """Weights (E, B) of the samples in the losses of critic and actor; None for equal weights."""
        return None

    def after_auxiliary_step(self, batch: Batch) -> dict[str, Tensor]:
        """What else changes after the auxiliary step, such as the horizon; returns metrics."""
        return {}

    def update_targets(self) -> None:
        """Move the method's own slow copies."""

    def sample_skills(self, random: MemberRandom, t: int) -> Tensor:
        """New skills (E, K), which actions follow from step t of an episode on."""
        raise NotImplementedError(f"{type(self).__name__} has skills but no sample_skills")

    def value(self, critic: SharedTrunkCritic, observation: Tensor, skill: Tensor | None, action: Tensor) -> Tensor:
        """Both critics' values (E, B, 2)."""
        return critic(self.with_skill(observation, skill), action)

    @staticmethod
    def with_skill(observation: Tensor, skill: Tensor | None) -> Tensor:
        """What actor and critic see: the observation, and the skill beside it where there is one."""
        return observation if skill is None else torch.cat([observation, skill], dim=-1)

    # The fixed sequence

    k: Tensor
    updates: Tensor
    skill: Tensor

    @property
    def horizon(self) -> Tensor:
        # k changes in place: a batch keeps the one that it was drawn with.
        return self.k.clone()

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        metrics: dict[str, Tensor] = {}
        if "belief" in self.optimisers:
            loss, metrics = self.auxiliary_loss(batch)
            self.minimise("belief", loss)
        with torch.no_grad():
            reward = self.reward(batch)
            weight = self.sample_weight(batch)
            metrics |= self.after_auxiliary_step(batch)
        metrics |= self._update_critic(batch, reward, weight)
        metrics |= self._update_actor(batch, weight)
        soft_update(self.critic, self.target_critic, self.config.critic_tau)
        self.update_targets()
        self.updates += 1
        return metrics if batch.measure else {}

    def next_skill(self, t: int) -> Tensor:
        """New ones at the start of an episode and every ``skill_steps`` steps; with 0 they last for the whole episode."""
        if t == 0 or (self.skill_steps and t % self.skill_steps == 0):
            self.skill.copy_(self.sample_skills(self.random["skill"], t))
        return self.skill

    def _policy(self, observation: Tensor, skill: Tensor | None) -> Tensor:
        mean = self.actor(self.with_skill(observation, skill))
        noise = self.random["noise"].normal(*mean.shape[1:])
        return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)

    def bootstrap(self, batch: Batch) -> Tensor:
        """The factor (E, 1) of the next value: γ^k, since s' lies k steps ahead; or plain γ, as the paper prints it."""
        if self.config.td_discount == "gamma":
            return torch.full((len(self.seeds), 1), self.config.discount, device=self.device)
        return (self.config.discount ** batch.horizon.to(batch.observation.dtype))[:, None]

    def _update_critic(self, batch: Batch, reward: Tensor, weight: Tensor | None) -> dict[str, Tensor]:
        with torch.no_grad():
            following, skill = batch.next_observation, batch.skill
            next_value = self.value(self.target_critic, following, skill, self._policy(following, skill)).amin(-1)
            target = reward + self.bootstrap(batch) * next_value
        values = self.value(self.critic, batch.observation, skill, batch.action)
        error = (values - target[..., None]).square().sum(-1)
        loss = (error if weight is None else weight * error).mean(1)
        self.minimise("critic", loss)
        if not batch.measure:
            return {}
        metrics = {"reward": reward.mean(1), "q": values.detach().mean((1, 2)), "critic_loss": loss.detach()}
        return metrics | {"k": batch.horizon.float()}

    def _update_actor(self, batch: Batch, weight: Tensor | None) -> dict[str, Tensor]:
        with frozen(self.critic):
            action = self._policy(batch.observation, batch.skill)
            value = self.value(self.critic, batch.observation, batch.skill, action).amin(-1)
            loss = -(value if weight is None else weight * value).mean(1)
            self.minimise("actor", loss)
        return {"actor_loss": loss.detach()}

    @torch.no_grad()
    def act(self, observation: Tensor, explore: bool = True) -> Tensor:
        mean = self.actor(self.with_skill(observation, self.skill if self.skill_size else None)[:, None])[:, 0]
        if not explore:
            return mean
        return noisy_action(mean, self.random["act"].normal(self.sizes.action), self.config.noise_std, None)
