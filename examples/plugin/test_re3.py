"""RE3 against the contract of every collector, and its reward against an independent NumPy version."""

import numpy as np
import torch

from cudc_bench.collectors.contract import CollectorContract, batch_for, make


class TestRE3(CollectorContract):
    method = "re3"


def test_the_reward_is_the_papers() -> None:
    collector = make("re3", seeds=(1, 2), neighbours=4)
    batch = batch_for(collector)
    reward = collector.reward(batch)
    assert reward.shape == (2, 32)
    for member in range(2):
        weight, bias, head, shift, scale, offset = (p[member].double().numpy() for p in collector.encoder.parameters())
        hidden = np.maximum(batch.observation[member].double().numpy() @ weight + bias, 0) @ head + shift
        spread = np.sqrt(hidden.var(-1, keepdims=True) + 1e-5)
        features = np.tanh((hidden - hidden.mean(-1, keepdims=True)) / spread * scale + offset)
        distances = np.sort(np.linalg.norm(features[:, None] - features[None], axis=-1), axis=-1)
        # The first of the sorted distances is that of a point to itself.
        np.testing.assert_allclose(reward[member].numpy(), np.log(1 + distances[:, 4]), rtol=1e-4)


def test_the_encoder_stays_as_it_was_drawn() -> None:
    collector = make("re3")
    before = [parameter.clone() for parameter in (*collector.encoder.parameters(), *collector.actor.parameters())]
    collector.update(batch_for(collector))
    after = [*collector.encoder.parameters(), *collector.actor.parameters()]
    frozen = len(list(collector.encoder.parameters()))
    assert all(torch.equal(a, b) for a, b in zip(before[:frozen], after[:frozen], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(before[frozen:], after[frozen:], strict=True))
