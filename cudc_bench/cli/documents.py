"""What commands say to scripts (``--json``): one document on standard output, whose fields the reference lists.

A field may come with a version; none goes or changes its meaning without ``schema_version`` saying so.
"""

from __future__ import annotations

import json
import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


# JSON has no numbers that are not finite.
Number = Annotated[float | None, BeforeValidator(_finite)]


class Document(BaseModel):
    """Base of what is printed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def to_json(document: Document) -> str:
    """A document in ASCII, which any terminal and any pipe carries; fields without a value are null."""
    return json.dumps(document.model_dump(mode="json"), indent=1, allow_nan=False)


def print_json(document: Document) -> None:
    """Print a document, and nothing else."""
    print(to_json(document))


class ListedMethod(Document):
    """A collector or an offline algorithm.

    Attributes:
        name: as on the command line.
        what: how it explores, or what it is in a few words.
        category: of a collector: knowledge, data or competence, as URLB has them, or other; null for an offline algorithm.
        citation: the paper.
        same_as: the name that stands for the same class, and comes first; null for most.
        package: the distribution that registers it, with its version.
    """

    name: str
    what: str
    category: str | None = None
    citation: str
    same_as: str | None = None
    package: str


class ListedDomain(Document):
    """A domain.

    Attributes:
        name: as on the command line.
        tasks: that datasets can be labelled for.
        quantities: physical ones that rewards are functions of.
        observation_size, action_size: of the spaces.
        episode_length: steps.
    """

    name: str
    tasks: list[str]
    quantities: list[str]
    observation_size: int
    action_size: int
    episode_length: int


class ListedProfile(Document):
    """A set of hyperparameters.

    Attributes:
        name: as on the command line.
        purpose: what it is for.
    """

    name: str
    purpose: str


class ListedDataset(Document):
    """A dataset of this project.

    Attributes:
        id: by which commands and Minari know it.
        domain: what was explored.
        task: that it is labelled for; null if it is task-agnostic.
        method: that collected it.
        source: who collected it, if it was imported; null if this project did.
        profile: of the collection.
        seed: of the collection.
        steps, episodes: how many there are.
        bytes: of its own files on the disk.
        base: the dataset that it is labelled from; null if it is task-agnostic.
        linked: whether it is of use only beside its base.
        parts: the datasets that a mixture, or its base, was made of; empty for others.
        fingerprint: of its arrays.
        created: UTC time, ISO 8601.
        notes: what to know of it; empty for most.
    """

    id: str
    domain: str
    task: str | None
    method: str
    source: str | None
    profile: str
    seed: int
    steps: int
    episodes: int
    bytes: int
    base: str | None
    linked: bool
    parts: list[str] = []
    fingerprint: str
    created: str
    notes: str


class ListedUnfinished(Document):
    """A dataset that is being made, or that was when its process ended.

    Attributes:
        id: that it will have.
        holder: the process that makes it now; null if none does.
        step: of its last checkpoint; null if it has none.
        bytes: of what there is of it.
    """

    id: str
    holder: str | None
    step: int | None
    bytes: int


class ListedRecords(Document):
    """Run records.

    Attributes:
        folder: where they are.
        records, references: how many there are.
    """

    folder: str
    records: int
    references: int


class Listing(Document):
    """What ``list --json`` prints. Sections that were not asked for are null.

    Attributes:
        schema_version: of this document.
        root: Minari's dataset root.
        methods: collectors, by name.
        domains: ours, then those of other packages.
        algorithms: for offline training, by name.
        profiles: from the largest to the smallest.
        datasets: in the order of their ids.
        unfinished: the same of those that are not complete.
        bytes: of these datasets together, and of what is unfinished.
        records: how many there are.
        left_out: one line for each plug-in or folder that cannot be used.
    """

    schema_version: Literal[1] = 1
    root: str
    methods: list[ListedMethod] | None = None
    domains: list[ListedDomain] | None = None
    algorithms: list[ListedMethod] | None = None
    profiles: list[ListedProfile] | None = None
    datasets: list[ListedDataset] | None = None
    unfinished: list[ListedUnfinished] | None = None
    bytes: int | None = None
    records: ListedRecords | None = None
    left_out: list[str] = Field(default_factory=list)


class DoctorCheck(Document):
    """One thing that was looked at.

    Attributes:
        name: of the check.
        ok: whether all is well.
        detail: what was found.
    """

    name: str
    ok: bool
    detail: str


class DoctorDocument(Document):
    """What ``doctor --json`` prints.

    Attributes:
        schema_version: of this document.
        ok: whether all checks passed.
        checks: in the order in which they were made.
    """

    schema_version: Literal[1] = 1
    ok: bool
    checks: list[DoctorCheck]


class VerifiedCheck(Document):
    """One check that a dataset passed.

    Attributes:
        name: of the check.
        detail: what was checked, and how much of it.
    """

    name: str
    detail: str


class VerifiedDataset(Document):
    """One dataset that was looked at.

    Attributes:
        id: which.
        ok: whether it passed everything.
        problem: what is wrong with it; null if nothing is.
        fingerprint: of its arrays, computed anew; null if it failed.
        checks: that it passed; none are named of one that failed.
        proven, unproven: what these checks show, and what nothing can.
        seed: by which the simulated episodes were drawn; null where all were, or it failed.
    """

    id: str
    ok: bool
    problem: str | None = None
    fingerprint: str | None = None
    checks: list[VerifiedCheck] = Field(default_factory=list)
    proven: list[str] = Field(default_factory=list)
    unproven: list[str] = Field(default_factory=list)
    seed: int | None = None


class VerifyDocument(Document):
    """What ``verify --json`` prints.

    Attributes:
        schema_version: of this document.
        ok: whether all datasets passed.
        datasets: in the order in which they were asked for.
    """

    schema_version: Literal[1] = 1
    ok: bool
    datasets: list[VerifiedDataset]
