"""TD3 in the form in which ExORL (Yarats et al. 2022, arXiv 2201.13425) trains on exploratory data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from cudc_bench.config import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt
from cudc_bench.networks import (
    MemberRandom,
    TwinCritic,
    actor,
    adam,
    frozen,
    make_target,
    minimise,
    noisy_action,
    soft_update,
)
from cudc_bench.replay import Batch

from .base import Evaluator


@dataclass(frozen=True)
class TD3Config:
    """ExORL's values."""

    batch_size: PositiveInt = 1024
    width: PositiveInt = 1024
    learning_rate: PositiveFloat = 1e-4
    discount: Fraction = 0.99
    critic_tau: Fraction = 0.01
    noise_std: NonNegativeFloat = 0.2
    noise_clip: NonNegativeFloat = 0.3


class TD3(Evaluator, nn.Module):
    """Twin critics and a deterministic policy, trained from a fixed dataset.

    Departs from Fujimoto et al. 2018 as ExORL's code does: no target actor and no delay, smoothing noise clipped at 0.3 instead of
    0.5, and an actor that maximises the smaller of both critics at a noisy action.
    """

    config_class = TD3Config
    citation = "Fujimoto et al. 2018; Yarats et al. 2022"

    def __init__(self, observation: int, action: int, config: TD3Config, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        nn.Module.__init__(self)
        Evaluator.__init__(self, observation, action, config, seeds, device)
        self._noise_random = MemberRandom(seeds, "update", device)
        weights = MemberRandom(seeds, "weights", device)
        self.actor = actor(weights, observation, action, config.width)
        self.critic = TwinCritic(weights, observation + action, config.width)
        self.target_critic = make_target(self.critic, TwinCritic(weights, observation + action, config.width))
        self.actor_optimiser = adam([self.actor], config.learning_rate)
        self.critic_optimiser = adam([self.critic], config.learning_rate)

    def update(self, batch: Batch) -> dict[str, Tensor]:
        metrics = self._update_critic(batch) | self._update_actor(batch)
        soft_update(self.critic, self.target_critic, self.config.critic_tau)
        return metrics if batch.measure else {}

    def _policy(self, observation: Tensor) -> Tensor:
        mean = self.actor(observation)
        noise = self._noise_random.normal(*mean.shape[1:])
        return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)

    def _update_critic(self, batch: Batch) -> dict[str, Tensor]:
        assert batch.reward is not None, "offline learning needs a relabelled dataset"
        with torch.no_grad():
            next_value = self.target_critic(batch.next_observation, self._policy(batch.next_observation)).amin(-1)
            # No episode of these domains terminates: the environment's own discount is always 1.
            target = batch.reward + self.config.discount * next_value
        values = self.critic(batch.observation, batch.action)
        loss = (values - target[..., None]).square().sum(-1).mean(1)
        minimise(loss, self.critic_optimiser)
        return {"q": values.detach().mean((1, 2)), "critic_loss": loss.detach()} if batch.measure else {}

    def _update_actor(self, batch: Batch) -> dict[str, Tensor]:
        with frozen(self.critic):
            loss = -self.critic(batch.observation, self._policy(batch.observation)).amin(-1).mean(1)
            minimise(loss, self.actor_optimiser)
        return {"actor_loss": loss.detach()}

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        return self.actor(observation)

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        return {
            "networks": nn.Module.state_dict(self),
            "optimisers": [self.actor_optimiser.state_dict(), self.critic_optimiser.state_dict()],
            "noise": self._noise_random.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        nn.Module.load_state_dict(self, state["networks"])
        for optimiser, saved in zip((self.actor_optimiser, self.critic_optimiser), state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        self._noise_random.load_state_dict(state["noise"])
