"""Nearest-neighbour distances inside a minibatch, from a matrix product.

A broadcast (B, B, D) tensor would need 2.4 GB at the paper's sizes; |u|² + |v|² - 2 u·v needs (B, B).
"""

from __future__ import annotations

import torch
from torch import Tensor


@torch.no_grad()
def neighbour_distances(points: Tensor, neighbours: int, exclude_self: bool = False, among: Tensor | None = None) -> Tensor:
    """Euclidean distances from each point to its nearest ones in the same minibatch, or among other points.

    Args:
        points: (E, B, D).
        neighbours: how many, at most B.
        exclude_self: leave out the point itself, which otherwise counts as the nearest, at distance 0; among others the one in its place.
        among: (E, M, D), to search there instead of in the minibatch; then no point is its own neighbour.

    Returns:
        (E, B, neighbours), in no particular order. Exact to about 1e-6 of the largest squared norm around the mean before the root
        is taken, so that two equal points can seem to be a thousandth of that norm apart. Differences of the chosen pairs would be
        exact, and cost up to 5 % of a CUDC update.
    """
    # Distances do not change by a shift; small norms lose fewer digits in the difference of squares.
    mean = points.mean(1, keepdim=True)
    centred = points - mean
    others = centred if among is None else among - mean
    squared = torch.baddbmm(others.square().sum(-1)[:, None, :], centred, others.transpose(1, 2), alpha=-2.0)
    squared += centred.square().sum(-1)[:, :, None]
    if exclude_self or among is None:
        squared.diagonal(dim1=1, dim2=2).fill_(torch.inf if exclude_self else 0.0)
    nearest = squared.topk(neighbours, dim=-1, largest=False, sorted=False).values
    return nearest.clamp_(min=0.0).sqrt_()


def normalised_entropy_reward(distances: Tensor, scale: Tensor, floor: float) -> Tensor:
    """A particle's entropy, with distances in running units (APS and CIC in their authors' code).

    Args:
        distances: (E, B, neighbours).
        scale: (E,), what divides them.
        floor: subtracted after that; what falls below 0 becomes 0.

    Returns:
        log(1 + mean) (E, B).
    """
    return (distances / scale[:, None, None] - floor).clamp(min=0.0).mean(-1).log1p()
