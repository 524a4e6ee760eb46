"""Tables as Markdown, LaTeX, CSV and for the terminal. Text from records is escaped in each of them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from cudc_bench.markup import escape_markdown, plain, templates

from .diagnostics import Comparison
from .load import short
from .table import Cell, Table

if TYPE_CHECKING:
    from rich.console import Group

_TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", **{c: f"\\{c}" for c in "&%$#_{}"},
}  # fmt: skip


def to_markdown(table: Table) -> str:
    """A heading, one GitHub-flavoured table for each milestone, the caption, and the commands that make the records again."""
    return _render("table.md.j2", table, escape_markdown)


def to_latex(table: Table) -> str:
    """A ``table`` environment with the caption; its document needs ``\\usepackage{booktabs}``."""
    return _render("table.tex.j2", table, escape_latex)


def to_csv(table: Table) -> str:
    """One line for each cell in full precision; a missing cell has 0 seeds and neither mean nor standard deviation."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "domain", "milestone", "task", "method", "mean", "std", "seeds", "best"])
    for section in table.sections:
        for row in section.rows:
            for method, cell in zip(table.methods, row.cells, strict=True):
                values = [cell.mean, cell.std, cell.n, cell.best] if cell else [None, None, 0, False]
                writer.writerow([table.group, table.algorithm, table.domain, section.milestone, row.task, method, *values])
    return text.getvalue()


_SIDE_BY_SIDE = 6


def to_rich(table: Table) -> Group:
    """For a terminal: title, table and caption; ``rich`` objects throughout, so that nothing in a record is taken for markup.

    Tasks are the rows as in the files, but methods are where there are too many of them to stand side by side in 80 columns.
    """
    from rich import box
    from rich.console import Group
    from rich.table import Table as Grid
    from rich.text import Text

    shown = Grid(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    shown.add_column("")
    turned = len(table.methods) > _SIDE_BY_SIDE
    for name in table.tasks if turned else table.methods:
        shown.add_column(Text(name), justify="right")
    for section in table.sections:
        shown.add_row(Text(f"{short(section.milestone)} steps", style="bold"))
        cells = [[Text(_text(cell), style="bold" if cell and cell.best else "") for cell in row.cells] for row in section.rows]
        for name, line in zip(table.methods if turned else table.tasks, zip(*cells, strict=True) if turned else cells, strict=True):
            shown.add_row(Text(name), *line)
        shown.add_section()
    title = Text(f"{table.domain}, {table.algorithm}, profile {table.group}", style="bold")
    return Group(title, shown, Text(table.caption, style="dim"))


def diagnostics_to_rich(comparison: Comparison) -> Group:
    """For a terminal: a line for each dataset, with k at the end, when it grew, whether that is suspect, and the last coverage."""
    from rich import box
    from rich.console import Group
    from rich.table import Table as Grid
    from rich.text import Text

    shown = Grid(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for name in ("method", "seed", "steps", "k", "k grew", "suspect", "cells", "entropy"):
        shown.add_column(name, justify="left" if name in {"method", "k grew", "suspect"} else "right")
    for run in comparison.runs:
        cells, entropy = run.last("coverage_cells"), run.last("coverage_entropy")
        # Only methods whose k can grow tell whether its schedule is suspect.
        adapts = "k_schedule_suspect" in run.manifest.diagnostics
        row = (
            plain(run.manifest.method), str(run.manifest.seed), f"{run.manifest.steps:,}", "" if run.k is None else f"{run.k:g}",
            "\n".join(map(str, run.manifest.k_growth)),
            ("yes" if run.manifest.has_suspect_schedule else "no") if adapts else "",
            "" if cells is None else f"{cells:,.0f}", "" if entropy is None else f"{entropy:.2f}",
        )  # fmt: skip
        shown.add_row(*(Text(cell or "–") for cell in row))
    return Group(Text(f"{comparison.domain}, profile {comparison.group}", style="bold"), shown)


def escape_latex(text: str) -> str:
    """Text that LaTeX shows as it is; characters beyond ASCII, which a font may lack, by their numbers."""
    ascii_only = plain(text).encode("ascii", "backslashreplace").decode()
    escaped = "".join(_TEX.get(c, c) for c in ascii_only)
    return re.sub("-(?=-)", "-{}", escaped)  # Two hyphens would become a dash.


def _text(cell: Cell | None) -> str:
    if cell is None:
        return "–"
    spread = "" if cell.std is None else f"±{round(cell.std)}"
    return f"{round(cell.mean)}{spread} ({cell.n})"


def _render(template: str, table: Table, escape: Callable[[str], str]) -> str:
    environment = templates(Path(__file__).with_name("templates"), escape)
    return environment.get_template(template).render(table=table, round=round, short=short)
