"""What every collector offers to the collection loop."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from cudc_bench.learning.learner import MemberStack
from cudc_bench.settings.config import build
from cudc_bench.settings.profiles import PAPER_STEPS, schedules


@dataclass(frozen=True)
class Sizes:
    """The sizes that a method is built for.

    Attributes:
        domain: its name.
        observation: S.
        action: A.
        episode_length: T.
        seed_steps: environment steps of uniformly random actions before the first update.
        update_every: environment steps for each update.
        steps: environment steps of the whole run; the paper's where nobody says.
    """

    domain: str
    observation: int
    action: int
    episode_length: int
    seed_steps: int
    update_every: int
    steps: int = PAPER_STEPS


class Collector(MemberStack):
    """A stack of E independent explorers, one for each seed.

    Class attributes, beside those of every stack:
        domain_values: hyperparameters that the method's paper sets per domain; ``values`` win over them.
        ignored_by_pilot: hyperparameters that have no effect while a pilot runs (see ``measured_by_pilot``).
        category: one of ``CATEGORIES`` of :mod:`cudc_bench.settings.described`, by which lists of methods are grouped.
        family: how it explores, for lists and tables.
        learns: False if ``update`` never has anything to do.
    """

    domain_values: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    ignored_by_pilot: ClassVar[frozenset[str]] = frozenset()
    category: ClassVar[str] = "other"
    family: ClassVar[str]
    learns: ClassVar[bool] = True

    def __init__(self, sizes: Sizes, config: Any, seeds: Sequence[int], device: torch.device | str = "cpu") -> None:
        super().__init__(config, seeds, device)
        self.sizes = sizes

    @classmethod
    def configure(cls, domain: str, profile: Mapping[str, Any] | None = None, settings: Mapping[str, Any] | None = None) -> Any:
        """The method's hyperparameters: its defaults, and over them those of the profile, the domain, the variant and the user.

        Raises:
            UsageError: a value is of the wrong type or out of range.
        """
        profile, config = profile or {}, cls.config_class
        return build(config, schedules(config, profile), profile, cls.domain_values.get(domain, {}), cls.values, settings or {})

    @classmethod
    def measured_by_pilot(cls, config: Any) -> str | None:
        """The hyperparameter that a pilot measures before the method can run, for which nobody knows a value; None for most methods.

        With 0 in its place the method runs as its own pilot: ``batch.signal`` (E, B) then holds, after each update, what the threshold
        will be compared with.
        """
        return None

    @property
    @abstractmethod
    def horizon(self) -> Tensor:
        """k of each member (E,), int64: how many steps lie between s and s' in the next minibatch."""

    @property
    def max_horizon(self) -> int:
        """The largest k that a member can reach; episodes must be at least this long."""
        return int(self.horizon.max())

    @property
    def min_horizon(self) -> int | None:
        """The smallest k' of the second state that comes with each transition, k' uniform from there to k; None where none is wanted."""
        return None

    @property
    def skill_size(self) -> int:
        """K, the size of the skill that actions follow; 0 for methods without skills."""
        return 0

    def next_skill(self, t: int) -> Tensor:
        """Called before the action at each step t of an episode; the skills (E, K) that the next actions follow."""
        raise NotImplementedError(f"{type(self).__name__} has no skills")

    def represent(self, observation: Tensor) -> Tensor | None:
        """The features (E, B, D) of observations (E, B, S) in which the method rewards; None if it rewards in none of its own."""
        return None

    @abstractmethod
    def act(self, observation: Tensor, explore: bool = True) -> Tensor:
        """Actions (E, A) in [-1, 1] for observations (E, S); deterministic without ``explore``."""

    def summary(self) -> list[dict[str, Any]]:
        """What the manifest keeps of each member's run beside the last metrics."""
        return [{} for _ in self.seeds]
