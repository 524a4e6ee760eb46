"""AWAC against the contract of every offline algorithm, and its actor's loss against an independent NumPy version."""

import numpy as np
import torch

from cudc_bench.evaluators.contract import EvaluatorContract, batch_for, make


class TestAWAC(EvaluatorContract):
    algorithm = "awac"


def test_the_actors_loss_is_the_papers() -> None:
    agent, batch = make("awac", seeds=(1, 2), temperature=0.5), batch_for(make("awac", seeds=(1, 2)))
    drawn = agent.sample(batch.observation)
    agent.sample = lambda observation: drawn
    loss, _ = agent.actor_loss(batch)
    with torch.no_grad():
        mean, action = agent.actor(batch.observation).double().numpy(), batch.action.double().numpy()
        data, own = (agent.critic(batch.observation, one).double().numpy().min(-1) for one in (batch.action, drawn))
    weight = np.minimum(np.exp((data - own) / 0.5), 20)
    likelihood = (-0.5 * ((action - mean) / 0.2) ** 2 - np.log(0.2) - 0.5 * np.log(2 * np.pi)).sum(-1)
    np.testing.assert_allclose(loss.detach().numpy(), -(weight * likelihood).mean(-1), rtol=1e-4)
