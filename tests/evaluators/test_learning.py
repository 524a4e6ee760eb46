"""Algorithms learn: a known optimum from good data, and more than the data show where these are mixed."""

from functools import cache

import numpy as np
import pytest
import torch

from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes

from .helpers import LABELLED, make

STEPS, GOAL, SPEED = 20, 0.5, 0.2
SETTINGS = {"width": 32, "batch_size": 64, "learning_rate": 1e-3, "discount": 0.9, "critic_tau": 0.02}


def roll(act, start, rng=None):
    """A point on a line, pushed by at most ``SPEED`` a step, is paid for being near the goal.

    Returns observations (n, T+1, 2), actions (n, T, 1) and rewards (n, T) of one episode for each start.
    """
    x = np.array(start, np.float64)
    observations, actions, rewards = [np.stack([x, np.ones_like(x)], -1)], [], []
    for _ in range(STEPS):
        a = np.clip(act(x), -1, 1)
        x = np.clip(x + SPEED * a, -1, 1)
        observations.append(np.stack([x, np.ones_like(x)], -1))
        actions.append(a[:, None])
        rewards.append(1 - np.abs(x - GOAL))
    return tuple(np.stack(rows, 1).astype(np.float32) for rows in (observations, actions, rewards))


def best(x):
    """The optimal policy: straight to the goal, and stay."""
    return (GOAL - x) / SPEED


def worst(x):
    """Straight to the far end."""
    return -np.ones_like(x)


def data(policies, episodes=120, noise=0.5):
    """Labelled episodes of several policies in turn, with noise on their actions."""
    rng = np.random.default_rng(0)
    found = Episodes(1, episodes, episodes * STEPS, 2, 1, MemberRandom((1,), "replay"))
    labels = []
    for episode in range(episodes):
        policy = policies[episode % len(policies)]
        o, a, r = roll(lambda x, policy=policy: policy(x) + rng.normal(0, noise, x.shape), rng.uniform(-1, 1, 1))
        found.add(0, torch.from_numpy(o[0]), torch.from_numpy(a[0]))
        labels.append(r[0])
    found.rewards = torch.from_numpy(np.concatenate(labels))[None]
    return found


def train(name, policies, updates):
    """An agent after so many updates on such data."""
    agent = make(name, (1,), 2, 1, **SETTINGS, **({"schedule_steps": updates} if name == "iql" else {}))
    episodes, horizon = data(policies), torch.ones(1, dtype=torch.int64)
    for _ in range(updates):
        agent.update(episodes.sample(64, horizon, next_action=agent.wants_next_action))
    return agent


def share(agent):
    """The mean return as a share of the way from the worst policy's to the best one's, over starts on the whole line."""
    start = np.linspace(-1, 1, 41)

    def act(x):
        observation = torch.from_numpy(np.stack([x, np.ones_like(x)], -1).astype(np.float32))[None]
        return agent.act(observation)[0, :, 0].numpy().astype(np.float64)

    own, top, bottom = (roll(policy, start)[2].sum(1).mean() for policy in (act, best, worst))
    return (own - bottom) / (top - bottom)


@cache
def share_on_mixed_data(name):
    """Three quarters of the episodes run away from the goal."""
    return share(train(name, (best, worst, worst, worst), 900))


@pytest.mark.parametrize("name", LABELLED)
def test_reaches_nine_tenths_of_the_optimum_from_good_data(name):
    assert share(train(name, (best,), 800)) > 0.9


@pytest.mark.parametrize("name", ["td3-bc", "iql", "cql", "cql-fixed", "crr", "rebrac", "td3", "td3-fujimoto"])
def test_beats_cloning_on_mixed_data(name):
    cloned = share_on_mixed_data("bc")
    assert cloned < 0.5
    assert share_on_mixed_data(name) > cloned + 0.15


def test_the_measure_knows_best_and_worst():
    class Fixed:
        def __init__(self, policy):
            self.policy = policy

        def act(self, observation):
            return torch.from_numpy(self.policy(observation[..., 0].numpy()))[..., None]

    assert share(Fixed(best)) == pytest.approx(1, abs=1e-6)
    assert share(Fixed(worst)) == pytest.approx(0, abs=1e-6)
