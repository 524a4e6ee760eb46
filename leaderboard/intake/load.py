"""Run records from files and folders. What cannot be used is reported in one line each and never stops the rest."""

from __future__ import annotations

import gc
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from cudc_bench.artefacts.provenance import is_own_command
from cudc_bench.artefacts.records import Record, parse_record, read_content, record_files
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.errors import RunError
from cudc_bench.execution.progress import bar_if_long
from cudc_bench.files import LeftOut
from cudc_bench.text import plain

from ..numbers.columns import column

if TYPE_CHECKING:
    import pandas as pd


_LARGEST_STEPS = 10**12  # beyond any collection; larger numbers are no floats
_LARGEST = 1e9  # Above any real return or number of steps; larger ones would overflow sums and axes.


@dataclass(frozen=True)
class Loaded:
    """What was found.

    Attributes:
        records: usable records, each training run once, in the order of their files.
        problems: one line for each file that was left out, and why.
        digests: a hash of each record's file, by the record's ``id``; see :meth:`inputs`.
        paths: the file of each record.
    """

    records: tuple[Record, ...]
    problems: tuple[str, ...]
    paths: tuple[Path, ...] = ()
    digests: Mapping[int, str] = field(default_factory=dict, repr=False)

    def inputs(self, records: Iterable[Record]) -> tuple[str, ...]:
        """What stands for some of the records where files are only made again if their inputs changed."""
        return tuple(self.digests[id(record)] for record in records)


def load_records(paths: Iterable[Path]) -> Loaded:
    """Read records from files, and all below folders in sorted order.

    Two records of one training run (same group, dataset, algorithm and seed, handed in by the same person if at all) are a duplicate: the
    newest is kept.

    Args:
        paths: existing files and folders; a file that is reached twice is read once.
    """
    kept: dict[tuple[str | int, ...], tuple[Path, Record]] = {}
    problems, digests = [], {}
    for path, record, digest in read_all(paths):
        if isinstance(record, RunError):
            problems.append(plain(str(record)))
            continue
        # Whoever hands in a run never takes the place of another's.
        by = "" if record.submission is None else record.submission.by
        digests[id(record)] = digest
        run = (record.group, record.labelled_id, record.algorithm, record.seed, by)
        if run not in kept:
            kept[run] = (path, record)
            continue
        old, new = sorted([kept[run], (path, record)], key=lambda entry: created(entry[1]))
        kept[run] = new
        problems.append(plain(f"{old[0]} is left out: {new[0]} is the same training run and not older."))
    return Loaded(tuple(record for _, record in kept.values()), tuple(problems), tuple(path for path, _ in kept.values()), digests)


def read_all(paths: Iterable[Path]) -> Iterator[tuple[Path, Record | RunError, str]]:
    """Every record below some paths, as :func:`load_records` finds them, or why it cannot be one, and a hash of its file."""
    left_out: list[OSError] = []
    found = files(paths, left_out.append)
    for error in left_out:
        place = Path(error.filename)
        yield place, RunError(f"the records in {place} are left out: it cannot be read: {error.strerror}."), ""
    with _without_collector(), bar_if_long("reading records", len(found), "files") as advance:
        for path in found:
            try:
                content = read_content(path)
                record = parse_record(content, path)
                why = impossible(record)
                yield path, record if why is None else RunError(f"{path} is left out: {why}"), hashlib.sha256(content).hexdigest()
            except RunError as error:
                yield path, error, ""
            advance(1)


@contextmanager
def kept_from_collector() -> Iterator[None]:
    """Within this context the garbage collector does not look through what is there already."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


@contextmanager
def _without_collector() -> Iterator[None]:
    """Python looks through all objects again and again while they become more: of ten thousand records that takes most of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            # Through the frozen ones they become old at once; as new ones all would be looked through now.
            gc.freeze()
            gc.enable()
            gc.unfreeze()


def to_frame(records: Iterable[Record]) -> pd.DataFrame:
    """One row for each record and milestone, for analyses of one's own.

    Columns: group, algorithm, domain, task, method (as :func:`column`), dataset_seed, seed, milestone (gradient steps), score (mean
    undiscounted return; NaN if nothing was evaluated there) and episodes (behind that score).
    """
    import pandas as pd

    rows = [
        {
            "group": record.group,
            "algorithm": record.algorithm,
            "domain": record.dataset.domain,
            "task": record.dataset.task,
            "method": column(record),
            "dataset_seed": record.dataset.seed,
            "seed": record.seed,
            "milestone": milestone,
            "score": float("nan") if evaluation is None else evaluation.mean,
            "episodes": 0 if evaluation is None else len(evaluation.returns),
        }
        for record in records
        for milestone in sorted(set(record.milestones))
        for evaluation in [record.evaluation(milestone)]
    ]
    columns = ["group", "algorithm", "domain", "task", "method", "dataset_seed", "seed", "milestone", "score", "episodes"]
    return pd.DataFrame(rows, columns=columns)


def files(paths: Iterable[Path], left_out: LeftOut | None = None) -> list[Path]:
    """Files, and every record below folders in sorted order, each once; ``left_out`` is told of folders that cannot be read."""
    found: dict[str, Path] = {}
    real = cache(os.path.realpath)  # of ten thousand files' folders
    for path in paths:
        for file in record_files(path, left_out) if path.is_dir() else [path]:
            folder, name = os.path.split(file)
            found.setdefault(os.path.realpath(file) if os.path.islink(file) else os.path.join(real(folder), name), file)
    return list(found.values())


def impossible(record: Record) -> str | None:
    """Why a record that fits the schema cannot be a result, since records come from others too; None if it can."""
    domain = DOMAINS.get(record.dataset.domain)
    limit = domain.max_return if domain and record.dataset.task in domain.tasks else _LARGEST
    # Looking at each number by itself takes a third of the time that reading takes.
    values = list(chain.from_iterable(one.returns for one in (*record.curve, *record.finals)))
    largest = max(max(values), -min(values))
    steps = (*record.milestones, record.final.step)
    if largest > limit * (1 + 1e-6):
        return f"a return of {largest:g} is impossible, the limit is {limit:g}."
    if min(steps) < 1 or max(steps) > _LARGEST:
        return f"a number of gradient steps is not between 1 and {_LARGEST:g}."
    if max(record.dataset.steps, record.dataset.used or 0) > _LARGEST_STEPS:
        return f"no dataset has more than {_LARGEST_STEPS:,} steps."
    if not is_own_command(record.command):
        # Tables list it for people to run.
        return f"its command is not one of cudc-bench: {record.command:.80}"
    try:
        created(record)
    except (ValueError, OverflowError):
        return f"its time of creation '{record.created}' is not ISO 8601."
    return None


def created(record: Record) -> datetime:
    """When a record was made.

    Raises:
        ValueError, OverflowError: it is no time.
    """
    time = datetime.fromisoformat(record.created)
    return time if time.tzinfo else time.replace(tzinfo=UTC)
