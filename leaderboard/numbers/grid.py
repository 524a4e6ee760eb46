"""One model for every table of numbers; :mod:`..show` writes it as Markdown, LaTeX, CSV and for a terminal, :mod:`..site` as HTML."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds

from .statistics import Interval


@dataclass(frozen=True)
class Entry:
    """A number, how sure it is, and the runs behind it.

    Attributes:
        value: the number.
        std: sample standard deviation over collector seeds.
        interval: of 95 %.
        n: number of collector seeds; 0 for a number that is not a mean over them.
        best: whether it is marked: of a row of returns the largest mean, after rounding to whole returns, and what is not significantly
            worse than it.
        records: what it was made from; empty for numbers of the paper.
    """

    value: float
    std: float | None = None
    interval: Interval | None = None
    n: int = 0
    best: bool = False
    records: tuple[Record, ...] = field(default=(), repr=False)

    def scored(self, bounds: Bounds) -> Entry:
        """A mean return as a score between a floor and a ceiling."""
        std = None if self.std is None else self.std / (bounds.ceiling - bounds.floor)
        return replace(self, value=bounds.normalise(self.value), std=std)


@dataclass(frozen=True)
class Column:
    """What the numbers below a name are: shown with so many digits behind the point (None: as many as they have), ``signed`` with their
    sign."""

    name: str
    digits: int | None = 0
    signed: bool = False


@dataclass(frozen=True)
class Line:
    """A row: its labels, one for each of the grid's ``head``, and an entry for each column, None where there is no result."""

    labels: tuple[str, ...]
    entries: tuple[Entry | None, ...]


@dataclass(frozen=True)
class Part:
    """Some rows under a heading of their own, such as ``"500K steps"``; ``key`` is the same as a value (500000) for CSV."""

    title: str
    key: int | str
    lines: tuple[Line, ...]


@dataclass(frozen=True)
class Grid:
    """A table.

    Attributes:
        name: in files' names; no two of a study have the same.
        title, caption: what it shows, and what the numbers are; plain ASCII except for what records bring along.
        split: what the parts differ in, such as ``"milestone"``; ``head``: what each of a row's labels is, such as ``"method"``.
        columns: of every part.
        parts: the rows.
        long: too long for a terminal, which names its file instead.
    """

    name: str
    title: str
    caption: str
    split: str
    head: tuple[str, ...]
    columns: tuple[Column, ...]
    parts: tuple[Part, ...]
    long: bool = False

    def entries(self) -> Iterator[tuple[Part, Line, Column, Entry | None]]:
        """All cells in reading order, the empty ones too."""
        for part in self.parts:
            for line in part.lines:
                for column, entry in zip(self.columns, line.entries, strict=True):
                    yield part, line, column, entry


def with_records(entry: Entry | None, records: Sequence[Record]) -> Entry | None:
    """The same with what it was made from."""
    return None if entry is None else replace(entry, records=tuple(records))


def number(value: float, column: Column) -> str:
    """A number with its column's digits; what rounds to zero has no minus."""
    if column.digits is None:
        return f"{value:g}"
    return f"{round(value, column.digits) + 0.0:{'+' if column.signed else ''}.{column.digits}f}"
