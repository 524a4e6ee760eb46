"""The backbone on a problem whose answer is known; its formulas are held in test_oracles.py."""

import torch

from cudc_bench.collectors.base import Sizes
from cudc_bench.collectors.ddpg import DDPG, DDPGConfig

from .helpers import batch_for


class Known(DDPG):
    """Rewards closeness of the action to (0.5, -0.5)."""

    family = citation = "test"

    def reward(self, batch):
        return -(batch.action - torch.tensor([0.5, -0.5])).square().sum(-1)


def test_learns_the_action_that_is_rewarded():
    config = DDPGConfig(width=32, batch_size=32, learning_rate=3e-3, discount=0.5)
    agent = Known(Sizes("walker", 4, 2, 100, 10, 2), config, [1, 2])
    for step in range(1000):
        agent.update(batch_for(agent, size=64, seed=step))
    actions = agent.actor(torch.randn(2, 256, 4)).detach()
    torch.testing.assert_close(actions.mean(1), torch.tensor([[0.5, -0.5]] * 2), atol=0.1, rtol=0)
