"""How an algorithm is trained and evaluated, offline or online: what its run is told, and what its record must therefore hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import Field

from cudc_bench.errors import UsageError
from cudc_bench.settings.config import ADDED_LATER, Config, NonNegativeFloat, NonNegativeInt, PositiveInt, Precision, as_dict, build
from cudc_bench.settings.profiles import PAPER_STEPS, Profile


@dataclass(frozen=True)
class EvaluateConfig(Config):
    """How long an agent trains and how often it is evaluated (paper and ExORL).

    Attributes:
        gradient_steps: updates in all.
        evaluate_every: updates between two evaluations; there is one before the first update and one after the last, too.
        evaluation_episodes: episodes of each evaluation, with the deterministic policy.
        final_episodes: episodes of each of the further, larger evaluations at the end of the training.
        final_evaluations: how many of these there are, at the last evaluation points, the last of them after the last update; as many as
            there are points where those after the first update are fewer. Tables use their mean for the last milestone.
        milestones: gradient steps whose scores go into tables; "computational efficiency" and "learning performance" in the paper.
        precision: of wide matrix products in updates: float32, bf16, or TF32 on CUDA.
    """

    gradient_steps: PositiveInt = 500_000
    evaluate_every: PositiveInt = 10_000
    evaluation_episodes: PositiveInt = 10
    final_episodes: PositiveInt = 50
    milestones: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (100_000, 500_000)
    final_evaluations: PositiveInt = 3
    precision: Precision = field(default="float32", metadata=ADDED_LATER)

    @property
    def points(self) -> list[int]:
        """The gradient steps after which the policy is evaluated, in their order, from 0 to the last."""
        return [*range(0, self.gradient_steps, self.evaluate_every), self.gradient_steps]

    @property
    def final_points(self) -> list[int]:
        """Those of the larger evaluations."""
        return self.points[1:][-self.final_evaluations :]


# What runs did whose records do not say so: they were made before it could be set, and the default is another now.
BEFORE: Mapping[str, Any] = {"final_evaluations": 1}


def in_full(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """A record's hyperparameters, and with them what its run did without their saying so."""
    return {**BEFORE, **hyperparameters}


@dataclass(frozen=True)
class OnlineConfig(Config):
    """How long an agent trains on a task itself, collecting its own data, and how often it is evaluated.

    Attributes:
        steps: environment steps, as many as a dataset has.
        seed_steps: steps of uniformly random actions before the first update.
        update_every: environment steps for each update.
        exploration_std: of the Gaussian noise around the policy's actions while it collects, as collectors have it.
        evaluations: how many there are after the first, which comes before any step: at equal distances, the last after the last step.
        evaluation_episodes: episodes of each evaluation, with the deterministic policy.
        final_episodes: episodes of a further evaluation after the last step, and of each floor.
        precision: of wide matrix products in updates: float32, bf16, or TF32 on CUDA.
    """

    steps: PositiveInt = PAPER_STEPS
    seed_steps: NonNegativeInt = 4_000
    update_every: PositiveInt = 2
    exploration_std: NonNegativeFloat = 0.2
    evaluations: PositiveInt = 10
    evaluation_episodes: PositiveInt = 10
    final_episodes: PositiveInt = 50
    precision: Precision = field(default="float32", metadata=ADDED_LATER)

    @property
    def points(self) -> list[int]:
        """The environment steps after which the policy is evaluated, in their order, from 0 to the last."""
        return list(dict.fromkeys(index * self.steps // self.evaluations for index in range(self.evaluations + 1)))


def check_milestones(loop: EvaluateConfig) -> None:
    """Refuse milestones at which nothing is evaluated.

    Raises:
        UsageError: names the milestone.
    """
    for milestone in loop.milestones:
        on_the_way = milestone % loop.evaluate_every == 0 and milestone <= loop.gradient_steps
        if not (on_the_way or milestone == loop.gradient_steps):
            raise UsageError(
                f"the milestone {milestone:,} is never evaluated: there is an evaluation every {loop.evaluate_every:,} steps "
                f"up to {loop.gradient_steps:,}; set milestones=[a,b] to fit."
            )


def profile_values(profile: Profile, gradient_steps: int) -> dict[str, Any]:
    """A profile's values for a training of that many steps: a schedule lasts as long as the run."""
    return dict(profile.evaluate) | {"schedule_steps": gradient_steps}


def plain_values(kind: Any, profile: Profile, gradient_steps: int, later: bool = True) -> Mapping[str, Any]:
    """All hyperparameters of an algorithm at a profile, from which a record's ``overrides`` say what differs.

    Args:
        kind: a registered evaluator.
        profile: the set of hyperparameters.
        gradient_steps: how long the run is.
        later: also the defaults of ``ADDED_LATER`` fields, which records leave out.
    """
    return as_dict(build(EvaluateConfig, profile.evaluate), kind.configure(profile_values(profile, gradient_steps)), later=later)
