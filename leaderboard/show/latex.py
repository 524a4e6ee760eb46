"""Tables as LaTeX for ``booktabs``. Text from records is escaped."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from cudc_bench.text import plain, templates

from ..numbers.grid import Column, Entry, Grid
from ..numbers.overall import NAMES, PAIRS_CAPTION, Overall
from ..numbers.study import Study
from ..numbers.table import Table
from .text import FOLDER, estimated, shown, text

_TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", **{c: f"\\{c}" for c in "&%$#_{}"},
}  # fmt: skip


def of_table(table: Table) -> str:
    """A ``table`` environment with the caption; its document needs ``\\usepackage{booktabs}``."""
    return _floats([(table.caption, table.slug, shown(table, ends_of_scores=True))], count_marked=False)


def of_paper(paper: Grid, slug: str) -> str:
    """Our cells beside the paper's as one table; ``slug``: of the table that they are from."""
    return _floats([(paper.caption, f"{slug}.{paper.name}", [paper])])


def of_study(study: Study) -> str:
    """A ``table`` environment for each table."""
    floats = [
        (f"{study.title}: {grid.title}. {study.caption} {grid.caption}", f"{study.slug}.{grid.name}", [grid]) for grid in study.tables
    ]
    return _floats(floats, [study.heading, *study.notes])


def of_overall(overall: Overall) -> str:
    """A table of all comparisons' aggregates and one of the headline's probabilities of improvement."""
    template = templates(FOLDER, escape).get_template("overall.tex.j2")
    return template.render(overall=overall, names=NAMES, pairs_caption=PAIRS_CAPTION, estimate=estimated,
                           chance=lambda pair: f"{pair.probability:.2f}")  # fmt: skip


def escape(text: str) -> str:
    """Text that LaTeX shows as it is; characters beyond ASCII, which a font may lack, by their numbers."""
    ascii_only = plain(text).encode("ascii", "backslashreplace").decode()
    escaped = "".join(_TEX.get(c, c) for c in ascii_only)
    return re.sub("-(?=-)", "-{}", escaped)  # Two hyphens would become a dash.


def _floats(floats: Sequence[tuple[str, str, Sequence[Grid]]], comments: Sequence[str] = (), *, count_marked: bool = True) -> str:
    """A document of tables.

    Args:
        floats: caption, label and grids of each; those of one have the same number of columns.
        comments: above all of them.
        count_marked: whether the number of seeds is bold where its cell is.
    """
    template = templates(FOLDER, escape).get_template("grids.tex.j2")
    return template.render(floats=floats, comments=comments, cell=lambda entry, column: _cell(entry, column, count_marked))


def _cell(entry: Entry | None, column: Column, count_marked: bool) -> str:
    # Numbers alone: nothing of a record's is in them.
    if entry is None:
        return "--"
    apart = bool(entry.n and entry.best and not count_marked)
    cell = text(replace(entry, n=0) if apart else entry, column, r" $\pm$ ")
    cell = f"${cell}$" if cell[:1] in "+-" and "$" not in cell else cell
    return f"\\textbf{{{cell}}}{f' ({entry.n})' if apart else ''}" if entry.best else cell
