"""Uniformly random actions: the baseline that every exploring method must beat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import Config

from .base import Collector, Sizes


@dataclass(frozen=True)
class RandomConfig(Config):
    """Nothing to set."""


class Random(Collector):
    """Actions uniform in [-1, 1], independent of everything (paper, baseline "Random")."""

    config_class = RandomConfig
    family = "random"
    citation = "uniform actions"
    learns = False

    def __init__(self, sizes: Sizes, config: RandomConfig, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        super().__init__(sizes, config, seeds, device)
        self._random = MemberRandom(seeds, "act", device)

    @property
    def horizon(self) -> Tensor:
        return torch.ones(len(self.seeds), dtype=torch.int64, device=self.device)

    def act(self, observation: Tensor, explore: bool = True) -> Tensor:
        if not explore:
            return torch.zeros(len(self.seeds), self.sizes.action, device=self.device)
        return self._random.uniform(self.sizes.action) * 2.0 - 1.0

    def update(self, batch: Batch) -> dict[str, Tensor]:
        return {}

    def state_dict(self) -> dict[str, Any]:
        return {"act": self._random.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._random.load_state_dict(state["act"])
