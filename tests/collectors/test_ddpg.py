"""The backbone against NumPy, and on a problem whose answer is known."""

import numpy as np
import pytest
import torch

from cudc_bench.collectors.base import Space
from cudc_bench.collectors.ddpg import DDPG, DDPGConfig

from .helpers import batch_for


class Known(DDPG):
    """Rewards closeness of the action to (0.5, -0.5)."""

    family = citation = "test"
    weight = None

    def reward(self, batch):
        return -(batch.action - torch.tensor([0.5, -0.5])).square().sum(-1)

    def sample_weight(self, batch):
        return self.weight


def make(seeds=(1,), **settings):
    config = DDPGConfig(**{"width": 16, "batch_size": 32, "learning_rate": 1e-3} | settings)
    return Known(Space("walker", 4, 2, 100, 10, 2), config, list(seeds))


def numpy_layers(module, x):
    """Trunk, hidden layer and output of a stack of one, by hand."""
    p = [parameter.detach().numpy()[0].astype(np.float64) for parameter in module.parameters()]
    x = x @ p[0] + p[1]
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * p[2] + p[3]
    x = np.maximum(np.tanh(x) @ p[4] + p[5], 0)
    return x @ p[6] + p[7]


def as_numpy(batch):
    return (x[0].numpy().astype(np.float64) for x in (batch.observation, batch.action, batch.next_observation))


@pytest.mark.parametrize("horizon", [3, 4, 5, 6])
@pytest.mark.parametrize("td_discount", ["gamma_pow_k", "gamma"])
def test_target_and_losses_equal_the_formula(horizon, td_discount):
    agent = make(noise_std=0.0, horizon=horizon, td_discount=td_discount, discount=0.9)
    batch = batch_for(agent, measure=True)
    s, a, following = as_numpy(batch)
    discount = 0.9**horizon if td_discount == "gamma_pow_k" else 0.9
    next_action = np.tanh(numpy_layers(agent.actor, following))
    r = -((a - [0.5, -0.5]) ** 2).sum(-1)
    y = r + discount * numpy_layers(agent.target_critic, np.concatenate([following, next_action], -1)).min(-1)
    q = numpy_layers(agent.critic, np.concatenate([s, a], -1))
    critic_loss = ((q[:, 0] - y) ** 2).mean() + ((q[:, 1] - y) ** 2).mean()
    own_action = np.tanh(numpy_layers(agent.actor, s))
    metrics = agent.update(batch)
    assert metrics["critic_loss"].item() == pytest.approx(critic_loss, rel=1e-4)
    assert metrics["q"].item() == pytest.approx(q.mean(), rel=1e-4)
    # The actor learns from the critic after its step.
    actor_loss = -numpy_layers(agent.critic, np.concatenate([s, own_action], -1)).min(-1).mean()
    assert metrics["actor_loss"].item() == pytest.approx(actor_loss, rel=1e-4)


def test_weights_of_one_change_nothing():
    plain, weighted = make(), make()
    batch = batch_for(plain, measure=True)
    weighted.weight = torch.ones(1, 32)
    for key, value in plain.update(batch).items():
        torch.testing.assert_close(value, weighted.update(batch_for(weighted, measure=True))[key] if key == "reward" else value)
    for a, b in zip(plain.parameters(), weighted.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_a_weight_of_zero_removes_a_sample():
    agents = make(noise_std=0.0), make(noise_std=0.0)
    for agent, value in zip(agents, (0.0, 50.0), strict=True):
        agent.weight = torch.ones(1, 32)
        agent.weight[0, 7] = 0.0
        batch = batch_for(agent)
        # What the ignored sample says makes no difference.
        batch.observation[0, 7] = value
        batch.action[0, 7] = 0.01 * value
        agent.update(batch)
    for a, b in zip(*(agent.parameters() for agent in agents), strict=True):
        torch.testing.assert_close(a, b)


def test_actor_step_leaves_the_critic_and_the_critic_step_leaves_the_actor():
    agent = make()
    critic = [p.clone() for p in agent.critic.parameters()]
    agent._update_actor(batch_for(agent), None)
    assert all(torch.equal(a, b) for a, b in zip(critic, agent.critic.parameters(), strict=True))
    policy = [p.clone() for p in agent.actor.parameters()]
    agent._update_critic(batch_for(agent), torch.zeros(1, 32), None)
    assert all(torch.equal(a, b) for a, b in zip(policy, agent.actor.parameters(), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(critic, agent.critic.parameters(), strict=True))


def test_target_critic_moves_by_tau():
    agent = make(critic_tau=0.01)
    old = [p.clone() for p in agent.target_critic.parameters()]
    agent.update(batch_for(agent))
    for before, online, target in zip(old, agent.critic.parameters(), agent.target_critic.parameters(), strict=True):
        torch.testing.assert_close(target, 0.99 * before + 0.01 * online)


def test_learns_the_action_that_is_rewarded():
    agent = make(seeds=(1, 2), width=32, learning_rate=3e-3, discount=0.5)
    for step in range(1000):
        agent.update(batch_for(agent, size=64, seed=step))
    actions = agent.actor(torch.randn(2, 256, 4)).detach()
    torch.testing.assert_close(actions.mean(1), torch.tensor([[0.5, -0.5]] * 2), atol=0.1, rtol=0)
