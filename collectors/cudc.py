"""CUDC: curiosity-driven data collection with adaptive temporal distances (Sun, Qian, Miao, AAAI 2024, arXiv 2312.12191).

Where the paper leaves a choice open, the configuration names it as a switch, and the default is the reading explained beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cudc_bench.config import Fraction, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from cudc_bench.neighbours import neighbour_distances
from cudc_bench.networks import Activation, LayerNorm, MemberRandom, Trained, make_target, mlp, soft_update
from cudc_bench.replay import Batch

from .ddpg import DDPG, DDPGConfig

STARTS_TOO_EARLY, ENDS_TOO_EARLY = 50_000, 100_000  # environment steps; see CUDC.summary


@dataclass(frozen=True)
class CUDCConfig(DDPGConfig):
    """The paper's values for Walker; ``horizon`` is the k to start from.

    Attributes:
        k_max: upper bound of k; K = {horizon, ..., k_max}.
        feature_dim, action_feature_dim: sizes of φ_s and φ_a. action_hidden: hidden width of φ_a.
        projection_hidden, projection_dim: sizes of h.
        neighbours: N_K of the state-action entropy.
        alpha, beta: r = r_H + α r_E + β.
        clip_low, clip_high: bounds of the curiosity weight.
        c_w, c_k: k grows when more than the share c_k of a minibatch has w < c_w.
        momentum_tau: rate of the momentum copies (the paper names none; CCLF, CURL and ProtoRL use 0.05).
        temperature: of the contrastive logits.
        w_init: start of W, uniform [0, 1) as CURL, or a scaled identity, which learns faster.
        loss_weights: of L_fwd, L_bwd, L_k and L_reach.
        state_target: what L_fwd predicts: z' with its gradient (URLB's APT does so), without it, or the momentum encoder's.
        action_target: what L_bwd predicts. With the gradient, φ_a collapses to a constant.
        knn_exclude_self: leave a point out of its own neighbours (URLB counts it).
        reward_after_update: compute w and r from the updated networks, as URLB's baselines do (Algorithm 1 computes them before).
        weight_mode: w as it is, or divided by its minibatch mean before clipping.
        patience: how many updates in a row must meet the test before k grows.
        min_dwell: environment steps for which k stays at least.
    """

    k_max: PositiveInt = 6
    feature_dim: PositiveInt = 512
    action_feature_dim: PositiveInt = 64
    action_hidden: PositiveInt = 64
    projection_hidden: PositiveInt = 128
    projection_dim: PositiveInt = 64
    neighbours: PositiveInt = 12
    alpha: NonNegativeFloat = 1e-3
    beta: NonNegativeFloat = 1e-2
    clip_low: NonNegativeFloat = 0.2
    clip_high: PositiveFloat = 2.0
    c_w: Fraction = 0.02
    c_k: Fraction = 0.5
    momentum_tau: Fraction = 0.05
    temperature: PositiveFloat = 1.0
    w_init: Literal["uniform", "scaled_identity"] = "uniform"
    loss_weights: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0, 1.0, 1.0)
    state_target: Literal["live", "stopgrad", "momentum"] = "live"
    action_target: Literal["stopgrad", "live"] = "stopgrad"
    knn_exclude_self: bool = False
    reward_after_update: bool = False
    weight_mode: Literal["prob", "mean_normalised"] = "prob"
    patience: PositiveInt = 1
    min_dwell: NonNegativeInt = 0


class CUDC(DDPG):
    """Rewards state-action entropy and surprise in a learned space, and looks further ahead once the future is reachable.

    Departs from the paper's printed equations in the discount, which is γ^k as in the code base that it extends (``td_discount``),
    and in averaging, not summing, the contrastive loss over the minibatch.
    """

    config_class: ClassVar[type] = CUDCConfig
    # Paper, appendix, hyperparameters per domain.
    domain_values: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "walker": {"alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2, "clip_high": 2.0, "c_w": 0.02},
        "quadruped": {"alpha": 1e-4, "beta": 1e-2, "clip_low": 0.2, "clip_high": 1.0, "c_w": 0.02},
        "jaco": {"alpha": 100.0, "beta": 0.0, "clip_low": 0.9, "clip_high": 1.0, "c_w": 0.01},
    }
    family = "curiosity and entropy"
    citation = "Sun, Qian, Miao 2024"

    @property
    def max_horizon(self) -> int:
        return int(self.config.k_max)

    def build(self, random: MemberRandom) -> list[Trained]:
        config, members = self.config, random.count
        if config.k_max < config.horizon:
            raise ValueError(f"k_max={config.k_max} is below the first horizon {config.horizon}")
        if config.neighbours + config.knn_exclude_self > config.batch_size:
            raise ValueError(f"{config.neighbours} neighbours cannot be found in a batch_size of {config.batch_size}")
        width, z, a = config.width, config.feature_dim, config.action_feature_dim
        self.horizons = config.k_max - config.horizon + 1  # |K|
        self.state_encoder = self._state_encoder(random)
        self.action_encoder = mlp(random, self.space.action, config.action_hidden, config.action_hidden, a)
        self.forward_model = mlp(random, z + a + self.horizons, width, z)
        self.inverse_model = mlp(random, 2 * z + self.horizons, width, a)
        self.step_model = mlp(random, 2 * z, width, self.horizons)
        self.projection = self._projection(random)
        self.similarity = nn.Parameter(self._first_similarity(random))
        self.momentum_encoder = make_target(self.state_encoder, self._state_encoder(random))
        self.momentum_projection = make_target(self.projection, self._projection(random))
        device = self.device
        self.register_buffer("in_a_row", torch.zeros(members, dtype=torch.int64, device=device))
        self.register_buffer("last_change", torch.zeros(members, dtype=torch.int64, device=device))
        # One row for each possible increment: number of the update, p and mean w at that moment.
        self.register_buffer("increments", torch.full((members, self.horizons, 3), -1.0, device=device))
        self.register_buffer("probe", torch.zeros(members, config.batch_size, self.space.observation, device=device))
        return [
            self.state_encoder, self.action_encoder, self.forward_model, self.inverse_model, self.step_model,
            self.projection, self.similarity,
        ]  # fmt: skip

    def _state_encoder(self, random: MemberRandom) -> nn.Module:
        size, width, z = self.space.observation, self.config.width, self.config.feature_dim
        return nn.Sequential(*mlp(random, size, width, z), LayerNorm(random, z), Activation(torch.tanh))

    def _projection(self, random: MemberRandom) -> nn.Module:
        sizes = (self.config.feature_dim, self.config.projection_hidden, self.config.projection_dim)
        return nn.Sequential(*mlp(random, *sizes), LayerNorm(random, self.config.projection_dim))

    def _first_similarity(self, random: MemberRandom) -> Tensor:
        size = self.config.projection_dim
        if self.config.w_init == "uniform":
            return random.uniform(size, size)
        return (torch.eye(size, device=self.device) / math.sqrt(size)).repeat(random.count, 1, 1)

    # Belief: dynamics in the learned space, and reachability

    def features(self, batch: Batch) -> dict[str, Tensor]:
        """Everything that losses, weights and reward are functions of, each network applied once."""
        both = self.state_encoder(torch.cat([batch.observation, batch.next_observation], dim=1))
        z, z_next = both.chunk(2, dim=1)
        action = self.action_encoder(batch.action)
        k = F.one_hot(batch.horizon - self.config.horizon, self.horizons).to(z.dtype)
        k = k[:, None].expand(-1, z.shape[1], -1)
        z_pair = torch.cat([z, z_next], dim=-1)
        with torch.no_grad():
            momentum = self.momentum_encoder(batch.next_observation)
            keys = self.momentum_projection(momentum)
        predicted = self.forward_model(torch.cat([z, action, k], dim=-1))
        queries = self.projection(predicted)
        # S_ij = q_iᵀ W c_j: row i ranks every future of the minibatch as the future of tuple i (paper, eq. of l_i).
        logits = torch.bmm(torch.bmm(queries, self.similarity), keys.transpose(1, 2)) / self.config.temperature
        log_reachable = logits.diagonal(dim1=1, dim2=2) - logits.logsumexp(-1)
        found = {
            "z": z, "z_next": z_next, "action": action, "predicted": predicted, "momentum": momentum,
            "inverse": self.inverse_model(torch.cat([z_pair, k], dim=-1)),
            "step_logits": self.step_model(z_pair), "log_reachable": log_reachable,
        }  # fmt: skip
        if batch.measure:
            own = torch.arange(logits.shape[1], device=logits.device)
            found["retrieved"] = (logits.detach().argmax(-1) == own).float().mean(1)
        return found

    def belief_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        f = self.features(batch)
        state_target = {"live": f["z_next"], "stopgrad": f["z_next"].detach(), "momentum": f["momentum"]}
        action_target = f["action"] if self.config.action_target == "live" else f["action"].detach()
        label = (batch.horizon - self.config.horizon)[:, None].expand(-1, batch.action.shape[1])
        losses = {
            "loss_forward": (state_target[self.config.state_target] - f["predicted"]).norm(dim=-1).mean(1),
            "loss_inverse": (action_target - f["inverse"]).norm(dim=-1).mean(1),
            "loss_step": F.cross_entropy(f["step_logits"].transpose(1, 2), label, reduction="none").mean(1),
            "loss_reach": -f["log_reachable"].mean(1),
        }
        # Algorithm 1 computes w and r before the module's update: these are the values of this forward pass.
        batch.kept = {name: value.detach() for name, value in f.items()}
        total = sum(weight * loss for weight, loss in zip(self.config.loss_weights, losses.values(), strict=True))
        return total, {name: loss.detach() for name, loss in losses.items()}

    # Reward, weight, horizon

    def reward(self, batch: Batch) -> Tensor:
        if self.config.reward_after_update:
            batch.kept = self.features(batch)
        f, config = batch.kept, self.config
        points = torch.cat([f["z"], f["action"]], dim=-1)
        f["entropy"] = neighbour_distances(points, config.neighbours, config.knn_exclude_self).mean(-1).log1p()
        f["surprise"] = (f["z_next"] - f["predicted"]).norm(dim=-1)
        return f["entropy"] + config.alpha * f["surprise"] + config.beta

    def sample_weight(self, batch: Batch) -> Tensor:
        # w = 1 - l, in the form that keeps its digits when l is close to 1.
        w = batch.kept["w"] = -torch.expm1(batch.kept["log_reachable"])
        if self.config.weight_mode == "mean_normalised":
            w = w / w.mean(1, keepdim=True)
        return w.clamp(self.config.clip_low, self.config.clip_high)

    def after_belief(self, batch: Batch) -> dict[str, Tensor]:
        w = batch.kept["w"]
        reachable = (w < self.config.c_w).float().mean(1)
        self._adapt_horizon(reachable, w.mean(1))
        return self._measure(batch, reachable) if batch.measure else {}

    def _adapt_horizon(self, reachable: Tensor, mean_w: Tensor) -> None:
        """k <- k + 1 where p > C_k (paper, Algorithm 1); tensors only, so that nothing waits for the device."""
        config = self.config
        self.in_a_row = torch.where(reachable > config.c_k, self.in_a_row + 1, 0)
        dwelt = (self.updates - self.last_change) * self.space.update_every >= config.min_dwell
        grow = (self.in_a_row >= config.patience) & dwelt & (self.k < config.k_max)
        row = (self.k - config.horizon)[:, None, None].expand(-1, 1, 3)
        seen = torch.stack([self.updates.float().expand_as(mean_w), reachable, mean_w], dim=-1)[:, None]
        self.increments.scatter_(1, row, torch.where(grow[:, None, None], seen, self.increments.gather(1, row)))
        self.last_change = torch.where(grow, self.updates, self.last_change)
        self.in_a_row = torch.where(grow, 0, self.in_a_row)
        # A new tensor: batches already drawn keep the k that they were drawn with.
        self.k = self.k + grow

    def update_targets(self) -> None:
        soft_update(self.state_encoder, self.momentum_encoder, self.config.momentum_tau)
        soft_update(self.projection, self.momentum_projection, self.config.momentum_tau)

    in_a_row: Tensor
    last_change: Tensor
    increments: Tensor
    probe: Tensor

    # Diagnostics

    def _measure(self, batch: Batch, reachable: Tensor) -> dict[str, Tensor]:
        f = batch.kept
        w, entropy, surprise = f["w"], f["entropy"], f["surprise"]
        if not self.probe.any():
            self.probe.copy_(batch.observation)
        return {
            "k": batch.horizon.float(),
            "p": reachable,
            "w_mean": w.mean(1),
            "w_median": w.median(1).values,
            "w_clipped": (w < self.config.clip_low).float().mean(1),
            "retrieved": f["retrieved"],
            "entropy": entropy.mean(1),
            "surprise": surprise.mean(1),
            "surprise_share": self.config.alpha * surprise.mean(1) / entropy.mean(1),
            "action_norm": f["action"].norm(dim=-1).mean(1),
            "action_spread": f["action"].std(1).norm(dim=-1),
            "step_norm": (f["z_next"] - f["z"]).norm(dim=-1).mean(1),
            "effective_rank": effective_rank(self.state_encoder(self.probe)),
        }

    def summary(self) -> list[dict[str, Any]]:
        """Every increment of k as (step, old k, new k, p, mean w), and whether the schedule is suspect.

        Suspect: k grew before 50K environment steps, or reached its bound within 100K of its first growth. The criterion looks at one
        minibatch, so a schedule this early says more about the thresholds than about reachability.
        """
        found = []
        for member in self.increments.tolist():
            changes = []
            for row, (update, p, w) in enumerate(member):
                if update >= 0:
                    step = self.space.seed_steps + int(update) * self.space.update_every
                    k = self.config.horizon + row
                    changes.append({"step": step, "old_k": k, "new_k": k + 1, "p": p, "mean_w": w})
            steps = [change["step"] for change in changes]
            at_bound = len(steps) == self.horizons - 1 and len(steps) > 1
            early = bool(steps) and (steps[0] < STARTS_TOO_EARLY or (at_bound and steps[-1] - steps[0] <= ENDS_TOO_EARLY))
            found.append({"k_increments": changes, "k_schedule_suspect": early})
        return found


def effective_rank(features: Tensor) -> Tensor:
    """exp of the entropy of the normalised singular values (Roy and Vetterli 2007): (E, B, D) -> (E,)."""
    singular = torch.linalg.svdvals(features)
    share = singular / singular.sum(-1, keepdim=True)
    return torch.special.entr(share).sum(-1).exp()
