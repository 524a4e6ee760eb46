"""Learners in double precision, where rounding cannot hide a wrong formula."""

from __future__ import annotations

from typing import TypeVar

import torch

from cudc_bench.learning.learner import Learner

LearnerT = TypeVar("LearnerT", bound=Learner)


def in_precision(learner: LearnerT, dtype: torch.dtype) -> LearnerT:
    """The same learner with networks and optimisers in another precision; counts of steps stay as they are."""
    learner.to(dtype)
    for optimiser in learner.optimisers.values():
        for state in optimiser.state.values():
            state.update({key: value.to(dtype) for key, value in state.items() if key != "step"})
    return learner
