"""One job, done: asks the stage for it by its registered name, and looks after what a suite keeps beside its records.

In ``.suite`` in the folder of the records lie logs, and a note of each dataset that the suite made: only such a dataset may be removed
again, and its note keeps the whole manifest.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, parse_id
from cudc_bench.artefacts.manifest import Manifest, exists, read_manifest
from cudc_bench.artefacts.records import SUITE_FOLDER, read_record
from cudc_bench.data import deletion
from cudc_bench.data.staging import tidy
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.progress import Listener, listening
from cudc_bench.files import bytes_below, read_limited, unwritable, write_atomically
from cudc_bench.stages import ensure_relabelled

from .jobs import Job


@dataclass(frozen=True)
class Common:
    """What all jobs of a suite share.

    Attributes:
        suite: its name.
        profile, collect, evaluate: hyperparameters.
        device: ``cpu`` or ``cuda``.
        engine: how updates are carried out, as it was asked for.
        output, report: folders of the records, and of tables and figures.
        checkpoint_every: seconds.
    """

    suite: str
    profile: str
    collect: Mapping[str, Any]
    evaluate: Mapping[str, Any]
    device: str
    engine: str
    output: Path
    report: Path
    checkpoint_every: float = CHECKPOINT_EVERY

    @property
    def folder(self) -> Path:
        """Of what the suite keeps for itself."""
        return self.output / SUITE_FOLDER


def do(job: Job, common: Common, listener: Listener) -> None:
    """Do a job in this process; what of it is done already is kept.

    Args:
        job: which.
        common: to all jobs.
        listener: told of progress.

    Raises:
        CudcBenchError: it failed.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    worked = False

    def on_progress(done: int, total: int) -> None:
        nonlocal worked
        worked = True
        listener(done, total)

    missing = [one for one in made_by(job) if not exists(one)]
    with listening(on_progress):
        _DOING[job.kind](job, common)
    # Otherwise another process made them while this one was starting, and they are not ours.
    if worked:
        for one in missing:
            _note(common, one)


def made_by(job: Job) -> list[str]:
    """The datasets that a job makes."""
    if job.kind == "collect":
        return list(job.datasets)
    return [str(parse_id(base).for_task(task)) for base in job.datasets for task in job.tasks] if job.kind == "relabel" else []


def _pilot(job: Job, common: Common) -> None:
    plugins.load("stages", "pilot")(
        list(job.methods), job.domain, profile=common.profile, settings=common.collect, device=common.device, engine=common.engine,
        checkpoint_every=common.checkpoint_every,
    )  # fmt: skip


def _collect(job: Job, common: Common) -> None:
    plugins.load("stages", "collect")(
        job.method, job.domain, job.seeds, profile=common.profile, settings=common.collect, device=common.device, engine=common.engine,
        checkpoint_every=common.checkpoint_every,
    )  # fmt: skip


def _relabel(job: Job, common: Common) -> None:
    for base in job.datasets:
        for one in ensure_relabelled(base, job.tasks):
            tidy(parse_id(one))


def _evaluate(job: Job, common: Common) -> None:
    for base in job.datasets:
        check_same(parse_id(base), common)
    if job.labels:
        data: dict[str, Any] = {"dataset_id": list(job.datasets), "tasks": job.tasks, "labels": job.labels}
    else:
        data = {"dataset_id": [str(parse_id(base).for_task(task)) for base in job.datasets for task in job.tasks]}
    plugins.load("stages", "evaluate")(
        job.algo, job.domain, **data,
        profile=common.profile, settings=common.evaluate, dataset_sizes=None if job.used is None else [job.used],
        output=common.output, device=common.device, engine=common.engine, checkpoint_every=common.checkpoint_every,
    )  # fmt: skip


def _stats(job: Job, common: Common) -> None:
    report = plugins.load("stages", "measure_quality")(list(job.datasets), common.report)
    content = {"datasets": _fingerprints(job), "files": [str(file.relative_to(common.report)) for file in report.files]}
    _write(_stamp(job, common), json.dumps(content, indent=1))


_DOING: dict[str, Callable[[Job, Common], None]] = {
    "pilot": _pilot,
    "collect": _collect,
    "relabel": _relabel,
    "evaluate": _evaluate,
    "stats": _stats,
}


def is_measured(job: Job, common: Common) -> bool:
    """Whether datasets were compared already; those that are gone count as they were."""
    try:
        found = json.loads(read_limited(_stamp(job, common)).decode("utf-8"))
        there, files = dict(found["datasets"]), list(found["files"])
        same = set(there) == set(job.datasets) and there | _fingerprints(job) == there
        return same and all((common.report / str(file)).exists() for file in files)
    except (OSError, ValueError, TypeError, KeyError):
        return False


def _stamp(job: Job, common: Common) -> Path:
    return common.folder / f"{job.slug}.json"


def _fingerprints(job: Job) -> dict[str, str]:
    return {one: read_manifest(one).fingerprint for one in job.datasets if exists(one)}


def check_same(base: DatasetId, common: Common) -> None:
    """Refuse to train on a dataset that was collected again and came out with other data than what its other records were made from.

    Raises:
        RunError: it did.
    """
    now = {str(one): read_manifest(one).fingerprint for one in (base, *_labelled(base))}
    # A record lies by its task, also that of a learner without rewards, which was made of the base itself.
    for path in sorted((common.output / common.profile / base.namespace).glob(f"*/{base.name}-v{base.version}/*.json")):
        try:
            dataset = read_record(path).dataset
        except RunError:
            continue  # whoever needs that record says so
        if now.get(dataset.id, dataset.fingerprint) != dataset.fingerprint:
            raise RunError(
                f"'{dataset.id}' has other data now (fingerprint {now[dataset.id][:12]}) than when {path} was made of it"
                f" ({dataset.fingerprint[:12]}): another machine or other versions collected it. Take another --output."
            )


def _labelled(base: DatasetId) -> list[DatasetId]:
    """The datasets that link to a base, or that are labelled copies of it."""
    found = []
    for path in sorted(dataset_path(base).parent.glob(f"*/{base.name}-v{base.version}")):
        with suppress(UsageError, RunError):
            one = parse_id(path.relative_to(datasets_root()).as_posix())
            there = read_manifest(one).base
            if there is not None and there.id == str(base):
                found.append(one)
    return found


# ------------------------------------------------------------------------------------------------------------------------ retention


class _Note(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    suite: str
    manifest: Manifest


def note_path(common: Common, dataset_id: str) -> Path:
    """Where the note of a dataset is that the suite made."""
    return common.folder / "datasets" / f"{dataset_id}.json"


def _note(common: Common, dataset_id: str) -> None:
    note = _Note(suite=common.suite, manifest=read_manifest(dataset_id))
    _write(note_path(common, dataset_id), note.model_dump_json(indent=1))


def is_ours(common: Common, dataset_id: str) -> bool:
    """Whether the dataset that stands there is the very one that this suite made."""
    try:
        note = _Note.model_validate_json(read_limited(note_path(common, dataset_id)))
    except (OSError, ValidationError):
        return False
    try:
        return note.suite == common.suite and note.manifest == read_manifest(dataset_id)
    except (UsageError, RunError):
        return False


def remove(common: Common, dataset_id: str) -> tuple[list[str], int]:
    """Remove a dataset and what was labelled from it, if this suite made all of it; the notes of how to make them again stay.

    Returns:
        What was removed, and its size in bytes; nothing if any of it is somebody else's.

    Raises:
        RunError: somebody is at work on it, or it cannot be removed.
    """
    base = parse_id(dataset_id)
    # What links to the base goes first.
    all_of_it = [*map(str, _labelled(base)), dataset_id]
    if not exists(base) or not all(is_ours(common, one) for one in all_of_it):
        return [], 0
    size = 0
    for one in all_of_it:
        size += bytes_below(dataset_path(one))
        deletion.remove(parse_id(one))
    return all_of_it, size


def _write(path: Path, content: str) -> None:
    try:
        write_atomically(path, f"{content}\n")
    except OSError as error:
        raise unwritable(str(path), error) from None
