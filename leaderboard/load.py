"""Run records from files and folders. What cannot be used is reported in one line each and never stops the rest."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.errors import RunError
from cudc_bench.markup import plain
from cudc_bench.provenance import is_own_command
from cudc_bench.records import Evaluation, Record, read_record

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
        paths: the file of each record.
    """

    records: tuple[Record, ...]
    problems: tuple[str, ...]
    paths: tuple[Path, ...] = ()


def load_records(paths: Iterable[Path]) -> Loaded:
    """Read records from files, and from every ``*.json`` below folders in sorted order.

    Two records of one training run (same group, dataset, algorithm and seed) are a duplicate: the newest is kept.

    Args:
        paths: existing files and folders; a file that is reached twice is read once.
    """
    kept: dict[tuple[str, str, str, int], tuple[Path, Record]] = {}
    problems = []
    for path in _files(paths):
        try:
            record = read_record(path)
            _check(path, record)
        except RunError as error:
            problems.append(plain(str(error)))
            continue
        run = (record.group, record.dataset.id, record.algorithm, record.seed)
        if run not in kept:
            kept[run] = (path, record)
            continue
        old, new = sorted([kept[run], (path, record)], key=lambda entry: _created(entry[1]))
        kept[run] = new
        problems.append(plain(f"{old[0]} is left out: {new[0]} is the same training run and not older."))
    return Loaded(tuple(record for _, record in kept.values()), tuple(problems), tuple(path for path, _ in kept.values()))


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
        for evaluation in [evaluation_at(record, milestone)]
    ]
    columns = ["group", "algorithm", "domain", "task", "method", "dataset_seed", "seed", "milestone", "score", "episodes"]
    return pd.DataFrame(rows, columns=columns)


def evaluation_at(record: Record, step: int) -> Evaluation | None:
    """The evaluation behind ``record.score(step)``: after the last step the larger, final one."""
    if step == record.final.step:
        return record.final
    return next((evaluation for evaluation in record.curve if evaluation.step == step), None)


def column(record: Record) -> str:
    """The name under which a record's dataset is compared: its method, or ``"proto (ExORL, 10M)"`` if it was imported.

    No profile fixes the size of an imported dataset; its steps are in the name, so that datasets of different sizes never share a cell.
    """
    dataset = record.dataset
    return dataset.method if dataset.source is None else f"{dataset.method} ({dataset.source}, {short(dataset.steps)})"


def short(steps: float) -> str:
    """``20000`` -> ``"20K"``, ``1500000`` -> ``"1.5M"``."""
    for size, letter in ((1e6, "M"), (1e3, "K")):
        if steps >= size:
            return f"{steps / size:.6g}{letter}"
    return f"{steps:.6g}"


def _files(paths: Iterable[Path]) -> list[Path]:
    found: dict[str, Path] = {}
    for path in paths:
        for file in sorted(path.rglob("*.json")) if path.is_dir() else [path]:
            # Hidden is what evaluations keep that are not done.
            if not file.is_dir() and not any(part.startswith(".") for part in file.relative_to(path).parts):
                found.setdefault(os.path.realpath(file), file)
    return list(found.values())


def _check(path: Path, record: Record) -> None:
    """Refuse what fits the schema but cannot be a result, since records come from others too."""
    domain = DOMAINS.get(record.dataset.domain)
    limit = domain.max_return if domain and record.dataset.task in domain.tasks else _LARGEST
    largest = max(abs(value) for evaluation in (*record.curve, record.final) for value in evaluation.returns)
    steps = (*record.milestones, record.final.step)
    if largest > limit * (1 + 1e-6):
        raise RunError(f"{path} is left out: a return of {largest:g} is impossible, the limit is {limit:g}.")
    if min(steps) < 1 or max(steps) > _LARGEST:
        raise RunError(f"{path} is left out: a number of gradient steps is not between 1 and {_LARGEST:g}.")
    if max(record.dataset.steps, record.dataset.used or 0) > _LARGEST_STEPS:
        raise RunError(f"{path} is left out: no dataset has more than {_LARGEST_STEPS:,} steps.")
    if not is_own_command(record.command):
        # Tables list it for people to run.
        raise RunError(f"{path} is left out: its command is not one of cudc-bench: {record.command:.80}")
    try:
        _created(record)
    except (ValueError, OverflowError):
        raise RunError(f"{path} is left out: its time of creation '{record.created}' is not ISO 8601.") from None


def _created(record: Record) -> datetime:
    time = datetime.fromisoformat(record.created)
    return time if time.tzinfo else time.replace(tzinfo=UTC)
