"""Tables for a terminal (see ``cudc_bench.cli.tables``), so that nothing in a record is taken for markup and no number is broken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from cudc_bench.cli import tables
from cudc_bench.cli.tables import Cell, Row, row

from ..datasets.diagnostics import Comparison
from ..datasets.pair import Pair
from ..datasets.quality import Quality, QualityTable, TaskMeasures
from ..numbers.grid import Column, Entry, number
from ..numbers.overall import LEAD, PRELIMINARY, Overall
from ..numbers.study import Study
from ..numbers.table import Table
from .text import bracketed, chance, text

if TYPE_CHECKING:
    from rich.console import Group

_NARROW = 2  # digits behind the point of a study's numbers, at most
_SIDE_BY_SIDE = 6
BESIDE = {
    "trajectory_quality": "TQ: mean return between floor and ceiling", "coverage_ratio": "SACo: state-action pairs, of a replay's",
    "expert_recall": "recall: of an expert's states", "expert_precision": "precision: where an expert's states are",
}  # fmt: skip
REPRESENTATION_COLUMNS = {"error_over_persistence": "error", "effective_rank": "rank", "state_spread": "spread"}


def of_table(table: Table) -> Group:
    """Title, table and caption.

    Tasks are the rows as in the files, but methods are where there are too many of them to stand side by side in 80 columns.
    """
    from rich.console import Group
    from rich.text import Text

    shown: list[Row] = []
    turned = len(table.headings) > _SIDE_BY_SIDE
    columns = _columns("", *(table.tasks if turned else table.headings))

    def block(title: str, tasks: Sequence[str], rows: Sequence[Sequence[tuple[str, bool]]]) -> None:
        shown.append(Row(heading=title))
        cells = [[Cell(cell, "bold" if best else "") for cell, best in line] for line in rows]
        for name, line in zip(table.headings if turned else tasks, zip(*cells, strict=True) if turned else cells, strict=True):
            shown.append(Row((Cell(name), *line)))

    for part in table.grid.parts:
        rows, scores = [], []
        for line in part.lines:
            bounds = table.references.get(line.labels[0])
            marks = [bool(entry and entry.best) for entry in line.entries]
            ends = [(str(round(end)) if bounds else "–", False) for end in ((bounds.floor, bounds.ceiling) if bounds else (0.0, 0.0))]
            texts = [(text(entry, Column(""), "±"), best) for entry, best in zip(line.entries, marks, strict=True)]
            rows.append([ends[0], *texts, ends[1]] if table.references else texts)
            scored = [entry.scored(bounds) if entry and bounds else None for entry in line.entries]
            between = [(text(entry and replace(entry, n=0), Column("", 2), "±"), best) for entry, best in zip(scored, marks, strict=True)]
            scores.append([("0", False), *between, ("1", False)] if bounds else [("–", False)] * len(table.headings))
        block(part.title, table.tasks, rows)
        if table.references:
            block(f"{part.title}, scores", table.tasks, scores)
    title = Text(f"{table.domain}, {table.algorithm}, profile {table.group}", style="bold")
    return Group(title, tables.Table(columns, tuple(shown)), Text(table.caption, style="dim"))


def of_study(study: Study) -> Group:
    """Title, tables and notes."""
    from rich.console import Group, RenderableType
    from rich.text import Text

    parts: list[RenderableType] = [Text(study.heading, style="bold")]
    for grid in study.tables:
        if grid.long:
            parts.append(Text(f"{grid.title}: {study.folder}/{study.name}-{grid.name}.csv, {study.name}.md"))
            continue
        rows = []
        for part in grid.parts:
            rows.append(Row(heading=part.title))
            for line in part.lines:
                cells = [
                    Cell(_narrow(entry, column), "bold" if entry and entry.best else "")
                    for column, entry in zip(grid.columns, line.entries, strict=True)
                ]
                rows.append(Row((*map(Cell, line.labels), *cells)))
        labels = tuple(tables.Column(name) for name in ("", *grid.head[1:]))
        columns = (*labels, *_columns(*(column.name for column in grid.columns), first=False))
        parts += [Text(grid.title), tables.Table(columns, tuple(rows), keys=len(labels))]
    parts.append(Text("\n".join([study.caption, *(f"Note: {note}" for note in study.notes)]), style="dim"))
    return Group(*parts)


def of_overall(overall: Overall) -> Group:
    """The headline comparison, the mean with its interval first."""
    from rich.console import Group
    from rich.text import Text

    comparison = overall.headline
    rows = []
    for standing in comparison.standings:
        headline = standing.estimates[LEAD]
        rest = [f"{standing.estimates[name].value:.3f}" for name in ("iqm", "median", "optimality_gap")]
        first = "–" if standing.ranks is None else f"{standing.ranks[0]:.2f}"
        interval = bracketed(headline.interval) or "–"
        rows.append(row(standing.method, f"{headline.value:.3f}", interval, *rest, first, standing.seeds_text))
    names = ("", "mean", "95 % interval", "IQM", "median", "gap", "P(rank 1)", "seeds")
    columns = tuple(tables.Column(name, right=bool(name)) for name in names)
    wins = [f"{pair.method} over {pair.other} ({chance(pair)})" for pair in comparison.pairs if pair.better]
    lines = [
        f"Scores: {comparison.unit}. IQM: mean without the lowest and highest quarter of runs; gap: mean of max(0, 1 - score).",
        f"Improvements (interval above 0.5, Holm's p < 0.05): {len(wins)}{f', such as {wins[-1]}' if wins else ''}.",
        *comparison.remarks,
        *([overall.power_text] if overall.power_text else []),
        *([PRELIMINARY] if comparison.preliminary else []),
        *(f"Left out: {line}" for line in comparison.left_out),
    ]
    title = Text(f"Overall: {overall.algorithm}, profile {overall.group}: {comparison.title}", style="bold")
    return Group(title, tables.Table(columns, tuple(rows)), Text("\n".join(lines), style="dim"))


def of_diagnostics(comparison: Comparison) -> Group:
    """A line for each dataset, with k at the end, when it grew, whether that is suspect, and the last coverage.

    Where some have a representation, also its last forward error over persistence, effective rank and spread.
    """
    from rich.console import Group
    from rich.text import Text

    measured = REPRESENTATION_COLUMNS if comparison.having(REPRESENTATION_COLUMNS) else {}
    names = ("method", "seed", "steps", "k", "k grew", "suspect", "cells", "entropy", *measured.values())
    columns = tuple(tables.Column(name, right=name not in {"method", "k grew", "suspect"}) for name in names)
    rows = []
    for run in comparison.runs:
        cells, entropy = run.last("coverage_cells"), run.last("coverage_entropy")
        texts = (
            run.manifest.method, str(run.manifest.seed), f"{run.manifest.steps:,}", "" if run.k is None else f"{run.k:g}",
            "\n".join(map(str, run.schedule.growth)),
            # Only methods whose k can grow tell whether its schedule is suspect.
            {True: "yes", False: "no", None: ""}[run.schedule.suspect],
            "" if cells is None else f"{cells:,.0f}", "" if entropy is None else f"{entropy:.2f}",
            *("" if (value := run.last(name)) is None else f"{value:.3g}" for name in measured),
        )  # fmt: skip
        rows.append(row(*(one or "–" for one in texts)))
    title = Text(f"{comparison.domain}, profile {comparison.group}", style="bold")
    return Group(title, tables.Table(columns, tuple(rows), keys=2))


def of_quality(table: QualityTable) -> Group:
    """A line for each dataset."""
    from rich.console import Group
    from rich.text import Text

    tasks = (task.replace("_", "\n") for task in table.tasks)
    names = ("method", "seed", *tasks, "visited\ncells", "visits\n(nats)", "states\n(nats)", "|a|\n>0.95", "a·a'")
    columns = tuple(tables.Column(name, right=name != "method") for name in names)
    rows = tuple(row(one.manifest.label, str(one.manifest.seed), *_rewards(one), *_spread(one)) for one in table.datasets)
    title = Text(f"{table.domain}, profile {table.group}: mean reward per step of each task, and how far the data spread", style="bold")
    shown = [tables.Table(columns, rows, keys=2)]
    if beside := _beside(table):
        shown.append(tables.Table(columns[: 2 + len(table.tasks)], beside, keys=2))
    return Group(title, *shown)


def of_pair(pair: Pair) -> Group:
    """A line for each of both, and how much of their states lies in the same places."""
    from rich.console import Group
    from rich.text import Text

    shared = f"{pair.shared:.0%} of the states are in the same cells of {pair.x.name} and {pair.y.name}."
    return Group(of_quality(pair.table), Text(shared, style="dim"))


def _columns(*names: str, first: bool = True) -> tuple[tables.Column, ...]:
    """Columns of numbers under names that may be shortened; the first, unless there is none, says what they are of."""
    return tuple(tables.Column(name, right=not first or index > 0, named=True) for index, name in enumerate(names))


def _rewards(one: Quality) -> list[str]:
    return [f"{found.mean:.3f}" for found in one.rewards.values()]


def _spread(one: Quality) -> list[str]:
    coverage = ["–", "–"] if one.coverage is None else [f"{one.coverage.coverage_cells:,}", f"{one.coverage.coverage_entropy:.2f}"]
    particle = "–" if one.particle_entropy is None else f"{one.particle_entropy:.2f}"
    correlation = "–" if one.action_correlation is None else f"{one.action_correlation:.2f}"
    return [*coverage, particle, f"{one.action_saturated:.1%}", correlation]


def _beside(table: QualityTable) -> tuple[Row, ...]:
    """What the datasets have of each task beside others, below a heading for each measure; nothing of what none has."""
    rows = []
    for name, title in BESIDE.items():
        texts = [[_share(one.tasks.get(task), name) for task in table.tasks] for one in table.datasets]
        if any(text != "–" for of in texts for text in of):
            rows.append(Row(heading=title))
            rows += [row(one.manifest.label, str(one.manifest.seed), *of) for one, of in zip(table.datasets, texts, strict=True)]
    return tuple(rows)


def _share(found: TaskMeasures | None, name: str) -> str:
    value = None if found is None else getattr(found, name)
    return "–" if value is None else f"{value:.3f}"


def _narrow(entry: Entry | None, column: Column) -> str:
    """The same in fewer letters; an interval stands below its value, and how many seeds it is of in files."""
    short = Column(column.name, None if column.digits is None else min(column.digits, _NARROW), column.signed)
    if entry is None or not entry.interval:
        return text(entry, short, "±")
    low, high = number(entry.interval.low, short), number(entry.interval.high, short)
    return f"{number(entry.value, short)}\n{low} to {high}"
