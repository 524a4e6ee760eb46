"""Pages of the studies: their tables, whose cells lead to their runs, figures and files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property

from cudc_bench.artefacts.records import Record

from ..methods import canonical
from ..numbers import figures as study_figures
from ..numbers import grid as study_grid
from ..numbers.columns import column
from ..numbers.study import Study
from ..numbers.table import ENOUGH_SEEDS
from ..numbers.words import short
from ..show.text import text
from .figures import captions, look_of, methods_of, milestone_styles, of_study, references_of, with_references
from .models import Figure, Heading, HtmlTable, Item, Page, Row, Section
from .parts import ComparisonPage, Parts, line_swatch, method_path, runs_path, study_path


class Studies(Parts):
    """Builds them."""

    def studies_of(self, board: ComparisonPage) -> list[Study]:
        """The studies that a comparison's records take part in."""
        of_group = [(study, names) for study, names in self._algorithms_of if study.group == board.group]
        return [study for study, names in of_group if board.algorithm in names]

    @cached_property
    def _algorithms_of(self) -> list[tuple[Study, set[str | None]]]:
        """Each study with the algorithms that take part in it."""
        return [(study, {study.algorithm, *(one.algorithm for one in study.records)}) for study in self.site.studies]

    def studies_list(self, studies: Sequence[Study]) -> tuple[Section, ...]:
        """Ways to them."""
        if not studies:
            return ()
        lines = tuple(Item(f"{study.title}{f': {study.domain}' if study.domain else ''}", link=study_path(study)) for study in studies)
        return (Section("Studies", lines=lines, lead="Further comparisons of the same records, each a page of its own."),)

    def study_pages(self, studies: Sequence[Study]) -> Iterable[Page]:
        """A page for each of some studies."""
        for study in studies:
            grids = [self._section(one) for one in study.tables]
            figures = tuple(one for name, figure in study.figures.items() for one in self._figures(name, figure))
            names = [study.name, *(f"{study.name}-{one}" for one in (*(table.name for table in study.tables), *study.figures))]
            sections = [
                *grids,
                *([Section("Figures", figures=figures)] if figures else []),
                *([Section("Notes", lines=tuple(map(Item, study.notes)))] if study.notes else []),
                Section("Files", downloads=self.downloads(study.folder, names)),
                Section("Make it again", code=tuple(("", command) for command in study.commands), folded=True),
            ]
            boards = [board for board in self.site.boards if any(study is one for one in self.studies_of(board))]
            crumbs = self.crumbs(boards[0]) if len(boards) == 1 else (("Overview", "index.html"),)
            few = any(0 < entry.n < ENOUGH_SEEDS for one in study.tables for *_, entry in one.entries() if entry)
            badges = ("Preliminary: fewer than five seeds",) if few else ()
            yield Page(study_path(study), study.title, crumbs, (study.heading, study.caption), badges, tuple(sections))

    def _figures(self, name: str, figure: study_figures.Figure) -> list[Figure]:
        """A figure of a study, once for each milestone if that is what it is of."""
        look = look_of(figure)
        legend = tuple(replace(self._label(method), picture=line_swatch(look[method])) for method in methods_of(figure))
        if isinstance(figure, study_figures.Bounds):
            legend = tuple(Item(text, picture=line_swatch(one)) for text, one in milestone_styles(figure.runs.milestones).items())
        after = with_references(references_of(figure))
        found = []
        for milestone, panels in of_study(figure, look):
            what = f"{name.replace('-', ' ')}{'' if milestone is None else f' after {short(milestone)} gradient steps'}"
            caption = f"{captions(figure)}{after}" if milestone is None else f"{captions(figure)} After {short(milestone)} steps.{after}"
            found.append(Figure(panels, f"Figure of the study: {what}; numbers in the tables above.", caption, legend, milestone))
        return found

    def _section(self, table: study_grid.Grid) -> Section:
        grids = []
        for part in table.parts:
            milestone = part.key if table.split == "milestone" and isinstance(part.key, int) else None
            lines = []
            for line in part.lines:
                items = [self._item(entry, one, line.labels, milestone) for one, entry in zip(table.columns, line.entries, strict=True)]
                head, *further = map(self._label, line.labels)
                lines.append(Row(head, (*further, *items)))
            columns = (*(Heading(name, number=False) for name in table.head[1:]), *(Heading(one.name) for one in table.columns))
            grids.append(HtmlTable(f"{table.title}: {part.title}", table.head[0], columns, tuple(lines), milestone=milestone))
        return Section(table.title, grids=tuple(grids), text=(table.caption.replace("Bold in", "Bold and ● in"),))

    def _label(self, label: str) -> Item:
        name = canonical(label)
        return Item(label, link=method_path(name)) if name in self.site.methods else Item(label)

    def _item(self, entry: study_grid.Entry | None, one: study_grid.Column, labels: Sequence[str], milestone: int | None) -> Item:
        if entry is None:
            return Item()
        # Of a share of CUDC's score the row's own runs.
        names = set(map(canonical, labels))
        records = [record for record in entry.records if column(record) in names] or entry.records
        return Item(text(entry, one, " ± "), entry.value, self._runs_behind(records, milestone), entry.best)

    def _runs_behind(self, records: Sequence[Record], milestone: int | None) -> str | None:
        """The page of the runs, if one page has them all; else that of their method."""
        places = {(id(self.table_of[id(one)]), one.dataset.task, column(one)) for one in records if id(one) in self.table_of}
        methods = {method for _, _, method in places}
        if len(places) == 1:
            first = records[0]
            return runs_path(self.table_of[id(first)], first.dataset.task, column(first), milestone)
        return method_path(methods.pop()) if len(methods) == 1 else None
