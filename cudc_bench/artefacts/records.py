"""Run records: one JSON file for each evaluated member. The leaderboard reads nothing else.

A record says what was trained on what, with every hyperparameter, every episode's return at every evaluation, and the command that
makes it again. The schema is versioned; unknown fields and numbers that are not finite are refused.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    field_validator,
    model_serializer,
    model_validator,
)

from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import MOST_PARTS, PartOrigin, RewardFunction, Source, mixture_label
from cudc_bench.errors import RunError
from cudc_bench.files import LeftOut, read_limited, unwritable, walk, write_atomically
from cudc_bench.settings.evaluate_config import BEFORE

SCHEMA_VERSION = 1
REFERENCE = "reference.json"  # the one file among records that is none, see ``cudc_bench.artefacts.references``
CHECKPOINTS = ".checkpoints"  # the folder among records of what is kept of trainings that are not done
SUITE_FOLDER = ".suite"  # the same of what a suite keeps: its lock, and a note of each dataset that it made
LABELS = 10_000  # transitions that a learner without rewards is told the rewards of, unless it is asked otherwise
# The most that a record of any run has reason to hold; more of them would take whoever reads it minutes.
MOST_EVALUATIONS, MOST_SETTINGS = 10_000, 1_000
Settings = Annotated[dict[str, Any], Field(max_length=MOST_SETTINGS)]
Versions = Annotated[dict[str, str], Field(max_length=MOST_SETTINGS)]
Name = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
DomainName = Annotated[str, Field(pattern=r"^([a-z0-9][a-z0-9_-]{0,63}|dm_control/[A-Za-z0-9][A-Za-z0-9_-]{0,63})$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]


def _without(values: dict[str, Any], *names: str) -> dict[str, Any]:
    """Without those of some fields that say nothing: a file has the form that it had before there was such a field."""
    return {name: value for name, value in values.items() if value or name not in names}


class Strict(BaseModel):
    """Refuses what it does not know, and does not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Collection(Strict):
    """With what a dataset was collected, so that its record alone is enough to collect it again, whatever defaults are by then.

    Attributes:
        hyperparameters: all of the collection's.
        versions, machine: of the collection.
    """

    hyperparameters: Settings
    versions: Versions
    machine: Settings


class DatasetReference(Strict):
    """The dataset that was trained on.

    Attributes:
        id: the relabelled dataset's id.
        fingerprint: SHA-256 of its arrays (see ``cudc_bench.artefacts.manifest``).
        domain, task, method, seed, steps: what it is.
        profile: at which profile it was collected.
        overrides: hyperparameters of the collection that differ from that profile.
        reward: the user's own function that labelled it, if it is none of the domain's tasks.
        source: who collected it, such as ``"ExORL"``, if it was imported; None if this project's own collector did.
        used: how many of its first transitions were trained on, if not all.
        collection: with what it was collected; a file without it is of an imported dataset, or from before this was written down.
        parts: the datasets that a mixture was made of; a file without them is of no mixture.
    """

    id: str
    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    domain: DomainName
    task: Name
    method: Name
    seed: Annotated[int, Field(ge=0)]
    steps: Annotated[int, Field(ge=1)]
    profile: Name
    overrides: Settings = {}
    reward: RewardFunction | None = None
    source: Source | None = None
    used: Annotated[int, Field(ge=1)] | None = None
    collection: Collection | None = None
    parts: Annotated[list[PartOrigin], Field(max_length=MOST_PARTS)] = []

    @model_serializer(mode="wrap")
    def _without_collection(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _without(serialise(self), "collection", "parts")

    @property
    def label(self) -> str:
        """The method, with the parts of a mixture: ``"mixture (cudc, rnd)"``."""
        return mixture_label(self.method, self.parts) if self.parts else self.method

    @property
    def goes_with_every_profile(self) -> bool:
        """Whether none of it was collected here, at a profile."""
        return self.source is not None or (bool(self.parts) and all(part.source for part in self.parts))


class LabelSource(Strict):
    """The dataset that labelled transitions were drawn from, where it is another than the one that was trained on.

    Attributes:
        id, fingerprint: which.
    """

    id: str
    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class ZeroShot(Strict):
    """What a learner that trains without rewards was told of its task, after the training that all its tasks share.

    Attributes:
        labels: transitions whose rewards it may see: so many, or all that there are.
        drawn: how many it saw.
        source: where they are from, if not from what was trained on.
        rule: how the task's vector z follows from them.
        norm: ‖z‖ before it was scaled; 0 where no reward was seen, so that nothing could follow.
        rewarded: share of the labels that are not zero.
        training: the same for all records of one training, and for no others.
        records: how many these are.
        training_seconds: wall time of that training with all its evaluations.
    """

    labels: Annotated[int, Field(ge=1)]
    drawn: Annotated[int, Field(ge=1)]
    source: LabelSource | None = None
    rule: Annotated[str, Field(max_length=200)]
    norm: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    rewarded: Annotated[float, Field(ge=0, le=1)]
    training: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    records: Annotated[int, Field(ge=1)]
    training_seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]

    def changes(self, labels: int | None = None) -> list[str]:
        """What keeps its record, or that of as many labels as are named, from tables of those with the usual labels."""
        count = labels or self.labels
        usual = [] if count == LABELS else [f"{count:,} labels"]
        return usual if self.source is None else [*usual, f"labels of {self.source.id} {self.source.fingerprint[:8]}"]


class Evaluation(Strict):
    """Undiscounted returns of the episodes of one evaluation after so many gradient steps.

    Attributes:
        step: how many gradient steps; of a reference, environment steps.
        returns: one for each episode, in their order.
    """

    step: Annotated[int, Field(ge=0)]
    returns: Annotated[list[Finite], Field(min_length=1, max_length=MOST_EVALUATIONS)]

    @property
    def mean(self) -> float:
        """The score: mean return over the episodes."""
        return sum(self.returns) / len(self.returns)


class TrainingMetrics(Strict):
    """Losses and values of the minibatch after so many gradient steps.

    Attributes:
        step: how many.
        values: each metric by its name.
    """

    step: Annotated[int, Field(ge=0)]
    values: Annotated[dict[str, Finite], Field(max_length=MOST_SETTINGS)]


class Reran(Strict):
    """That a run was made again from its record alone, by this project's code, with the same numbers to the last bit.

    Attributes:
        collected: whether its dataset was collected again, too, and not only had the same fingerprint.
        commit, versions: what with.
        created: UTC time, ISO 8601.
    """

    collected: bool
    commit: str | None = None
    versions: Versions
    created: str


class Submission(Strict):
    """Who handed in a record that was not made here; nothing but ``cudc-bench submit`` writes it.

    Attributes:
        by: a short name, which stands behind the method in tables.
        url: where more is to be found about it.
        note: one line of theirs or of whoever took it in.
        sha256: of the file as it was handed in.
        submitted: UTC time, ISO 8601.
        reran: what ``cudc-bench rerun`` found who made the run again; None if nobody did, or it came out with other numbers.
    """

    by: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
    url: Annotated[str, Field(pattern=r"^https?://[A-Za-z0-9._~:/?#@!$&*+,;=%-]+$", max_length=300)] | None = None
    note: Annotated[str, Field(min_length=1, max_length=300)] | None = None
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    submitted: str
    reran: Reran | None = None

    @model_serializer(mode="wrap")
    def _without_rerun(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _without(serialise(self), "reran")

    @field_validator("note")
    @classmethod
    def _printable(cls, note: str | None) -> str | None:
        if note is not None and not note.isprintable():
            raise ValueError("it is not one line of printable text")
        return note


class Record(Strict):
    """One offline training run.

    Attributes:
        schema_version: of this format.
        dataset: what was trained on.
        algorithm: the evaluator's name.
        profile: of the training.
        overrides: hyperparameters of the training that differ from the profile.
        seed: of the training, which is the dataset's own unless another was asked for.
        hyperparameters: all of them.
        hyperparameters_hash: of ``hyperparameters``.
        milestones: gradient steps whose scores go into tables.
        curve: evaluations in the order of their steps; the first at 0, the last after the last step.
        final: a further, larger evaluation after the last step.
        late: the same at the evaluation points shortly before, in the order of their steps. A file without it is of a run that had none, as
            all runs once had.
        metrics: training metrics at the evaluations.
        seconds: wall time of the run; of several that were trained side by side, each one's equal share.
        versions: of Python and the packages that matter.
        commit: of this project's code, ``None`` when it is not run from a checkout.
        dirty: whether it had local changes.
        machine: processor, threads, device, engine; ``beside``, how many were trained side by side, if more than one.
        command: makes this record again.
        created: UTC time, ISO 8601.
        zero_shot: how its task was told to a learner that trains without rewards, whose ``dataset`` is task-agnostic; None for those
            that train on a labelled one.
        submission: who handed it in, if it was not made here. A file without it has the form that it always had; programs that do not
            know the field refuse the file rather than take somebody's run for their own, so that the version stays.
    """

    schema_version: Literal[1] = 1
    dataset: DatasetReference
    algorithm: Name
    profile: Name
    overrides: Settings = {}
    seed: Annotated[int, Field(ge=0)]
    hyperparameters: Settings
    hyperparameters_hash: str
    milestones: Annotated[list[int], Field(min_length=1, max_length=MOST_SETTINGS)]
    curve: Annotated[list[Evaluation], Field(min_length=1, max_length=MOST_EVALUATIONS)]
    final: Evaluation
    late: Annotated[list[Evaluation], Field(max_length=MOST_SETTINGS)] = []
    metrics: Annotated[list[TrainingMetrics], Field(max_length=MOST_EVALUATIONS)] = []
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    versions: Versions
    commit: str | None = None
    dirty: bool = False
    machine: Settings
    command: str
    created: str
    zero_shot: ZeroShot | None = None
    submission: Submission | None = None

    @model_serializer(mode="wrap")
    def _without_empty(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return _without(serialise(self), "submission", "late", "zero_shot")

    @model_validator(mode="after")
    def _ordered(self) -> Record:
        steps = [evaluation.step for evaluation in self.curve]
        if any(later <= earlier for earlier, later in pairwise(steps)):
            raise ValueError("the evaluations of 'curve' are not in the order of their steps")
        if self.final.step != steps[-1]:
            raise ValueError("'final' was not taken after the last step of 'curve'")
        late = [evaluation.step for evaluation in self.late]
        if late and late != steps[-1 - len(late) : -1]:
            raise ValueError("'late' was not taken at the last evaluations of 'curve' before 'final'")
        return self

    @property
    def group(self) -> str:
        """The table that this record belongs to: results of different profiles or settings never share one.

        The profile's name, followed by whatever differs from it, as in ``"cpu (collect: steps=100000)"``. An imported dataset was
        collected at no profile; it belongs to the training's, in a column of its own.
        """
        return self._group(self.dataset.used)

    @property
    def group_of_all_sizes(self) -> str:
        """The group of the same run on all of the dataset: equal for records that differ in nothing but how much of it they used."""
        return self._group(None)

    @property
    def group_of_all_labels(self) -> str:
        """The group of the same run with the usual labels: equal for records that differ in nothing but their number."""
        return self._group(self.dataset.used, LABELS)

    def _group(self, used: int | None, labels: int | None = None) -> str:
        changes = []
        if self.dataset.profile != self.profile and not self.dataset.goes_with_every_profile:
            changes.append(f"collected at {self.dataset.profile}")
        if self.dataset.reward is not None:
            # A function that was changed on the way is another task.
            changes.append(f"reward: {self.dataset.reward.reference} {self.dataset.reward.sha256[:8]}")
        if used is not None:
            changes.append(f"first {used:,} transitions")
        if self.zero_shot is not None:
            changes += self.zero_shot.changes(labels)
        for stage, overrides in (("collect", self.dataset.overrides), ("evaluate", self.settings)):
            if overrides:
                changes.append(f"{stage}: {settings_text(overrides)}")
        return f"{self.profile} ({'; '.join(changes)})" if changes else self.profile

    @property
    def labelled_id(self) -> str:
        """The id of what was trained on with the labels of the task, also where no dataset of that id was needed."""
        return self.dataset.id if self.zero_shot is None else str(parse_id(self.dataset.id).for_task(self.dataset.task))

    @property
    def settings(self) -> dict[str, Any]:
        """What differs from the profile as it is now: ``overrides``, and what the run did that was nobody's choice when it was made."""
        return {name: value for name, value in BEFORE.items() if name not in self.hyperparameters} | self.overrides

    @property
    def again(self) -> str:
        """The command that makes this record again with this version; ``command`` does so with the one that made it."""
        unsaid = [f"--set {name}={value}" for name, value in BEFORE.items() if name not in self.hyperparameters]
        return " ".join([self.command, *unsaid])

    @property
    def finals(self) -> list[Evaluation]:
        """The larger evaluations at the end of the training, whose mean is the score after the last step; ``final`` is the last alone."""
        return [*self.late, self.final]

    @property
    def conclusion(self) -> Evaluation:
        """All episodes of the larger evaluations together."""
        # Its parts were checked when they were read.
        returns = [value for evaluation in self.finals for value in evaluation.returns]
        return Evaluation.model_construct(step=self.final.step, returns=returns)

    def evaluation(self, milestone: int) -> Evaluation | None:
        """The episodes behind the score at a milestone, if there are any: after the last step those of the larger evaluations."""
        if milestone == self.final.step:
            return self.conclusion
        return next((evaluation for evaluation in self.curve if evaluation.step == milestone), None)

    def score(self, milestone: int) -> float | None:
        """The mean return at a milestone (see :meth:`evaluation`), or None if nothing was evaluated there."""
        if milestone == self.final.step:  # the usual question, for which no evaluation has to be made
            values = [value for evaluation in self.finals for value in evaluation.returns]
            return sum(values) / len(values)
        found = self.evaluation(milestone)
        return None if found is None else found.mean


def settings_text(overrides: Mapping[str, Any]) -> str:
    """Settings that differ from a profile, by name: ``"gamma=0.9, steps=5"``; as JSON, in which no two values look alike."""
    return ", ".join(f"{name}={json.dumps(overrides[name])}" for name in sorted(overrides))


def record_path(
    results: Path,
    dataset_id: str,
    algorithm: str,
    seed: int,
    profile: str,
    used: int | None = None,
    training_seed: int | None = None,
    labels: int | None = None,
) -> Path:
    """Where a record is kept: ``results/<profile>/<dataset id>/<algorithm>-seed<seed>.json``, by the dataset's seed.

    That of a part of the dataset is ``<algorithm>-first<used>-seed<seed>.json``, that of another number of labels than the usual
    ``<algorithm>-labels<labels>-seed<seed>.json``, and that of a training with another seed than the dataset's
    ``<algorithm>-seed<seed>-training<training seed>.json``.
    """
    part = "" if used is None else f"-first{used}"
    part += "" if labels in (None, LABELS) else f"-labels{labels}"
    training = "" if training_seed in (None, seed) else f"-training{training_seed}"
    return results.joinpath(profile, *dataset_id.split("/"), f"{algorithm}{part}-seed{seed}{training}.json")


def record_files(folder: Path, left_out: LeftOut | None = None) -> list[Path]:
    """Every record below a folder, sorted; none of what is kept there of runs that are not done, which is hidden, and no reference.

    Args:
        folder: whose; links in it are followed.
        left_out: told of each folder below it that cannot be read.
    """
    return [path for path in visible_files(folder, "*.json", left_out) if path.name != REFERENCE]


def visible_files(folder: Path, pattern: str, left_out: LeftOut | None = None) -> list[Path]:
    """The files below a folder that fit a pattern, sorted, without hidden ones and those in hidden folders; see :func:`record_files`."""
    found = []
    for place, folders, names in walk(folder, left_out):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [place / name for name in names if not name.startswith(".") and fnmatchcase(name, pattern)]
    return sorted(found)


def to_json(record: Record) -> str:
    """A record as it stands in its file."""
    return record.model_dump_json(indent=1) + "\n"


def write_record(path: Path, record: Record) -> None:
    """Write a record atomically: a reader sees the whole file or none.

    Raises:
        RunError: it cannot be written there.
    """
    try:
        write_atomically(path, to_json(record))
    except OSError as error:
        raise unwritable(f"the record {path}", error) from None


def read_record(path: Path) -> Record:
    """Read and check one record.

    Raises:
        RunError: the file is missing, is not JSON, or does not fit the schema.
    """
    return parse_record(read_content(path), path)


def read_content(path: Path) -> bytes:
    """What is in a record's file.

    Raises:
        RunError: it cannot be read.
    """
    try:
        return read_limited(path)
    except OSError as error:
        raise RunError(f"cannot read the record {path}: {error.strerror}.") from None


def parse_record(content: bytes, path: Path) -> Record:
    """Check what is in a record's file; ``path`` is for messages.

    Raises:
        RunError: it is not JSON, or does not fit the schema.
    """
    try:
        return Record.model_validate_json(content)
    except ValidationError as error:
        raise RunError(f"{path} is not a run record: {first_fault(error)}.") from None


def first_fault(error: ValidationError) -> str:
    """Where a file does not fit its schema, and why not."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "the file"
    return f"{where}: {first['msg']}"
