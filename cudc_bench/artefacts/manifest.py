"""The manifest: what a dataset is and where it came from, kept in its Minari metadata under one key.

The fingerprint is a hash of hashes. Each field (observations, actions, rewards, …) has a SHA-256 over its episodes in order; the
dataset's fingerprint is the SHA-256 over those. A relabelled dataset differs from its base in one field only, so its fingerprint is
known without reading the base again, and is the same whether it links to the base or is a standalone copy.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root
from cudc_bench.artefacts.tiers import Tier
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import check_folder, read_limited
from cudc_bench.settings.seeding import episode_seed

KEY = "cudc_bench"
IMPORTED_PROFILE = "imported"  # stands where the profile would, in a dataset that was not collected here
Source = Annotated[str, Field(pattern=r"^[A-Za-z0-9](?:[A-Za-z0-9 ._-]{0,30}[A-Za-z0-9])?$")]
MIXTURE = "mixture"  # the method of a mixture
MOST_PARTS = 100  # of one
_Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Base(BaseModel):
    """The task-agnostic dataset that a relabelled one was made from.

    Attributes:
        id, fingerprint: of that dataset.
        linked: whether arrays are links to that dataset's file; copies otherwise.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str
    fingerprint: _Sha256
    linked: bool


class Collected(BaseModel):
    """What the states and observations of a relabelled dataset were made with, by which they can be made again to the last bit or not.

    Attributes:
        versions, machine: of the base.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    versions: dict[str, str]
    machine: dict[str, Any]


class RewardFunction(BaseModel):
    """A user's own reward function that labelled a dataset (see ``cudc_bench.envs.rewards``).

    Attributes:
        reference: ``module:function``.
        sha256: of the function's source text.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    reference: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_.]*:[A-Za-z_][A-Za-z0-9_]*$", max_length=200)]
    sha256: _Sha256


class Import(BaseModel):
    """Where a dataset that was not collected here came from.

    Attributes:
        source: who collected it, such as ``"ExORL"``.
        files: how many files it was made from.
        sha256: SHA-256 over the output of ``sha256sum`` for those files in collection order, with their names alone.
        clipped: how many numbers of actions were beyond [-1, 1] by rounding, and were clipped.
        ignored: arrays of the files that were left out.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    source: Source
    files: int
    sha256: _Sha256
    clipped: int = 0
    ignored: list[str] = []


class PartOrigin(BaseModel):
    """A dataset of which a mixture has episodes, and all that is known of how it was collected.

    Attributes:
        id, fingerprint: of that dataset.
        method, seed, profile, overrides, hyperparameters, citation: as in its manifest.
        source: who collected it, if it was imported.
        collected: what its states and observations were made with.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: Annotated[str, Field(pattern=r"^[a-z0-9_/-]+-v[0-9]{1,6}$", max_length=500)]
    fingerprint: _Sha256
    # Names of columns, also in records of others.
    method: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    seed: Annotated[int, Field(ge=0)]
    profile: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    overrides: dict[str, Any] = {}
    hyperparameters: dict[str, Any] = {}
    citation: str = ""
    source: Source | None = None
    collected: Collected

    @property
    def label(self) -> str:
        """The method, with its source where this project did not collect it."""
        return self.method if self.source is None else f"{self.method} ({self.source})"


class Part(PartOrigin):
    """One of the equal parts of a mixture.

    Attributes:
        episodes: the numbers in that dataset of those that were taken, in their order.
    """

    episodes: Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]

    def episode_seed(self, number: int) -> int | None:
        """The seed that the environment of one of these episodes, by its place among them, was reset with; None of what was imported."""
        return None if self.source is not None else episode_seed(self.seed, "environment", self.episodes[number])


class Mixture(BaseModel):
    """Of which episodes a mixture is: the first of each part, then the second of each, and so on.

    Attributes:
        parts: in their order; each has equally many episodes, of equal length.
        ignored: infos that were left out, since not all parts have them, or not in one form.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    parts: Annotated[list[Part], Field(min_length=2, max_length=MOST_PARTS)]
    ignored: list[str] = []

    def origin(self, index: int) -> tuple[Part, int]:
        """The part that an episode is of, and how many episodes of that part come before it."""
        number, place = divmod(index, len(self.parts))
        return self.parts[place], number


def mixture_label(method: str, parts: Sequence[PartOrigin]) -> str:
    """The name of a mixture of some parts: ``"mixture (cudc, rnd)"``."""
    return f"{method} ({', '.join(sorted({part.label for part in parts}))})"


class Pilot(BaseModel):
    """A threshold that a method needed, and the pilot run that measured it (see ``cudc_bench.collectors.running.pilot``).

    Attributes:
        name, value: of the hyperparameter.
        method, domain, profile, overrides: what was run.
        key: hash of the settings for which the value holds; the length of the run and what has no effect in a pilot are left out.
        quantile: the value is this quantile of the medians of the minibatches.
        updates: how many minibatches there were.
        seed, first_step, last_step: of the run, and the environment steps between which these updates happened.
        versions, commit, dirty, machine, seconds, created, command: provenance, as of a dataset.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    value: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    method: str
    domain: str
    profile: str
    overrides: dict[str, Any] = {}
    key: str
    quantile: float
    updates: int
    seed: int
    first_step: int
    last_step: int
    versions: dict[str, str]
    commit: str | None = None
    dirty: bool = False
    machine: dict[str, Any]
    seconds: float
    created: str
    command: str


class Manifest(BaseModel):
    """What a dataset is.

    Attributes:
        schema_version: of this format.
        domain: what was explored.
        task: what rewards are of; None for a task-agnostic dataset, whose rewards are all 0.
        method: what explored.
        seed: of the collection; an imported dataset's is the number that it was given at import.
        steps, episodes: how many there are.
        profile: the named set of hyperparameters; ``"imported"`` for an imported dataset.
        overrides: hyperparameters that differ from the profile.
        hyperparameters: all of them; none are known for an imported dataset.
        hyperparameters_hash: of ``hyperparameters``.
        citation: the method's paper, as its plug-in names it.
        fields: SHA-256 of each field; ``fingerprint``: of all of them.
        final_state: SHA-256 of the collector's state after the last step (networks, optimisers, random streams), all members of its stack
            included; empty where it is not known. A relabelled dataset has its base's.
        base: of a relabelled dataset.
        collected: of a relabelled dataset, what its base was made with; None in those from before this was written down.
        reward: the user's function that labelled it, for a task that is none of the domain's own.
        pilot: where a threshold among the hyperparameters came from, for methods that need one measured.
        imported: where an imported dataset, or the base of a relabelled one, came from; None if this project collected it.
        mixture: of which episodes of which datasets a mixture is, or the base of a relabelled one; None if it is none.
        tier: of which part of which online training it is; None if it is of none. Its rewards are those of ``task``, and it has no base.
        diagnostics: the last line of the collection's diagnostics and the method's own summary; a relabelled dataset has its base's.
        versions: of Python and the packages that matter.
        commit: of this project's code, None when it is not run from a checkout.
        dirty: whether it had local changes.
        machine: processor, threads, device.
        seconds: wall time.
        created: UTC time, ISO 8601.
        command: makes this dataset again.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: Literal[1] = 1
    domain: str
    task: str | None = None
    method: str
    seed: int
    steps: int
    episodes: int
    profile: str
    overrides: dict[str, Any] = {}
    hyperparameters: dict[str, Any]
    hyperparameters_hash: str
    citation: str = ""
    fields: dict[str, _Sha256]
    fingerprint: _Sha256
    final_state: _Sha256 | Literal[""] = ""
    base: Base | None = None
    collected: Collected | None = None
    reward: RewardFunction | None = None
    pilot: Pilot | None = None
    imported: Import | None = None
    mixture: Mixture | None = None
    tier: Tier | None = None
    diagnostics: dict[str, Any] = {}
    versions: dict[str, str]
    commit: str | None = None
    dirty: bool = False
    machine: dict[str, Any]
    seconds: float
    created: str
    command: str

    @property
    def label(self) -> str:
        """The method, with its source where this project did not collect it, or with its parts: ``"mixture (cudc, proto (ExORL))"``."""
        if self.mixture is not None:
            return mixture_label(self.method, self.mixture.parts)
        return self.method if self.imported is None else f"{self.method} ({self.imported.source})"

    @property
    def was_collected(self) -> bool:
        """Whether a collector of this project made it, or its base: it was neither imported nor mixed, nor made by a training on a task."""
        return self.imported is None and self.mixture is None and self.tier is None

    @property
    def holds_others_data(self) -> bool:
        """Whether any of it was not collected by this project."""
        return self.imported is not None or (self.mixture is not None and any(part.source for part in self.mixture.parts))

    def episode_seed(self, index: int) -> int | None:
        """The seed that an episode's environment was reset with; None where that is not known, of what was imported."""
        if self.mixture is not None:
            part, number = self.mixture.origin(index)
            return part.episode_seed(number)
        return None if self.imported is not None else episode_seed(self.seed, "environment", index)

    def describe(self) -> str:
        """What is there, in a few words, for messages: method, profile or source, seed, steps."""
        if self.imported is not None:
            return f"{self.method} imported from {self.imported.source}, seed {self.seed}, {self.steps:,} steps"
        if self.mixture is not None:
            return f"{self.label}, profile {self.profile}, seed {self.seed}, {self.steps:,} steps"
        changed = " with " + ", ".join(f"{k}={v}" for k, v in sorted(self.overrides.items())) if self.overrides else ""
        return f"{self.method}, profile {self.profile}{changed}, seed {self.seed}, {self.steps:,} steps"


class FieldHasher:
    """Hashes the fields of a dataset as its episodes are written or read, in order."""

    def __init__(self) -> None:
        self._hashes: dict[str, Any] = {}

    def update(self, name: str, array: NDArray[Any]) -> None:
        """Add one episode's array of a field; its dtype and shape count, too."""
        digest = self._hashes.setdefault(name, hashlib.sha256())
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)

    def digests(self) -> dict[str, str]:
        """SHA-256 of each field, by name."""
        return {name: digest.hexdigest() for name, digest in sorted(self._hashes.items())}


def fingerprint(fields: dict[str, str]) -> str:
    """The dataset's fingerprint from the hashes of its fields."""
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def metadata_path(dataset_id: DatasetId | str, root: Path | None = None) -> Path:
    """Minari's metadata file of a dataset."""
    return dataset_path(dataset_id, root) / "data" / "metadata.json"


def exists(dataset_id: DatasetId | str, root: Path | None = None) -> bool:
    """Whether anything stands at that id, ours or not."""
    return dataset_path(dataset_id, root).exists()


def read_metadata(dataset_id: DatasetId | str, root: Path | None = None) -> dict[str, Any]:
    """Read Minari's metadata of one of our datasets, with the manifest in it unchecked.

    Raises:
        UsageError: there is no such dataset, or it is not one of ours.
        RunError: the file is damaged.
    """
    path = metadata_path(dataset_id, root)
    try:
        metadata = json.loads(read_limited(path).decode("utf-8"))
    except FileNotFoundError:
        raise UsageError(f"there is no dataset '{dataset_id}' in {root or datasets_root()}.") from None
    except NotADirectoryError:
        check_folder(root or datasets_root(), "the dataset root", writable=False)
        raise UsageError(f"there is no dataset '{dataset_id}' in {root or datasets_root()}.") from None
    except RecursionError:
        raise RunError(f"the metadata of '{dataset_id}' cannot be read ({path}): they are nested too deeply.") from None
    except (OSError, ValueError) as error:
        raise RunError(f"the metadata of '{dataset_id}' cannot be read ({path}): {error}.") from None
    if not isinstance(metadata, dict) or KEY not in metadata:
        raise UsageError(
            f"'{dataset_id}' was not made by cudc-bench: it has no manifest; a copy that has one: cudc-bench import-minari {dataset_id} "
            "--method NAME."
        )
    return metadata


def read_manifest(dataset_id: DatasetId | str, root: Path | None = None) -> Manifest:
    """Read a dataset's manifest.

    Raises:
        UsageError: there is no such dataset, or it is not one of ours.
        RunError: its metadata is damaged.
    """
    metadata = read_metadata(dataset_id, root)
    try:
        return Manifest.model_validate(metadata[KEY])
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise RunError(f"the manifest of '{dataset_id}' is damaged: {where}: {first['msg']}.") from None


def check_free(dataset_id: DatasetId, overwrite: bool, root: Path | None = None) -> None:
    """Refuse to replace an existing dataset unless told to.

    Raises:
        UsageError: the id is taken; the message says by what, and the ways out.
    """
    if overwrite or not exists(dataset_id, root):
        return
    try:
        there = read_manifest(dataset_id, root).describe()
    except (UsageError, RunError):
        there = "not a dataset of cudc-bench"
    raise UsageError(f"'{dataset_id}' exists ({there}); use --overwrite, --dataset-id or another --seed.")
