"""Nearest neighbours from a matrix product equal a brute-force loop."""

import math

import pytest
import torch

from cudc_bench.learning.knn import neighbour_distances


@pytest.mark.parametrize("exclude_self", [False, True])
@pytest.mark.parametrize("offset", [0.0, 100.0], ids=["centred", "far from the origin"])
def test_equals_a_loop(exclude_self, offset):
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 64, 5, generator=generator) + offset
    found = neighbour_distances(points, 12, exclude_self).sort(-1).values
    for member in range(2):
        for i in range(64):
            distances = sorted(
                math.dist(points[member, i].tolist(), points[member, j].tolist()) for j in range(64) if not (exclude_self and i == j)
            )
            torch.testing.assert_close(found[member, i], torch.tensor(distances[:12]), atol=1e-4, rtol=1e-4)


def test_a_point_is_at_distance_zero_from_itself_and_its_copies_are_within_the_rounding_of_the_squares():
    points = torch.randn(1, 8, 30, generator=torch.Generator().manual_seed(0)) * 100
    points[0, 1] = points[0, 0]
    assert neighbour_distances(points, 1).max() == 0.0
    largest = (points - points.mean(1, keepdim=True)).norm(dim=-1).max().item()
    copies = neighbour_distances(points, 1, exclude_self=True)[0, :2]
    others = neighbour_distances(points, 1, exclude_self=True)[0, 2:]
    assert copies.max() <= 1e-3 * largest
    assert others.min() > 0.1 * largest
