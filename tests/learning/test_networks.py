"""Stacked networks: shapes, initial weights, independence of members."""

import numpy as np
import pytest
import torch
from torch import nn

from cudc_bench.learning.networks import (
    LayerNorm,
    Linear,
    MemberRandom,
    SharedTrunkCritic,
    TwinCritic,
    actor,
    adam,
    frozen,
    make_target,
    minimise,
    mlp,
    noisy_action,
    soft_update,
    trunk,
)

SEEDS = [3, 1, 4]


def weights(seeds=SEEDS):
    return MemberRandom(seeds, "weights")


BUILDERS = {
    "mlp": lambda random: mlp(random, 5, 7, 2, output=torch.tanh),
    "actor": lambda random: actor(random, 5, 2, 8),
    "layer norm": lambda random: LayerNorm(random, 5),
}
CRITICS = {
    "shared trunk": SharedTrunkCritic,
    "separate": lambda random, inputs, width: TwinCritic(random, lambda streams: mlp(streams, inputs, width, 1)),
}


@pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS)
def test_a_stack_equals_its_members_built_alone(build):
    stack = build(weights())
    x = torch.randn(len(SEEDS), 6, 5)
    together = stack(x)
    for index, seed in enumerate(SEEDS):
        alone = build(weights([seed]))
        for stacked, single in zip(stack.parameters(), alone.parameters(), strict=True):
            assert torch.equal(stacked[index], single[0])
        torch.testing.assert_close(together[index : index + 1], alone(x[index : index + 1]))


@pytest.mark.parametrize("kind", CRITICS.values(), ids=CRITICS)
def test_stacked_twin_critics_equal_their_members_built_alone(kind):
    stack = kind(weights(), 7, 8)
    observation, action = torch.randn(3, 6, 5), torch.randn(3, 6, 2)
    together = stack(observation, action)
    assert together.shape == (3, 6, 2)
    assert not torch.allclose(together[..., 0], together[..., 1])
    for index, seed in enumerate(SEEDS):
        rows = slice(index, index + 1)
        torch.testing.assert_close(together[rows], kind(weights([seed]), 7, 8)(observation[rows], action[rows]))


def test_the_first_of_twin_critics_alone_is_the_first_of_both():
    critic = TwinCritic(weights(), lambda streams: nn.Sequential(trunk(streams, 7, 64), *mlp(streams, 64, 64, 1)))
    observation, action = torch.randn(3, 32, 5), torch.randn(3, 32, 2, requires_grad=True)
    found = []
    for values in (critic(observation, action)[..., 0], critic.first(observation, action)):
        with frozen(critic):
            (gradient,) = torch.autograd.grad(values.square().mean(), action, retain_graph=True)
        found.append((values, gradient))
    for both, alone in zip(*found, strict=True):
        torch.testing.assert_close(both, alone)


@pytest.mark.parametrize("kind", CRITICS.values(), ids=CRITICS)
def test_no_gradient_leaves_its_member(kind):
    critic = kind(weights(), 7, 8)
    critic(torch.randn(3, 6, 5), torch.randn(3, 6, 2))[1].sum().backward()
    for parameter in critic.parameters():
        per_member = parameter.grad.view(3, -1).abs().sum(1)
        assert per_member[1] > 0
        assert per_member[0] == 0
        assert per_member[2] == 0


def test_heads_of_the_shared_trunk_stay_separate_while_training():
    critic = SharedTrunkCritic(weights([1]), 7, 8)
    optimiser = adam([critic], 1e-2)
    for _ in range(20):
        minimise((critic(torch.randn(1, 16, 5), torch.randn(1, 16, 2)) - 3.0).square().mean((1, 2)), optimiser)
    assert torch.count_nonzero(critic.out.weight * (1 - critic.head_mask)) == 0
    # Head 1 ignores head 0's half of the hidden layer.
    before = critic(*(x := (torch.randn(1, 4, 5), torch.randn(1, 4, 2))))
    with torch.no_grad():
        critic.hidden.weight[:, :, :8] += 1.0
    after = critic(*x)
    assert torch.equal(before[..., 1], after[..., 1])
    assert not torch.equal(before[..., 0], after[..., 0])


def test_initial_weights_are_orthogonal_with_zero_bias_in_every_block():
    layer = Linear(weights(), 16, 24, blocks=2)
    assert torch.count_nonzero(layer.bias) == 0
    for member in layer.weight:
        for block in member.chunk(2, dim=1):
            torch.testing.assert_close(block.T @ block, torch.eye(12), atol=1e-5, rtol=0)


def test_layer_norm_agrees_with_the_formula():
    layer = LayerNorm(weights([1]), 6)
    with torch.no_grad():
        layer.weight.uniform_(0.5, 2)
        layer.bias.uniform_(-1, 1)
    x = torch.randn(1, 4, 6)
    a = x.numpy()
    normal = (a - a.mean(-1, keepdims=True)) / np.sqrt(a.var(-1, keepdims=True) + 1e-5)
    expected = normal * layer.weight.detach().numpy() + layer.bias.detach().numpy()
    np.testing.assert_allclose(layer(x).detach().numpy(), expected, rtol=1e-5, atol=1e-6)


def test_frozen_weights_get_no_gradient_but_pass_it_on():
    critic = SharedTrunkCritic(weights([1]), 7, 8)
    action = torch.randn(1, 6, 2, requires_grad=True)
    with frozen(critic):
        critic(torch.randn(1, 6, 5), action).sum().backward()
    assert action.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in critic.parameters())
    assert all(parameter.requires_grad for parameter in critic.parameters())


def test_soft_update_is_the_moving_average_and_targets_take_no_gradient():
    online = mlp(weights([1]), 3, 4, 2)
    target = make_target(online, mlp(weights([2]), 3, 4, 2))
    old = [parameter.clone() for parameter in target.parameters()]
    for before, parameter in zip(old, online.parameters(), strict=True):
        assert torch.equal(before, parameter)
    with torch.no_grad():
        for parameter in online.parameters():
            parameter.add_(torch.randn_like(parameter))
    soft_update(online, target, 0.05)
    for before, now, moved in zip(old, online.parameters(), target.parameters(), strict=True):
        torch.testing.assert_close(moved, 0.95 * before + 0.05 * now)
        assert not moved.requires_grad


def test_noisy_action_clips_the_noise_clamps_the_action_and_passes_the_gradient():
    mean = torch.tensor([[[0.0, 0.95, -0.9]]], requires_grad=True)
    noise = torch.tensor([[[10.0, 1.0, -1.0]]])
    action = noisy_action(mean, noise, std=0.2, clip=0.3)
    torch.testing.assert_close(action.detach(), torch.tensor([[[0.3, 1 - 1e-6, -1 + 1e-6]]]))
    action.sum().backward()
    assert torch.equal(mean.grad, torch.ones_like(mean))
    unclipped = noisy_action(mean.detach(), noise, std=0.05, clip=None)
    torch.testing.assert_close(unclipped, torch.tensor([[[0.5, 1 - 1e-6, -0.95]]]))


def test_streams_of_seeds_and_purposes_differ_and_continue_from_their_state():
    a, b = MemberRandom([1, 2], "replay"), MemberRandom([1, 2], "noise")
    first = a.uniform(50)
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first, b.uniform(50))
    state = a.state_dict()
    expected = a.normal(7)
    other = MemberRandom([1, 2], "replay")
    other.load_state_dict(state)
    assert torch.equal(other.normal(7), expected)
    assert 0.0 <= first.min() <= first.max() < 1.0
