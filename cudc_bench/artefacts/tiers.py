"""Datasets of one online training, of the kinds that D4RL has (Fu et al. 2020): which there are, and which policy or data each is of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

TIERS = ("expert", "medium", "medium-replay", "replay")
SHARE = 1 / 3  # of the expert's score, which a medium policy passes


class LearningPoint(BaseModel):
    """An evaluation of the training.

    Attributes:
        step: environment steps until then.
        score: mean undiscounted return of the policy without noise.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    step: Annotated[int, Field(ge=0)]
    score: Annotated[float, Field(allow_inf_nan=False)]


class Tier(BaseModel):
    """Of which part of which online training a dataset is.

    Attributes:
        kind: ``expert`` and ``medium`` are of one policy, which acts with the noise that the training explored with; ``medium-replay`` and
            ``replay`` are what the training did itself.
        algorithm: that was trained.
        step: environment steps of training behind the policy, or all that the replay has.
        score: of the policy at that step in ``curve``.
        expert_score: mean return of the further, larger evaluation after the last step.
        curve: all evaluations of the training, in their order.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["expert", "medium", "medium-replay", "replay"]
    algorithm: str
    step: Annotated[int, Field(ge=1)]
    score: Annotated[float, Field(allow_inf_nan=False)]
    expert_score: Annotated[float, Field(allow_inf_nan=False)]
    curve: Annotated[list[LearningPoint], Field(min_length=2)]


def step_of(kind: str, curve: Sequence[LearningPoint], expert_score: float) -> int:
    """Where in the training the policy or the end of a dataset is.

    That of the medium ones is the first evaluation after the untrained policy's at which more than a third of the expert's score was
    reached, and the last one where that was at none.
    """
    *before, last = curve[1:]
    if kind in ("expert", "replay"):
        return last.step
    return next((point.step for point in before if point.score > SHARE * expert_score), last.step)
