"""CUDC against an independent NumPy implementation of the paper's formulas, and its rules on made-up cases."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from cudc_bench.collectors.base import Space
from cudc_bench.collectors.cudc import CUDC, CUDCConfig
from cudc_bench.collectors.representation import effective_rank
from cudc_bench.networks import minimise
from tests.evaluators.helpers import random_walker_data

from .helpers import batch_for, make

# By hand, from stacks of one member


def parameters(module):
    return [parameter.detach().numpy()[0].astype(np.float64) for parameter in module.parameters()]


def relu_layers(module, x):
    p = parameters(module)
    for index in range(0, len(p) - 2, 2):
        x = np.maximum(x @ p[index] + p[index + 1], 0)
    return x @ p[-2] + p[-1]


def normalised_layers(module, x, last=lambda x: x):
    p = parameters(module)
    x = np.maximum(x @ p[0] + p[1], 0) @ p[2] + p[3]
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * p[4] + p[5]
    return last(x)


def softmax(x):
    e = np.exp(x - x.max(-1, keepdims=True))
    return e / e.sum(-1, keepdims=True)


def by_hand(c, batch, k):
    """Every loss, weight and reward of spec of CUDC, from the formulas."""
    s, a, following = (x[0].numpy().astype(np.float64) for x in (batch.observation, batch.action, batch.next_observation))
    size, config = len(s), c.config
    onehot = np.zeros((size, c.horizons))
    onehot[:, k - config.horizon] = 1
    z, z_next = (normalised_layers(c.state_encoder, x, np.tanh) for x in (s, following))
    az = relu_layers(c.action_encoder, a)
    z_hat = relu_layers(c.forward_model, np.concatenate([z, az, onehot], -1))
    a_hat = relu_layers(c.inverse_model, np.concatenate([z, z_next, onehot], -1))
    kappa = softmax(relu_layers(c.step_model, np.concatenate([z, z_next], -1)))
    momentum = normalised_layers(c.momentum_encoder, following, np.tanh)
    keys = normalised_layers(c.momentum_projection, momentum)
    queries = normalised_layers(c.projection, z_hat)
    scores = queries @ c.similarity.detach().numpy()[0] @ keys.T / config.temperature
    reach = np.diag(softmax(scores))
    u = np.concatenate([z, az], -1)
    entropy = np.empty(size)
    for i in range(size):
        distances = sorted(math.dist(u[i], u[j]) for j in range(size) if not (config.knn_exclude_self and i == j))
        entropy[i] = math.log(1 + sum(distances[: config.neighbours]) / config.neighbours)
    surprise = np.linalg.norm(z_next - z_hat, axis=-1)
    target = {"live": z_next, "stopgrad": z_next, "momentum": momentum}[config.state_target]
    # A search among older futures, too.
    older = c.older_keys[0, : int(c.keys_seen)].numpy().astype(np.float64)
    everywhere = np.concatenate([scores, queries @ c.similarity.detach().numpy()[0] @ older.T / config.temperature], -1)
    w = 1 - softmax(everywhere)[np.arange(size), np.arange(size)]
    return {
        "loss_forward": np.linalg.norm(target - z_hat, axis=-1).mean(),
        "loss_inverse": np.linalg.norm(az - a_hat, axis=-1).mean(),
        "loss_step": -np.log(kappa[:, k - config.horizon]).mean(),
        "loss_reach": -np.log(reach).mean(),
        "entropy": entropy.mean(),
        "surprise": surprise.mean(),
        "w_mean": w.mean(),
        "p": (w < config.c_w).mean(),
        "w_clipped": ((w / w.mean() if config.weight_mode == "mean_normalised" else w) < config.clip_low).mean(),
        "retrieved": (scores.argmax(-1) == np.arange(size)).mean(),
        "action_norm": np.linalg.norm(az, axis=-1).mean(),
        "step_norm": np.linalg.norm(z_next - z, axis=-1).mean(),
        "reward": (entropy + config.alpha * surprise + config.beta).mean(),
    }, np.clip(w / w.mean() if config.weight_mode == "mean_normalised" else w, config.clip_low, config.clip_high)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"state_target": "stopgrad", "knn_exclude_self": True, "w_init": "scaled_identity"},
        {"state_target": "momentum", "action_target": "live", "temperature": 3.0, "alpha": 2.0, "beta": 0.5},
        {"weight_mode": "mean_normalised", "keys": 100, "c_w": 0.9, "clip_low": 0.99, "clip_high": 1.01, "neighbours": 5},
    ],
    ids=["default", "stopped", "momentum", "normalised"],
)
@pytest.mark.parametrize("k", [3, 5])
def test_losses_weights_and_reward_equal_the_formulas(settings, k):
    c = make(**settings)
    # A few updates first, so that the momentum copies differ from the online networks.
    for step in range(5):
        c.update(batch_for(c, seed=step))
    c.k = torch.tensor([k])
    batch = batch_for(c, seed=9, measure=True)
    expected, weight = by_hand(c, batch, k)
    metrics = c.update(batch)
    for name, value in expected.items():
        assert metrics[name].item() == pytest.approx(value, rel=2e-4, abs=2e-5), name
    assert metrics["k"].item() == k
    assert metrics["surprise_share"].item() == pytest.approx(c.config.alpha * expected["surprise"] / expected["entropy"], rel=1e-3)
    np.testing.assert_allclose(c.sample_weight(batch)[0].numpy(), weight, rtol=2e-4, atol=2e-5)


def test_reward_after_the_update_uses_the_updated_networks():
    before, after = make(), make(reward_after_update=True)
    for c in (before, after):
        c.update(batch_for(c, measure=True))
    batches = [batch_for(c, seed=3, measure=True) for c in (before, after)]
    same_start, _ = by_hand(after, batches[1], 3)
    rewards = [c.update(batch)["reward"].item() for c, batch in zip((before, after), batches, strict=True)]
    assert rewards[0] == pytest.approx(same_start["reward"], rel=1e-3)
    assert rewards[1] != pytest.approx(rewards[0], rel=1e-4)


def test_reach_loss_is_cross_entropy_with_the_own_future_as_label():
    c = make(seeds=(1, 2))
    batch = batch_for(c)
    c.belief_loss(batch)
    f = c.features(batch)
    queries, keys = c.projection(f["predicted"]), c.momentum_projection(f["momentum"])
    logits = queries @ c.similarity @ keys.transpose(1, 2)
    label = torch.arange(32)
    expected = torch.stack([F.cross_entropy(member, label) for member in logits])
    torch.testing.assert_close(-f["log_reachable"].mean(1), expected, atol=1e-4, rtol=1e-4)


# Gradients


def gradients(c, batch, loss_weights):
    object.__setattr__(c.config, "loss_weights", loss_weights)
    c.zero_grad()
    loss, _ = c.belief_loss(batch)
    loss.sum().backward()


def size(module):
    return sum(float(p.grad.abs().sum()) for p in module.parameters() if p.grad is not None)


def test_momentum_copies_take_no_gradient_and_move_by_tau():
    c = make(momentum_tau=0.05)
    copies = {c.momentum_encoder: c.state_encoder, c.momentum_projection: c.projection}
    old = {copy: [p.clone() for p in copy.parameters()] for copy in copies}
    gradients(c, batch_for(c), (1.0, 1.0, 1.0, 1.0))
    assert all(p.grad is None for copy in copies for p in copy.parameters())
    c.update(batch_for(c))
    for copy, online in copies.items():
        # Scale and shift of the LayerNorm belong to the copies, too.
        assert len(old[copy]) == 6
        for before, new, moved in zip(old[copy], online.parameters(), copy.parameters(), strict=True):
            torch.testing.assert_close(moved, 0.95 * before + 0.05 * new)


def test_a_stopped_action_target_gives_the_action_encoder_no_gradient():
    inverse_only = (0.0, 1.0, 0.0, 0.0)
    stopped, live = make(), make(action_target="live")
    gradients(stopped, batch_for(stopped), inverse_only)
    gradients(live, batch_for(live), inverse_only)
    assert size(stopped.action_encoder) == 0
    assert size(stopped.inverse_model) > 0
    assert size(live.action_encoder) > 0


def test_a_stopped_state_target_gives_the_next_state_no_gradient():
    forward_only = (1.0, 0.0, 0.0, 0.0)
    found = {}
    for target in ("live", "stopgrad", "momentum"):
        c = make(state_target=target)
        batch = batch_for(c)
        batch.next_observation.requires_grad_()
        gradients(c, batch, forward_only)
        found[target] = float(batch.next_observation.grad.abs().sum())
    assert found["live"] > 0
    assert found["stopgrad"] == found["momentum"] == 0


# The rule for k


class Scripted(CUDC):
    """A CUDC whose reachability is what the test says."""

    def reach(self, log_reachable):
        self.log_reachable = log_reachable

    def features(self, batch):
        reachable = self.log_reachable.expand(len(self.seeds), batch.action.shape[1])
        return super().features(batch) | {"log_reachable": reachable, "log_found": reachable}


def scripted(seeds=(1,), **settings):
    config = CUDCConfig(**{"width": 8, "batch_size": 8, "feature_dim": 8, "neighbours": 4} | settings)
    return Scripted(Space("walker", 24, 6, 1000, 4000, 8), config, list(seeds))


def drive(c, shares):
    """Update with the given share of reachable futures each time; returns k after each update."""
    ks = []
    for share in shares:
        reachable = (torch.arange(8) < round(share * 8)).float()
        c.reach(torch.where(reachable > 0, -1e-4, -3.0)[None])
        c.update(batch_for(c, size=8))
        ks.append(int(c.k[0]))
    return ks


def test_k_grows_when_most_futures_are_reachable_and_never_beyond_its_bound():
    assert drive(scripted(), [0.5, 0.625, 0.25, 0.75, 1.0, 1.0, 1.0]) == [3, 4, 4, 5, 6, 6, 6]


def test_patience_asks_for_updates_in_a_row():
    assert drive(scripted(patience=3), [1, 1, 0, 1, 1, 1, 1, 1, 1]) == [3, 3, 3, 3, 3, 4, 4, 4, 5]


def test_min_dwell_counts_environment_steps():
    # 8 steps for each update: after the first three updates 24 steps have passed.
    assert drive(scripted(min_dwell=24), [1] * 8) == [3, 3, 3, 4, 4, 4, 5, 5]


def test_members_have_their_own_k_and_record_every_increment():
    c = scripted(seeds=(1, 2))
    c.reach(torch.stack([torch.full((8,), -1e-4), torch.full((8,), -3.0)]))
    for _ in range(2):
        c.update(batch_for(c, size=8))
    assert c.k.tolist() == [5, 3]
    first, second = c.summary()
    assert [(x["step"], x["old_k"], x["new_k"]) for x in first["k_increments"]] == [(4000, 3, 4), (4008, 4, 5)]
    assert first["k_increments"][0]["p"] == 1.0
    assert first["k_increments"][0]["mean_w"] == pytest.approx(1 - math.exp(-1e-4), rel=1e-3)
    assert first["k_schedule_suspect"] is True
    assert second == {"k_increments": [], "k_schedule_suspect": False}


@pytest.mark.parametrize("length", [1_000_000, 400_000])
@pytest.mark.parametrize(
    ("shares", "suspect"),
    [((0.049,), True), ((0.05,), False), ((0.06, 0.09, 0.16), True), ((0.06, 0.09, 0.161), False), ((), False)],
)
def test_a_schedule_is_suspect_when_it_starts_or_ends_too_early_for_its_run(shares, suspect, length):
    c = scripted()
    c.space = Space("walker", 24, 6, 1000, 0, 1, length)
    for row, share in enumerate(shares):
        c.increments[0, row] = torch.tensor([round(share * length), 0.6, 0.3])
    assert c.summary()[0]["k_schedule_suspect"] is suspect


def test_w_is_that_of_a_search_among_the_minibatchs_keys_and_those_before_it():
    c = make(seeds=(1, 2), keys=100)  # three minibatches of 32, and 4 of the fourth
    seen = [[], []]
    for step in range(6):
        batch = batch_for(c, seed=step)
        with torch.no_grad():
            f = c.features(batch)
        for member in range(2):
            queries = c.projection(f["predicted"])[member].detach().double()
            futures = c.momentum_projection(c.momentum_encoder(batch.next_observation))[member].double()
            older = seen[member][-68:]
            scores = (queries @ c.similarity[member].detach().double() @ torch.cat([futures, *(one[None] for one in older)]).T).exp()
            own = scores.diagonal()
            torch.testing.assert_close(f["log_found"][member].double(), (own / scores.sum(1)).log(), rtol=1e-4, atol=1e-5)
            # The loss is a search among the minibatch.
            torch.testing.assert_close(f["log_reachable"][member].double(), (own / scores[:, :32].sum(1)).log(), rtol=1e-4, atol=1e-5)
            seen[member] += list(futures)
        c.update(batch)
        torch.testing.assert_close(batch.kept["w"], -torch.expm1(f["log_found"]))
    assert make().older_keys.numel() == make(keys=32).older_keys.numel() == make(keys=7).older_keys.numel() == 0


def test_a_perfectly_predicted_future_is_reachable():
    c = make(w_init="scaled_identity")
    # Make the forward model's output, and so the query, equal to the key of the own future, and W large.
    with torch.no_grad():
        c.similarity.mul_(1e4)
    batch = batch_for(c)
    real = c.features
    keys = c.momentum_encoder(batch.next_observation)
    c.forward_model = torch.nn.Module()
    c.forward_model.forward = lambda x: keys
    f = real(batch)
    batch.kept = {name: value.detach() for name, value in f.items()}
    w = c.sample_weight(batch)
    assert f["log_reachable"].exp().min() > 0.999
    assert batch.kept["w"].max() < 1e-3
    assert (w == c.config.clip_low).all()
    c._adapt_horizon(torch.ones(1), torch.zeros(1))
    assert c.k.tolist() == [4]


# Sizes, probes, values


@pytest.mark.parametrize(("observation", "action"), [(24, 6), (78, 12), (42, 9)])
@pytest.mark.parametrize("k_max", [6, 8])
def test_networks_have_the_papers_sizes(observation, action, k_max):
    c = CUDC(Space("x", observation, action, 250, 0, 2), CUDCConfig(k_max=k_max), [1])
    horizons = k_max - 2

    def linear(*sizes):
        return sum(a * b + b for a, b in pairwise(sizes))

    expected = {
        c.state_encoder: linear(observation, 1024, 512) + 2 * 512,
        c.action_encoder: linear(action, 64, 64, 64),
        c.forward_model: linear(512 + 64 + horizons, 1024, 512),
        c.inverse_model: linear(2 * 512 + horizons, 1024, 64),
        c.step_model: linear(2 * 512, 1024, horizons),
        c.projection: linear(512, 128, 64) + 2 * 64,
        c.actor: linear(observation, 1024, 1024, action) + 2 * 1024,
    }
    for module, count in expected.items():
        assert sum(p.numel() for p in module.parameters()) == count
    assert c.similarity.shape == (1, 64, 64)
    assert 0 <= c.similarity.min() <= c.similarity.max() < 1
    # Two heads of (1024, 1024) and (1024, 1) on one trunk; the masked halves of the last layer are not weights.
    heads = 2 * (linear(1024, 1024, 1))
    masked = 2 * 1024
    assert sum(p.numel() for p in c.critic.parameters()) == linear(observation + action, 1024) + 2 * 1024 + heads + masked


def test_the_papers_values_per_domain():
    values = CUDC.domain_values
    assert CUDCConfig(**values["walker"]) == CUDCConfig()
    assert values["quadruped"] == {"alpha": 1e-4, "beta": 1e-2, "clip_low": 0.2, "clip_high": 1.0, "c_w": 0.02}
    assert values["jaco"] == {"alpha": 100.0, "beta": 0.0, "clip_low": 0.9, "clip_high": 1.0, "c_w": 0.01}


def test_effective_rank_of_known_spectra():
    def points(*sizes):
        axes = torch.diag(torch.tensor(sizes))
        return torch.cat([axes, -axes])

    found = effective_rank(torch.stack([points(3.0, 3.0, 0.0, 0.0), points(2.0, 1.0, 1.0, 0.0), points(2.0, 1.0, 1.0, 0.0) + 50.0]))
    expected = math.exp(0.5 * math.log(2) + 0.5 * math.log(4))
    torch.testing.assert_close(found, torch.tensor([2.0, expected, expected]))
    # Points that do not differ.
    torch.testing.assert_close(effective_rank(torch.full((1, 8, 4), 0.7)), torch.ones(1))


def test_what_is_measured_of_the_representation():
    c = make(seeds=(1, 2))
    batch = batch_for(c, measure=True)
    with torch.no_grad():
        f = c.features(batch)
    found = c.update(batch)
    for member in range(2):
        z, z_next, action, predicted = (f[name][member].double().numpy() for name in ("z", "z_next", "action", "predicted"))
        error, change = np.linalg.norm(z_next - predicted, axis=1).mean(), np.linalg.norm(z_next - z, axis=1).mean()
        assert found["error_over_persistence"][member].item() == pytest.approx(error / change, rel=1e-4)
        assert found["state_spread"][member].item() == pytest.approx(np.sqrt(z.var(0, ddof=1).sum()), rel=1e-4)
        of_state = of_both = 0.0
        for i in range(32):
            squared = [(((z[i] - z[j]) ** 2).sum(), ((action[i] - action[j]) ** 2).sum()) for j in range(32)]
            nearest = sorted(squared, key=sum)[:12]
            of_state += sum(s for s, _ in nearest)
            of_both += sum(map(sum, nearest))
        assert found["action_share"][member].item() == pytest.approx(1 - of_state / of_both, rel=1e-3)


def test_the_probe_batch_stays_the_same():
    c = make()
    c.update(batch_for(c, measure=True))
    first = c.probe.clone()
    c.update(batch_for(c, seed=5, measure=True))
    assert torch.equal(first, c.probe)
    assert torch.equal(first, batch_for(c).observation)


@pytest.fixture(scope="module")
def random_walker():
    return random_walker_data(40, "stand", (1,))


@pytest.mark.parametrize("action_target", ["stopgrad", "live"])
def test_the_representation_learns_and_a_live_action_target_collapses(random_walker, action_target):
    # The belief alone, on 40 episodes of random actions: the pilot behind the choice of targets, at a smaller width.
    space = Space("walker", 24, 6, 1000, 4000, 2)
    c = CUDC(space, CUDCConfig(width=128, feature_dim=128, batch_size=128, action_target=action_target), [1])
    reach, batch = [], None
    for _ in range(1500):
        batch = random_walker.sample(128, c.horizon)
        loss, losses = c.belief_loss(batch)
        minimise(loss, c.optimisers["belief"])
        c.update_targets()
        reach.append(losses["loss_reach"].item())
    # Chance is ln 128.
    assert np.mean(reach[580:620]) < math.log(128)
    spread = batch.kept["action"].std(1).norm(dim=-1).item()
    assert spread > 0.1 if action_target == "stopgrad" else spread < 0.05
