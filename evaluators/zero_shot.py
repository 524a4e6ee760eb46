"""Learners that train without rewards, and turn rewards into a policy afterwards: what they have in common.

One training on a task-agnostic dataset serves every task of its domain, and rewards that somebody writes later. A task is a vector z, which
:meth:`ZeroShotLearner.infer` makes of a few labelled transitions; :meth:`ZeroShotLearner.policy_for` is the policy that pursues it.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import Activation, Ensemble, Linear, MemberRandom, mlp, noisy_action, trunk
from cudc_bench.settings.config import Config, NonNegativeFloat, PositiveFloat, PositiveInt, UnitInterval

from .actor_critic import OfflineLearner


@dataclass(frozen=True)
class ZeroShotConfig(Config):
    """The values that zero-shot learners on ExORL's data have in common (Touati et al. 2023).

    Attributes:
        batch_size: transitions of a minibatch.
        width: of the hidden layers of what looks ahead and of the policy.
        feature_width: of the hidden layers of what embeds states.
        learning_rate: of every Adam optimiser, unless there is one of its own.
        discount: γ.
        target_tau: rate at which slow copies follow.
        z_dim: d, the size of the vector that stands for a task.
        z_mix: share of a minibatch's z that are embeddings of states of the data; the others are uniform on the sphere.
    """

    batch_size: PositiveInt = 1024
    width: PositiveInt = 1024
    feature_width: PositiveInt = 256
    learning_rate: PositiveFloat = 1e-4
    discount: UnitInterval = 0.98
    target_tau: UnitInterval = 0.01
    z_dim: PositiveInt = 50
    z_mix: UnitInterval = 0.5


@dataclass(frozen=True)
class NoisyZeroShotConfig(ZeroShotConfig):
    """Beside them, the values of a policy with noise of its own.

    Attributes:
        noise_std: of the policy around its mean, in training.
        noise_clip: bound of that noise.
    """

    noise_std: NonNegativeFloat = 0.2
    noise_clip: NonNegativeFloat = 0.3


@dataclass(frozen=True)
class Labelled:
    """Transitions with their rewards in K tasks, from which tasks are inferred.

    Attributes:
        observation: s (E, m, S).
        action: a (E, m, A).
        next_observation: s' (E, m, S).
        reward: of s' (E, K, m).
    """

    observation: Tensor
    action: Tensor
    next_observation: Tensor
    reward: Tensor


class ZeroShotLearner(OfflineLearner):
    """Networks that know no reward, and a policy π(s, z).

    Class attributes, beside those of every evaluator:
        rule: how z follows from labelled transitions, in a few words, for records.
        has_goals: whether a state alone can be a task.

    Attributes:
        actor: the policy's mean, (E, B, S) and (E, B, d) -> (E, B, A).
    """

    learns_from_rewards: ClassVar[bool] = False
    rule: ClassVar[str]
    has_goals: ClassVar[bool] = True

    actor: nn.Module

    @abstractmethod
    def direction(self, labelled: Labelled) -> Tensor:
        """A vector of each task (E, K, d) of any length, zero where all rewards are. It follows from a task's own rewards alone."""

    # What follows from these

    def infer(self, labelled: Labelled) -> Tensor:
        """The vector z of each task (E, K, d), of length √d; zero where all rewards are."""
        return normalised(self.direction(labelled))

    def toward(self, goal: Tensor, labelled: Labelled) -> Tensor:
        """As :meth:`direction`, of the task whose only rewarded state is a goal (E, S), among those of some transitions, (E, 1, d)."""
        state, nothing = goal[:, None], torch.zeros_like(labelled.action[:, :1])
        reward = torch.zeros_like(labelled.reward[:, :1])
        return self.direction(
            Labelled(
                torch.cat([labelled.observation, state], 1), torch.cat([labelled.action, nothing], 1),
                torch.cat([labelled.next_observation, state], 1), torch.cat([reward, torch.ones_like(reward[..., :1])], -1),
            )
        )  # fmt: skip

    @property
    def acting(self) -> nn.Module:
        """What acts, (E, n, S) and (E, n, d) -> (E, n, A); the actor, unless it reads something else than observations."""
        return self.actor

    @property
    def policy(self) -> nn.Module:
        """That of the zero vector, whose form that of every task has."""
        return self.policy_for(torch.zeros(len(self.seeds), self.config.z_dim, device=self.device))

    def policy_for(self, z: Tensor) -> Conditioned:
        """The policies of a task vector for each member (E, d)."""
        return Conditioned(self.acting, z)

    @torch.no_grad()
    def act_for(self, observation: Tensor, z: Tensor) -> Tensor:
        """Deterministic actions (E, n, A) in [-1, 1] for observations (E, n, S), each with a task vector (E, n, d)."""
        actions: Tensor = self.acting(observation, z)
        return actions

    @torch.no_grad()
    def task_vectors(self, embedded: Tensor) -> Tensor:
        """z of the transitions of a minibatch (E, B, d): uniform on the sphere, and a share of them other transitions' embeddings.

        Args:
            embedded: the z of a task that asks for each transition's state (E, B, d); they are given to others in a random order.
        """
        noise, size = self.random["noise"], embedded.shape[1]
        uniform = normalised(noise.normal(size, self.config.z_dim).to(embedded.dtype))
        draws = noise.uniform(2, size)
        order = draws[:, 0].argsort(1)
        others = embedded.gather(1, order[..., None].expand_as(embedded))
        return torch.where((draws[:, 1] < self.config.z_mix)[..., None], others, uniform)

    def sample(self, observation: Tensor, z: Tensor) -> Tensor:
        """Actions of the stochastic policy for what the actor reads (E, B, S) and (E, B, d), with gradient."""
        mean = self.actor(observation, z)
        noise = self.random["noise"].normal(*mean.shape[1:])
        return noisy_action(mean, noise, self.config.noise_std, self.config.noise_clip)


class Conditioned(nn.Module):
    """π(·, z) with z held fast, whose parameters and buffers have the member axis first.

    Args:
        network: the actor, (E, n, S) and (E, n, d) -> (E, n, A).
        z: of each member (E, d).
    """

    z: Tensor

    def __init__(self, network: nn.Module, z: Tensor) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("z", z[:, None].clone())

    def forward(self, observation: Tensor) -> Tensor:
        """(E, n, S) -> (E, n, A)."""
        actions: Tensor = self.network(observation, self.z.expand(-1, observation.shape[1], -1))
        return actions


class ConditionedActor(nn.Module):
    """The policy's mean from an embedding of s and one of (s, z): controllable_agent's ``Actor`` (Touati et al. 2023), in (-1, 1).

    Args:
        random: the members' streams for initial weights.
        observation, z_dim, action: sizes of s, z and a.
        width: of the hidden layers; each embedding has half of it.
    """

    def __init__(self, random: MemberRandom, observation: int, z_dim: int, action: int, width: int) -> None:
        super().__init__()
        self.of_state = embedding(random, observation, width)
        self.of_both = embedding(random, observation + z_dim, width)
        self.head = mlp(random, 2 * (width // 2), width, action, output=torch.tanh)

    def forward(self, observation: Tensor, z: Tensor) -> Tensor:
        """(E, B, S), (E, B, d) -> (E, B, A)."""
        both = torch.cat([self.of_state(observation), self.of_both(torch.cat([observation, z], -1))], -1)
        actions: Tensor = self.head(both)
        return actions


class ForwardMap(nn.Module):
    """Two estimates of a vector at (s, z, a) that look ahead: controllable_agent's ``ForwardMap`` (Touati et al. 2023).

    Args:
        random: the members' streams for initial weights.
        observation, z_dim, action: sizes of s, z and a.
        outputs: size of the vector.
        width: of the hidden layers; each embedding has half of it.
        shared: whether the two have their embeddings in common.
    """

    def __init__(
        self, random: MemberRandom, observation: int, z_dim: int, action: int, outputs: int, width: int, shared: bool = True
    ) -> None:
        super().__init__()
        self.shared = shared

        def head(streams: MemberRandom) -> nn.Module:
            return mlp(streams, 2 * (width // 2), width, outputs)

        if shared:
            self.embeddings = _Embeddings(random, observation, z_dim, action, width)
            self.heads = Ensemble(random, 2, head)
        else:
            self.heads = Ensemble(
                random, 2, lambda streams: nn.Sequential(_Embeddings(streams, observation, z_dim, action, width), head(streams))
            )

    def forward(self, observation: Tensor, z: Tensor, action: Tensor) -> Tensor:
        """(E, B, S), (E, B, d), (E, B, A) -> (E, 2, B, outputs)."""
        x = torch.cat([action, observation, z], -1)
        vectors: Tensor = self.heads(self.embeddings(x) if self.shared else x)
        return vectors


class _Embeddings(nn.Module):
    """Of (s, a) and of (s, z), side by side; what comes in is (a, s, z)."""

    def __init__(self, random: MemberRandom, observation: int, z_dim: int, action: int, width: int) -> None:
        super().__init__()
        self.action, self.observation = action, observation
        self.of_action = embedding(random, action + observation, width)
        self.of_task = embedding(random, observation + z_dim, width)

    def forward(self, x: Tensor) -> Tensor:
        """(E, B, A + S + d) -> (E, B, width)."""
        return torch.cat([self.of_action(x[..., : self.action + self.observation]), self.of_task(x[..., self.action :])], -1)


def embedding(random: MemberRandom, inputs: int, width: int) -> nn.Sequential:
    """Linear, LayerNorm, tanh, linear to half the width, ReLU."""
    return nn.Sequential(trunk(random, inputs, width), Linear(random, width, width // 2), Activation(torch.relu_))


def features(random: MemberRandom, inputs: int, width: int, outputs: int) -> nn.Sequential:
    """Linear, LayerNorm, tanh, linear, ReLU, linear: what embeds states."""
    return nn.Sequential(trunk(random, inputs, width), *mlp(random, width, width, outputs))


def normalised(vectors: Tensor) -> Tensor:
    """Vectors (…, d) scaled to the length √d; zero stays zero."""
    return vectors * (math.sqrt(vectors.shape[-1]) / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12))


def measures(ahead: Tensor, back: Tensor) -> Tensor:
    """F_k(i)ᵀ B(j) of two forward maps (E, 2, B, d) and a backward map (E, B, d), (E, 2, B, B)."""
    return torch.matmul(ahead, back[:, None].transpose(2, 3))


def off_diagonal(matrices: Tensor) -> Tensor:
    """The mean of what is not on the diagonal of (…, B, B), (…)."""
    size = matrices.shape[-1]
    return (matrices.sum((-2, -1)) - on_diagonal(matrices) * size) / (size * (size - 1))


def on_diagonal(matrices: Tensor) -> Tensor:
    """The mean of the diagonal of (…, B, B), (…)."""
    return matrices.diagonal(dim1=-2, dim2=-1).mean(-1)


def orthonormality(vectors: Tensor) -> Tensor:
    """½ off[C²] − diag(C) of C = v vᵀ for (E, B, d), (E,): least where the vectors' second moment is the identity."""
    products = torch.bmm(vectors, vectors.transpose(1, 2))
    return 0.5 * off_diagonal(products.square()) - on_diagonal(products)


def weighted_sums(weights: Tensor, vectors: Tensor) -> Tensor:
    """Sums (E, K, d) of vectors (E, m, d) with weights (E, K, m).

    Of each member by itself: a product with a vector rounds by the size of a stack.
    """
    return torch.stack([row @ column for row, column in zip(weights, vectors, strict=True)])


def least_squares(vectors: Tensor, reward: Tensor) -> Tensor:
    """The weights (E, K, d) that bring vectors (E, m, d) nearest to rewards (E, K, m), without an intercept; or the shortest of them.

    On the CPU in float64: other devices have no solver that bears vectors which depend on one another.
    """
    weights: Tensor = torch.linalg.lstsq(vectors.cpu().double(), reward.cpu().double().transpose(1, 2), driver="gelsd").solution
    return weights.transpose(1, 2).to(vectors)
