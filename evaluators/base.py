"""What every offline algorithm offers to the evaluation loop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from cudc_bench.replay import Batch


class Evaluator(ABC):
    """A stack of E independent offline agents, each with its own seed and data.

    Class attributes:
        config_class: the frozen dataclass of hyperparameters; its defaults are ExORL's.
        citation: the paper, for lists and tables.
    """

    config_class: ClassVar[type]
    citation: ClassVar[str]

    def __init__(self, observation: int, action: int, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        """Build the agents for observations (S,) and actions (A,)."""
        self.config = config
        self.seeds = tuple(seeds)
        self.device = torch.device(device)

    @abstractmethod
    def update(self, batch: Batch) -> dict[str, Tensor]:
        """One gradient step on a minibatch of one-step transitions; metrics are (E,) tensors when ``batch.measure`` is set."""

    @abstractmethod
    def act(self, observation: Tensor) -> Tensor:
        """Deterministic actions (E, n, A) for observations (E, n, S)."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that ``update`` changes."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
