"""Losses and rewards of the field's collectors against independent NumPy versions and loops, on random weights and inputs."""

import math

import numpy as np
import pytest
import torch

from cudc_bench.collectors.aps import APS
from cudc_bench.collectors.be import BE
from cudc_bench.moments import RunningMoments
from cudc_bench.neighbours import neighbour_distances
from cudc_bench.networks import MemberRandom, minimise

from .helpers import batch_for, make

SIZE = 32


def arrays(batch):
    skill = None if batch.skill is None else batch.skill[0].numpy().astype(np.float64)
    return *(x[0].numpy().astype(np.float64) for x in (batch.observation, batch.action, batch.next_observation)), skill


def parameters(module):
    return [parameter.detach().numpy()[0].astype(np.float64) for parameter in module.parameters()]


def relu_layers(module, x, last=lambda x: x):
    p = parameters(module)
    for index in range(0, len(p) - 2, 2):
        x = np.maximum(x @ p[index] + p[index + 1], 0)
    return last(x @ p[-2] + p[-1])


def trunk(module, x):
    weight, bias, scale, shift = parameters(module)
    x = x @ weight + bias
    return np.tanh((x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * scale + shift)


def softmax(x, axis=-1):
    e = np.exp(x - x.max(axis, keepdims=True))
    return e / e.sum(axis, keepdims=True)


def normalised(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def nearest(points, neighbours, exclude_self=False):
    """Distances to the nearest points (B, neighbours), one pair at a time."""
    rows = []
    for i, point in enumerate(points):
        rows.append(sorted(math.dist(point, other) for j, other in enumerate(points) if not (exclude_self and i == j))[:neighbours])
    return np.array(rows)


def check(found, expected, tolerance=1e-4):
    np.testing.assert_allclose(found.detach().numpy()[0], expected, atol=tolerance, rtol=tolerance)


def learn(collector, batch):
    """The belief step alone: what rewards are computed after."""
    loss, metrics = collector.belief_loss(batch)
    minimise(loss, collector.optimisers["belief"])
    return loss.detach(), metrics


def after_some_updates(name, **settings):
    """A collector whose statistics and networks are no longer those of the start."""
    collector = make(name, **settings)
    for step in range(3):
        collector.update(batch_for(collector, seed=step))
    return collector


def reward_of(collector, batch):
    with torch.no_grad():
        return collector.reward(batch)


# Curiosity, novelty, uncertainty


@pytest.mark.parametrize("reward_scale", [1.0, 2.5])
def test_icm(reward_scale):
    icm = after_some_updates("icm", reward_scale=reward_scale)
    batch = batch_for(icm, seed=9)
    s, a, following, _ = arrays(batch)
    inferred = relu_layers(icm.inverse_model, np.concatenate([s, following], -1), np.tanh)
    error = np.linalg.norm(following - relu_layers(icm.forward_model, np.concatenate([s, a], -1)), axis=-1)
    loss, metrics = learn(icm, batch)
    check(metrics["loss_forward"], error.mean())
    check(metrics["loss_inverse"], np.linalg.norm(a - inferred, axis=-1).mean())
    check(loss, error.mean() + np.linalg.norm(a - inferred, axis=-1).mean())
    # The reward is that of the networks after their step.
    error = np.linalg.norm(following - relu_layers(icm.forward_model, np.concatenate([s, a], -1)), axis=-1)
    check(reward_of(icm, batch), np.log(1 + reward_scale * error))


def merged(moments, batch):
    """Mean, variance and count after a batch, as URLB merges them: each batch with its unbiased variance (spec, section 5.10)."""
    mean, variance, n = moments
    size, delta = batch.size, batch.mean() - mean
    total = n + size
    new = (variance * n + batch.var(ddof=1) * size + delta**2 * n * size / total) / total
    return mean + delta * size / total, new, total


def test_rnd():
    rnd = make("rnd", observation_clip=1.5)
    frozen = [x.copy() for x in parameters(rnd.random_network)]
    moments = (0.0, 1.0, 1e-4)

    def error(batch):
        s, *_ = arrays(batch)
        x = np.clip((s - s.mean(0)) / np.sqrt(s.var(0) + 1e-5), -1.5, 1.5)
        return ((relu_layers(rnd.random_network, x) - relu_layers(rnd.predictor, x)) ** 2).mean(-1)

    for step in range(4):
        batch = batch_for(rnd, seed=step)
        expected = error(batch).mean()
        loss, _ = learn(rnd, batch)
        check(loss, expected)
        seen = error(batch)
        moments = merged(moments, seen)
        check(reward_of(rnd, batch), seen / (math.sqrt(moments[1]) + 1e-8), 1e-4)
    assert all((x == y).all() for x, y in zip(frozen, parameters(rnd.random_network), strict=True))


def test_disagreement():
    one = after_some_updates("disagreement", models=3)
    batch = batch_for(one, seed=9)
    s, a, following, _ = arrays(batch)

    def predictions():
        weights = [p.detach().numpy().astype(np.float64) for p in one.models.parameters()]
        x = np.concatenate([s, a], -1)
        return np.stack([np.maximum(x @ weights[0][n] + weights[1][n], 0) @ weights[2][n] + weights[3][n] for n in range(3)])

    expected = np.linalg.norm(following - predictions(), axis=-1).mean()
    loss, _ = learn(one, batch)
    check(loss, expected)
    check(reward_of(one, batch), predictions().var(0, ddof=1).mean(-1))


def test_an_ensembles_models_start_apart_within_the_default_bounds():
    models = make("disagreement", (1, 2), models=4).models
    first = next(models.parameters()).detach()
    assert first.shape[0] == 8
    assert len({tuple(row[0].tolist()) for row in first}) == 8
    bound = 30**-0.5  # inputs: 24 + 6
    assert first.abs().max() <= bound
    assert first.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
    assert list(models.parameters())[1].abs().max() > 0


# Entropy


@pytest.mark.parametrize("exclude", [False, True])
def test_apt(exclude):
    apt = after_some_updates("apt", knn_exclude_self=exclude)
    batch = batch_for(apt, seed=9)
    s, a, following, _ = arrays(batch)
    z, z_next = trunk(apt.encoder, s), trunk(apt.encoder, following)
    forward = np.linalg.norm(z_next - relu_layers(apt.forward_model, np.concatenate([z, a], -1)), axis=-1).mean()
    inverse = np.linalg.norm(a - relu_layers(apt.inverse_model, np.concatenate([z, z_next], -1), np.tanh), axis=-1).mean()
    loss, metrics = learn(apt, batch)
    check(metrics["loss_forward"], forward)
    check(metrics["loss_inverse"], inverse)
    check(loss, forward + inverse)
    check(reward_of(apt, batch), np.log(1 + nearest(trunk(apt.encoder, s), 12, exclude).mean(-1)))


def test_apts_loss_reaches_the_encoder_through_both_states():
    apt, batch = make("apt"), batch_for(make("apt"))
    for part in ("observation", "next_observation"):
        alone = batch_for(apt)
        x = getattr(alone, part).requires_grad_(True)
        apt.belief_loss(alone)[0].sum().backward()
        assert x.grad.abs().max() > 0
    assert batch.observation.grad is None


@pytest.mark.parametrize("alpha", [0.5, 0.8, 1.0, 1.5, 3.0])
def test_behavioural_entropy(alpha):
    be = after_some_updates("be", alpha=alpha)
    batch = batch_for(be, seed=9)
    distance = nearest(trunk(be.encoder, arrays(batch)[0]), 12).mean(-1)
    beta = math.log(12) ** (1 - alpha)
    density = 1 / (1 + distance)
    weighted = np.exp(-beta * (-np.log(density)) ** alpha)
    check(reward_of(be, batch), -weighted * np.log(weighted) / density)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0])
def test_behavioural_entropy_as_a_third_party_reads_it(alpha):
    be = make("be", alpha=alpha, particle_weight="distance", normalise_by="running_mean", distance_floor=0.1)
    moments = (0.0, 1.0, 1e-4)
    for step in range(3):
        batch = batch_for(be, seed=step)
        learn(be, batch)
        distance = nearest(trunk(be.encoder, arrays(batch)[0]), 12).mean(-1)
        moments = merged(moments, distance)
        distance = np.maximum(distance / moments[0] - 0.1, 0.0)
        weighted = math.log(12) ** (1 - alpha) * np.log(1 + distance) ** alpha
        check(reward_of(be, batch), distance * weighted * np.exp(-weighted))


def test_behavioural_entropy_is_apt_at_alpha_one():
    apt, be = make("apt"), make("be", alpha=1.0)
    batch = batch_for(apt)
    torch.testing.assert_close(reward_of(be, batch), reward_of(apt, batch), atol=1e-5, rtol=1e-5)
    assert issubclass(BE, type(apt))


def sinkhorn(scores, rounds):
    """Balanced assignments, one sum at a time, as in SwAV's listing: every prototype the same mass, every sample 1 / B."""
    q = np.exp(scores / 0.1)
    q /= q.sum()
    samples, prototypes = q.shape
    for _ in range(rounds):
        for m in range(prototypes):
            q[:, m] /= q[:, m].sum() * prototypes
        for b in range(samples):
            q[b] /= q[b].sum() * samples
    return q * samples


def test_protorl():
    proto = after_some_updates("proto", prototypes=8, queue_size=32, projection_hidden=10)
    batch = batch_for(proto, seed=9)
    s, _, following, _ = arrays(batch)

    def linear(module, x):
        weight, bias = parameters(module)
        return x @ weight + bias

    c = normalised(proto.prototypes.detach().numpy()[0].astype(np.float64))
    online = normalised(relu_layers(proto.projector, linear(proto.predictor, s))) @ c.T
    target = normalised(linear(proto.slow_predictor, following)) @ c.T
    q = sinkhorn(target, 3)
    np.testing.assert_allclose(q.sum(-1), 1, rtol=1e-9)
    loss, _ = learn(proto, batch)
    check(loss, -(q * np.log(softmax(online / 0.1))).sum(-1).mean())
    # The reward: what the prototypes picked joins the queue first.
    start = int(proto.queue_start)
    before = proto.queue[0].numpy().copy()
    reward = reward_of(proto, batch)
    y = normalised(linear(proto.predictor, following))
    queue = proto.queue[0].numpy().astype(np.float64)
    changed = [(start + i) % 32 for i in range(8)]
    kept = [i for i in range(32) if i not in changed]
    assert (queue[kept] == before[kept]).all()
    assert int(proto.queue_start) == (start + 8) % 32
    for row in queue[changed]:
        assert min(math.dist(row, one) for one in y) < 1e-5
    expected = [sorted(math.dist(one, other) for other in queue)[2] for one in y]
    check(reward, np.array(expected), 1e-3)


def test_protorl_prototypes_pick_with_the_softmax_of_their_scores():
    proto = make("proto", prototypes=4, queue_size=4, batch_size=32)
    y = torch.nn.functional.normalize(torch.randn(1, 6, 12), dim=-1)
    expected = softmax(proto.scores(y)[0].detach().numpy(), axis=0).T  # (M, B)
    counts = np.zeros((4, 6))
    for _ in range(4000):
        with torch.no_grad():
            proto._remember(y)
        picked = torch.cdist(proto.queue[0], y[0]).argmin(-1)
        counts[range(4), picked.numpy()] += 1
    np.testing.assert_allclose(counts / 4000, expected, atol=0.035)


def test_protorls_prototypes_are_put_back_to_norm_one_before_loss_and_reward():
    proto = make("proto")
    np.testing.assert_allclose(np.linalg.norm(proto.prototypes.detach().numpy(), axis=-1), 1, rtol=1e-6)
    for step in (proto.belief_loss, proto.reward):
        with torch.no_grad():
            proto.prototypes.mul_(3.0)
        direction = proto.prototypes.detach().clone() / 3.0
        step(batch_for(proto))
        torch.testing.assert_close(proto.prototypes.detach(), direction)


def test_protorls_slow_predictor_follows():
    proto = make("proto", encoder_tau=0.25)
    slow = [x.copy() for x in parameters(proto.slow_predictor)]
    batch = batch_for(proto)
    proto.update(batch)
    for old, new, online in zip(slow, parameters(proto.slow_predictor), parameters(proto.predictor), strict=True):
        np.testing.assert_allclose(new, 0.75 * old + 0.25 * online, atol=1e-6)


# Competence


def test_diayn():
    diayn = after_some_updates("diayn", skills=5)
    batch = batch_for(diayn, seed=9)
    _, _, following, z = arrays(batch)
    assert (z.sum(-1) == 1).all()
    logits = relu_layers(diayn.discriminator, following)
    expected = -np.log(softmax(logits))[np.arange(SIZE), z.argmax(-1)]
    loss, metrics = learn(diayn, batch)
    check(loss, expected.mean())
    check(metrics["accuracy"], (logits.argmax(-1) == z.argmax(-1)).mean())
    q = softmax(relu_layers(diayn.discriminator, following))[np.arange(SIZE), z.argmax(-1)]
    check(reward_of(diayn, batch), np.log(q) + math.log(5))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_smm(sign):
    smm = after_some_updates("smm", discriminator_weight=sign)
    batch = batch_for(smm, seed=9)
    s, _, _, z = arrays(batch)
    state = smm.random["noise"].state_dict()
    noise = smm.random["noise"].normal(SIZE, 128)[0].numpy().astype(np.float64)
    smm.random["noise"].load_state_dict(state)
    seen = np.concatenate([s, z], -1)
    mean, log_variance = np.split(relu_layers(smm.encoder, seen), 2, axis=-1)
    squared = (seen - relu_layers(smm.decoder, mean + np.exp(log_variance / 2) * noise)) ** 2
    # KL of two normal distributions, one dimension at a time.
    divergence = sum(
        0.5 * (np.exp(log_variance[:, i]) + mean[:, i] ** 2 - 1 - log_variance[:, i]) for i in range(128)
    ).mean()  # fmt: skip
    unrecognised = -np.log(softmax(relu_layers(smm.discriminator, s)))[np.arange(SIZE), z.argmax(-1)]
    loss, metrics = learn(smm, batch)
    check(metrics["loss_reconstruction"], squared.mean())
    check(metrics["loss_divergence"], 0.5 * divergence)
    check(metrics["loss_discriminator"], unrecognised.mean())
    check(loss, squared.mean() + 0.5 * divergence + unrecognised.mean())
    check(reward_of(smm, batch), squared.sum(-1) + math.log(4) + sign * unrecognised)


def test_smms_mean_and_log_variance_start_orthogonal_each_on_its_own():
    for head in parameters(make("smm").encoder)[-2].T.reshape(2, 128, 150):
        np.testing.assert_allclose(head @ head.T, np.eye(128), atol=1e-5)


def test_smms_networks_have_their_own_learning_rates():
    smm = make("smm")
    rates = {id(p): group["lr"] for group in smm.optimisers["belief"].param_groups for p in group["params"]}
    assert {rates[id(p)] for p in (*smm.encoder.parameters(), *smm.decoder.parameters())} == {1e-2}
    assert {rates[id(p)] for p in smm.discriminator.parameters()} == {1e-3}


def test_aps():
    aps = after_some_updates("aps")
    count, average = float(aps.moments.weight), float(aps.moments.mean)
    batch = batch_for(aps, seed=9)
    _, _, following, w = arrays(batch)
    np.testing.assert_allclose(np.linalg.norm(w, axis=-1), 1, rtol=1e-5)
    loss, _ = learn(aps, batch_for(aps, seed=9))
    features = relu_layers(aps.features, following)
    distances = nearest(features, 12)
    assert count == pytest.approx(3 * SIZE * 12 + 1e-4)
    average = (average * count + distances.sum()) / (count + distances.size)
    entropy = np.log(1 + np.maximum(distances / average - 1e-4, 0).mean(-1))
    check(reward_of(aps, batch), entropy + (w * normalised(features)).sum(-1), 1e-3)
    features = relu_layers(aps.features, following)
    check(learn(aps, batch)[0], -(w * normalised(features)).sum(-1).mean())
    assert -1 <= loss.item() <= 1


def test_aps_values_are_the_task_vectors_product_with_successor_features():
    aps, batch = make("aps"), batch_for(make("aps"))
    with torch.no_grad():
        values = aps.value(aps.critic, batch.observation, batch.skill, batch.action)
        successor = aps.critic(torch.cat([batch.observation, batch.skill], -1), batch.action)
    assert successor.shape == (1, SIZE, 2, 10)
    expected = [[[sum(w * p for w, p in zip(batch.skill[0, b], successor[0, b, j], strict=True)) for j in (0, 1)] for b in range(SIZE)]]
    torch.testing.assert_close(values, torch.tensor(expected), atol=1e-5, rtol=1e-5)
    assert APS.critic_outputs.fget(aps) == 10


@pytest.mark.parametrize("divisor", ["variance", "std"])
def test_cic(divisor):
    cic = after_some_updates("cic", normalise_by=divisor, skill_dim=7)
    batch = batch_for(cic, seed=9)
    s, _, following, z = arrays(batch)
    assert z.min() >= 0
    assert z.max() < 1
    pair = np.concatenate([relu_layers(cic.state_network, x) for x in (s, following)], -1)
    keys, queries = normalised(relu_layers(cic.pair_network, pair)), normalised(relu_layers(cic.skill_network, z))
    losses = []
    for i in range(SIZE):
        similar = [math.exp(queries[i] @ keys[j] / 0.5) for j in range(SIZE)]
        losses.append(-math.log(similar[i] / (sum(similar) - similar[i])))
    loss, _ = learn(cic, batch)
    check(loss, np.mean(losses))
    moments = [float(x) for x in (cic.moments.mean, cic.moments.variance, cic.moments.weight)]
    distances = nearest(relu_layers(cic.state_network, following), 16)
    _, scale, _ = merged(moments, distances)
    scale = scale if divisor == "variance" else math.sqrt(scale)
    check(reward_of(cic, batch), np.log(1 + np.maximum(distances / scale - 5e-4, 0).mean(-1)), 1e-3)


@pytest.mark.parametrize(("name", "settings"), [("apt", {}), ("aps", {}), ("cic", {}), ("be", {})])
def test_more_neighbours_than_a_minibatch_has_are_refused(name, settings):
    with pytest.raises(ValueError, match="40 neighbours cannot be found in a batch_size of 32"):
        make(name, neighbours=40, **settings)


# Shared parts


def test_running_moments_merge_unbiased_variances():
    moments, expected = RunningMoments(2, "cpu"), [(0.0, 1.0, 1e-4)] * 2
    generator = torch.Generator().manual_seed(0)
    for scale, size in ((1.0, 5), (30.0, 2), (0.1, 7)):
        batch = torch.randn(2, size, 3, generator=generator) * scale + scale
        moments.add(batch)
        expected = [merged(before, member.numpy().astype(np.float64)) for before, member in zip(expected, batch, strict=True)]
        found = zip(moments.mean.tolist(), moments.variance.tolist(), [float(moments.weight)] * 2, strict=True)
        np.testing.assert_allclose(list(found), expected, rtol=1e-5)
    # One number says nothing of its spread.
    moments.add(torch.ones(2, 1))
    assert moments.variance.isfinite().all()


def test_neighbours_among_other_points():
    generator = torch.Generator().manual_seed(0)
    points, others = torch.randn(2, 20, 4, generator=generator) + 50, torch.randn(2, 30, 4, generator=generator) + 50
    found = neighbour_distances(points, 3, among=others).sort(-1).values
    expected = torch.cdist(points.double(), others.double()).sort(-1).values[..., :3]
    torch.testing.assert_close(found.double(), expected, atol=1e-4, rtol=1e-4)


def test_skills_are_drawn_from_each_members_own_stream():
    for name in ("diayn", "smm", "aps", "cic"):
        pair, alone = make(name, (5, 6)), make(name, (6,))
        for t in range(0, 200, 50):
            assert torch.equal(pair.next_skill(t)[1:], alone.next_skill(t))
    draws = torch.cat([make("diayn").draw_skills(MemberRandom([seed], "x")) for seed in range(400)])
    assert (draws.sum(0) > 5).all()
