"""Running mean and variance of a stream of numbers, one for each member."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class RunningMeanStd(nn.Module):
    """Mean and variance of all numbers seen, merged batch by batch (Chan, Golub, LeVeque 1979).

    They start as mean 0 and variance 1 with a weight of 1e-4, and each batch enters with its unbiased variance, as in URLB and in the
    code of CIC's authors.

    Attributes:
        mean: (E,).
        variance: (E,), the weighted mean of the batches' unbiased variances, plus the variance of their means.
        weight: how many numbers were seen, and the prior's weight.
    """

    mean: Tensor
    variance: Tensor
    weight: Tensor

    def __init__(self, members: int, device: torch.device | str) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(members, device=device))
        self.register_buffer("variance", torch.ones(members, device=device))
        self.register_buffer("weight", torch.full((), 1e-4, dtype=torch.float64, device=device))

    @torch.no_grad()
    def add(self, values: Tensor) -> None:
        """Take in a batch (E, …) of numbers."""
        values = values.flatten(1)
        count = values.shape[1]
        # One number has no unbiased variance.
        variance, mean = torch.var_mean(values, dim=1, correction=min(1, count - 1))
        share = (count / (self.weight + count)).to(values.dtype)
        difference = mean - self.mean
        self.variance += share * (variance - self.variance) + share * (1.0 - share) * difference.square()
        self.mean += share * difference
        self.weight += count
