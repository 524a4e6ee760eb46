"""How k moves: with what a method sees in its minibatches, as the paper's Algorithm 1 has it, or by draws.

Everything is a tensor that changes in place, so that nothing waits for the device and a graph can repeat it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor

from cudc_bench.artefacts.k_schedule import summarise
from cudc_bench.learning.networks import MemberRandom

from .ddpg import DDPG

# The hyperparameter below which each rule counts what it looks at, and what the record of growth calls the mean of that.
_THRESHOLDS = {"weight": "c_w", "reward": "c_r", "error": "c_e"}
_MEANS = {"weight": "mean_w", "reward": "mean_reward", "error": "mean_error"}
_MEASURED = frozenset({"reward", "error"})  # rules whose thresholds a pilot measures
_DRAWN = frozenset({"uniform", "normal"})  # rules that look at nothing


class MovingHorizon(DDPG):
    """A backbone whose k moves inside K = {horizon, ..., k_max} by the rule that the configuration names.

    A method calls ``build_horizon`` in ``build`` and ``move_horizon`` in ``after_auxiliary_step``. Its configuration has ``k_max``,
    ``k_rule``, the thresholds ``c_w``, ``c_r`` and ``c_e``, the share ``c_k``, ``patience``, ``min_dwell``, ``threshold_dwell``,
    ``normal_std`` and ``normal_steps``, as :class:`.cudc.CUDCConfig` explains them.
    """

    ignored_by_pilot: ClassVar[frozenset[str]] = frozenset(
        {"c_w", "c_r", "c_e", "c_k", "patience", "min_dwell", "threshold_dwell", "normal_std", "normal_steps"}
    )

    @classmethod
    def measured_by_pilot(cls, config: Any) -> str | None:
        return _THRESHOLDS[config.k_rule] if config.k_rule in _MEASURED else None

    @property
    def max_horizon(self) -> int:
        return int(self.config.k_max)

    @property
    def horizons(self) -> int:
        """|K|."""
        return int(self.config.k_max - self.config.horizon + 1)

    def build_horizon(self, members: int) -> None:
        """Make what the rule remembers."""
        if self.config.k_rule in _DRAWN:
            self.random["k"] = MemberRandom(self.seeds, "horizon", self.device)
        self.register_buffer("in_a_row", torch.zeros(members, dtype=torch.int64, device=self.device))
        self.register_buffer("last_change", torch.zeros(members, dtype=torch.int64, device=self.device))
        # One row for each possible increment: number of the update, p and the signal's mean at that moment.
        self.register_buffer("increments", torch.full((members, self.horizons, 3), -1.0, device=self.device))

    in_a_row: Tensor
    last_change: Tensor
    increments: Tensor

    def move_horizon(self, signal: Tensor | None) -> Tensor | None:
        """Set k of the next minibatch.

        Args:
            signal: what the rule compares with its threshold (E, B); None where the method has nothing for it to look at, and k stays.

        Returns:
            p (E,), the share below the threshold; None if the rule looked at nothing.
        """
        config = self.config
        if config.k_rule in _DRAWN:
            self.k.copy_(self._drawn_horizon())
        if config.k_rule in _DRAWN or signal is None:
            return None
        low = (signal < getattr(config, _THRESHOLDS[config.k_rule])).float().mean(1)
        self._adapt_horizon(low, signal.mean(1))
        return low

    def _adapt_horizon(self, low: Tensor, mean: Tensor) -> None:
        """k <- k + 1 where p > C_k (paper, Algorithm 1)."""
        config = self.config
        self.in_a_row.copy_(torch.where(low > config.c_k, self.in_a_row + 1, 0))
        dwell = max(config.min_dwell, config.threshold_dwell if self.measured_by_pilot(config) else 0)
        dwelt = (self.updates - self.last_change) * self.sizes.update_every >= dwell
        grow = (self.in_a_row >= config.patience) & dwelt & (self.k < config.k_max)
        row = (self.k - config.horizon)[:, None, None].expand(-1, 1, 3)
        seen = torch.stack([self.updates.float().expand_as(mean), low, mean], dim=-1)[:, None]
        self.increments.scatter_(1, row, torch.where(grow[:, None, None], seen, self.increments.gather(1, row)))
        self.last_change.copy_(torch.where(grow, self.updates, self.last_change))
        self.in_a_row.masked_fill_(grow, 0)
        self.k += grow

    def _drawn_horizon(self) -> Tensor:
        """k of the next minibatch, one for each member: uniform on K, or round(N(μ_t, σ²)) kept inside K."""
        config = self.config
        if config.k_rule == "uniform":
            drawn = config.horizon + (self.random["k"].uniform() * self.horizons).long()
        else:
            steps = self.sizes.seed_steps + (self.updates + 1) * self.sizes.update_every
            mean = config.horizon + (config.k_max - config.horizon) * steps / config.normal_steps
            drawn = (mean + config.normal_std * self.random["k"].normal()).round().long()
        return drawn.clamp(config.horizon, config.k_max)

    def summary(self) -> list[dict[str, Any]]:
        """Every increment of k as (step, old k, new k, p, mean of what the rule looks at), and whether the schedule is suspect.

        Suspect: k grew in the first twentieth of the run, or reached its bound within a tenth of the run of its first growth (50K and
        100K of the paper's 1M environment steps). The criterion looks at one minibatch, so a schedule this early says more about the
        thresholds than about reachability.
        """
        found = []
        looked_at = _MEANS.get(self.config.k_rule, _MEANS["weight"])
        for member in self.increments.tolist():
            changes = []
            for row, (update, p, mean) in enumerate(member):
                if update >= 0:
                    step = self.sizes.seed_steps + int(update) * self.sizes.update_every
                    k = self.config.horizon + row
                    changes.append({"step": step, "old_k": k, "new_k": k + 1, "p": p, looked_at: mean})
            at_bound = len(changes) == self.horizons - 1 and len(changes) > 1
            found.append(summarise(changes, at_bound, self.sizes.steps))
        return found
