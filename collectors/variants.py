"""CUDC's relatives by name: the rows of the paper's component studies, and controls that the paper lacks.

Each is a setting of the switches of ``CUDCConfig`` (or ``APTConfig``) and nothing else, so that ``--set`` can vary it further. Two names
for one setting are one class: ``cudc-reach`` is ``cudc-no-regularize``, ``cudc-no-vary`` is ``cudc-kmax3``, and ``cudc-kmax6`` and
``cudc-stopgrad`` are ``cudc``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from cudc_bench.learning.networks import MemberRandom, Trainable
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.config import WITH_STEPS, PositiveInt

from .apt import APT, APTConfig
from .cudc import CUDC

Values = Mapping[str, Any]

# From ICM and APT to CUDC, step by step (paper, section on the proposed components and its appendix)


class VaryICM(CUDC):
    """CUDC_vary^ICM: ICM with its own reward, but k grows, the forward model is told k, and another network infers it.

    Like ICM, it rewards what the updated networks predict badly.
    """

    family = "towards CUDC"
    values: ClassVar[Values] = {
        # Without an encoder the forward model's target has nothing to give a gradient to; a threshold is kept for it by this value.
        "encoder": "none", "action_encoder": False, "inverse": "actions", "reach": False, "regularize": False, "entropy": False,
        "state_target": "live", "prediction_error": "log", "beta": 0.0, "reward_after_update": True, "k_rule": "reward",
    }  # fmt: skip


class VaryAPT(CUDC):
    """CUDC_vary^APT: APT with its own reward, but k grows, the forward model is told k, and another network infers it.

    Like APT, it computes the reward from the updated networks, and its forward model's target has its gradient.
    """

    family = "towards CUDC"
    values: ClassVar[Values] = {
        "encoder": "apt", "action_encoder": False, "inverse": "actions", "reach": False, "regularize": False, "state_target": "live",
        "prediction_error": "none", "beta": 0.0, "reward_after_update": True, "k_rule": "reward",
    }  # fmt: skip


class Reward(CUDC):
    """CUDC_reward: CUDC_vary^APT with CUDC's reward, and the action encoder that its entropy needs.

    The inverse model still predicts raw actions. The forward model's target has no gradient, as CUDC's and unlike APT's: with it the
    entropy would be that of a representation of few dimensions (studies/cudc-representations.md). The reward comes before the update, as in
    the paper's Algorithm 1.
    """

    family = "towards CUDC"
    values: ClassVar[Values] = {
        "encoder": "apt", "inverse": "actions", "reach": False, "regularize": False, "k_rule": "reward",
    }  # fmt: skip


class Reach(CUDC):
    """CUDC_reach: CUDC without weights for critic and actor, which is what "without regularization" means in the paper, too."""

    family = "towards CUDC"
    values: ClassVar[Values] = {"regularize": False}


# CUDC without one of its parts (paper, appendix)


class NoEntropy(CUDC):
    """Without r_H: the reward is α r_E + β.

    With Walker's and Quadruped's α that is nearly the constant β; ``--set alpha=1 --set beta=0`` rewards r_E itself.
    """

    family = "CUDC less a part"
    values: ClassVar[Values] = {"entropy": False}


class NoPE(CUDC):
    """Without the prediction error: the reward is r_H + β."""

    family = "CUDC less a part"
    values: ClassVar[Values] = {"prediction_error": "none"}


class NoVary(CUDC):
    """With k = 3 throughout; the networks' code for k has one entry."""

    family = "CUDC less a part"
    values: ClassVar[Values] = {"k_max": 3}


class NoReach(CUDC):
    """Without the reachability module, and so without weights; k grows with the share of small forward errors."""

    family = "CUDC less a part"
    values: ClassVar[Values] = {"reach": False, "regularize": False, "k_rule": "error"}


class NoInverse(CUDC):
    """Without the inverse model and without the network that infers k."""

    family = "CUDC less a part"
    values: ClassVar[Values] = {"inverse": "none", "step_model": False}


# Other ways to choose k (paper, section on adjusting the k-step)


class UniformK(CUDC):
    """k is drawn for each update, uniformly from {3, ..., 6}."""

    family = "CUDC, other k"
    values: ClassVar[Values] = {"k_rule": "uniform"}


class NormalK(CUDC):
    """k is drawn for each update, normally (σ = 1) with a mean that rises from 3 to 6 over the run.

    The paper says no more than "normally with an increasing mean".
    """

    family = "CUDC, other k"
    values: ClassVar[Values] = {"k_rule": "normal"}


class KMax4(CUDC):
    """k at most 4."""

    family = "CUDC, other k"
    values: ClassVar[Values] = {"k_max": 4}


class KMax5(CUDC):
    """k at most 5."""

    family = "CUDC, other k"
    values: ClassVar[Values] = {"k_max": 5}


class KMax7(CUDC):
    """k at most 7."""

    family = "CUDC, other k"
    values: ClassVar[Values] = {"k_max": 7}


class KMax8(CUDC):
    """k at most 8."""

    family = "CUDC, other k"
    values: ClassVar[Values] = {"k_max": 8}


# What the paper does not have


class OneSetting(CUDC):
    """One setting for all domains, as every other method has: CUDC's values per domain are an advantage that others lack."""

    family = "CUDC, other reading"
    domain_values: ClassVar[Mapping[str, Values]] = {}
    values: ClassVar[Values] = {"alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2, "clip_high": 1.0, "c_w": 0.02}


class Live(CUDC):
    """L_fwd predicts z' with its gradient, as the paper prints it: shrinking z lowers it, too, and the forward model learns little."""

    family = "CUDC, other reading"
    values: ClassVar[Values] = {"state_target": "live"}


class Momentum(CUDC):
    """L_fwd predicts the momentum encoder's z'."""

    family = "CUDC, other reading"
    values: ClassVar[Values] = {"state_target": "momentum"}


class Literal(CUDC):
    """The paper's equations as printed, with gradients through the targets of both models; the action features then collapse."""

    family = "CUDC, other reading"
    values: ClassVar[Values] = {"state_target": "live", "action_target": "live"}


class KMix(CUDC):
    """L_k on second ends of the tuples at different k', so that the network that infers k has something to infer."""

    family = "CUDC, other reading"
    values: ClassVar[Values] = {"inverse_k_batch": "mixed"}


class APTK6(APT):
    """APT with transitions of 6 steps from the start: a longer bootstrap without any reachability module."""

    family = "control"
    values: ClassVar[Values] = {"horizon": 6}


@dataclass(frozen=True)
class APTScheduleConfig(APTConfig):
    """APT's values and a schedule.

    Attributes:
        k_steps: environment steps at which k grows by one; those of CUDC on Walker, read off the paper's figure.
    """

    k_steps: tuple[PositiveInt, ...] = field(default=(450_000, 650_000, 1_050_000), metadata=WITH_STEPS)


class APTSchedule(APT):
    """APT whose k grows when the paper's CUDC grew its own: the same longer bootstrap at the same time, without its cause."""

    config_class: ClassVar[type] = APTScheduleConfig
    family = "control"

    @property
    def max_horizon(self) -> int:
        return int(self.config.horizon) + len(self.config.k_steps)

    def build(self, random: MemberRandom) -> list[Trainable]:
        self.register_buffer("k_steps", torch.tensor(self.config.k_steps, dtype=torch.int64, device=self.device), persistent=False)
        return super().build(random)

    def after_auxiliary_step(self, batch: Batch) -> dict[str, Tensor]:
        step = self.sizes.seed_steps + (self.updates + 1) * self.sizes.update_every
        self.k.copy_((self.config.horizon + (step >= self.k_steps).sum()).expand(len(self.seeds)))
        return super().after_auxiliary_step(batch)

    k_steps: Tensor
