"""TD3 in the form in which ExORL trains it on exploratory data, and in that of its own paper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, make_target, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveInt

from .actor_critic import ActorCritic, ExORLConfig


@dataclass(frozen=True)
class TD3Config(ExORLConfig):
    """ExORL's values, and switches to Fujimoto's TD3.

    Attributes:
        target_actor: take a' from a slow copy of the actor instead of the actor itself.
        policy_delay: updates of the critics for each update of the actor and the slow copies.
        maximise: what the actor maximises, the smaller critic or the first.
        actor_noise: whether the actor is judged by noisy actions or by its means.
    """

    target_actor: bool = False
    policy_delay: PositiveInt = 1
    maximise: Literal["min", "first"] = "min"
    actor_noise: bool = True


class TD3(ActorCritic):
    """Twin critics and a deterministic policy, trained from a fixed dataset.

    Departs from Fujimoto et al. 2018 as ExORL's code does: no target actor and no delay, smoothing noise clipped at 0.3 instead of
    0.5, and an actor that maximises the smaller of both critics at a noisy action. ``td3-fujimoto`` undoes these four.
    """

    config_class: ClassVar[type] = TD3Config
    citation = "Fujimoto et al. 2018; Yarats et al. 2022"
    summary = "as in ExORL and the paper"

    def build(self, random: MemberRandom) -> None:
        super().build(random)
        if self.config.target_actor:
            self.target_actor = make_target(self.actor, self.make_actor(random))

    def updates_actor(self) -> bool:
        return (self.updates + 1) % self.config.policy_delay == 0

    def next_action(self, batch: Batch) -> Tensor:
        if not self.config.target_actor:
            return super().next_action(batch)
        return self.around(self.target_actor(batch.next_observation))

    def actor_value(self, batch: Batch, mean: Tensor) -> Tensor:
        """What the actor maximises at each state (E, B), whose means (E, B, A) it gives."""
        action = self.around(mean) if self.config.actor_noise else mean
        if self.config.maximise == "first":
            return self.critic.first(batch.observation, action)
        return self.critic(batch.observation, action).amin(-1)

    def actor_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        return -self.actor_value(batch, self.actor(batch.observation)).mean(1), {}

    def update_targets(self) -> None:
        super().update_targets()
        if self.config.target_actor:
            soft_update(self.actor, self.target_actor, self.config.critic_tau)


class TD3Fujimoto(TD3):
    """TD3's own algorithm on ExORL's networks, learning rates and batches.

    Fujimoto et al. 2018 also have smaller networks (256), faster learning (3e-4) and slower targets (0.005): ``--set`` reaches them.
    """

    values: ClassVar[Mapping[str, Any]] = {
        "target_actor": True, "policy_delay": 2, "maximise": "first", "actor_noise": False, "noise_clip": 0.5,
    }  # fmt: skip
    citation = "Fujimoto et al. 2018"
    summary = "target actor, delayed policy, first critic"
