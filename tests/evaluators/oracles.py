"""What every offline algorithm computes, one member and one formula at a time, as its paper and the code that it follows have it.

An oracle changes one :class:`~tests.plain.Member` as one gradient step on one minibatch does, and returns the metrics. Hyperparameters are
written down here again, so that a default that changes is noticed as well. Each loss is a mean over the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Normal

from tests.plain import Member, Weights, ema, mlp, noisy, trunk_mlp

Metrics = dict[str, Tensor]


@dataclass(frozen=True)
class Transitions:
    """One member's minibatch: s (B, S), a (B, A), s' (B, S), r (B,), the action after s' (B, A), a later state and any state (B, S)."""

    s: Tensor
    a: Tensor
    s_next: Tensor
    r: Tensor
    a_next: Tensor
    later: Tensor
    other: Tensor


@dataclass(frozen=True)
class Oracle:
    """One algorithm.

    Attributes:
        update: of a member, on a batch, with the values, in the n-th step (from 1).
        act: the actions that are evaluated, of a member at observations, with the values.
        values: every hyperparameter that enters a formula.
        trained: what each optimiser trains.
        reads: what of a batch enters; the rest is NaN in the test.
        infer: z of the rewards (B,) of one task on a batch, of a member, with the values; for learners that train without rewards.
    """

    update: Callable[[Member, Transitions, Any, int], Metrics]
    act: Callable[[Member, Tensor, Any], Tensor]
    values: Mapping[str, Any]
    trained: Mapping[str, tuple[str, ...]]
    reads: frozenset[str] = frozenset({"s", "a", "s_next", "r"})
    infer: Callable[[Member, Transitions, Tensor, Any], Tensor] | None = None


# ExORL's networks: actors and critics with trunks of their own


def mean_action(actor: Weights, s: Tensor) -> Tensor:
    return torch.tanh(trunk_mlp(actor, s))


def value(critic: Weights, s: Tensor, a: Tensor) -> Tensor:
    return trunk_mlp(critic, torch.cat([s, a], -1))[:, 0]


def smaller(critics: list[Weights], s: Tensor, a: Tensor) -> Tensor:
    return torch.minimum(value(critics[0], s, a), value(critics[1], s, a))


def regress(m: Member, b: Transitions, y: Tensor) -> Metrics:
    """Both critics' step towards y: mean (Q_1 - y)² + mean (Q_2 - y)²."""
    q1, q2 = value(m.critic[0], b.s, b.a), value(m.critic[1], b.s, b.a)
    loss = ((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean()
    m.adam["critic"].minimise(loss)
    return {"critic_loss": loss, "q": (q1.mean() + q2.mean()) / 2}


def follow(slow: list[Weights], online: list[Weights], tau: float) -> None:
    # Networks may have layers in common, which follow once.
    pairs = {id(old): (old, new) for one, other in zip(slow, online, strict=True) for old, new in zip(one, other, strict=True)}
    for old, new in pairs.values():
        ema([old], [new], tau)


EXORL = {"learning_rate": 1e-4, "discount": 0.99, "critic_tau": 0.01, "noise_std": 0.2, "noise_clip": 0.3}
BOTH = {"actor": ("actor",), "critic": ("critic",)}


def act_mean(m: Member, s: Tensor, v: Any) -> Tensor:
    return mean_action(m.actor, s)


# BC


def bc(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """-log π(a | s), π normal around the mean action with σ = 0.2 in each dimension."""
    loss = -Normal(mean_action(m.actor, b.s), v.noise_std).log_prob(b.a).sum(-1).mean()
    m.adam["actor"].minimise(loss)
    return {"actor_loss": loss}


# TD3 (Fujimoto et al. 2018, algorithm 1) and TD3+BC, with what ExORL's code does otherwise as switches

TD3 = EXORL | {"target_actor": False, "policy_delay": 1, "maximise": "min", "actor_noise": True}


ActorLoss = Callable[[Member, Transitions, Any, Tensor], Metrics]


def value_alone(m: Member, b: Transitions, v: Any, q: Tensor) -> Metrics:
    return {"actor_loss": -q.mean()}


def td3(m: Member, b: Transitions, v: Any, n: int, actor_loss: ActorLoss = value_alone) -> Metrics:
    """y = r + γ min_j Q̄_j(s', a'), a' noisy; the actor ascends Q at its own action; slow copies follow."""
    with torch.no_grad():
        mean = mean_action(m.target_actor if v.target_actor else m.actor, b.s_next)
        a_next = noisy(mean, m.normal(*mean.shape), v.noise_std, v.noise_clip)
        y = b.r + v.discount * smaller(m.target_critic, b.s_next, a_next)
    metrics = regress(m, b, y)
    if n % v.policy_delay == 0:
        mean = mean_action(m.actor, b.s)
        own = noisy(mean, m.normal(*mean.shape), v.noise_std, v.noise_clip) if v.actor_noise else mean
        q = smaller(m.critic, b.s, own) if v.maximise == "min" else value(m.critic[0], b.s, own)
        metrics |= actor_loss(m, b, v, q)
        m.adam["actor"].minimise(metrics["actor_loss"])
        follow(m.target_critic, m.critic, v.critic_tau)
        if v.target_actor:
            ema(m.target_actor, m.actor, v.critic_tau)
    return metrics


def value_and_distance(m: Member, b: Transitions, v: Any, q: Tensor) -> Metrics:
    scale = v.alpha / q.detach().abs().mean()
    distance = ((mean_action(m.actor, b.s) - b.a) ** 2).mean()
    return {"actor_loss": distance - scale * q.mean(), "bc_loss": distance, "actor_value": q.mean()}


def td3_bc(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """-λ mean Q + (mean action - data action)², averaged over dimensions; λ = α / mean |Q|, a number (Fujimoto and Gu 2021, eq. 5)."""
    return td3(m, b, v, n, value_and_distance)


# CRR (Wang et al. 2020), with an online critic


def crr(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """-f(A) log π(a | s), A = min Q(s, a) - mean_j min Q(s, a_j), a_j ~ π(s); f(A) is a number."""
    with torch.no_grad():
        mean = mean_action(m.actor, b.s_next)
        y = b.r + v.discount * smaller(m.target_critic, b.s_next, noisy(mean, m.normal(*mean.shape), v.noise_std, v.noise_clip))
    metrics = regress(m, b, y)
    mean = mean_action(m.actor, b.s)
    with torch.no_grad():
        noise = m.normal(v.value_samples * len(b.s), b.a.shape[1]).reshape(v.value_samples, *b.a.shape)
        own = torch.stack([smaller(m.critic, b.s, noisy(mean, one, v.noise_std, v.noise_clip)) for one in noise]).mean(0)
        advantage = smaller(m.critic, b.s, b.a) - own
    if v.weight == "indicator":
        weight = m.branch(advantage > 0, "a data action better than the policy's").double()
    elif v.weight == "exp":
        weight = advantage.exp()
        weight = torch.where(m.branch(weight > v.largest_weight, "a weight at its bound"), v.largest_weight, weight)
    else:
        weight = advantage
    loss = -(weight * Normal(mean, v.noise_std).log_prob(b.a).sum(-1)).mean()
    m.adam["actor"].minimise(loss)
    follow(m.target_critic, m.critic, v.critic_tau)
    return metrics | {"actor_loss": loss, "advantage": advantage.mean(), "weight": weight.mean()}


# CQL (Kumar et al. 2020) on soft actor-critic, as ExORL has it and put right


def squashed(m: Member, s: Tensor, noise: Tensor, v: Any) -> tuple[Tensor, Tensor]:
    """Actions tanh x, x ~ N(μ, σ²), and log π of each dimension by the change of variables."""
    mean, log_std = trunk_mlp(m.actor, s).chunk(2, -1)
    m.branch(log_std < -10, "a deviation at its lower bound")
    m.branch(log_std > 2, "a deviation at its upper bound")
    mean = torch.tanh(mean) if v.squash_twice else mean
    std = torch.exp(torch.clamp(log_std, -10.0, 2.0))
    x = mean + std * noise
    # log (d tanh x / dx) = log (1 - tanh² x) = -2 log cosh x
    return torch.tanh(x), Normal(mean, std).log_prob(x) + 2.0 * torch.log(torch.cosh(x))


def cql(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """Critics: the TD error + α_c Σ_j (logsumexp over actions Q_j(s, ·) - Q_j(s, a)). Actor: α_e log π - min Q, α_e by its own step."""
    shape, times = b.a.shape, v.penalty_samples
    with torch.no_grad():
        y = b.r + v.discount * smaller(m.target_critic, b.s_next, squashed(m, b.s_next, m.normal(*shape), v)[0])
        uniform = m.uniform(times * shape[0], shape[1]).reshape(times, *shape) * 2.0 - 1.0
        own = [squashed(m, b.s, noise, v)[0] for noise in m.normal(times * shape[0], shape[1]).reshape(times, *shape)]
        following = [squashed(m, b.s_next, noise, v)[0] for noise in m.normal(times * shape[0], shape[1]).reshape(times, *shape)]
    error, penalty = torch.zeros(()), torch.zeros(())
    for critic in m.critic:
        of_data = value(critic, b.s, b.a)
        others = [value(critic, b.s, action) for action in (*uniform, *own, *following)]
        error = error + ((of_data - y) ** 2).mean()
        penalty = penalty + (torch.stack([*others, of_data]).exp().sum(0).log() - of_data).mean()
    weight: float | Tensor = v.penalty_weight
    if v.lagrange:
        # The multiplier ascends its own product with the gap, and is used after its step.
        multiplier = torch.clamp(m.log_multiplier.exp(), 0.0, 1e6)
        m.branch(m.log_multiplier.exp() > 1e6, "a multiplier at its bound")
        m.adam["multiplier"].minimise(-0.5 * multiplier * (penalty.detach() - v.penalty_target))
        weight = m.log_multiplier.detach().exp().clamp(0.0, 1e6)
    loss = error + weight * penalty
    q = torch.stack([value(critic, b.s, b.a) for critic in m.critic]).mean()
    m.adam["critic"].minimise(loss)

    action, log_prob = squashed(m, b.s, m.normal(*shape), v)  # log π (B, A)
    if v.sum_log_prob:
        log_prob = log_prob.sum(-1)[:, None]
    # -log α (log π + target entropy), target entropy -A; ExORL broadcasts over dimensions where they are not summed.
    m.adam["temperature"].minimise(-(m.log_temperature * (log_prob.detach() - shape[1])).mean())
    temperature = m.log_temperature.detach().exp()
    actor_loss = (temperature * log_prob - smaller(m.critic, b.s, action)[:, None]).mean()
    m.adam["actor"].minimise(actor_loss)
    follow(m.target_critic, m.critic, v.critic_tau)
    return {
        "critic_loss": loss, "q": q, "penalty": penalty, "actor_loss": actor_loss, "entropy": -log_prob.mean(),
        "temperature": temperature,
    }  # fmt: skip


def cql_action(m: Member, s: Tensor, v: Any) -> Tensor:
    mean = trunk_mlp(m.actor, s).chunk(2, -1)[0]
    return torch.tanh(torch.tanh(mean)) if v.squash_twice else torch.tanh(mean)


# IQL (Kostrikov et al. 2021, eqs. 5 to 7), in the order of CORL's code: V, Q and its slow copy, then the actor, all with V of before


def plain_value(critic: Weights, s: Tensor, a: Tensor) -> Tensor:
    return mlp(critic, torch.cat([s, a], -1))[:, 0]


def iql(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """V: |τ - 1[u < 0]| u², u = min Q̄(s, a) - V(s). Q: (r + γ V(s') - Q)². Actor: -exp(β u) log π(a | s)."""
    with torch.no_grad():
        target_q = torch.minimum(*(plain_value(critic, b.s, b.a) for critic in m.target_critic))
        y = b.r + v.discount * mlp(m.value, b.s_next)[:, 0]
    u = target_q - mlp(m.value, b.s)[:, 0]
    value_loss = (torch.abs(v.expectile - m.branch(u < 0, "a value below V").double()) * u**2).mean()
    m.adam["value"].minimise(value_loss)

    q1, q2 = (plain_value(critic, b.s, b.a) for critic in m.critic)
    critic_loss = (((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean()) / 2
    m.adam["critic"].minimise(critic_loss)
    follow(m.target_critic, m.critic, v.critic_tau)

    u = u.detach()
    weight = torch.exp(v.beta * u)
    weight = torch.where(m.branch(weight > v.largest_weight, "a weight at its bound"), v.largest_weight, weight)
    m.branch(m.log_std < -20, "a deviation at its lower bound")
    m.branch(m.log_std > 2, "a deviation at its upper bound")
    policy = Normal(torch.tanh(mlp(m.actor, b.s)), torch.exp(torch.clamp(m.log_std, -20.0, 2.0)))
    actor_loss = -(weight * policy.log_prob(b.a).sum(-1)).mean()
    # A cosine from the whole rate in the first step to 0 after the last.
    m.adam["actor"].rate = v.learning_rate * (1 + math.cos(math.pi * min((n - 1) / v.schedule_steps, 1.0))) / 2
    m.adam["actor"].minimise(actor_loss)
    return {
        "critic_loss": critic_loss, "value_loss": value_loss, "actor_loss": actor_loss, "q": (q1.mean() + q2.mean()) / 2,
        "advantage": u.mean(), "weight": weight.mean(),
    }  # fmt: skip


# ReBRAC (Tarasov et al. 2023, eqs. 3 and 4), with the authors' networks: ReLU, in critics then LayerNorm, in each hidden layer


def deep(weights: Weights, x: Tensor, norm: bool) -> Tensor:
    layers = iter(weights[:-2])
    for weight in layers:
        x = torch.relu(torch.nn.functional.linear(x, weight, next(layers)))
        if norm:
            x = torch.nn.functional.layer_norm(x, x.shape[-1:], next(layers), next(layers))
    return torch.nn.functional.linear(x, weights[-2], weights[-1])


def deep_value(critic: Weights, s: Tensor, a: Tensor) -> Tensor:
    return deep(critic, torch.cat([s, a], -1), norm=True)[:, 0]


def rebrac(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """y = r + γ (min Q̄(s', a') - β_c |a' - the data's|²). Actor: β_a |π(s) - a|² - min Q / mean |min Q|, the mean a number."""
    with torch.no_grad():
        mean = torch.tanh(deep(m.target_actor, b.s_next, norm=False))
        a_next = noisy(mean, m.normal(*mean.shape), v.noise_std, v.noise_clip)
        next_q = torch.minimum(*(deep_value(critic, b.s_next, a_next) for critic in m.target_critic))
        next_distance = ((a_next - b.a_next) ** 2).sum(-1)
        y = b.r + v.discount * (next_q - v.critic_penalty * next_distance)
    q1, q2 = (deep_value(critic, b.s, b.a) for critic in m.critic)
    critic_loss = ((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean()
    m.adam["critic"].minimise(critic_loss)
    metrics = {"critic_loss": critic_loss, "q": (q1.mean() + q2.mean()) / 2, "next_distance": next_distance.mean()}
    if n % v.policy_delay == 0:
        own = torch.tanh(deep(m.actor, b.s, norm=False))
        q = torch.minimum(*(deep_value(critic, b.s, own) for critic in m.critic))
        distance = ((own - b.a) ** 2).sum(-1)
        actor_loss = (v.actor_penalty * distance - q / q.detach().abs().mean()).mean()
        m.adam["actor"].minimise(actor_loss)
        ema(m.target_actor, m.actor, v.critic_tau)
        follow(m.target_critic, m.critic, v.critic_tau)
        metrics |= {"actor_loss": actor_loss, "bc_loss": distance.mean()}
    return metrics


CQL = {
    "learning_rate": 1e-4, "discount": 0.99, "critic_tau": 0.01, "penalty_weight": 0.01, "penalty_samples": 3, "lagrange": False,
    "penalty_target": 5.0, "squash_twice": True, "sum_log_prob": False,
}  # fmt: skip
SOFT = BOTH | {"temperature": ("log_temperature",), "multiplier": ("log_multiplier",)}

ORACLES = {
    "bc": Oracle(bc, act_mean, {"learning_rate": 1e-4, "noise_std": 0.2}, {"actor": ("actor",)}, frozenset({"s", "a"})),
    "td3": Oracle(td3, act_mean, TD3, BOTH),
    "td3-fujimoto": Oracle(
        td3, act_mean,
        TD3 | {"target_actor": True, "policy_delay": 2, "maximise": "first", "actor_noise": False, "noise_clip": 0.5}, BOTH,
    ),
    "td3-bc": Oracle(td3_bc, act_mean, TD3 | {"alpha": 2.5}, BOTH),
    "crr": Oracle(crr, act_mean, EXORL | {"value_samples": 10, "weight": "indicator", "largest_weight": 20.0}, BOTH),
    "cql": Oracle(cql, cql_action, CQL, SOFT),
    "cql-fixed": Oracle(cql, cql_action, CQL | {"squash_twice": False, "sum_log_prob": True}, SOFT),
    "iql": Oracle(
        iql, lambda m, s, v: torch.tanh(mlp(m.actor, s)),
        {
            "learning_rate": 3e-4, "discount": 0.99, "critic_tau": 0.005, "expectile": 0.7, "beta": 3.0, "largest_weight": 100.0,
            "schedule_steps": 500_000,
        },
        {"actor": ("actor", "log_std"), "critic": ("critic",), "value": ("value",)},
    ),
    "rebrac": Oracle(
        rebrac, lambda m, s, v: torch.tanh(deep(m.actor, s, norm=False)),
        {
            "learning_rate": 1e-3, "discount": 0.99, "critic_tau": 0.005, "actor_penalty": 0.01, "critic_penalty": 0.01,
            "noise_std": 0.2, "noise_clip": 0.5, "policy_delay": 2,
        },
        BOTH, frozenset({"s", "a", "s_next", "r", "a_next"}),
    ),
}  # fmt: skip
