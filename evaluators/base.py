"""What every offline algorithm offers to the evaluation loop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.learner import MemberStack
from cudc_bench.settings.config import build


class Evaluator(MemberStack):
    """A stack of E independent offline agents, each with its own seed and data.

    Class attributes, beside those of every stack:
        summary: what it is, in a few words, for lists.
        learns_from_rewards: whether it trains on labelled datasets; one that does not is told of tasks afterwards, as a
            :class:`~cudc_bench.evaluators.zero_shot.ZeroShotLearner` is.
        wants_next_action: whether batches must hold the action after s'; transitions that end an episode are then never drawn.
    """

    summary: ClassVar[str] = ""
    learns_from_rewards: ClassVar[bool] = True
    wants_next_action: ClassVar[bool] = False

    def __init__(self, observation: int, action: int, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        """Build the agents for observations (S,) and actions (A,)."""
        super().__init__(config, seeds, device)

    @classmethod
    def configure(cls, profile: Mapping[str, Any] | None = None, settings: Mapping[str, Any] | None = None) -> Any:
        """The algorithm's hyperparameters: its defaults, and over them those of the profile, the variant and the user.

        Raises:
            UsageError: a value is of the wrong type or out of range.
        """
        return build(cls.config_class, profile or {}, cls.values, settings or {})

    @property
    @abstractmethod
    def policy(self) -> nn.Module:
        """The deterministic policies as one module, (E, n, S) -> (E, n, A), whose parameters and buffers have the member axis first."""

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """Deterministic actions (E, n, A) in [-1, 1] for observations (E, n, S)."""
        actions: Tensor = self.policy(observation)
        return actions
