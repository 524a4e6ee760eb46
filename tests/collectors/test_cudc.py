"""CUDC's rules on made-up cases, its sizes, and what it learns; its formulas are held in test_oracles.py."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from cudc_bench.collectors.base import Sizes
from cudc_bench.collectors.cudc import CUDC, CUDCConfig
from cudc_bench.collectors.representation import effective_rank
from cudc_bench.learning.networks import minimise
from tests.evaluators.helpers import random_walker_data

from .helpers import batch_for, make

# The rule for k


class Scripted(CUDC):
    """A CUDC whose reachability is what the test says."""

    def reach(self, log_reachable):
        self.log_reachable = log_reachable

    def features(self, batch):
        reachable = self.log_reachable.expand(len(self.seeds), batch.action.shape[1])
        found = super().features(batch)
        found.log_reachable = found.log_found = reachable
        return found


def scripted(seeds=(1,), **settings):
    config = CUDCConfig(**{"width": 8, "batch_size": 8, "feature_dim": 8, "neighbours": 4} | settings)
    return Scripted(Sizes("walker", 24, 6, 1000, 4000, 8), config, list(seeds))


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
    c.sizes = Sizes("walker", 24, 6, 1000, 0, 1, length)
    for row, share in enumerate(shares):
        c.increments[0, row] = torch.tensor([round(share * length), 0.6, 0.3])
    assert c.summary()[0]["k_schedule_suspect"] is suspect


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
    batch.cache = f.detached()
    w = c.sample_weight(batch)
    assert f.log_reachable.exp().min() > 0.999
    assert batch.cache.w.max() < 1e-3
    assert (w == c.config.clip_low).all()
    c._adapt_horizon(torch.ones(1), torch.zeros(1))
    assert c.k.tolist() == [4]


# Sizes, probes, values


@pytest.mark.parametrize(("observation", "action"), [(24, 6), (78, 12), (42, 9)])
@pytest.mark.parametrize("k_max", [6, 8])
def test_networks_have_the_papers_sizes(observation, action, k_max):
    c = CUDC(Sizes("x", observation, action, 250, 0, 2), CUDCConfig(k_max=k_max), [1])
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


@pytest.fixture(scope="module")
def random_walker():
    return random_walker_data(10, "stand", (1,))


@pytest.mark.parametrize("action_target", ["stopgrad", "live"])
def test_the_representation_learns_and_a_live_action_target_collapses(random_walker, action_target):
    # The auxiliary models alone, on 10 episodes of random actions: the pilot behind the choice of targets, smaller and faster.
    sizes = Sizes("walker", 24, 6, 1000, 4000, 2)
    c = CUDC(sizes, CUDCConfig(width=64, feature_dim=64, batch_size=128, learning_rate=3e-4, action_target=action_target), [1])
    reach, batch = [], None
    for _ in range(800):
        batch = random_walker.sample(128, c.horizon)
        loss, losses = c.auxiliary_loss(batch)
        minimise(loss, c.optimisers["belief"])
        c.update_targets()
        reach.append(losses["loss_reach"].item())
    # Chance is ln 128.
    assert np.mean(reach[580:620]) < math.log(128)
    spread = batch.cache.action.std(1).norm(dim=-1).item()
    assert spread > 0.1 if action_target == "stopgrad" else spread < 0.05
