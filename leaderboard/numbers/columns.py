"""The columns of tables: under which name a record's dataset is compared, and whose it is."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.tiers import TIERS

from ..methods import canonical
from .words import short


def column(record: Record) -> str:
    """The name under which a record's dataset is compared: its method, and in brackets what keeps it apart from our own.

    Of the names of one setting it is always the same one (:func:`~..methods.canonical`). ``"proto (ExORL, 10M)"`` was imported: no profile
    fixes the size of such a dataset; its steps are in the name, so that datasets of different sizes never share a cell. ``"mixture (cudc,
    rnd)"`` has equal parts of both. ``"cudc (by ann)"`` was handed in by somebody.
    """
    dataset, apart = record.dataset, []
    if dataset.source is not None:
        apart += [dataset.source, short(dataset.steps)]
    if record.submission is not None:
        apart.append(f"by {record.submission.by}")
    if dataset.parts and dataset.goes_with_every_profile:
        apart.append(short(dataset.steps))
    name = canonical(dataset.label) if dataset.source is None else dataset.label
    return f"{name} ({', '.join(apart)})" if apart else name


def is_own(record: Record) -> bool:
    """Whether it was collected and trained here, so that more of its kind can be asked for."""
    return was_collected(record) and record.submission is None


def was_collected(record: Record) -> bool:
    """Whether a collector of this project, or one that is plugged into it, made its dataset, here or elsewhere."""
    data = record.dataset
    return data.source is None and not data.parts and data.method not in TIERS


@dataclass(frozen=True)
class Submitted:
    """A column that somebody handed in.

    Attributes:
        name: of the column.
        runs: in it.
        reran: how many of them were run again here, with the same numbers.
    """

    name: str
    runs: int
    reran: int


def submitted_columns(records: Iterable[Record]) -> tuple[Submitted, ...]:
    """The columns of some records that somebody handed in, sorted."""
    found: dict[str, list[bool]] = defaultdict(list)
    for record in records:
        if record.submission is not None:
            found[column(record)].append(record.submission.reran is not None)
    return tuple(Submitted(name, len(reran), sum(reran)) for name, reran in sorted(found.items()))


def submitted_caption(columns: Sequence[Submitted]) -> str:
    """What a caption says of columns that were handed in; empty if none was."""
    claimed = [one.name if one.reran == 0 else f"{one.name} (but for {one.reran} of {one.runs} runs)"
               for one in columns if one.reran < one.runs]  # fmt: skip
    shown = [one.name for one in columns if one.reran == one.runs]
    return (f" Submitted by others, and not run again here: {', '.join(claimed)}." if claimed else "") + (
        f" Submitted by others, and run again here with the same numbers: {', '.join(shown)}." if shown else ""
    )
