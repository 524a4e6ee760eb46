"""Algorithms learn: a known optimum from good data, and more than the data show where these are mixed."""

from functools import cache, partial

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


# What the episodes of each of the two members of a stack follow in turn: good data, and mixed, of which three quarters run away.
GOOD, MIXED = 0, 1
POLICIES = ((best,), (best, worst, worst, worst))


def data(episodes=120, noise=0.5):
    """Labelled episodes of each member's policies, with noise on their actions."""
    found = Episodes(2, episodes, episodes * STEPS, 2, 1, MemberRandom((1, 1), "replay"), rewards=True)
    for member, policies in enumerate(POLICIES):
        rng = np.random.default_rng(0)
        for episode in range(episodes):
            policy = policies[episode % len(policies)]
            rows = roll(lambda x, policy=policy, rng=rng: policy(x) + rng.normal(0, noise, x.shape), rng.uniform(-1, 1, 1))
            observations, actions, rewards = (torch.from_numpy(one[0]) for one in rows)
            found.add(member, observations, actions, rewards=rewards)
    return found


def share(act):
    """The mean return as a share of the way from the worst policy's to the best one's, over starts on the whole line."""
    start = np.linspace(-1, 1, 41)
    own, top, bottom = (roll(policy, start)[2].sum(1).mean() for policy in (act, best, worst))
    return (own - bottom) / (top - bottom)


@cache
def shares(name, updates=800):
    """What the two members of a stack have learnt."""
    agent = make(name, (1, 1), 2, 1, **SETTINGS, **({"schedule_steps": updates} if name == "iql" else {}))
    episodes, horizon = data(), torch.ones(2, dtype=torch.int64)
    for _ in range(updates):
        agent.update(episodes.sample(64, horizon, next_action=agent.wants_next_action))

    def act(x, member):
        observation = torch.from_numpy(np.stack([x, np.ones_like(x)], -1).astype(np.float32))
        return agent.act(observation.expand(2, -1, -1))[member, :, 0].numpy().astype(np.float64)

    return [share(partial(act, member=member)) for member in (GOOD, MIXED)]


@pytest.mark.parametrize("name", LABELLED)
def test_reaches_nine_tenths_of_the_optimum_from_good_data_and_beats_cloning_on_mixed(name):
    assert shares(name)[GOOD] > 0.9
    cloned = shares("bc")[MIXED]
    assert cloned < 0.5
    assert name == "bc" or shares(name)[MIXED] > cloned + 0.15


def test_the_measure_knows_best_and_worst():
    assert share(best) == pytest.approx(1, abs=1e-6)
    assert share(worst) == pytest.approx(0, abs=1e-6)
