"""TD-JEPA: what states and tasks are to each other's future, predicted in latent space (Bagatella et al. 2026)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import Activation, Linear, MemberRandom, frozen, make_target, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import NonNegativeFloat, PositiveInt, UnitInterval

from .zero_shot import (
    ConditionedActor,
    ForwardMap,
    Labelled,
    NoisyZeroShotConfig,
    ZeroShotLearner,
    features,
    least_squares,
    normalised,
    orthonormality,
)


@dataclass(frozen=True)
class TDJEPAConfig(NoisyZeroShotConfig):
    """The authors' values for states of dm_control, where they do not choose them by domain.

    Attributes:
        feature_width: of the hidden layer of the task encoder.
        state_dim: size of what the state encoder gives.
        state_ortho: weight of the state encoder's orthonormality.
        task_ortho: the same of the task encoder; the authors choose 0.01, 0.1 or 1 by domain.
    """

    target_tau: UnitInterval = 0.001
    state_dim: PositiveInt = 256
    state_ortho: NonNegativeFloat = 0.1
    task_ortho: NonNegativeFloat = 0.1


class TDJEPA(ZeroShotLearner):
    """Predictors of the discounted sum of ψ(s') from (φ(s), z, a), and of φ(s') from (ψ(s), z, a), through which both encoders learn.

    π(φ(s), z) maximises the first predictor's product with z. As the authors have it: each predictor is the mean of two separate networks,
    in targets and for the actor; slow copies of encoders and predictors give targets, and the state of which the next action is; both
    encoders are normalised, and the state encoder is linear but for that; the actor takes φ(s) as it is after its step, as a number.
    Unlike theirs: all learning rates are the same (they have 1e-5 for the task encoder of some domains).
    """

    config_class: ClassVar[type] = TDJEPAConfig
    citation = "Bagatella et al. 2026"
    paper = "https://arxiv.org/abs/2510.00739"
    summary = "latent prediction of states' and tasks' futures"
    rule = "normalised least squares of r on the task encoding of s'"

    def build(self, random: MemberRandom) -> None:
        config, a = self.config, self.action
        states, tasks = config.state_dim, config.z_dim

        def state_encoder() -> nn.Module:
            return nn.Sequential(Linear(random, self.observation, states), Activation(normalised))

        def task_encoder() -> nn.Module:
            return nn.Sequential(features(random, self.observation, config.feature_width, tasks), Activation(normalised))

        def state_predictor() -> ForwardMap:
            return ForwardMap(random, states, tasks, a, tasks, config.width, shared=False)

        def task_predictor() -> ForwardMap:
            return ForwardMap(random, tasks, tasks, a, states, config.width, shared=False)

        self.actor = ConditionedActor(random, states, tasks, a, config.width)
        self.state_encoder, self.task_encoder = state_encoder(), task_encoder()
        self.state_predictor, self.task_predictor = state_predictor(), task_predictor()
        self.target_state_encoder = make_target(self.state_encoder, state_encoder())
        self.target_task_encoder = make_target(self.task_encoder, task_encoder())
        self.target_state_predictor = make_target(self.state_predictor, state_predictor())
        self.target_task_predictor = make_target(self.task_predictor, task_predictor())
        trained = [self.state_encoder, self.task_encoder, self.state_predictor, self.task_predictor]
        self.add_optimiser("prediction", trained, config.learning_rate)
        self.add_optimiser("actor", [self.actor], config.learning_rate)

    @property
    def acting(self) -> nn.Module:
        return _OfObservations(self.state_encoder, self.actor)

    @torch.no_grad()
    def direction(self, labelled: Labelled) -> Tensor:
        return least_squares(self.task_encoder(labelled.next_observation), labelled.reward)

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        config, following, action = self.config, batch.next_observation, batch.action
        with torch.no_grad():
            z = self.task_vectors(self.task_encoder(following))
            next_state, next_task = self.target_state_encoder(following), self.target_task_encoder(following)
            next_action = self.sample(next_state, z)
            of_state = next_task + config.discount * self.target_state_predictor(next_state, z, next_action).mean(1)
            of_task = next_state + config.discount * self.target_task_predictor(next_task, z, next_action).mean(1)
        state, task = self.state_encoder(batch.observation), self.task_encoder(batch.observation)
        state_loss = _distance(self.state_predictor(state, z, action), of_state)
        task_loss = _distance(self.task_predictor(task, z, action), of_task)
        ortho_loss = config.state_ortho * orthonormality(state) + config.task_ortho * orthonormality(task)
        self.minimise("prediction", state_loss + task_loss + ortho_loss)

        with torch.no_grad():
            state = self.state_encoder(batch.observation)
        with frozen(self.state_predictor):
            values = (self.state_predictor(state, z, self.sample(state, z)) * z[:, None]).sum(-1).mean(1)
            actor_loss = -values.mean(1)
            self.minimise("actor", actor_loss)
        for name in ("state_encoder", "task_encoder", "state_predictor", "task_predictor"):
            soft_update(getattr(self, name), getattr(self, f"target_{name}"), config.target_tau)
        if not batch.measure:
            return {}
        return {
            "state_loss": state_loss.detach(), "task_loss": task_loss.detach(), "ortho_loss": ortho_loss.detach(),
            "actor_loss": actor_loss.detach(), "q": values.detach().mean(1),
        }  # fmt: skip


class _OfObservations(nn.Module):
    """π(φ(s), z) as a policy of s."""

    def __init__(self, encoder: nn.Module, actor: nn.Module) -> None:
        super().__init__()
        self.encoder, self.actor = encoder, actor

    def forward(self, observation: Tensor, z: Tensor) -> Tensor:
        """(E, n, S), (E, n, d) -> (E, n, A)."""
        actions: Tensor = self.actor(self.encoder(observation), z)
        return actions


def _distance(predictions: Tensor, target: Tensor) -> Tensor:
    """The mean squared distance (E,) of two predictions (E, 2, B, n) from a target (E, B, n)."""
    return (predictions - target[:, None]).square().sum(-1).mean((1, 2))
