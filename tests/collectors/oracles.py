"""One update of every collector, of one member and step by step, as the papers and the authors' code have it: the other opinion.

Written from formulas alone, in float64, with the plain networks and the plain Adam of ``tests.plain``; a neighbour is found by measuring
the distance to every point. Nothing is shared with the collectors but the names of their networks, whose weights an oracle starts from,
and hyperparameters, whose defaults stand here a second time.

A method is a function ``(member, batch, hyperparameters) -> Found``: it takes the method's own step, moves its own slow copies, and says
what the agent is rewarded with. ``explore`` is that and the agent's own update after it. ``ORACLES`` has the function of every name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.plain import Adam, Member, Weights, ema, mlp, noisy, trunk, trunk_mlp


@dataclass
class Sample:
    """One member's minibatch: (s, a, s') with s' k steps after s, the skill that a followed, a second end k' ≤ k steps after s,
    and some later state."""

    s: Tensor
    a: Tensor
    s_next: Tensor
    k: int
    skill: Tensor | None = None
    s_nearer: Tensor | None = None
    k_nearer: Tensor | None = None
    s_future: Tensor | None = None


@dataclass
class Found:
    """What a method found in a minibatch: the reward (B,), metrics, and the samples' weights (B,) if it has them."""

    reward: Tensor
    metrics: dict[str, Any]
    weight: Tensor | None = None


class Explorer(Member):
    """One member of a collector: its networks, and what else changes from update to update.

    Attributes:
        k: how far ahead the next minibatch looks. increments: what the manifest will say of its growth.
        kept: the stack's buffers that the method changes, by their names.
    """

    def __init__(self, collector: Any, e: int, rate: float = 1e-4) -> None:
        super().__init__(collector, e, {}, rate)
        self.rate = rate
        self.sizes, self.k, self.updates = collector.sizes, int(collector.horizon[e]), int(collector.updates)
        self.increments: list[dict[str, float]] = []
        self.in_a_row, self.last_change = 0, 0
        self.kept: dict[str, Any] = {}

    def minimise(self, loss: Tensor, *names: str, rate: float | None = None) -> None:
        """One step of the Adam that trains the networks of these names together."""
        if names[0] not in self.adam:
            self.adam[names[0]] = Adam([weight for name in names for weight in _flat(getattr(self, name))], rate or self.rate)
        self.adam[names[0]].minimise(loss)

    @property
    def step(self) -> int:
        """The environment step at which this update takes place: the first comes after the random actions."""
        return int(self.sizes.seed_steps + self.updates * self.sizes.update_every)


def _flat(weights: Any) -> Weights:
    return [weights] if isinstance(weights, Tensor) else [one for part in weights for one in _flat(part)]


# Shared formulas


def beside(*parts: Tensor | None) -> Tensor:
    """[x; y; …] of each sample."""
    return torch.cat([part for part in parts if part is not None], dim=1)


def length(x: Tensor) -> Tensor:
    """‖x‖ of each sample."""
    return (x * x).sum(1).sqrt()


def unit(x: Tensor) -> Tensor:
    """x / ‖x‖ of each sample."""
    return x / length(x)[:, None]


def nearest(points: Tensor, count: int, others: Tensor | None = None, without_self: bool = False) -> Tensor:
    """Distances (B, count) from each point to its nearest ones among all points, itself included, or among others."""
    rows = []
    for i, point in enumerate(points):
        candidates = points if others is None else others
        if without_self:
            candidates = torch.cat([candidates[:i], candidates[i + 1 :]])
        rows.append(length(candidates - point).sort().values[:count])
    return torch.stack(rows)


class Running:
    """Mean and variance of a stream of numbers (spec 5.10): a prior of weight 1e-4 with M = 0, V = 1, and a parallel merge."""

    def __init__(self) -> None:
        self.mean, self.variance, self.weight = torch.tensor(0.0), torch.tensor(1.0), 1e-4

    def add(self, values: Tensor) -> None:
        n, mean, variance = values.numel(), values.mean(), values.var(unbiased=True)
        total, delta = self.weight + n, mean - self.mean
        self.variance = (self.weight * self.variance + n * variance + delta**2 * self.weight * n / total) / total
        self.mean = self.mean + delta * n / total
        self.weight = total


def running(m: Explorer, values: Tensor) -> Running:
    """The member's statistics, with these values added."""
    moments: Running = m.kept.setdefault("moments", Running())
    moments.add(values.detach())
    m.kept |= {"moments.mean": moments.mean, "moments.variance": moments.variance, "moments.weight": moments.weight}
    return moments


def particle_entropy(distances: Tensor, unit_of_length: Tensor, floor: float) -> Tensor:
    """log(1 + mean max(d / unit - floor, 0))."""
    return torch.log(1 + torch.clamp(distances / unit_of_length - floor, min=0).mean(1))


# The agent (spec 2)


def twin_values(critic: Weights, x: Tensor) -> list[Tensor]:
    """Two heads on one trunk; the stack keeps their layers side by side, and what would join head 1 to head 2 is never used."""
    hidden, hidden_bias, out, out_bias = critic[4:]
    features, width, size = trunk(critic[:4], x), len(hidden) // 2, len(out) // 2
    heads = []
    for half, rows in ((slice(0, width), slice(0, size)), (slice(width, None), slice(size, None))):
        heads.append(mlp([hidden[half], hidden_bias[half], out[rows, half], out_bias[rows]], features))
    return heads


def explore(
    m: Explorer,
    b: Sample,
    method: Callable[..., Found],
    own: dict[str, Any],
    *,
    discount: float = 0.99,
    critic_tau: float = 0.01,
    noise_std: float = 0.2,
    noise_clip: float = 0.3,
    td_discount: str = "gamma_pow_k",
    learning_rate: float = 1e-4,
) -> Found:
    """One update: the method's own step, its reward, the critic, the actor, the target critic."""
    m.rate = learning_rate
    found = method(m, b, **own)
    weight = torch.ones(len(b.a)) if found.weight is None else found.weight

    def policy(s: Tensor) -> Tensor:
        mean = torch.tanh(trunk_mlp(m.actor, beside(s, b.skill)))
        return noisy(mean, m.normal(*mean.shape), noise_std, noise_clip)

    def q(critic: Weights, s: Tensor, a: Tensor) -> Tensor:
        heads = twin_values(critic, beside(s, b.skill, a))
        if method is aps:  # Q_j = w · ψ_j
            return torch.stack([(b.skill * successor).sum(1) for successor in heads])
        return torch.stack([head[:, 0] for head in heads])

    with torch.no_grad():
        gamma = discount**b.k if td_discount == "gamma_pow_k" else discount
        y = found.reward + gamma * torch.minimum(*q(m.target_critic, b.s_next, policy(b.s_next)))
    q_1, q_2 = q(m.critic, b.s, b.a)
    critic_loss = (weight * ((q_1 - y) ** 2 + (q_2 - y) ** 2)).mean()
    m.minimise(critic_loss, "critic")
    actor_loss = -(weight * torch.minimum(*q(m.critic, b.s, policy(b.s)))).mean()
    m.minimise(actor_loss, "actor")
    ema(m.target_critic, m.critic, critic_tau)
    m.updates += 1
    found.metrics |= {
        "reward": found.reward.mean(), "q": (q_1 + q_2).mean() / 2, "critic_loss": critic_loss, "actor_loss": actor_loss, "k": b.k,
    }  # fmt: skip
    return found


# Baselines (spec 5)


def icm(m: Explorer, b: Sample, *, reward_scale: float = 1.0) -> Found:
    def error() -> Tensor:
        return length(b.s_next - mlp(m.forward_model, beside(b.s, b.a)))

    forward = error().mean()
    inverse = length(b.a - torch.tanh(mlp(m.inverse_model, beside(b.s, b.s_next)))).mean()
    m.minimise(forward + inverse, "forward_model", "inverse_model")
    return Found(torch.log(1 + reward_scale * error()), {"loss_forward": forward, "loss_inverse": inverse})


def apt(
    m: Explorer, b: Sample, *, neighbours: int = 12, knn_exclude_self: bool = False, shape: Callable[[Tensor], Tensor] | None = None
) -> Found:
    z, z_next = trunk(m.encoder, b.s), trunk(m.encoder, b.s_next)
    forward = length(z_next - mlp(m.forward_model, beside(z, b.a))).mean()
    inverse = length(b.a - torch.tanh(mlp(m.inverse_model, beside(z, z_next)))).mean()
    m.minimise(forward + inverse, "encoder", "forward_model", "inverse_model")
    distance = nearest(trunk(m.encoder, b.s), neighbours, without_self=knn_exclude_self).mean(1)
    reward = torch.log(1 + distance) if shape is None else shape(distance)
    return Found(reward, {"loss_forward": forward, "loss_inverse": inverse})


def apt_schedule(
    m: Explorer,
    b: Sample,
    *,
    k_steps: tuple[int, ...] = (450_000, 650_000, 1_050_000),
    neighbours: int = 12,
    knn_exclude_self: bool = False,
) -> Found:
    """APT with 3 steps, and one more from each of these environment steps on."""
    found = apt(m, b, neighbours=neighbours, knn_exclude_self=knn_exclude_self)
    following = m.step + m.sizes.update_every
    m.k = 3 + sum(following >= step for step in k_steps)
    return found


def be(
    m: Explorer,
    b: Sample,
    *,
    alpha: float = 0.5,
    particle_weight: str = "one_plus_distance",
    normalise_by: str = "none",
    distance_floor: float = 0.0,
    neighbours: int = 12,
    knn_exclude_self: bool = False,
) -> Found:
    """The integrand of the behavioural entropy, -w log w / p, where w = exp(-β (-log p)^α) and a particle's p is 1 / (1 + R)."""
    size = len(m.encoder[0])

    def shape(distance: Tensor) -> Tensor:
        scale = running(m, distance).mean if normalise_by == "running_mean" else 1.0
        distance = torch.clamp(distance / scale - distance_floor, min=0)
        beta, log = math.log(size) ** (1 - alpha), torch.log(1 + distance) ** alpha
        return (distance if particle_weight == "distance" else 1 + distance) * beta * log * torch.exp(-beta * log)

    return apt(m, b, neighbours=neighbours, knn_exclude_self=knn_exclude_self, shape=shape)


def proto(
    m: Explorer,
    b: Sample,
    *,
    queue_size: int = 2048,
    neighbours: int = 3,
    temperature: float = 0.1,
    sinkhorn_iterations: int = 3,
    encoder_tau: float = 0.05,
    **sizes: int,
) -> Found:
    def normalise_prototypes() -> None:
        with torch.no_grad():
            m.prototypes.copy_(m.prototypes / length(m.prototypes.T))

    def sinkhorn(scores: Tensor) -> Tensor:
        """SwAV's listing: in turn, every prototype gets 1/M of the mass and every sample 1/B of it."""
        q = torch.exp(scores / temperature)
        q /= q.sum()
        samples, prototypes = q.shape
        for _ in range(sinkhorn_iterations):
            for c in range(prototypes):
                q[:, c] /= prototypes * q[:, c].sum()
            for i in range(samples):
                q[i] /= samples * q[i].sum()
        return q * samples

    # m.prototypes holds one prototype in each column.
    normalise_prototypes()
    x = unit(mlp(m.projector, F.linear(b.s, *m.predictor)))
    p = torch.softmax(x @ m.prototypes / temperature, dim=1)
    with torch.no_grad():
        q = sinkhorn(unit(F.linear(b.s_next, *m.slow_predictor)) @ m.prototypes)
    loss = -(q * torch.log(p)).sum(1).mean()
    m.minimise(loss, "predictor", "projector", "prototypes")

    normalise_prototypes()
    with torch.no_grad():
        y = unit(F.linear(b.s_next, *m.predictor))
        queue = m.kept.setdefault("queue", torch.zeros(queue_size, y.shape[1]))
        start = m.kept.get("queue_start", 0)
        draws = m.uniform(m.prototypes.shape[1])
        for c, prototype in enumerate(m.prototypes.T):
            # The first sample up to which the samples' chances add up to the number drawn.
            chances = torch.softmax(y @ prototype, dim=0)
            picked = next(i for i in range(len(y)) if chances[: i + 1].sum() >= draws[c])
            queue[(start + c) % queue_size] = y[picked]
        m.kept["queue_start"] = (start + len(draws)) % queue_size
        reward = nearest(y, neighbours, queue)[:, -1]
    ema(m.slow_predictor, m.predictor, encoder_tau)
    return Found(reward, {"loss_assignment": loss})


def aps(
    m: Explorer, b: Sample, *, neighbours: int = 12, knn_exclude_self: bool = False, distance_floor: float = 1e-4, **sizes: int
) -> Found:
    def along() -> Tensor:
        return (b.skill * unit(mlp(m.features, b.s_next))).sum(1)

    loss = -along().mean()
    m.minimise(loss, "features")
    distances = nearest(mlp(m.features, b.s_next), neighbours, without_self=knn_exclude_self)
    entropy = particle_entropy(distances, running(m, distances).mean, distance_floor)
    return Found(entropy + along(), {"loss_alignment": loss})


def rnd(m: Explorer, b: Sample, *, observation_clip: float = 5.0, reward_scale: float = 1.0) -> Found:
    # BatchNorm without affine, in training.
    x = torch.clamp((b.s - b.s.mean(0)) / torch.sqrt(b.s.var(0, unbiased=False) + 1e-5), -observation_clip, observation_clip)

    def error() -> Tensor:
        return ((mlp(m.random_network, x).detach() - mlp(m.predictor, x)) ** 2).mean(1)

    loss = error().mean()
    m.minimise(loss, "predictor")
    deviation = running(m, error()).variance.sqrt()
    return Found(reward_scale * error() / (deviation + 1e-8), {"loss_prediction": loss})


def disagreement(m: Explorer, b: Sample, **sizes: int) -> Found:
    def predictions() -> list[Tensor]:
        return [mlp(model, beside(b.s, b.a)) for model in m.models]

    loss = sum(length(b.s_next - predicted).mean() for predicted in predictions()) / len(m.models)
    m.minimise(loss, "models")
    return Found(torch.stack(predictions()).var(0, unbiased=True).mean(1), {"loss_forward": loss})


def diayn(m: Explorer, b: Sample, **sizes: int) -> Found:
    label = b.skill.argmax(1)

    def log_q() -> Tensor:
        return torch.log(torch.softmax(mlp(m.discriminator, b.s_next), dim=1)[torch.arange(len(label)), label])

    right = (mlp(m.discriminator, b.s_next).argmax(1) == label).double().mean()
    loss = -log_q().mean()
    m.minimise(loss, "discriminator")
    return Found(log_q() + math.log(b.skill.shape[1]), {"loss_discriminator": loss, "accuracy": right})


def smm(
    m: Explorer,
    b: Sample,
    *,
    latent_dim: int = 128,
    vae_learning_rate: float = 1e-2,
    discriminator_learning_rate: float = 1e-3,
    kl_weight: float = 0.5,
    novelty_weight: float = 1.0,
    latent_weight: float = 1.0,
    discriminator_weight: float = 1.0,
    **sizes: int,
) -> Found:
    """The reward is that of the forward pass before the step, as in URLB."""
    x, label = beside(b.s, b.skill), b.skill.argmax(1)
    out = mlp(m.encoder, x)
    mean, log_variance = out[:, :latent_dim], out[:, latent_dim:]
    code = mean + torch.exp(log_variance / 2) * m.normal(*mean.shape)
    squared = (x - mlp(m.decoder, code)) ** 2
    divergence = sum(log_variance[:, i].exp() + mean[:, i] ** 2 - 1 - log_variance[:, i] for i in range(latent_dim)) / 2
    unrecognised = F.cross_entropy(mlp(m.discriminator, b.s), label, reduction="none")
    reward = novelty_weight * squared.sum(1) + latent_weight * math.log(b.skill.shape[1]) + discriminator_weight * unrecognised
    losses = {
        "loss_reconstruction": squared.mean(), "loss_divergence": kl_weight * divergence.mean(), "loss_discriminator": unrecognised.mean(),
    }  # fmt: skip
    m.minimise(losses["loss_reconstruction"] + losses["loss_divergence"], "encoder", "decoder", rate=vae_learning_rate)
    m.minimise(losses["loss_discriminator"], "discriminator", rate=discriminator_learning_rate)
    return Found(reward, losses)


def cic(
    m: Explorer,
    b: Sample,
    *,
    temperature: float = 0.5,
    neighbours: int = 16,
    knn_exclude_self: bool = False,
    distance_floor: float = 5e-4,
    normalise_by: str = "variance",
    **sizes: int,
) -> Found:
    loss = contrastive_step(m, b, temperature)
    distances = nearest(mlp(m.state_network, b.s_next), neighbours, without_self=knn_exclude_self)
    variance = running(m, distances).variance
    reward = particle_entropy(distances, variance if normalise_by == "variance" else variance.sqrt(), distance_floor)
    return Found(reward, {"loss_contrastive": loss})


def contrastive_step(m: Explorer, b: Sample, temperature: float) -> Tensor:
    """Pulls a skill's embedding and that of its own state change together; the loss."""
    pair = beside(mlp(m.state_network, b.s), mlp(m.state_network, b.s_next))
    query, key = unit(mlp(m.skill_network, b.skill)), unit(mlp(m.pair_network, pair))
    losses = []
    for i in range(len(query)):
        similar = torch.exp(key @ query[i] / temperature)
        losses.append(-torch.log(similar[i] / (similar[:i].sum() + similar[i + 1 :].sum())))
    loss = torch.stack(losses).mean()
    m.minimise(loss, "state_network", "pair_network", "skill_network")
    return loss


def moss(
    m: Explorer,
    b: Sample,
    *,
    temperature: float = 0.5,
    neighbours: int = 16,
    knn_exclude_self: bool = False,
    distance_floor: float = 5e-4,
    normalise_by: str = "variance",
    skill_mode: str = "half",
    **sizes: float,
) -> Found:
    """The entropy is that of the embedding before its step, of states among next states; control is its opposite."""
    states, following = mlp(m.state_network, b.s).detach(), mlp(m.state_network, b.s_next).detach()
    rows = []
    for i, state in enumerate(states):
        to = [length((other - state)[None]) for j, other in enumerate(following) if i != j or not knn_exclude_self]
        rows.append(torch.cat(to).sort().values[:neighbours])
    distances = torch.stack(rows)
    moments = running(m, distances)
    scale = moments.variance if normalise_by == "variance" else moments.variance.sqrt()
    entropy = particle_entropy(distances - moments.mean, scale, distance_floor)
    last = b.skill[:, -(b.skill.shape[1] // 2) :].sum(1)
    explores = last == 0 if skill_mode == "half" else last > 0
    assert 0 < explores.sum() < len(explores)
    return Found(torch.where(explores, 1.0, -1.0) * entropy, {"loss_contrastive": contrastive_step(m, b, temperature)})


def ctec(m: Explorer, b: Sample, *, logsumexp_weight: float = 0.1, **sizes: int) -> Found:
    """The reward is that of the forward pass before the step: how far the future that was drawn is, in ℓ1."""
    u = unit(mlp(m.pair_encoder, beside(b.s, b.a))) / torch.exp(m.log_temperature)
    v = unit(mlp(m.state_encoder, b.s_future))
    contrasts, logs, reward = [], [], []
    for i in range(len(u)):
        energies = -(v - u[i]).abs().sum(1)
        logs.append(torch.log(torch.exp(energies).sum()))
        contrasts.append(logs[-1] - energies[i])
        reward.append(-energies[i].detach())
    losses = {
        "loss_contrastive": torch.stack(contrasts).mean(), "loss_logsumexp": logsumexp_weight * (torch.stack(logs) ** 2).mean(),
    }  # fmt: skip
    m.minimise(sum(losses.values()), "pair_encoder", "state_encoder", "log_temperature")
    return Found(torch.stack(reward), losses)


def metra(m: Explorer, b: Sample, *, discrete: bool = False, slack: float = 1e-3, **sizes: float) -> Found:
    """φ, then λ, each in an Adam of its own; the reward is that of the φ after its step."""
    size = b.skill.shape[1]
    direction = (b.skill - b.skill.mean(1)[:, None]) * size / (size - 1) if discrete else b.skill

    def moved() -> Tensor:
        return mlp(m.state_network, b.s_next) - mlp(m.state_network, b.s)

    weight, step = torch.exp(m.log_multiplier.detach()), moved()
    excess = torch.maximum((step**2).sum(1) / size - 1, torch.tensor(-slack))
    loss = (weight * excess - (step * direction).sum(1)).mean()
    m.minimise(loss, "state_network")
    m.minimise(-(m.log_multiplier * excess.detach().mean()).sum(), "log_multiplier")
    reward = (moved() * direction).sum(1).detach()
    return Found(reward, {"loss_skill": loss, "multiplier": weight.squeeze(), "excess": excess.mean()})


# CUDC (spec 3) and its relatives (spec 4)


@dataclass(frozen=True)
class Parts:
    """A row of the table of relatives.

    Attributes:
        encoder: φ_s, or APT's trunk, or none: the observation as it is.
        phi_a: whether actions are encoded, and belong to the entropy's points.
        inverse: whether f_a gives action features, or raw actions as in ICM and APT, or is left out. f_k: whether that is there.
        reach: whether h, W, m and h̄ are there.
        reward: which terms it has.
        rule: which share makes k grow (w, r or e), or how k is drawn.
        weighted: whether critic and actor weigh samples by w̃.
        k_max: K ends here.
    """

    encoder: str | None = "φ_s"
    phi_a: bool = True
    inverse: str | None = "features"
    f_k: bool = True
    reach: bool = True
    reward: tuple[str, ...] = ("r_H", "α r_E", "β")
    rule: str = "w"
    weighted: bool = True
    k_max: int = 6

    @property
    def trained(self) -> list[str]:
        """What its one Adam trains."""
        there = {
            "state_encoder": self.encoder, "action_encoder": self.phi_a, "forward_model": True, "inverse_model": self.inverse,
            "step_model": self.f_k, "projection": self.reach, "similarity": self.reach,
        }  # fmt: skip
        return [name for name, trained in there.items() if trained]


def encoded(network: Weights, parts: Parts, s: Tensor) -> Tensor:
    """φ_s(s): Linear, ReLU, Linear, LayerNorm, tanh."""
    return trunk(network, s) if parts.encoder == "trunk" else torch.tanh(projected(network, s))


def projected(network: Weights, z: Tensor) -> Tensor:
    """h(z): Linear, ReLU, Linear, LayerNorm."""
    return F.layer_norm(mlp(network[:4], z), network[5].shape, *network[4:])


def forward_pass(m: Explorer, b: Sample, parts: Parts, ks: list[int], temperature: float, momentum: bool) -> dict[str, Tensor]:
    """z, z', a^z, ẑ, â, κ (spec 3.3), and the scores S of all futures of the minibatch (spec 3.4)."""

    def phi_s(network: str, s: Tensor) -> Tensor:
        return s if parts.encoder is None else encoded(getattr(m, network), parts, s)

    e_k = torch.zeros(len(b.a), len(ks))
    e_k[:, ks.index(b.k)] = 1
    z, z_next = phi_s("state_encoder", b.s), phi_s("state_encoder", b.s_next)
    a_z = mlp(m.action_encoder, b.a) if parts.phi_a else b.a
    z_hat = mlp(m.forward_model, beside(z, a_z, e_k))
    f = {"z": z, "z'": z_next, "a^z": a_z, "ẑ": z_hat}
    if parts.inverse == "features":
        f["â"] = mlp(m.inverse_model, beside(z, z_next, e_k))
    elif parts.inverse == "actions":
        f["â"] = torch.tanh(mlp(m.inverse_model, beside(z, z_next)))
    if parts.f_k:
        end = z_next if b.s_nearer is None else phi_s("state_encoder", b.s_nearer)
        f["κ"] = mlp(m.step_model, beside(z, end))
    if momentum:
        f["m(s')"] = phi_s("momentum_encoder", b.s_next).detach()
    if parts.reach:
        f["c"] = projected(m.momentum_projection, f["m(s')"]).detach()
        # As a layer of the network it would be W transposed.
        f["qᵀW"] = projected(m.projection, z_hat) @ m.similarity.T / temperature
        f["S"] = f["qᵀW"] @ f["c"].T
    return f


def cudc_losses(f: dict[str, Tensor], b: Sample, parts: Parts, first_k: int, state_target: str, action_target: str) -> dict[str, Tensor]:
    target = {"live": f["z'"], "stopgrad": f["z'"].detach(), "momentum": f.get("m(s')")}[state_target]
    losses = {"loss_forward": length(target - f["ẑ"]).mean()}
    if parts.inverse == "features":
        losses["loss_inverse"] = length((f["a^z"] if action_target == "live" else f["a^z"].detach()) - f["â"]).mean()
    elif parts.inverse == "actions":
        losses["loss_inverse"] = length(b.a - f["â"]).mean()
    if parts.f_k:
        k = torch.full((len(b.a),), b.k) if b.k_nearer is None else b.k_nearer
        losses["loss_step"] = F.cross_entropy(f["κ"], k - first_k)
    if parts.reach:
        losses["loss_reach"] = F.cross_entropy(f["S"], torch.arange(len(b.a)))  # every tuple's label is its own future
    return losses


def curiosity(m: Explorer, f: dict[str, Tensor], keys: int | None) -> Tensor:
    """w = 1 - l (spec 3.5) in a search among the minibatch's keys and, up to that many in all, the last ones before it, as they were."""
    capacity = max((keys or 0) - len(f["c"]), 0)
    queue = m.kept.setdefault("older_keys", torch.zeros(capacity, f["c"].shape[1]))
    seen = m.kept.setdefault("keys_seen", 0)
    rows = []
    for i, row in enumerate(f["S"]):
        others = torch.cat([row[:i], row[i + 1 :], queue[:seen] @ f["qᵀW"][i]])
        largest = torch.maximum(row[i], others.max())
        own, against = torch.exp(row[i] - largest), torch.exp(others - largest).sum()
        rows.append(against / (own + against))
    for key in f["c"][:capacity]:
        queue[m.kept["keys_seen"] % capacity] = key
        m.kept["keys_seen"] += 1
    return torch.stack(rows)


def grow(m: Explorer, signal: Tensor, below: float, what: str, c_k: float, patience: int, dwell: int, k_max: int) -> float:
    """Spec 3.7, and what the manifest keeps of it: k <- k + 1 where the share of samples below the threshold exceeds C_k."""
    share = sum(float(value) < below for value in signal) / len(signal)
    m.in_a_row = m.in_a_row + 1 if share > c_k else 0
    if m.in_a_row >= patience and (m.updates - m.last_change) * m.sizes.update_every >= dwell and m.k < k_max:
        m.increments.append({"step": m.step, "old_k": m.k, "new_k": m.k + 1, "p": share, what: float(signal.mean())})
        m.k, m.in_a_row, m.last_change = m.k + 1, 0, m.updates
    return share


def cudc(
    m: Explorer,
    b: Sample,
    *,
    parts: Parts,
    horizon: int = 3,
    neighbours: int = 12,
    knn_exclude_self: bool = False,
    alpha: float = 1e-3,
    beta: float = 1e-2,
    clip_low: float = 0.2,
    clip_high: float = 2.0,
    c_w: float = 0.02,
    c_k: float = 0.5,
    c_r: float | None = None,
    c_e: float | None = None,
    momentum_tau: float = 0.05,
    temperature: float = 1.0,
    keys: int | None = None,
    loss_weights: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0),
    state_target: str = "stopgrad",
    action_target: str = "stopgrad",
    weight_mode: str = "prob",
    reward_after_update: bool = False,
    patience: int = 1,
    min_dwell: int = 0,
    threshold_dwell: int = 150_000,
    normal_std: float = 1.0,
    normal_steps: int = 1_000_000,
    **sizes: Any,
) -> Found:
    ks = list(range(horizon, parts.k_max + 1))
    momentum = parts.reach or state_target == "momentum"
    f = forward_pass(m, b, parts, ks, temperature, momentum)
    losses = cudc_losses(f, b, parts, horizon, state_target, action_target)
    of = dict(zip(("loss_forward", "loss_inverse", "loss_step", "loss_reach"), loss_weights, strict=True))
    m.minimise(sum(of[name] * loss for name, loss in losses.items()), *parts.trained)

    # w and r are those of the forward pass before the step, as in Algorithm 1.
    if reward_after_update:
        f = forward_pass(m, b, parts, ks, temperature, momentum)
    f = {name: value.detach() for name, value in f.items()}
    r_e, r_h = length(f["z'"] - f["ẑ"]), None
    if "r_H" in parts.reward:
        points = beside(f["z"], f["a^z"]) if parts.phi_a else f["z"]
        r_h = torch.log(1 + nearest(points, neighbours, without_self=knn_exclude_self).mean(1))
    terms = {"r_H": r_h, "α r_E": alpha * r_e, "log(1 + r_E)": torch.log(1 + r_e), "β": torch.full_like(r_e, beta)}
    reward = sum(terms[name] for name in parts.reward)
    w = curiosity(m, f, keys) if parts.reach else None
    unclipped = w / w.mean() if weight_mode == "mean_normalised" and w is not None else w
    weight = torch.clamp(unclipped, clip_low, clip_high) if parts.weighted else None
    metrics = losses | diagnostics(m, b, parts, f, r_e, r_h, w, neighbours)
    if r_h is not None and "α r_E" in parts.reward:
        metrics["surprise_share"] = alpha * r_e.mean() / r_h.mean()
    if parts.weighted:
        metrics["w_clipped"] = (unclipped < clip_low).double().mean()

    # k of the next minibatch.
    if parts.rule == "uniform":
        m.k = ks[int(m.uniform(purpose="k") * len(ks))]
    elif parts.rule == "normal":
        mean = horizon + (parts.k_max - horizon) * (m.step + m.sizes.update_every) / normal_steps
        m.k = min(max(round(mean + normal_std * float(m.normal(purpose="k"))), horizon), parts.k_max)
    else:
        pilot_dwell = max(min_dwell, threshold_dwell)
        rules = {
            "w": (w, c_w, "mean_w", min_dwell),
            "r": (reward, c_r, "mean_reward", pilot_dwell),
            "e": (r_e, c_e, "mean_error", pilot_dwell),
        }
        signal, threshold, what, dwell = rules[parts.rule]
        metrics["p"] = grow(m, signal, threshold, what, c_k, patience, dwell, parts.k_max)

    if momentum and parts.encoder is not None:
        ema(m.momentum_encoder, m.state_encoder, momentum_tau)
    if parts.reach:
        ema(m.momentum_projection, m.projection, momentum_tau)
    return Found(reward, metrics, weight)


def diagnostics(
    m: Explorer, b: Sample, parts: Parts, f: dict[str, Tensor], r_e: Tensor, r_h: Tensor | None, w: Tensor | None, neighbours: int
) -> dict[str, Any]:
    """What the collector logs of itself (spec 3.11)."""
    m.kept.setdefault("probe", b.s)
    if not parts.reach:
        m.kept |= {"older_keys": torch.zeros(0, 64), "keys_seen": 0}
    found: dict[str, Any] = {"surprise": r_e.mean(), "step_norm": length(f["z'"] - f["z"]).mean()}
    found["error_over_persistence"] = found["surprise"] / found["step_norm"]
    if r_h is not None:
        found["entropy"] = r_h.mean()
    if parts.phi_a:
        found |= {"action_norm": length(f["a^z"]).mean(), "action_spread": spread(f["a^z"])}
    if parts.phi_a and r_h is not None:
        found["action_share"] = action_share(f["z"], f["a^z"], neighbours)
    if w is not None:
        quantiles = {"w_q10": 0.1, "w_q25": 0.25, "w_median": 0.5, "w_q75": 0.75, "w_q90": 0.9}
        found |= {"w_mean": w.mean()} | {name: np.quantile(w.numpy(), share) for name, share in quantiles.items()}
        found["retrieved"] = sum(int(row.argmax()) == i for i, row in enumerate(f["S"])) / len(w)
    if parts.encoder is not None:
        found["state_spread"] = spread(f["z"])
        found["effective_rank"] = effective_rank(encoded(m.state_encoder, parts, m.kept["probe"]).detach())
    return found


def spread(x: Tensor) -> float:
    """Root of the summed variances of all dimensions."""
    return float(np.linalg.norm(x.numpy().std(0, ddof=1)))


def action_share(z: Tensor, a_z: Tensor, neighbours: int) -> float:
    """How much of the squared distances to the nearest points, of which one is the point itself, lies along the actions."""
    of_both, of_actions = 0.0, 0.0
    for point, action in zip(z, a_z, strict=True):
        along = ((a_z - action) ** 2).sum(1)
        both = ((z - point) ** 2).sum(1) + along
        near = both.argsort()[:neighbours]
        of_both += float(both[near].sum())
        of_actions += float(along[near].sum())
    return of_actions / of_both


def effective_rank(z: Tensor) -> float:
    """exp of the entropy of the singular values' shares (Roy and Vetterli 2007), around the mean."""
    values = np.linalg.svd(z.numpy() - z.numpy().mean(0), compute_uv=False)
    shares = values / values.sum()
    return math.exp(-sum(share * math.log(share) for share in shares if share > 0))


VARY: dict[str, Any] = {"inverse": "actions", "reach": False, "weighted": False, "rule": "r"}
RELATIVES: dict[str, Parts] = {
    "cudc": Parts(),
    "cudc-vary-icm": Parts(encoder=None, phi_a=False, reward=("log(1 + r_E)",), **VARY),
    "cudc-vary-apt": Parts(encoder="trunk", phi_a=False, reward=("r_H",), **VARY),
    "cudc-reward": Parts(encoder="trunk", **VARY),
    "cudc-reach": Parts(weighted=False),
    "cudc-no-entropy": Parts(reward=("α r_E", "β")),
    "cudc-no-pe": Parts(reward=("r_H", "β")),
    "cudc-no-regularize": Parts(weighted=False),
    "cudc-no-vary": Parts(k_max=3),
    "cudc-no-reach": Parts(reach=False, weighted=False, rule="e"),
    "cudc-no-inverse": Parts(inverse=None, f_k=False),
    "cudc-uniform-k": Parts(rule="uniform"),
    "cudc-normal-k": Parts(rule="normal"),
    **{f"cudc-kmax{k}": Parts(k_max=k) for k in range(3, 9)},
    **{name: Parts() for name in ("cudc-one-setting", "cudc-live", "cudc-stopgrad", "cudc-momentum", "cudc-literal", "cudc-kmix")},
}

ORACLES: dict[str, Callable[..., Found]] = {
    "icm": icm, "apt": apt, "apt-k6": apt, "apt-ksched": apt_schedule, "be": be, "proto": proto, "aps": aps, "rnd": rnd,
    "disagreement": disagreement, "diayn": diayn, "smm": smm, "cic": cic, "moss": moss, "ctec": ctec, "metra": metra,
    **{name: partial(cudc, parts=parts) for name, parts in RELATIVES.items()},
    # ICM's and APT's own rewards, of the updated networks, and APT's own target, with its gradient.
    "cudc-vary-icm": partial(cudc, parts=RELATIVES["cudc-vary-icm"], beta=0.0, reward_after_update=True, state_target="live"),
    "cudc-vary-apt": partial(cudc, parts=RELATIVES["cudc-vary-apt"], beta=0.0, reward_after_update=True, state_target="live"),
    "cudc-one-setting": partial(cudc, parts=Parts(), alpha=1e-3, beta=1e-2, clip_low=0.2, clip_high=1.0, c_w=0.02),
    "cudc-live": partial(cudc, parts=Parts(), state_target="live"),
    "cudc-momentum": partial(cudc, parts=Parts(), state_target="momentum"),
    "cudc-literal": partial(cudc, parts=Parts(), state_target="live", action_target="live"),
}  # fmt: skip
