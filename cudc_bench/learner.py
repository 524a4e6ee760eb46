"""What learns: the networks, optimisers and random streams of a stack of members, saved and restored as one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from cudc_bench.networks import MemberRandom, Trained, adam, minimise


class Learner(nn.Module):
    """Networks as modules, and beside them optimisers and streams by name.

    Attributes:
        random: streams that the state holds.
        optimisers: one for each loss.
    """

    def __init__(self) -> None:
        super().__init__()
        self.random: dict[str, MemberRandom] = {}
        self.optimisers: dict[str, torch.optim.Optimizer] = {}

    def add_optimiser(self, name: str, trained: Sequence[Trained], learning_rate: float) -> None:
        """One Adam over some modules, under a name."""
        self.optimisers[name] = adam(trained, learning_rate)

    def minimise(self, name: str, loss: Tensor) -> None:
        """One step of the optimiser of that name on the sum of the members' losses (E,)."""
        minimise(loss, self.optimisers[name])

    def state_dict(self) -> dict[str, Any]:  # type: ignore[override]
        """Parameters, buffers, optimisers and streams."""
        return {
            "networks": nn.Module.state_dict(self),
            "optimisers": {name: optimiser.state_dict() for name, optimiser in self.optimisers.items()},
            "random": {name: random.state_dict() for name, random in self.random.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:  # type: ignore[override]
        """Continue exactly where ``state_dict`` was taken."""
        nn.Module.load_state_dict(self, state["networks"])
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        for name, random in self.random.items():
            random.load_state_dict(state["random"][name])
