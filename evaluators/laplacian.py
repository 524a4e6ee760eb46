"""Laplacian features: what changes slowly along the data's ways (Wu, Tucker and Nachum 2019; Touati, Rapin and Ollivier 2023)."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from cudc_bench.learning.networks import Activation, MemberRandom
from cudc_bench.learning.replay import Batch

from .successor_features import SuccessorFeatures, SuccessorFeaturesConfig
from .zero_shot import features, normalised, orthonormality


class Laplacian(SuccessorFeatures):
    """Successor features of eigenfunctions of the Laplacian of the data's walk: normalised φ with ‖φ(s) − φ(s')‖² small and φ orthonormal.

    As in HILP's code, which has it from controllable_agent: the squared distance is averaged over φ's dimensions, beside an orthonormality
    loss of 2 (½ off[C²] − diag(C)) of φ(s). Unlike theirs: a ridge in place of a pseudo-inverse where states become tasks.
    """

    config_class: ClassVar[type] = SuccessorFeaturesConfig
    citation = "Wu et al. 2019; Touati et al. 2023"
    paper = "https://arxiv.org/abs/2209.14935"
    summary = "successor features of the data's Laplacian"

    def build_features(self, random: MemberRandom) -> None:
        config = self.config
        self.map = nn.Sequential(features(random, self.observation, config.feature_width, config.z_dim), Activation(normalised))
        self.add_optimiser("features", [self.map], config.feature_rate * config.learning_rate)

    def features(self, observation: Tensor) -> Tensor:
        found: Tensor = self.map(observation)
        return found

    def feature_loss(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        of_state, of_next = self.map(torch.cat([batch.observation, batch.next_observation], 1)).chunk(2, 1)
        change = (of_state - of_next).square().mean((1, 2))
        ortho_loss = 2.0 * orthonormality(of_state)
        return change + ortho_loss, {"change": change.detach(), "ortho_loss": ortho_loss.detach()}
