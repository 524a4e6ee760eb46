"""A study's tables as Markdown, LaTeX, CSV and for a terminal, one renderer for each. Text from records is escaped in all of them."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

from cudc_bench.text import escape_markdown, templates

from ..numbers.grid import Column, Entry, Grid, number
from ..numbers.study import Study
from .figures.draw import study_figure_files
from .render import escape_latex

if TYPE_CHECKING:
    from rich.console import Group


_FOLDER = Path(__file__).with_name("templates")
_NARROW = 2  # digits behind the point of a terminal's numbers, at most


def study_files(study: Study) -> dict[str, str | bytes]:
    """``<study>.md`` and ``.tex`` with all tables, ``<study>-<table>.csv`` for each, ``<study>-<figure>.svg`` and ``.pdf`` for each."""
    files: dict[str, str | bytes] = {f"{study.name}.md": to_markdown(study), f"{study.name}.tex": to_latex(study)}
    files |= {f"{study.name}-{grid.name}.csv": to_csv(study, grid) for grid in study.tables}
    return files | study_figure_files(study)


def to_markdown(study: Study) -> str:
    """A heading, the tables with their captions, what to know of them, and the commands that make the records again."""
    template = templates(_FOLDER, escape_markdown).get_template("study.md.j2")
    return template.render(study=study, text=lambda entry, column: text(entry, column, " ± "))


def to_latex(study: Study) -> str:
    """A ``table`` environment for each table; its document needs ``\\usepackage{booktabs}``."""
    template = templates(_FOLDER, escape_latex).get_template("study.tex.j2")
    # Numbers alone: nothing of a record's is in them.
    return template.render(study=study, text=lambda entry, column: _math(text(entry, column, r" $\pm$ ")))


def to_csv(study: Study, grid: Grid) -> str:
    """One line for each cell in full precision; a missing cell has no value."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    head = ["study", "group", "algorithm", "domain", grid.split, *grid.head, "column"]
    writer.writerow([*head, "value", "std", "low", "high", "seeds", "best"])
    for part, line, column, entry in grid.entries():
        where = [study.name, study.group, study.algorithm, study.domain, part.key, *line.labels, column.name]
        values: list[object] = [None] * 6
        if entry is not None:
            low, high = (entry.interval.low, entry.interval.high) if entry.interval else (None, None)
            values = [entry.value, entry.std, low, high, entry.n, entry.best]
        writer.writerow([*where, *values])
    return file.getvalue()


def to_rich(study: Study) -> Group:
    """For a terminal: title, tables and notes; ``rich`` objects throughout, so that nothing in a record is taken for markup."""
    from rich import box
    from rich.console import Group, RenderableType
    from rich.table import Table
    from rich.text import Text

    parts: list[RenderableType] = [Text(study.heading, style="bold")]
    for grid in study.tables:
        if grid.long:
            parts.append(Text(f"{grid.title}: {study.folder}/{study.name}-{grid.name}.csv, {study.name}.md"))
            continue
        shown = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
        for name in ("", *grid.head[1:]):
            shown.add_column(name)
        for column in grid.columns:
            shown.add_column(Text(column.name), justify="right")
        for part in grid.parts:
            shown.add_row(Text(part.title, style="bold"))
            for line in part.lines:
                cells = [
                    Text(_narrow(entry, column), style="bold" if entry and entry.best else "")
                    for column, entry in zip(grid.columns, line.entries, strict=True)
                ]
                shown.add_row(*map(Text, line.labels), *cells)
            shown.add_section()
        parts += [Text(grid.title), shown]
    parts.append(Text("\n".join([study.caption, *(f"Note: {note}" for note in study.notes)]), style="dim"))
    return Group(*parts)


def text(entry: Entry | None, column: Column, plus_minus: str) -> str:
    """A cell without its mark: value, deviation, interval and number of seeds, as far as it has them."""
    if entry is None:
        return "–"
    spread = "" if entry.std is None else f"{plus_minus}{number(entry.std, Column('', column.digits))}"
    within = f" [{number(entry.interval.low, column)}, {number(entry.interval.high, column)}]" if entry.interval else ""
    return f"{number(entry.value, column)}{spread}{within}{'' if entry.n is None else f' ({entry.n})'}"


def _narrow(entry: Entry | None, column: Column) -> str:
    """The same in fewer letters; an interval stands below its value, and how many seeds it is of in files."""
    short = Column(column.name, min(column.digits, _NARROW), column.signed)
    if entry is None or not entry.interval:
        return text(entry, short, "±")
    low, high = number(entry.interval.low, short), number(entry.interval.high, short)
    return f"{number(entry.value, short)}\n{low} to {high}"


def _math(cell: str) -> str:
    """Dashes and signs as LaTeX writes them."""
    return "--" if cell == "–" else f"${cell}$" if cell[:1] in "+-" else cell
