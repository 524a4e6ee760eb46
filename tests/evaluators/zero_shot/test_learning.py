"""One training on aimless data reaches goals that nobody had named; learners whose gradients go where they must not, do not."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from cudc_bench import plugins
from cudc_bench.evaluators import fb
from cudc_bench.evaluators.zero_shot import Labelled
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes

STEPS, SPEED = 20, 0.5
GOALS = np.array([0.4, 2.0, 3.5, 5.1])  # angles
SETTINGS = {
    "width": 32, "feature_width": 32, "state_dim": 8, "batch_size": 64, "learning_rate": 1e-3, "discount": 0.9, "z_dim": 8,
}  # fmt: skip


def reward(angle, goal):
    """Near the goal, and hardly anything elsewhere."""
    return np.exp((np.cos(angle - goal) - 1) / 0.1)


def observed(angle):
    return np.stack([np.cos(angle), np.sin(angle)], -1).astype(np.float32)


def aimless(episodes=100):
    """Episodes of uniformly random actions of a point on a circle, for one member."""
    rng = np.random.default_rng(0)
    data = Episodes(1, episodes, episodes * STEPS, 2, 1, MemberRandom((1,), "replay"))
    for _ in range(episodes):
        actions = rng.uniform(-1, 1, STEPS)
        angles = rng.uniform(0, 2 * np.pi) + SPEED * np.cumsum([0.0, *actions])
        data.add(0, torch.from_numpy(observed(angles)), torch.from_numpy(actions[:, None].astype(np.float32)))
    return data


def trained(kind, updates, **settings):
    agent = kind(2, 1, kind.configure(SETTINGS, settings), (1,))
    data, one = aimless(), torch.ones(1, dtype=torch.int64)
    for _ in range(updates):
        agent.update(data.sample(SETTINGS["batch_size"], one, next_action=agent.wants_next_action, future=agent.wants_future))
    return agent


def shares(agent):
    """For each goal the mean return as a share of the way from standing still to going straight there, over starts all around."""
    batch = aimless().sample(2000, torch.ones(1, dtype=torch.int64))
    x, y = batch.next_observation[0].double().numpy().T
    rewards = np.array([reward(np.arctan2(y, x), goal) for goal in GOALS], np.float32)
    z = agent.infer(Labelled(batch.observation, batch.action, batch.next_observation, torch.from_numpy(rewards)[None]))
    found = []
    for task, goal in enumerate(GOALS):
        policy = agent.policy_for(z[:, task])

        def own(angle, policy=policy):
            with torch.no_grad():
                return policy(torch.from_numpy(observed(angle))[None])[0, :, 0].numpy()

        def best(angle, goal=goal):
            return ((goal - angle + np.pi) % (2 * np.pi) - np.pi) / SPEED

        reached, most, least = (total(act, goal) for act in (own, best, np.zeros_like))
        found.append((reached - least) / (most - least))
    return np.array(found)


def total(act, goal):
    angle, returns = np.linspace(0, 2 * np.pi, 24, endpoint=False), 0.0
    for _ in range(STEPS):
        angle = angle + SPEED * np.clip(act(angle), -1, 1)
        returns += reward(angle, goal)
    return returns.mean()


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


# They reach 0.92 and 0.80. Nothing learnt is 0 on average: running around is as good as standing still.
@pytest.mark.parametrize(("name", "updates", "share"), [("fb", 500, 0.75), ("hilp", 800, 0.55)])
def test_one_training_reaches_all_goals(name, updates, share):
    found = shares(trained(plugins.load("evaluators", name), updates))
    assert found.mean() > share, found
    assert found.min() > 0.3, found


class Chased(fb.FB):
    """Its targets are the very maps that learn."""

    def build(self, random):
        super().build(random)
        del self.target_forward_map, self.target_backward_map
        # Known under these names, but no networks of their own.
        self.__dict__ |= {"target_forward_map": self.forward_map, "target_backward_map": self.backward_map}


def test_targets_that_take_gradients_reach_nothing(monkeypatch):
    monkeypatch.setattr(fb, "soft_update", lambda *networks: None)
    monkeypatch.setattr(fb, "torch", SimpleNamespace(no_grad=torch.enable_grad, bmm=torch.bmm))
    assert shares(trained(Chased, 300)).mean() < 0.3
