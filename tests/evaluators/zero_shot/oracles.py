"""What learners without rewards compute, one member and one formula at a time; see :mod:`tests.evaluators.oracles`."""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from tests.plain import Member, Weights, mlp, noisy, trunk, trunk_mlp

from ..oracles import Metrics, Oracle, Transitions, follow

# Networks of Touati et al. 2023


def embed(weights: Weights, x: Tensor) -> Tensor:
    return torch.relu(F.linear(trunk(weights[:4], x), weights[4], weights[5]))


def two_embeddings(weights: Weights, first: Tensor, second: Tensor) -> Tensor:
    return mlp(weights[12:], torch.cat([embed(weights[:6], first), embed(weights[6:12], second)], -1))


def ahead(weights: Weights, s: Tensor, z: Tensor, a: Tensor) -> Tensor:
    """F(s, z, a), from embeddings of (a, s) and of (s, z)."""
    return two_embeddings(weights, torch.cat([a, s], -1), torch.cat([s, z], -1))


def mean_action(actor: Weights, s: Tensor, z: Tensor) -> Tensor:
    """From embeddings of s and of (s, z)."""
    return torch.tanh(two_embeddings(actor, s, torch.cat([s, z], -1)))


def norm(x: Tensor) -> Tensor:
    """To the length √d."""
    return math.sqrt(x.shape[-1]) * x / (x**2).sum(-1, keepdim=True).sqrt()


# What they have in common


def tasks(m: Member, embedded: Tensor, v: Any) -> Tensor:
    """z of each transition: the embedding of another one, or uniform on the sphere."""
    n, d = embedded.shape
    uniform = norm(m.normal(n, d))
    place, share = m.uniform(2, n)
    order = sorted(range(n), key=lambda i: float(place[i]))
    return torch.stack([embedded[order[i]] if share[i] < v.z_mix else uniform[i] for i in range(n)]).detach()


def draw(m: Member, s: Tensor, z: Tensor, v: Any) -> Tensor:
    mean = mean_action(m.actor, s, z)
    return noisy(mean, m.normal(*mean.shape), v.noise_std, v.noise_clip)


def regress(x: Tensor, r: Tensor) -> Tensor:
    """(xᵀx)⁻¹ xᵀ r."""
    return torch.linalg.solve(x.T @ x, x.T @ r)


def off(matrix: Tensor) -> Tensor:
    """The mean over i ≠ j."""
    n = len(matrix)
    return (matrix * (1 - torch.eye(n))).sum() / (n * (n - 1))


def on(matrix: Tensor) -> Tensor:
    return torch.diag(matrix).mean()


def orthonormal(e: Tensor) -> Tensor:
    return 0.5 * off((e @ e.T) ** 2) - on(e @ e.T)


def act_of_nothing(m: Member, s: Tensor, v: Any) -> Tensor:
    """The policy of z = 0."""
    d = m.actor[6].shape[1] - s.shape[1]
    return mean_action(m.actor, s, torch.zeros(len(s), d))


# FB (Touati and Ollivier 2021; Touati et al. 2023)


def back(m: Member, s: Tensor) -> Tensor:
    return norm(trunk_mlp(m.backward_map, s))


def fb(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """Σ_k ½ off[(M_k - γ min M̄)²] - diag M_k + λ (off[(B Bᵀ)²] - 2 diag B Bᵀ), M_k = F_k(s, z, a) B(s')ᵀ.

    The actor ascends min_k F_kᵀ z. With the mean instead, both times it is the mean.
    """
    z = tasks(m, back(m, b.s), v)
    with torch.no_grad():
        a_next = draw(m, b.s_next, z, v)
        slow = norm(trunk_mlp(m.target_backward_map, b.s_next))
        one, two = (ahead(weights, b.s_next, z, a_next) @ slow.T for weights in m.target_forward_map)
        least = torch.where(m.branch(one < two, "the first slow measure is smaller"), one, two)
        target = least if v.reduce == "min" else (one + two) / 2
    embedded = back(m, b.s_next)
    measures = [ahead(weights, b.s, z, b.a) @ embedded.T for weights in m.forward_map]
    fb_loss = sum((0.5 * off((one - v.discount * target) ** 2) - on(one) for one in measures), torch.zeros(()))
    ortho_loss = off((embedded @ embedded.T) ** 2) - 2 * on(embedded @ embedded.T)
    m.adam["maps"].minimise(fb_loss + v.ortho * ortho_loss)

    action = draw(m, b.s, z, v)
    one, two = ((ahead(weights, b.s, z, action) * z).sum(-1) for weights in m.forward_map)
    q = torch.where(m.branch(one < two, "the first value is smaller"), one, two) if v.reduce == "min" else (one + two) / 2
    m.adam["actor"].minimise(-q.mean())
    follow(m.target_forward_map, m.forward_map, v.target_tau)
    follow([m.target_backward_map], [m.backward_map], v.target_tau)
    measure = sum((on(one) for one in measures), torch.zeros(())) / 2
    return {"fb_loss": fb_loss, "ortho_loss": ortho_loss, "actor_loss": -q.mean(), "measure": measure, "q": q.mean()}


# One-step FB (Zheng et al. 2026): F and B of (s, a), the data's next action, (1 - γ) on the diagonal


def of_pair(weights: Weights, s: Tensor, a: Tensor) -> Tensor:
    return trunk_mlp(weights, torch.cat([s, a], -1))


def one_step_action(m: Member, s: Tensor, z: Tensor, v: Any) -> Tensor:
    hidden = torch.tanh(F.linear(torch.cat([s, z], -1), m.actor[0], m.actor[1]))
    out = mlp(m.actor[2:], hidden)
    if v.squash:
        return torch.tanh(out)
    return torch.where(m.branch(out.detach().abs() > 1, "an action beyond its bounds"), out.detach().sign(), out)


def one_step_fb(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """mean_k {½ off[(M_k - γ mean M̄)²] - (1 - γ) diag M_k} + λ (½ off[(B Bᵀ)²] - diag B Bᵀ).

    The actor ascends F(s, a)ᵀ z / mean |F(s, a)ᵀ z|. All of it at the weights of before.
    """
    embedded = of_pair(m.backward_map, b.s, b.a)
    z = tasks(m, norm(embedded.detach()), v)
    with torch.no_grad():
        slow = of_pair(m.target_backward_map, b.s, b.a)
        one, two = (of_pair(weights, b.s_next, b.a_next) @ slow.T for weights in m.target_forward_map)
        target = (one + two) / 2
    found = [of_pair(weights, b.s, b.a) @ embedded.T for weights in m.forward_map]
    one, two = (0.5 * off((one - v.discount * target) ** 2) - (1 - v.discount) * on(one) for one in found)
    fb_loss, ortho_loss = (one + two) / 2, orthonormal(embedded)

    own = one_step_action(m, b.s, z, v)
    one, two = ((of_pair(weights, b.s, own) * z).sum(-1) for weights in m.forward_map)
    q = (one + two) / 2 if v.maximise == "mean" else torch.minimum(one, two)
    actor_loss = -q.mean() / q.detach().abs().mean()
    m.adam["actor"].minimise(actor_loss)
    m.adam["maps"].minimise(fb_loss + v.ortho * ortho_loss)
    follow(m.target_forward_map, m.forward_map, v.target_tau)
    follow([m.target_backward_map], [m.backward_map], v.target_tau)
    measure = (on(found[0]) + on(found[1])) / 2
    return {"fb_loss": fb_loss, "ortho_loss": ortho_loss, "actor_loss": actor_loss, "measure": measure, "q": q.mean()}


def one_step_infer(m: Member, b: Transitions, r: Tensor, v: Any) -> Tensor:
    weights = torch.exp(v.temperature * r) / torch.exp(v.temperature * r).sum()
    return norm(((weights * r)[:, None] * of_pair(m.backward_map, b.s, b.a)).mean(0))


# HILP (Park et al. 2024): distances by goal-conditioned TD, and successor features of φ_1(s) less a slow mean


def distance(weights: Weights, s: Tensor, g: Tensor) -> Tensor:
    return torch.clamp(((trunk_mlp(weights, s) - trunk_mlp(weights, g)) ** 2).sum(-1), min=1e-6).sqrt()


def centred(m: Member, s: Tensor) -> Tensor:
    return trunk_mlp(m.maps[0], s).detach() - getattr(m, "mean", 0.0)


def successor_step(m: Member, b: Transitions, x: Tensor, v: Any) -> tuple[Tensor, Tensor]:
    """Σ_k |ψ_k - (x(s') + γ ψ̄_least)|²: z, and the loss."""
    z = tasks(m, norm(x @ torch.linalg.inv(x.T @ x / len(x) + 1e-5 * torch.trace(x.T @ x / len(x)) * torch.eye(x.shape[1]))), v)
    with torch.no_grad():
        a_next = draw(m, b.s_next, z, v)
        one, two = (ahead(weights, b.s_next, z, a_next) for weights in m.target_successor)
        first = m.branch((one * z).sum(-1) < (two * z).sum(-1), "the first head is smaller")
        y = x + v.discount * torch.stack([one[i] if first[i] else two[i] for i in range(len(x))])
    errors = [ahead(weights, b.s, z, b.a) - y for weights in m.successor]
    loss = sum((((one * z).sum(-1) if v.q_loss else one) ** 2).mean() for one in errors)
    m.adam["successor"].minimise(loss)
    m.adam["features"].rate = v.feature_rate * v.learning_rate
    return z, loss


def ascend(m: Member, b: Transitions, z: Tensor, v: Any) -> Tensor:
    """The actor ascends min_k ψ_kᵀ z, and ψ's slow copy follows."""
    action = draw(m, b.s, z, v)
    one, two = ((ahead(weights, b.s, z, action) * z).sum(-1) for weights in m.successor)
    q = torch.where(m.branch(one < two, "the first value is smaller"), one, two)
    m.adam["actor"].minimise(-q.mean())
    follow(m.target_successor, m.successor, v.target_tau)
    return q.mean()


def hilp(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """Features: Σ_k |κ - 1[A < 0]| (r + γ_h (1 - reached) V̄_k(s', g) - V_k(s, g))², r = reached - 1."""
    z, successor_loss = successor_step(m, b, centred(m, b.s_next), v)
    anywhere = m.branch(m.uniform(len(z)) < v.random_goals, "any state is the goal")
    g = torch.where(anywhere[:, None], b.other, b.later)
    reached = m.branch(((b.s - g) ** 2).sum(-1).sqrt() < 1e-6, "the goal is reached").double()
    with torch.no_grad():
        targets = [reached - 1 - v.feature_discount * (1 - reached) * distance(weights, b.s_next, g) for weights in m.target_maps]
        here = sum(-distance(weights, b.s, g) for weights in m.target_maps) / 2
        advantage = torch.minimum(*targets) - here
        weight = (v.expectile - m.branch(advantage < 0, "a negative advantage").double()).abs()
        mean_of_phi = trunk_mlp(m.maps[0], b.s).mean(0)
    distances = [distance(weights, b.s, g) for weights in m.maps]
    feature_loss = sum((weight * (y + one) ** 2).mean() for y, one in zip(targets, distances, strict=True))
    follow(m.target_maps, m.maps, v.feature_tau)
    m.adam["features"].minimise(feature_loss)
    m.mean = 0.995 * getattr(m, "mean", 0.0) + 0.005 * mean_of_phi
    q = ascend(m, b, z, v)
    return {
        "successor_loss": successor_loss, "feature_loss": feature_loss, "actor_loss": -q, "q": q,
        "distance": (distances[0] + distances[1]).mean() / 2, "advantage": advantage.mean(),
    }  # fmt: skip


def laplacian(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """Features: |φ(s) - φ(s')|² + off[(φ φᵀ)²] - 2 diag φ φᵀ."""
    z, successor_loss = successor_step(m, b, encode_task(m.map, b.s_next).detach(), v)
    phi = encode_task(m.map, b.s)
    change, ortho_loss = ((phi - encode_task(m.map, b.s_next)) ** 2).mean(), 2 * orthonormal(phi)
    m.adam["features"].minimise(change + ortho_loss)
    q = ascend(m, b, z, v)
    return {
        "successor_loss": successor_loss, "feature_loss": change + ortho_loss, "change": change, "ortho_loss": ortho_loss, "actor_loss": -q,
        "q": q,
    }  # fmt: skip


# TD-JEPA (Bagatella et al. 2026): T_φ(φ(s), z, a) predicts ψ's discounted sums, T_ψ(ψ(s), z, a) those of φ


def encode_state(weights: Weights, s: Tensor) -> Tensor:
    return norm(F.linear(s, weights[0], weights[1]))


def encode_task(weights: Weights, s: Tensor) -> Tensor:
    return norm(trunk_mlp(weights, s))


def predict(networks: list[Weights], x: Tensor, z: Tensor, a: Tensor) -> Tensor:
    return (ahead(networks[0], x, z, a) + ahead(networks[1], x, z, a)) / 2


def td_jepa(m: Member, b: Transitions, v: Any, n: int) -> Metrics:
    """mean_k |T_φ,k - (ψ̄(s') + γ mean T̄_φ)|² + mean_k |T_ψ,k - (φ̄(s') + γ mean T̄_ψ)|² + λ O; the actor ascends T_φ(φ(s), z, a)ᵀ z."""
    z = tasks(m, encode_task(m.task_encoder, b.s_next), v)
    with torch.no_grad():
        state, task = encode_state(m.target_state_encoder, b.s_next), encode_task(m.target_task_encoder, b.s_next)
        a_next = draw(m, state, z, v)
        of_state = task + v.discount * predict(m.target_state_predictor, state, z, a_next)
        of_task = state + v.discount * predict(m.target_task_predictor, task, z, a_next)
    state, task = encode_state(m.state_encoder, b.s), encode_task(m.task_encoder, b.s)
    losses = []
    for networks, x, y in ((m.state_predictor, state, of_state), (m.task_predictor, task, of_task)):
        losses.append(sum(((ahead(weights, x, z, b.a) - y) ** 2).sum(-1).mean() for weights in networks) / 2)
    ortho_loss = v.state_ortho * orthonormal(state) + v.task_ortho * orthonormal(task)
    m.adam["prediction"].minimise(losses[0] + losses[1] + ortho_loss)

    state = encode_state(m.state_encoder, b.s).detach()
    q = (predict(m.state_predictor, state, z, draw(m, state, z, v)) * z).sum(-1)
    m.adam["actor"].minimise(-q.mean())
    for name in ("state_encoder", "task_encoder"):
        follow([getattr(m, f"target_{name}")], [getattr(m, name)], v.target_tau)
    for name in ("state_predictor", "task_predictor"):
        follow(getattr(m, f"target_{name}"), getattr(m, name), v.target_tau)
    return {"state_loss": losses[0], "task_loss": losses[1], "ortho_loss": ortho_loss, "actor_loss": -q.mean(), "q": q.mean()}


COMMON = {"learning_rate": 1e-4, "discount": 0.98, "target_tau": 0.01, "z_mix": 0.5}
NOISE = {"noise_std": 0.2, "noise_clip": 0.3}
SUCCESSOR = COMMON | NOISE | {"q_loss": False, "feature_rate": 5.0}
SEEN = frozenset({"s", "a", "s_next"})
MAPS = {"maps": ("forward_map", "backward_map"), "actor": ("actor",)}

ZERO_SHOT = {
    "fb": Oracle(
        fb, act_of_nothing, COMMON | NOISE | {"ortho": 1.0, "reduce": "min"}, MAPS, SEEN,
        lambda m, b, r, v: norm((r[:, None] * back(m, b.s_next)).mean(0)),
    ),
    "fb-onestep": Oracle(
        one_step_fb, lambda m, s, v: one_step_action(m, s, torch.zeros(len(s), m.actor[0].shape[1] - s.shape[1]), v),
        COMMON | {"ortho": 0.1, "temperature": 10.0, "maximise": "mean", "squash": False}, MAPS, SEEN | {"a_next"}, one_step_infer,
    ),
    "hilp": Oracle(
        hilp, act_of_nothing,
        SUCCESSOR | {"feature_discount": 0.96, "feature_tau": 0.005, "expectile": 0.5, "random_goals": 0.375},
        {"successor": ("successor",), "features": ("maps",), "actor": ("actor",)}, SEEN | {"later", "other"},
        lambda m, b, r, v: norm(regress(centred(m, b.s_next), r)),
    ),
    "laplacian": Oracle(
        laplacian, act_of_nothing, SUCCESSOR, {"successor": ("successor",), "features": ("map",), "actor": ("actor",)}, SEEN,
        lambda m, b, r, v: norm(regress(encode_task(m.map, b.s_next).detach(), r)),
    ),
    "td-jepa": Oracle(
        td_jepa, lambda m, s, v: act_of_nothing(m, encode_state(m.state_encoder, s), v),
        COMMON | NOISE | {"target_tau": 0.001, "state_ortho": 0.1, "task_ortho": 0.1},
        {"prediction": ("state_encoder", "task_encoder", "state_predictor", "task_predictor"), "actor": ("actor",)}, SEEN,
        lambda m, b, r, v: norm(regress(encode_task(m.task_encoder, b.s_next).detach(), r)),
    ),
}  # fmt: skip
