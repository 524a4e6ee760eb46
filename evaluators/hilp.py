"""HILP: Hilbert representations, in which distances are the times that it takes between states (Park, Kreiman and Levine 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from cudc_bench.learning.networks import Ensemble, MemberRandom, make_target, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import UnitInterval

from .successor_features import SuccessorFeatures, SuccessorFeaturesConfig
from .zero_shot import features

MEAN_RATE = 0.005  # at which the mean of the features follows them


@dataclass(frozen=True)
class HILPConfig(SuccessorFeaturesConfig):
    """The authors' values for ExORL's Walker; for Quadruped and Jaco they have q_loss, and for all but Walker a feature_discount of 0.98.

    Attributes:
        feature_discount: of the time between states.
        feature_tau: rate at which the slow copies of the features follow them.
        expectile: of the errors of distances.
        random_goals: share of goals that are any states of the data; the others come later in the same episode.
    """

    feature_discount: UnitInterval = 0.96
    feature_tau: UnitInterval = 0.005
    expectile: UnitInterval = 0.5
    random_goals: UnitInterval = 0.375


class HILP(SuccessorFeatures):
    """Successor features of φ(s) less its mean, where −‖φ(s) − φ(g)‖ is learnt as the value of reaching g with −1 for each step.

    As in the authors' code for ExORL: two φ with slow copies, which follow before the step, and of which the first is the feature; later
    states of the episode (geometric, 0.99) or any states as goals, which are reached where they are s; features take no gradient from
    what builds on them. Unlike theirs: a ridge in place of a pseudo-inverse where states become tasks.
    """

    config_class: ClassVar[type] = HILPConfig
    citation = "Park et al. 2024"
    paper = "https://arxiv.org/abs/2402.15567"
    summary = "successor features of Hilbert representations"
    wants_future = "last"

    mean: Tensor

    def build_features(self, random: MemberRandom) -> None:
        config = self.config

        def maps() -> Ensemble:
            return Ensemble(random, 2, lambda streams: features(streams, self.observation, config.feature_width, config.z_dim))

        self.maps = maps()
        self.target_maps = make_target(self.maps, maps())
        self.register_buffer("mean", torch.zeros(len(self.seeds), 1, config.z_dim, device=self.device))
        self.add_optimiser("features", [self.maps], config.feature_rate * config.learning_rate)

    def features(self, observation: Tensor) -> Tensor:
        return self.maps.first(observation) - self.mean

    def feature_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        config, state = self.config, batch.observation
        size = state.shape[1]
        assert batch.future_observation is not None, "HILP needs later states"
        assert batch.other_observation is not None, "HILP needs any states"
        anywhere = self.random["noise"].uniform(size) < config.random_goals
        goal = torch.where(anywhere[..., None], batch.other_observation, batch.future_observation)
        with torch.no_grad():
            reached = ((state - goal).norm(dim=-1) < 1e-6).to(state.dtype)[:, None]
            slow_state, slow_next, slow_goal = self.target_maps(torch.cat([state, batch.next_observation, goal], 1)).split(size, 2)
            target = reached - 1.0 + config.feature_discount * (1.0 - reached) * _value(slow_next, slow_goal)
            # All but the distance is the same for both.
            advantage = target.amin(1) - _value(slow_state, slow_goal).mean(1)
            weight = torch.where(advantage < 0, 1.0 - config.expectile, config.expectile)
        of_state, of_goal = self.maps(torch.cat([state, goal], 1)).split(size, 2)
        values = _value(of_state, of_goal)
        loss = (weight[:, None] * (target - values).square()).mean(2).sum(1)
        soft_update(self.maps, self.target_maps, config.feature_tau)
        with torch.no_grad():
            self.mean.lerp_(of_state[:, 0].mean(1, keepdim=True), MEAN_RATE)
        return loss, {"distance": -values.detach().mean((1, 2)), "advantage": advantage.mean(1)}


def _value(state: Tensor, goal: Tensor) -> Tensor:
    """−‖φ(s) − φ(g)‖ (…, B) of (…, B, d); its gradient stays finite where they are one."""
    return -(state - goal).square().sum(-1).clamp_min(1e-6).sqrt()
