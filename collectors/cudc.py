"""CUDC: curiosity-driven data collection with adaptive temporal distances (Sun, Qian, Miao, AAAI 2024, arXiv 2312.12191).

Where the paper leaves a choice open, the configuration names it as a switch, and the default is the reading explained beside it.
The switches of the second group turn CUDC's parts off, or into those of the methods that it was built from; ``variants`` names the
settings that the paper studies.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cudc_bench.learning.knn import neighbour_distances
from cudc_bench.learning.networks import Activation, LayerNorm, MemberRandom, Trainable, make_target, mlp, soft_update, trunk
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import ADDED_LATER, WITH_STEPS, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, UnitInterval

from .ddpg import DDPGConfig
from .horizon import MovingHorizon
from .representation import action_share, effective_rank, spread


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
        keys: among how many futures each tuple has to find its own, for w: the minibatch's (None, the paper's definition), or this many,
            the rest being keys of the minibatches before it, as they were then (He et al. 2020 keep such a queue). C_w was stated for
            minibatches of 1,024, and w falls with their size: 1024 keeps its meaning in smaller ones. L_reach always has the
            minibatch's futures alone.
        w_init: start of W, uniform [0, 1) as CURL, or a scaled identity, which learns faster.
        loss_weights: of L_fwd, L_bwd, L_k and L_reach.
        state_target: what L_fwd predicts: z' without its gradient; with it, as the paper prints it and URLB's APT does (the forward model
            then ends no better than "nothing changes": studies/cudc-state-target.md); or the momentum encoder's.
        action_target: what L_bwd predicts. With the gradient, φ_a collapses to a constant.
        knn_exclude_self: leave a point out of its own neighbours (URLB counts it).
        reward_after_update: compute w and r from the updated networks, as URLB's baselines do (Algorithm 1 computes them before).
        weight_mode: w as it is, or divided by its minibatch mean before clipping.
        patience: how many updates in a row must meet the test before k grows.
        min_dwell: environment steps for which k stays at least.
        inverse_k_batch: what L_k is computed on: the minibatch, whose tuples all share one k, or second ends of its tuples with k' drawn
            for each from {horizon, ..., k}, without which f_k only learns what k is at the moment.
        encoder: φ_s, APT's trunk in its place, or none: z is then the observation, as in ICM.
        action_encoder: whether there is φ_a; the forward model sees raw actions without it, and the entropy is that of states.
        inverse: what the inverse model predicts: action features, given k; raw actions, as in ICM and APT; or it is left out.
        step_model: whether f_k and L_k are there.
        reach: whether the reachability module is there: h, W, the momentum copies and L_reach.
        regularize: weigh the samples of critic and actor by curiosity.
        entropy: whether r_H is in the reward.
        prediction_error: α r_E, ICM's log(1 + r_E), or no such term in the reward.
        k_rule: k grows with the share of w below c_w, of rewards below c_r, or of forward errors below c_e; or each update's k is drawn,
            uniformly from K, or normally with a mean that rises from horizon to k_max.
        c_r, c_e: thresholds of those rules. The paper gives none, so that a pilot measures them (see ``pilot``).
        threshold_dwell: min_dwell of the two rules whose thresholds a pilot measures.
        normal_std: of the normal draw. normal_steps: environment steps after which its mean has reached k_max.
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
    c_w: UnitInterval = 0.02
    c_k: UnitInterval = 0.5
    momentum_tau: UnitInterval = 0.05
    temperature: PositiveFloat = 1.0
    keys: PositiveInt | None = field(default=None, metadata=ADDED_LATER)
    w_init: Literal["uniform", "scaled_identity"] = "uniform"
    loss_weights: tuple[NonNegativeFloat, NonNegativeFloat, NonNegativeFloat, NonNegativeFloat] = (1.0, 1.0, 1.0, 1.0)
    state_target: Literal["live", "stopgrad", "momentum"] = "stopgrad"
    action_target: Literal["stopgrad", "live"] = "stopgrad"
    knn_exclude_self: bool = False
    reward_after_update: bool = False
    weight_mode: Literal["prob", "mean_normalised"] = "prob"
    patience: PositiveInt = 1
    min_dwell: NonNegativeInt = 0
    inverse_k_batch: Literal["shared", "mixed"] = "shared"
    encoder: Literal["cudc", "apt", "none"] = "cudc"
    action_encoder: bool = True
    inverse: Literal["features", "actions", "none"] = "features"
    step_model: bool = True
    reach: bool = True
    regularize: bool = True
    entropy: bool = True
    prediction_error: Literal["linear", "log", "none"] = "linear"
    k_rule: Literal["weight", "reward", "error", "uniform", "normal"] = "weight"
    c_r: NonNegativeFloat | None = None
    c_e: NonNegativeFloat | None = None
    threshold_dwell: NonNegativeInt = field(default=150_000, metadata=WITH_STEPS)
    normal_std: NonNegativeFloat = 1.0
    normal_steps: PositiveInt = field(default=1_000_000, metadata=WITH_STEPS)


_SIGNALS = {"weight": "w", "reward": "reward", "error": "surprise"}  # what each rule for k looks at
_LOSSES = ("loss_forward", "loss_inverse", "loss_step", "loss_reach")  # in the order of loss_weights
_QUANTILES = {"w_q10": 0.10, "w_q25": 0.25, "w_median": 0.50, "w_q75": 0.75, "w_q90": 0.90}


@dataclass
class Features:
    """What the networks make of one minibatch, each applied once, and what the update computes from that.

    Those of parts that the configuration leaves out are never set, and asking for them is an error.

    Attributes:
        z, z_next: φ_s of both ends (E, B, D).
        action: φ_a (E, B, A'), or the raw actions.
        predicted: the forward model's z'.
        inverse, step_logits, momentum: outputs of the inverse model, of f_k, and of the momentum encoder for s'.
        keys: h of ``momentum``.
        log_reachable, log_found: log l among the minibatch's futures, for L_reach, and among all keys, for w (E, B).
        retrieved: the share of tuples whose own future comes first (E,).
        surprise, entropy, reward: r_E, r_H and r (E, B).
        w, unclipped: 1 - l, and the sample weights before their bounds (E, B).
    """

    z: Tensor
    z_next: Tensor
    action: Tensor
    predicted: Tensor
    inverse: Tensor = field(init=False)
    step_logits: Tensor = field(init=False)
    momentum: Tensor = field(init=False)
    keys: Tensor = field(init=False)
    log_reachable: Tensor = field(init=False)
    log_found: Tensor = field(init=False)
    retrieved: Tensor = field(init=False)
    surprise: Tensor = field(init=False)
    entropy: Tensor = field(init=False)
    reward: Tensor = field(init=False)
    w: Tensor = field(init=False)
    unclipped: Tensor = field(init=False)

    def detached(self) -> Features:
        """The same values without gradient."""
        found = copy.copy(self)
        for name, value in vars(self).items():
            setattr(found, name, value.detach())
        return found


def features_of(batch: Batch) -> Features:
    """Those that ``auxiliary_loss``, or ``reward``, left with a minibatch."""
    assert isinstance(batch.cache, Features)
    return batch.cache


class CUDC(MovingHorizon):
    """Rewards state-action entropy and surprise in a learned space, and looks further ahead once the future is reachable.

    Departs from the paper's printed equations in the targets of L_fwd and L_bwd, which have no gradient (``state_target``,
    ``action_target``), in the discount, which is γ^k as in the code base that it extends (``td_discount``), and in averaging, not summing,
    the contrastive loss over the minibatch.
    """

    config_class: ClassVar[type] = CUDCConfig
    # Paper, appendix, hyperparameters per domain.
    domain_values: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "walker": {"alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2, "clip_high": 2.0, "c_w": 0.02},
        "quadruped": {"alpha": 1e-4, "beta": 1e-2, "clip_low": 0.2, "clip_high": 1.0, "c_w": 0.02},
        "jaco": {"alpha": 100.0, "beta": 0.0, "clip_low": 0.9, "clip_high": 1.0, "c_w": 0.01},
    }
    category = "knowledge"
    family = "curiosity and entropy"
    citation = "Sun, Qian, Miao 2024"
    paper = "https://arxiv.org/abs/2312.12191"

    @property
    def min_horizon(self) -> int | None:
        return int(self.config.horizon) if self.config.inverse_k_batch == "mixed" else None

    def check(self) -> None:
        """Refuse switches that do not fit each other.

        Raises:
            ValueError: says which.
        """
        config = self.config
        wanted = self.measured_by_pilot(config)
        problems = {
            f"k_max={config.k_max} is below the first horizon {config.horizon}": config.k_max < config.horizon,
            f"{config.neighbours} neighbours cannot be found in a batch_size of {config.batch_size}": config.entropy
            and config.neighbours + config.knn_exclude_self > config.batch_size,
            "inverse=features predicts what action_encoder=false leaves out": config.inverse == "features" and not config.action_encoder,
            "inverse_k_batch=mixed needs the step_model": config.inverse_k_batch == "mixed" and not config.step_model,
            "regularize needs reach, whose probabilities are the weights": config.regularize and not config.reach,
            "k_rule=weight needs reach, or k_max equal to horizon": (
                config.k_rule == "weight" and not config.reach and config.k_max > config.horizon
            ),
            "entropy=false and prediction_error=none leave no reward": not config.entropy and config.prediction_error == "none",
            f"{wanted} has no value": wanted is not None and getattr(config, wanted) is None,
        }
        for problem, found in problems.items():
            if found:
                raise ValueError(problem)

    def build(self, random: MemberRandom) -> list[Trainable]:
        self.check()
        config, members = self.config, random.count
        width = config.width
        s = self.sizes.observation if config.encoder == "none" else config.feature_dim
        a = config.action_feature_dim if config.action_encoder else self.sizes.action
        self.state_encoder = self._state_encoder(random)
        trained: list[Trainable] = [self.state_encoder]
        if config.action_encoder:
            self.action_encoder = mlp(random, self.sizes.action, config.action_hidden, config.action_hidden, a)
            trained.append(self.action_encoder)
        self.forward_model = mlp(random, s + a + self.horizons, width, s)
        trained.append(self.forward_model)
        if config.inverse == "features":
            self.inverse_model = mlp(random, 2 * s + self.horizons, width, a)
        elif config.inverse == "actions":
            self.inverse_model = mlp(random, 2 * s, width, self.sizes.action, output=torch.tanh)
        if config.inverse != "none":
            trained.append(self.inverse_model)
        if config.step_model:
            self.step_model = mlp(random, 2 * s, width, self.horizons)
            trained.append(self.step_model)
        if config.reach:
            self.projection = self._projection(random, s)
            self.similarity = nn.Parameter(self._first_similarity(random))
            trained += [self.projection, self.similarity]
        self.has_momentum = config.reach or config.state_target == "momentum"
        if self.has_momentum:
            self.momentum_encoder = make_target(self.state_encoder, self._state_encoder(random))
        if config.reach:
            self.momentum_projection = make_target(self.projection, self._projection(random, s))
        self.build_horizon(members)
        device = self.device
        older = max((config.keys or 0) - config.batch_size, 0) if config.reach else 0
        self.register_buffer("older_keys", torch.zeros(members, older, config.projection_dim, device=device))
        self.register_buffer("keys_seen", torch.zeros((), dtype=torch.int64, device=device))
        self.register_buffer("probe", torch.zeros(members, config.batch_size, self.sizes.observation, device=device))
        return trained

    def _state_encoder(self, random: MemberRandom) -> nn.Module:
        size, width, z = self.sizes.observation, self.config.width, self.config.feature_dim
        if self.config.encoder == "none":
            return nn.Identity()
        if self.config.encoder == "apt":
            return trunk(random, size, z)
        return nn.Sequential(*mlp(random, size, width, z), LayerNorm(random, z), Activation(torch.tanh))

    def _projection(self, random: MemberRandom, size: int) -> nn.Module:
        sizes = (size, self.config.projection_hidden, self.config.projection_dim)
        return nn.Sequential(*mlp(random, *sizes), LayerNorm(random, self.config.projection_dim))

    def _first_similarity(self, random: MemberRandom) -> Tensor:
        size = self.config.projection_dim
        if self.config.w_init == "uniform":
            return random.uniform(size, size)
        return (torch.eye(size, device=self.device) / math.sqrt(size)).repeat(random.count, 1, 1)

    # Auxiliary models: dynamics in the learned space, and reachability

    def features(self, batch: Batch) -> Features:
        """Everything that losses, weights and reward are functions of, each network applied once."""
        config, size = self.config, batch.observation.shape[1]
        states = [batch.observation, batch.next_observation]
        if batch.nearer_observation is not None:
            states.append(batch.nearer_observation)
        z, z_next, *nearer = self.state_encoder(torch.cat(states, dim=1)).split(size, dim=1)
        action = self.action_encoder(batch.action) if config.action_encoder else batch.action
        # Not one_hot, which has the host look whether a number is too small.
        k = (batch.horizon[:, None] - config.horizon == torch.arange(self.horizons, device=z.device)).to(z.dtype)
        k = k[:, None].expand(-1, size, -1)
        z_pair = torch.cat([z, z_next], dim=-1)
        predicted = self.forward_model(torch.cat([z, action, k], dim=-1))
        found = Features(z, z_next, action, predicted)
        if config.inverse != "none":
            found.inverse = self.inverse_model(torch.cat([z_pair, k], dim=-1) if config.inverse == "features" else z_pair)
        if config.step_model:
            found.step_logits = self.step_model(torch.cat([z, nearer[0]], dim=-1) if nearer else z_pair)
        if self.has_momentum:
            with torch.no_grad():
                found.momentum = self.momentum_encoder(batch.next_observation)
        if not config.reach:
            return found
        with torch.no_grad():
            keys = self.momentum_projection(found.momentum)
        queries = self.projection(predicted)
        # S_ij = q_iᵀ W c_j: row i ranks every future of the minibatch as the future of tuple i (paper, eq. of l_i).
        logits = torch.bmm(torch.bmm(queries, self.similarity), keys.transpose(1, 2)) / config.temperature
        own, all_keys = logits.diagonal(dim1=1, dim2=2), logits.logsumexp(-1)
        found.log_reachable = own - all_keys
        with torch.no_grad():
            found.keys = keys
            if self.older_keys.shape[1]:
                older = torch.bmm(torch.bmm(queries, self.similarity), self.older_keys.transpose(1, 2)) / config.temperature
                there = torch.arange(older.shape[-1], device=older.device) < self.keys_seen
                all_keys = torch.logaddexp(all_keys, older.masked_fill(~there, -torch.inf).logsumexp(-1))
            found.log_found = own - all_keys
        if batch.measure:
            label = torch.arange(size, device=logits.device)
            found.retrieved = (logits.detach().argmax(-1) == label).float().mean(1)
        return found

    def auxiliary_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        f, config = self.features(batch), self.config
        state_target = f.momentum if config.state_target == "momentum" else f.z_next
        if config.state_target == "stopgrad":
            state_target = state_target.detach()
        losses = {"loss_forward": (state_target - f.predicted).norm(dim=-1).mean(1)}
        if config.inverse != "none":
            features = f.action if config.action_target == "live" else f.action.detach()
            target = features if config.inverse == "features" else batch.action
            losses["loss_inverse"] = (target - f.inverse).norm(dim=-1).mean(1)
        if config.step_model:
            k = batch.horizon[:, None].expand(-1, batch.action.shape[1]) if batch.nearer_horizon is None else batch.nearer_horizon
            losses["loss_step"] = F.cross_entropy(f.step_logits.transpose(1, 2), k - config.horizon, reduction="none").mean(1)
        if config.reach:
            losses["loss_reach"] = -f.log_reachable.mean(1)
        # Algorithm 1 computes w and r before the module's update: these are the values of this forward pass.
        batch.cache = f.detached()
        total = sum(weight * losses[name] for name, weight in zip(_LOSSES, config.loss_weights, strict=True) if name in losses)
        return total, {name: loss.detach() for name, loss in losses.items()}

    # Reward, weight, horizon

    def represent(self, observation: Tensor) -> Tensor | None:
        return None if self.config.encoder == "none" else self.state_encoder(observation)

    def reward(self, batch: Batch) -> Tensor:
        if self.config.reward_after_update:
            batch.cache = self.features(batch)
        f, config = features_of(batch), self.config
        f.surprise = (f.z_next - f.predicted).norm(dim=-1)
        terms = []
        if config.entropy:
            points = torch.cat([f.z, f.action], dim=-1) if config.action_encoder else f.z
            f.entropy = neighbour_distances(points, config.neighbours, config.knn_exclude_self).mean(-1).log1p()
            terms.append(f.entropy)
        if config.prediction_error != "none":
            terms.append(config.alpha * f.surprise if config.prediction_error == "linear" else f.surprise.log1p())
        f.reward = sum(terms) + torch.full_like(f.surprise, config.beta)
        return f.reward

    def sample_weight(self, batch: Batch) -> Tensor | None:
        if not self.config.reach:
            return None
        f = features_of(batch)
        # w = 1 - l, in the form that keeps its digits when l is close to 1.
        w = f.w = -torch.expm1(f.log_found)
        if not self.config.regularize:
            return None
        if self.config.weight_mode == "mean_normalised":
            w = w / w.mean(1, keepdim=True)
        f.unclipped = w
        return w.clamp(self.config.clip_low, self.config.clip_high)

    def after_auxiliary_step(self, batch: Batch) -> dict[str, Tensor]:
        f, config = features_of(batch), self.config
        measured = self._measure(batch) if batch.measure else {}
        if config.reach and (size := self.older_keys.shape[1]):
            keys = f.keys[:, :size]
            rows = (self.keys_seen + torch.arange(keys.shape[1], device=self.device)) % size
            self.older_keys[:, rows] = keys
            self.keys_seen.add_(keys.shape[1])
        # Without the module there is no w; k has no room to grow then.
        compares = config.k_rule in _SIGNALS and (config.k_rule != "weight" or config.reach)
        batch.signal = getattr(f, _SIGNALS[config.k_rule]) if compares else None
        p = self.move_horizon(batch.signal)
        return measured if p is None or not batch.measure else measured | {"p": p}

    def update_targets(self) -> None:
        if self.has_momentum:
            soft_update(self.state_encoder, self.momentum_encoder, self.config.momentum_tau)
        if self.config.reach:
            soft_update(self.projection, self.momentum_projection, self.config.momentum_tau)

    older_keys: Tensor
    keys_seen: Tensor
    probe: Tensor

    # Diagnostics

    def _measure(self, batch: Batch) -> dict[str, Tensor]:
        f, config = features_of(batch), self.config
        if not self.probe.any():
            self.probe.copy_(batch.observation)
        found = {"surprise": f.surprise.mean(1), "step_norm": (f.z_next - f.z).norm(dim=-1).mean(1)}
        # 1 and above: the forward model is no better than the prediction that nothing changes.
        found["error_over_persistence"] = found["surprise"] / found["step_norm"]
        if (probed := self.represent(self.probe)) is not None:
            found |= {"effective_rank": effective_rank(probed), "state_spread": spread(f.z)}
        if config.action_encoder:
            found |= {"action_norm": f.action.norm(dim=-1).mean(1), "action_spread": spread(f.action)}
            if config.entropy:
                found["action_share"] = action_share(f.z, f.action, config.neighbours)
        if config.entropy:
            found["entropy"] = f.entropy.mean(1)
            if config.prediction_error == "linear":
                found["surprise_share"] = config.alpha * found["surprise"] / found["entropy"]
        if config.reach:
            quantiles = f.w.quantile(torch.tensor(list(_QUANTILES.values()), device=self.device), dim=1)
            found |= dict(zip(_QUANTILES, quantiles, strict=True)) | {"w_mean": f.w.mean(1), "retrieved": f.retrieved}
        if config.regularize:
            found["w_clipped"] = (f.unclipped < config.clip_low).float().mean(1)
        return found
