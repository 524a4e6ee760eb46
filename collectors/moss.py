"""MOSS: a mixture of skills that seek and skills that avoid surprise (Zhao, Lin, Li, Liu, Huang 2022, arXiv 2210.06702)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from cudc_bench.learning.knn import neighbour_distances, normalised_entropy_reward
from cudc_bench.learning.networks import MemberRandom, Trainable
from cudc_bench.learning.replay import Batch

from .cic import CIC, CICConfig
from .diayn import skill_of


@dataclass(frozen=True)
class MOSSConfig(CICConfig):
    """The values of the authors' code.

    Attributes:
        knn_exclude_self: leave a state's own next state out of its neighbours.
        periods: of an episode, which explore and control in turn; the length of one is rounded down.
        skill_mode: how a skill says what it is for: exploring ones have their first half drawn and the others their last one, with zeros
            in the rest, or exploring ones are positive and the others negative.
    """

    skill_dim: Annotated[int, Field(ge=2, le=10**10)] = 32
    periods: Annotated[float, Field(ge=1, allow_inf_nan=False)] = 2.0
    skill_mode: Literal["half", "sign"] = "half"


class MOSS(CIC):
    """CIC whose agent seeks the entropy of states in one half of each episode, and in the other avoids it, with skills of other kinds.

    What a skill is for is chosen when it is drawn and stands in the skill, and so in the dataset: with a first number above 0 it explores
    (+ entropy), else it controls (- entropy).

    As in the authors' code: the entropy is that of states among next states, of both kinds together, in the embedding before its step;
    the running mean is subtracted from distances, and the running variance divides them, where the paper has a deviation. On Jaco an
    episode has one and a half periods. Unlike that code: as in CIC here, an action comes with the skill that it followed, the own pair's
    term is left out of the contrastive sum as it is, and batches enter the running variance with their unbiased one.
    """

    config_class: ClassVar[type] = MOSSConfig
    domain_values: ClassVar[Mapping[str, Mapping[str, Any]]] = {"jaco": {"periods": 1.5}}
    citation = "Zhao et al. 2022"
    paper = "https://arxiv.org/abs/2210.06702"

    def controls_at(self, t: int) -> bool:
        """Whether a skill that is drawn at step t of an episode is for control."""
        return bool(t // (self.sizes.episode_length // self.config.periods) % 2)

    def sample_skills(self, random: MemberRandom, t: int) -> Tensor:
        size, controls = self.config.skill_dim, self.controls_at(t)
        if self.config.skill_mode == "sign":
            # In (0, 1], so that every skill says what it is for.
            return (1.0 - random.uniform(size)) * (-1.0 if controls else 1.0)
        drawn = 1.0 - random.uniform(size - size // 2)
        zero = drawn.new_zeros(random.count, size // 2)
        return torch.cat([zero, drawn] if controls else [drawn, zero], dim=-1)

    def build(self, random: MemberRandom) -> list[Trainable]:
        length = self.sizes.episode_length
        if self.config.periods > length:
            raise ValueError(f"{self.config.periods:g} periods do not fit into an episode of {length} steps")
        return super().build(random)

    def reward(self, batch: Batch) -> Tensor:
        config = self.config
        states, following = batch.cache["states"]
        distances = neighbour_distances(states, config.neighbours, config.knn_exclude_self, among=following)
        self.moments.add(distances)
        entropy = normalised_entropy_reward(distances - self.moments.mean[:, None, None], self.scale, config.distance_floor)
        return torch.where(skill_of(batch)[..., 0] > 0, entropy, -entropy)
