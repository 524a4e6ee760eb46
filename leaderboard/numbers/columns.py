"""The columns of tables: under which name a record's dataset is compared, and whose it is."""

from __future__ import annotations

from collections.abc import Iterable

from cudc_bench.artefacts.records import Record

from ..methods import canonical
from .words import short


def column(record: Record) -> str:
    """The name under which a record's dataset is compared: its method, and in brackets what keeps it apart from our own.

    Of the names of one setting it is always the same one (:func:`~..methods.canonical`). ``"proto (ExORL, 10M)"`` was imported: no profile
    fixes the size of such a dataset; its steps are in the name, so that datasets of different sizes never share a cell. ``"cudc (by ann)"``
    was handed in by somebody and not run again here.
    """
    dataset, apart = record.dataset, []
    if dataset.source is not None:
        apart += [dataset.source, short(dataset.steps)]
    if record.submission is not None:
        apart.append(f"by {record.submission.by}")
    name = canonical(dataset.method) if dataset.source is None else dataset.method
    return f"{name} ({', '.join(apart)})" if apart else name


def is_own(record: Record) -> bool:
    """Whether it was collected and trained here, so that more of its kind can be asked for."""
    return record.dataset.source is None and record.submission is None


def submitted_columns(records: Iterable[Record]) -> tuple[str, ...]:
    """The columns of some records that somebody handed in, sorted."""
    return tuple(sorted({column(record) for record in records if record.submission is not None}))
