"""Numbers as text, in whatever format they stand, and what of a table documents show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..numbers.grid import Column, Entry, Grid, Line, Part, number
from ..numbers.overall import Estimate, Pair
from ..numbers.statistics import Interval
from ..numbers.table import Table

FOLDER = Path(__file__).with_name("templates")


def text(entry: Entry | None, column: Column, plus_minus: str) -> str:
    """A cell without its mark: value, deviation, interval and number of seeds, as far as it has them."""
    if entry is None:
        return "–"
    spread = "" if entry.std is None else f"{plus_minus}{number(entry.std, Column('', column.digits))}"
    within = f" [{number(entry.interval.low, column)}, {number(entry.interval.high, column)}]" if entry.interval else ""
    return f"{number(entry.value, column)}{spread}{within}{f' ({entry.n})' if entry.n else ''}"


def shown(table: Table, ends_of_scores: bool = False) -> list[Grid]:
    """A table as documents show it: for each milestone returns between floor and ceiling, and the scores of tasks that have a reference.

    Args:
        table: which.
        ends_of_scores: the second has a column for floor and ceiling, too, so that both have as many.
    """
    returns = tuple(map(Column, table.headings))
    scores = tuple(Column(method, 2) for method in table.methods)
    if ends_of_scores:  # below the others' heads
        scores = (Column(""), *(Column("", 2) for _ in table.methods), Column(""))
    grids = []
    for part in table.grid.parts:
        lines, scored = [], []
        for line in part.lines:
            bounds = table.references.get(line.labels[0])
            floor, ceiling = (None, None) if bounds is None else (Entry(bounds.floor), Entry(bounds.ceiling))
            lines.append(Line(line.labels, (floor, *line.entries, ceiling)) if table.references else line)
            if bounds is not None:
                between = [None if entry is None else entry.scored(bounds) for entry in line.entries]
                scored.append(Line(line.labels, tuple([Entry(0.0), *between, Entry(1.0)] if ends_of_scores else between)))
        grids.append(replace(table.grid, columns=returns, parts=(Part(part.title, part.key, tuple(lines)),)))
        if table.references:
            grids.append(replace(table.grid, columns=scores, parts=(Part(f"{part.title}, scores", part.key, tuple(scored)),)))
    return grids


def estimated(estimate: Estimate) -> str:
    """A value with its interval in square brackets and the stratified one in braces."""
    stratified = f" {{{_ends(estimate.stratified)}}}" if estimate.stratified else ""
    return " ".join(filter(None, (f"{estimate.value:.3f}", bracketed(estimate.interval)))) + stratified


def chance(pair: Pair) -> str:
    """The probability of an improvement with its interval."""
    return f"{pair.probability:.2f}" + (f" [{pair.interval.low:.2f}, {pair.interval.high:.2f}]" if pair.interval else "")


def bracketed(interval: Interval | None) -> str:
    """An interval in square brackets; empty without one."""
    return f"[{_ends(interval)}]" if interval else ""


def _ends(interval: Interval) -> str:
    return f"{interval.low:.3f}, {interval.high:.3f}"
