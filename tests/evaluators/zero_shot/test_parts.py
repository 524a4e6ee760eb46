"""What learners without rewards are made of, at its edges: vectors that are zero, or that depend on one another."""

import torch

from cudc_bench.evaluators.successor_features import whitened
from cudc_bench.evaluators.zero_shot import least_squares, normalised, off_diagonal, on_diagonal

from ..helpers import make


def normal(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def test_whitening_is_a_product_with_the_pseudo_inverse():
    vectors = normal(2, 200, 6) @ normal(2, 6, 6) + normal(2, 1, 6)
    moments = vectors.transpose(1, 2) @ vectors / 200
    expected = vectors @ torch.linalg.pinv(moments)
    # The ridge shortens what varies least.
    found = whitened(vectors)
    assert torch.nn.functional.cosine_similarity(found, expected, dim=-1).min() > 0.99
    # One member has another's vectors a thousand times as long: nothing of that is left.
    torch.testing.assert_close(normalised(whitened(1000 * vectors)), normalised(found), atol=1e-4, rtol=1e-4)


def test_whitening_bears_fewer_vectors_than_dimensions_and_none_at_all():
    vectors = torch.tensor([[[1.0], [2.0], [-3.0]]]) * torch.tensor([1.0, -1.0, 2.0, 0.0, 5.0])  # without any rounding
    found = normalised(whitened(vectors))
    assert torch.isfinite(found).all()
    # All vary in one direction, and so does what comes of them.
    torch.testing.assert_close(found, normalised(vectors), atol=1e-5, rtol=1e-5)
    assert torch.equal(whitened(torch.zeros(1, 4, 3)), torch.zeros(1, 4, 3))


def test_least_squares_takes_the_shortest_of_several_solutions():
    one = normal(1, 50, 1)
    weights = least_squares(torch.cat([one, one], -1), 3.0 * one.transpose(1, 2))
    torch.testing.assert_close(weights, torch.tensor([[[1.5, 1.5]]]))
    assert torch.equal(least_squares(normal(2, 50, 4), torch.zeros(2, 3, 50)), torch.zeros(2, 3, 4))


def test_means_on_and_off_the_diagonal():
    matrix = torch.tensor([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 10.0]]])
    torch.testing.assert_close(on_diagonal(matrix), torch.tensor([16 / 3]))
    torch.testing.assert_close(off_diagonal(matrix), torch.tensor([30 / 6]))


def test_the_z_of_a_minibatch_are_others_embeddings_and_uniform_on_the_sphere():
    agent = make("fb", (1, 2), z_dim=5, z_mix=0.25)
    embedded = normalised(torch.arange(1.0, 20_001.0).view(2, 2000, 5).sin())
    z = agent.task_vectors(embedded)
    torch.testing.assert_close(z.norm(dim=-1), torch.full((2, 2000), 5**0.5))
    for member in (0, 1):
        same = (z[member, :, None] == embedded[member]).all(-1)
        assert abs(same.any(1).double().mean() - 0.25) < 0.04
        assert same.sum(0).max() == 1  # none is given twice
        assert same.diagonal().double().mean() < 0.01  # and hardly any to itself
        uniform = z[member][~same.any(1)]
        assert uniform.mean(0).abs().max() < 0.1
        torch.testing.assert_close(uniform.T @ uniform / len(uniform), torch.eye(5), atol=0.12, rtol=0)
