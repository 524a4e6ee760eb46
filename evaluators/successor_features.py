"""Successor features (Touati, Rapin and Ollivier 2023): what learners have in common that differ in how they embed states."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, frozen, make_target, soft_update
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import PositiveFloat, PositiveInt

from .zero_shot import ConditionedActor, ForwardMap, Labelled, NoisyZeroShotConfig, ZeroShotLearner, least_squares, normalised

RIDGE = 1e-5  # of the second moments' trace; what PyTorch's pinv takes for zero is 6e-6 of their largest eigenvalue


@dataclass(frozen=True)
class SuccessorFeaturesConfig(NoisyZeroShotConfig):
    """The values of HILP's code for ExORL's data.

    Attributes:
        feature_width: of the hidden layers of the features.
        feature_rate: the learning rate of the features, as a multiple of ``learning_rate``.
        q_loss: whether successor features regress on their target along z alone, or in each dimension.
    """

    feature_width: PositiveInt = 512
    feature_rate: PositiveFloat = 5.0
    q_loss: bool = False


class SuccessorFeatures(ZeroShotLearner):
    """ψ(s, z, a) are the discounted sums of the features x(s') that follow under π(·, z), which maximises ψ(s, z, a)ᵀ z.

    An update is: ψ, the features, the actor, the slow copy of ψ. Targets take the head with the smaller value, row by row.
    """

    rule = "normalised least squares of r on the features of s'"

    # What a learner says

    @abstractmethod
    def build_features(self, random: MemberRandom) -> None:
        """Make the features' networks and the optimiser of the name ``features``."""

    @abstractmethod
    def features(self, observation: Tensor) -> Tensor:
        """x(s) (E, B, d) of observations (E, B, S)."""

    @abstractmethod
    def feature_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The features' loss (E,), and metrics."""

    # The fixed sequence

    def build(self, random: MemberRandom) -> None:
        config, s, a = self.config, self.observation, self.action

        def successor() -> ForwardMap:
            return ForwardMap(random, s, config.z_dim, a, config.z_dim, config.width)

        self.actor = ConditionedActor(random, s, config.z_dim, a, config.width)
        self.successor = successor()
        self.target_successor = make_target(self.successor, successor())
        self.build_features(random)
        self.add_optimiser("successor", [self.successor], config.learning_rate)
        self.add_optimiser("actor", [self.actor], config.learning_rate)

    @torch.no_grad()
    def direction(self, labelled: Labelled) -> Tensor:
        return least_squares(self.features(labelled.next_observation), labelled.reward)

    def learn(self, batch: Batch, plan: Any) -> dict[str, Tensor]:
        config, following = self.config, batch.next_observation
        with torch.no_grad():
            x = self.features(following)
            z = self.task_vectors(normalised(whitened(x)))
            later = self.target_successor(following, z, self.sample(following, z))
            first, second = (later * z[:, None]).sum(-1).unbind(1)
            target = x + config.discount * torch.where((first < second)[..., None], later[:, 0], later[:, 1])
        errors = self.successor(batch.observation, z, batch.action) - target[:, None]
        squares = (errors * z[:, None]).sum(-1).square() if config.q_loss else errors.square().mean(-1)
        successor_loss = squares.mean(2).sum(1)
        self.minimise("successor", successor_loss)
        feature_loss, metrics = self.feature_loss(batch)
        self.minimise("features", feature_loss)

        with frozen(self.successor):
            values = (self.successor(batch.observation, z, self.sample(batch.observation, z)) * z[:, None]).sum(-1).amin(1)
            actor_loss = -values.mean(1)
            self.minimise("actor", actor_loss)
        soft_update(self.successor, self.target_successor, config.target_tau)
        if not batch.measure:
            return {}
        return metrics | {
            "successor_loss": successor_loss.detach(), "feature_loss": feature_loss.detach(), "actor_loss": actor_loss.detach(),
            "q": values.detach().mean(1),
        }  # fmt: skip


def whitened(vectors: Tensor) -> Tensor:
    """x (xᵀx / n)⁻¹ of vectors (E, n, d), in float64 on the way.

    The sources take the pseudo-inverse. It needs eigenvalues, for which a device is waited for; a ridge does the same to directions in
    which nothing varies, and little to others.
    """
    exact = vectors.double()
    moments = torch.bmm(exact.transpose(1, 2), exact) / vectors.shape[1]
    spread = moments.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    identity = torch.eye(vectors.shape[2], dtype=exact.dtype, device=exact.device)
    # The last number is for vectors that are all zero.
    root = torch.linalg.cholesky_ex(moments + (RIDGE * spread + 1e-30) * identity).L
    half = torch.linalg.solve_triangular(root, exact.transpose(1, 2), upper=False)
    return torch.linalg.solve_triangular(root.transpose(1, 2), half, upper=True).transpose(1, 2).to(vectors.dtype)
