"""Collectors learn what they are for: known regions bore, new ones attract, skills can be told apart."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from cudc_bench.collectors.base import Sizes
from cudc_bench.collectors.running.loop import run_collection
from cudc_bench.envs import Domain
from cudc_bench.learning.replay import Batch
from cudc_bench.runs import interaction
from cudc_bench.settings.collect_config import CollectConfig

from .helpers import make


def region(collector: Any, centre: float, seed: int) -> Batch:
    """Transitions around one place; s' is a simple function of (s, a) there, and elsewhere another one."""
    generator = torch.Generator().manual_seed(seed)
    size, sizes = 32, collector.sizes
    observation = centre + 0.3 * torch.randn(1, size, sizes.observation, generator=generator)
    action = torch.rand(1, size, sizes.action, generator=generator) * 2 - 1
    turned = torch.roll(observation, 1 + int(centre), -1) * (1.0 if centre == 0 else -1.0)
    following = observation + 0.5 * turned + (1.0 - centre) * action.mean(-1, keepdim=True)
    return Batch(observation, action, following, collector.horizon)


@pytest.mark.parametrize("name", ["icm", "rnd", "disagreement"])
def test_a_region_that_is_repeated_becomes_less_rewarding_than_a_new_one(name: str) -> None:
    collector = make(name)

    def reward(batch: Batch) -> float:
        with torch.no_grad():
            return float(collector.reward(batch).mean())

    def ratio() -> float:
        # RND normalises each minibatch by itself: both regions go in one.
        known, new = region(collector, 0.0, 999), region(collector, 2.0, 999)
        if name != "rnd":
            return reward(known) / reward(new)
        both = Batch(
            *(torch.cat([getattr(b, f) for b in (known, new)], 1) for f in ("observation", "action", "next_observation")), known.horizon
        )
        with torch.no_grad():
            error = collector.error(both)[0]
        return float(error[:32].mean() / error[32:].mean())

    before = ratio()
    for step in range(800):
        batch = region(collector, 0.0, step)
        if name == "rnd":
            # A few samples from elsewhere keep the normalisation of the minibatch from hiding where the region lies.
            far = region(collector, 2.0, step)
            for field in ("observation", "action", "next_observation"):
                getattr(batch, field)[:, :2] = getattr(far, field)[:, :2]
        collector.update(batch)
    assert ratio() < 0.7 * before


class PointMass:
    """A point on a square, moved by at most 0.03 a step; a walk at random hardly leaves the middle."""

    def reset(self, seed: int) -> None:
        self.place = np.zeros(2)

    def step(self, action: np.ndarray) -> None:
        self.place = np.clip(self.place + 0.03 * action, -1, 1)

    def observe(self, out: np.ndarray) -> None:
        out[:] = self.place

    def state(self, out: np.ndarray) -> None:
        out[:] = self.place


class Places:
    """Keeps where one member has been."""

    def __init__(self) -> None:
        self.seen: list[np.ndarray] = []

    def add_episode(self, seed: int, observations: np.ndarray, actions: np.ndarray, infos: dict[str, np.ndarray]) -> None:
        self.seen.append(observations[1:].copy())

    def add_diagnostics(self, row: dict[str, Any], steps_per_second: float) -> None:
        pass

    def cells(self) -> int:
        """How many of the square's hundred cells."""
        places = np.concatenate(self.seen)
        return len(np.unique(np.floor((places + 1) * 5).clip(0, 9), axis=0))


@cache
def visited(name: str) -> int:
    domain = Domain("point mass", (), 2, 2, 2, 100, 1.0, (), "", "", "")
    collector = make(name, (1,), Sizes("walker", 2, 2, 100, 500, 2), width=32, batch_size=64, feature_dim=16)
    places = Places()
    config = CollectConfig(steps=3_000, seed_steps=500, update_every=2, measure_every=10**6)
    run_collection(collector, config, domain, [places], lambda n: None)
    return places.cells()


@pytest.mark.parametrize("name", ["apt", "be", "proto", "aps", "cic", "moss", "ctec", "metra", "cudc"])
def test_covers_more_of_a_square_than_random_actions(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    simulators: Callable[[str, int], list[PointMass]] = lambda domain, count: [PointMass() for _ in range(count)]  # noqa: E731
    monkeypatch.setattr(interaction, "make_simulators", simulators)
    assert visited(name) > 1.4 * visited("random")


def test_diayns_skills_become_distinguishable() -> None:
    diayn = make("diayn", skills=4, width=64)
    skills = torch.eye(4)
    rewards, accuracies = [], []
    for step in range(250):
        generator = torch.Generator().manual_seed(step)
        which = torch.randint(4, (32,), generator=generator)
        # Each skill visits a place of its own.
        following = 0.5 * torch.randn(1, 32, 24, generator=generator) + 2.0 * torch.nn.functional.pad(skills[which], (0, 20))
        batch = Batch(torch.zeros(1, 32, 24), torch.zeros(1, 32, 6), following, diayn.horizon, measure=True, skill=skills[which][None])
        metrics = diayn.update(batch)
        accuracies.append(metrics["accuracy"].item())
        rewards.append(metrics["reward"].item())
    assert np.mean(accuracies[:5]) < 0.6
    assert np.mean(accuracies[-20:]) > 0.95
    # From about nothing to nearly the most that four skills can give, log 4.
    assert np.mean(rewards[:5]) < 0.3
    assert np.mean(rewards[-20:]) > 0.8 * np.log(4)


@pytest.mark.parametrize("name", ["aps", "cic", "moss", "metra"])
def test_continuous_skills_and_what_they_lead_to_find_each_other(name: str) -> None:
    collector = make(name)
    projection = torch.randn(collector.skill_size, 24, generator=torch.Generator().manual_seed(0))
    losses = []
    for step in range(300):
        generator = torch.Generator().manual_seed(step)
        skill = torch.rand(1, 32, collector.skill_size, generator=generator) * 2 - 1
        skill = torch.nn.functional.normalize(skill, dim=-1) if name in ("aps", "metra") else skill
        observation = torch.randn(1, 32, 24, generator=generator) * 0.1
        batch = Batch(observation, torch.zeros(1, 32, 6), observation + skill @ projection, collector.horizon, measure=True, skill=skill)
        losses.append(collector.update(batch)[{"aps": "loss_alignment", "metra": "loss_skill"}.get(name, "loss_contrastive")].item())
    assert np.mean(losses[-20:]) < np.mean(losses[:5]) - 0.5


def test_ctec_rewards_states_whose_future_is_hard_to_tell() -> None:
    """Of half of the states the future is a function of state and action; of the others it is anything."""
    ctec = make("ctec", width=32)
    half = torch.arange(32) < 16

    def batch(seed: int) -> Batch:
        generator = torch.Generator().manual_seed(seed)
        state, anything = (torch.randn(1, 32, 24, generator=generator) for _ in range(2))
        state[..., 0] = torch.where(half, 2.0, -2.0)
        future = torch.where(half[:, None], 0.9 * state, anything)
        return Batch(state, torch.zeros(1, 32, 6), state, ctec.horizon, future_observation=future)

    def ratio(seeds: range) -> float:
        rewards = []
        for seed in seeds:
            ctec.update(one := batch(seed))
            rewards.append(ctec.reward(one)[0])
        reward = torch.stack(rewards).mean(0)
        return float(reward[~half].mean() / reward[half].mean())

    before = ratio(range(10))
    for seed in range(10, 250):
        ctec.update(batch(seed))
    assert ratio(range(250, 270)) > 1.3 * before
