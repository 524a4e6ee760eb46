"""Tables as Markdown. Text from records is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cudc_bench.text import escape_markdown, templates

from ..datasets.quality import QualityTable
from ..numbers.grid import Column, Entry, Grid
from ..numbers.overall import NAMES, PAIRS_CAPTION, Overall
from ..numbers.study import Study
from ..numbers.table import Table
from .text import FOLDER, chance, estimated, shown, text


def of_table(table: Table) -> str:
    """A heading, one GitHub-flavoured table for each milestone, the caption, and the commands that make the records again."""
    heading = f"{table.domain}, {table.algorithm}, profile {table.group}"
    return _grids(heading, [("", shown(table), table.caption)], table.submissions, table.commands, count_marked=False)


def of_paper(paper: Grid) -> str:
    """Our cells beside the paper's, a table for each milestone."""
    return _grids(paper.title, [("", [paper], paper.caption)])


def of_study(study: Study) -> str:
    """A heading, the tables with their captions, what to know of them, and the commands that make the records again."""
    sections = [(grid.title, [grid], grid.caption) for grid in study.tables]
    return _grids(study.heading, sections, study.notes, study.commands, lead=study.caption, notes_head="Notes:")


def of_overall(overall: Overall) -> str:
    """For each comparison its aggregates, the probabilities of improvement and what was left out."""
    template = templates(FOLDER, escape_markdown).get_template("overall.md.j2")
    return template.render(overall=overall, names=NAMES, pairs_caption=PAIRS_CAPTION, estimate=estimated, chance=chance)


def of_quality(table: QualityTable) -> str:
    """A heading, a table of what datasets are worth to each task, one of how far they spread, and what the numbers are."""
    return templates(FOLDER, escape_markdown).get_template("quality.md.j2").render(table=table)


def _grids(
    heading: str, sections: Sequence[tuple[str, Sequence[Grid], str]], notes: Sequence[str] = (), commands: Sequence[str] = (), *,
    lead: str = "", notes_head: str = "", count_marked: bool = True,
) -> str:  # fmt: skip
    """A document of grids.

    Args:
        heading, lead: above all of them.
        sections: title, if it has one, grids and the caption below them.
        notes, notes_head: a list below, and what stands above it.
        commands: that make the numbers again.
        count_marked: whether the number of seeds is bold where its cell is.
    """
    return templates(FOLDER, escape_markdown).get_template("grids.md.j2").render(
        heading=heading, lead=lead, sections=sections, notes=notes, notes_head=notes_head, commands=commands,
        cell=lambda entry, column: _cell(entry, column, count_marked),
    )  # fmt: skip


def _cell(entry: Entry | None, column: Column, count_marked: bool) -> str:
    # Numbers alone: nothing of a record's is in them.
    if entry is None or not entry.best:
        return text(entry, column, " ± ")
    if count_marked or not entry.n:
        return f"**{text(entry, column, ' ± ')}**"
    return f"**{text(replace(entry, n=0), column, ' ± ')}** ({entry.n})"
