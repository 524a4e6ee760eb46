"""References: what random actions and an agent trained online get on a task, between which its scores are normalised.

One JSON file for each (profile, domain, task), beside the run records of that task. It holds every episode's return of the floors (random
actions, and policies before any training) and of the ceiling (TD3 trained on the task's own reward, as ExORL's oracle is), with every
hyperparameter and the command that makes it again. The schema is versioned; unknown fields and numbers that are not finite are refused.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from cudc_bench.artefacts.ids import domain_namespace
from cudc_bench.artefacts.records import (
    REFERENCE,
    DomainName,
    Evaluation,
    Finite,
    Name,
    Strict,
    TrainingMetrics,
    first_fault,
    read_content,
    settings_text,
    visible_files,
)
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import unwritable, write_atomically
from cudc_bench.settings.config import as_dict, build, config_hash
from cudc_bench.settings.evaluate_config import OnlineConfig
from cudc_bench.settings.profiles import PROFILES
from cudc_bench.text import plain


@dataclass(frozen=True)
class Bounds:
    """Between what scores of a task are normalised: mean return of random actions (0) and of TD3 trained online on the task (1).

    Attributes:
        floor: mean return of uniformly random actions.
        untrained: of policies before any training.
        ceiling: of policies trained online.
        seeds: over how many of them each is the mean.
    """

    floor: float
    untrained: float
    ceiling: float
    seeds: int

    def normalise(self, score: float) -> float:
        """0 for the floor, 1 for the ceiling; a score may lie outside of them."""
        return (score - self.floor) / (self.ceiling - self.floor)


class ReferenceRun(Strict):
    """What came out for one seed.

    Attributes:
        seed: of the random actions, of the agent's weights and of its training.
        random: undiscounted returns of episodes of uniformly random actions.
        untrained: of the policy before its first update, whose weights are this seed's.
        curve: evaluations in the order of their environment steps; the first before any, the last after the last.
        final: a further, larger evaluation after the last step.
        metrics: training metrics of the last update before each evaluation, by environment steps.
    """

    seed: Annotated[int, Field(ge=0)]
    random: Annotated[list[Finite], Field(min_length=1)]
    untrained: Annotated[list[Finite], Field(min_length=1)]
    curve: Annotated[list[Evaluation], Field(min_length=1)]
    final: Evaluation
    metrics: list[TrainingMetrics]


class Reference(Strict):
    """The floors and the ceiling of one task at one profile.

    Attributes:
        schema_version: of this format.
        domain, task: what was trained on.
        profile: of the training; its collection says how many steps.
        algorithm: what was trained.
        overrides: hyperparameters that differ from the profile; with any, this is not the profile's reference.
        hyperparameters: all of them.
        hyperparameters_hash: of ``hyperparameters``.
        runs: one for each seed.
        seconds: wall time of all runs together.
        versions: of Python and the packages that matter.
        commit: of this project's code, ``None`` when it is not run from a checkout.
        dirty: whether it had local changes.
        machine: processor, threads, device.
        command: makes this reference again.
        created: UTC time, ISO 8601.
    """

    schema_version: Literal[1] = 1
    domain: DomainName
    task: Name
    profile: Name
    algorithm: Literal["td3"] = "td3"
    overrides: dict[str, Any]
    hyperparameters: dict[str, Any]
    hyperparameters_hash: str
    runs: Annotated[list[ReferenceRun], Field(min_length=1)]
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    versions: dict[str, str]
    commit: str | None = None
    dirty: bool = False
    machine: dict[str, Any]
    command: str
    created: str

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> Reference:
        if self.hyperparameters_hash != config_hash(self.hyperparameters):
            raise ValueError("'hyperparameters_hash' is not that of the hyperparameters")
        if any(self.hyperparameters.get(name) != value for name, value in self.overrides.items()):
            raise ValueError("'overrides' say what the hyperparameters do not")
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError("a seed is there twice")
        try:
            loop = build(OnlineConfig, self.hyperparameters)
        except UsageError as error:
            raise ValueError(str(error)) from None
        for run in self.runs:
            if [evaluation.step for evaluation in run.curve] != loop.points or run.final.step != loop.steps:
                raise ValueError(f"seed {run.seed} was not evaluated where its hyperparameters say")
            if {len(evaluation.returns) for evaluation in run.curve} != {loop.evaluation_episodes} or any(
                len(returns) != loop.final_episodes for returns in (run.random, run.untrained, run.final.returns)
            ):
                raise ValueError(f"seed {run.seed} has not as many episodes as its hyperparameters say")
        return self

    @property
    def seeds(self) -> tuple[int, ...]:
        """Those of its runs."""
        return tuple(run.seed for run in self.runs)

    @property
    def bounds(self) -> Bounds:
        """The means over its runs; every run has as many episodes as the others."""
        return Bounds(
            _mean([_mean(run.random) for run in self.runs]),
            _mean([_mean(run.untrained) for run in self.runs]),
            _mean([run.final.mean for run in self.runs]),
            len(self.runs),
        )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def reference_path(results: Path, domain: str, task: str, profile: str) -> Path:
    """Where a reference is kept: ``results/<profile>/<domain>/<task>/reference.json``, beside the folders of the task's records."""
    return results.joinpath(profile, *domain_namespace(domain).split("/"), task, REFERENCE)


def write_reference(path: Path, reference: Reference) -> None:
    """Write a reference atomically: a reader sees the whole file or none.

    Raises:
        RunError: it cannot be written there.
    """
    try:
        write_atomically(path, reference.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise unwritable(f"the reference {path}", error) from None


def read_reference(path: Path) -> Reference:
    """Read and check one reference.

    Raises:
        RunError: the file is missing, is not JSON, does not fit the schema, or contradicts itself.
    """
    try:
        return Reference.model_validate_json(read_content(path))
    except ValidationError as error:
        raise RunError(f"{path} is not a reference: {first_fault(error)}.") from None


def read_references(folders: Iterable[Path]) -> tuple[dict[tuple[str, str, str], Bounds], tuple[str, ...]]:
    """The references of profiles below some folders.

    Args:
        folders: of results; a file that is reached twice is read once.

    Returns:
        {(profile, domain, task): bounds}, and one line for each file that cannot be used: it is no reference, it was made with settings
        that are not its profile's, nothing can be normalised by it, or there is a newer one.
    """
    found: dict[tuple[str, str, str], tuple[Path, Reference]] = {}
    problems = []
    paths = {os.path.realpath(path): path for folder in folders for path in visible_files(folder, REFERENCE)}
    for path in paths.values():
        try:
            reference = read_reference(path)
        except RunError as error:
            problems.append(str(error))
            continue
        if (why := _unusable(reference)) is not None:
            problems.append(f"{path} is left out: {why}")
            continue
        of = (reference.profile, reference.domain, reference.task)
        entries = sorted([*([found[of]] if of in found else []), (path, reference)], key=lambda entry: entry[1].created)
        found[of] = entries[-1]
        problems += [f"{old} is left out: {entries[-1][0]} is of the same task and not older." for old, _ in entries[:-1]]
    return {of: reference.bounds for of, (_, reference) in found.items()}, tuple(plain(problem) for problem in problems)


def _unusable(reference: Reference) -> str | None:
    """Why a reference is not that of its profile; None if it is."""
    if reference.overrides:
        return f"it was made with settings of its own ({settings_text(reference.overrides)})."
    if (profile := PROFILES.get(reference.profile)) is None:
        return f"there is no profile '{reference.profile:.80}'."
    usual = {**profile.collect, **profile.evaluate, **as_dict(build(OnlineConfig, profile.collect, profile.evaluate))}
    if other := {name: value for name, value in reference.hyperparameters.items() if name in usual and usual[name] != value}:
        return f"profile {reference.profile} does not have {settings_text(other)} any more."
    bounds = reference.bounds
    if not bounds.ceiling > bounds.floor:
        return f"its ceiling, {bounds.ceiling:g}, is not above its floor, {bounds.floor:g}."
    return None
