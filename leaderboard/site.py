"""The static site: pages over tables, comparisons, methods, datasets and runs, beside the files that are made of the same models.

:func:`site_files` is a function of its arguments alone. Pages need no server, ask nothing of the network and can be read without
JavaScript; their policy (``Content-Security-Policy``) allows neither scripts nor styles of anybody else's. Places in the output:

    index.html                              the overview, with the comparison that most people want
    <profile>.<algorithm>/index.html        a comparison of its own for each group and algorithm; they are never mixed
    <profile>.<algorithm>.<domain>/         index.html; task-<task>.html; runs-<task>.<method>.html, the runs behind each cell
    methods/, datasets/                     index.html and a page for each
    site/                                   style and script
"""

from __future__ import annotations

import posixpath
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from math import ceil
from pathlib import Path
from typing import Any

from markupsafe import Markup

from cudc_bench.data.card import facts_of
from cudc_bench.envs.domains import DOMAINS, domain_title
from cudc_bench.markup import html_templates, plain
from cudc_bench.records import Record

from .figures import looks
from .load import column, evaluation_at, short
from .methods import describe
from .missing import Missing
from .overall import PAIRS_CAPTION, PRELIMINARY, Comparison, Overall, Standing
from .published import Beside, beside_paper
from .site_datasets import Dataset, Local, datasets_of
from .site_models import MISSING, Exhibit, Figure, Grid, Heading, Item, Line, Page, bar, dots, swatch
from .statistics import student
from .table import ENOUGH_SEEDS, METHOD_ORDER, Cell, Row, Section, Table, file_word, group_slug, ordered, seed_scores, span

ASSETS = ("site.css", "site.js")
Run = tuple[str, str, str, int]  # group, dataset id, algorithm, seed: what records are told apart by
_MOST_LINES = 200  # of problems on a page; a folder of other files gives one for each
_DASHES = {"-": "", "--": "5 2", "-.": "5 2 1.5 2", ":": "1.5 2"}
_LONG = 90  # letters of a name that stands in a line with others


@dataclass(frozen=True)
class Site:
    """What the site is made from.

    Attributes:
        tables, overall, problems, missing: as in ``api.Report``.
        files: names of the files that lie in each slug's folder; they can be shown and downloaded.
        places: where each record is below the results that were read.
        local: datasets that are on this machine, by ``Dataset.word``.
        exhibits: more to show on the page of a slug.
    """

    tables: Sequence[Table]
    overall: Sequence[Overall]
    problems: Sequence[str] = ()
    missing: Sequence[Missing] = ()
    files: Mapping[str, Collection[str]] = field(default_factory=dict)
    places: Mapping[Run, str] = field(default_factory=dict)
    local: Mapping[str, Local] = field(default_factory=dict)
    exhibits: Mapping[str, Sequence[Exhibit]] = field(default_factory=dict)

    @cached_property
    def boards(self) -> list[Board]:
        """What may be compared, the one to show first in front."""
        found: dict[tuple[str, str], list[Table]] = defaultdict(list)
        for table in self.tables:
            found[table.records[0].group, table.algorithm].append(table)
        places = list(DOMAINS)
        boards = []
        for (group, algorithm), tables in found.items():
            tables.sort(key=lambda one: (places.index(one.domain) if one.domain in places else len(places), one.domain))
            slug = group_slug(group, algorithm)
            boards.append(Board(tables[0].group, algorithm, slug, tuple(tables), next((o for o in self.overall if o.slug == slug), None)))
        first = {"paper": 0, "cpu": 1}
        return sorted(boards, key=lambda one: (first.get(one.group, 2), one.algorithm != "td3", -one.runs, one.group, one.algorithm))

    @cached_property
    def datasets(self) -> list[Dataset]:
        """All that were trained on."""
        return datasets_of(self.tables)

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """All columns of all tables."""
        return ordered({method for table in self.tables for method in table.methods}, METHOD_ORDER)

    @cached_property
    def dataset_of(self) -> dict[int, Dataset]:
        """By the identity of a record."""
        return {id(record): dataset for dataset in self.datasets for record in dataset.records}

    def place(self, record: Record) -> str:
        """Where a record was found; empty if that is not known."""
        return self.places.get(run_of(record), "")


@dataclass(frozen=True)
class Board:
    """The tables of one group and algorithm, and their comparison, if there is one."""

    group: str
    algorithm: str
    slug: str
    tables: tuple[Table, ...]
    overall: Overall | None

    @property
    def name(self) -> str:
        """For links."""
        return f"{self.algorithm}, profile {brief(self.group)}"

    @property
    def path(self) -> str:
        """Its page."""
        return f"{self.slug}/index.html"

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods of its tables."""
        return ordered({method for table in self.tables for method in table.methods}, METHOD_ORDER)

    @property
    def milestones(self) -> list[int]:
        """Of its tables, the last first."""
        return sorted({section.milestone for table in self.tables for section in table.sections}, reverse=True)

    @property
    def runs(self) -> int:
        """How many records it has."""
        return sum(len(table.records) for table in self.tables)

    @property
    def preliminary(self) -> bool:
        """Whether a cell has fewer than five seeds."""
        return any(cell.n < ENOUGH_SEEDS for table in self.tables for cell in table.cells)


def run_of(record: Record) -> Run:
    """What tells a record from others."""
    return record.group, record.dataset.id, record.algorithm, record.seed


def site_files(site: Site) -> dict[str, str | bytes]:
    """All files of the site by their path below the output folder."""
    here = Path(__file__).parent
    template = html_templates(here / "templates").get_template("page.html.j2")
    files: dict[str, str | bytes] = {f"site/{name}": (here / "assets" / name).read_bytes() for name in ASSETS}
    for page in _Pages(site).every():
        if page.path in files:
            raise AssertionError(f"two pages want to be {page.path}")
        files[page.path] = template.render(page=page, to=_Links(page.path), style="site/site.css", script="site/site.js",
                                            identify=_Ids(), short=short)  # fmt: skip
    for dataset in site.datasets:
        if dataset.word in site.local:
            files |= {f"datasets/{dataset.word}.{name}.svg": content for name, content in site.local[dataset.word].figures.items()}
    return files


def brief(text: str) -> str:
    """A name without its middle, where it is so long that it would bury the others."""
    return text if len(text) <= _LONG else f"{text[: _LONG * 2 // 3]} … {text[-_LONG // 4 :]}"


class _Links:
    """Makes paths from the site's root relative to a page."""

    def __init__(self, page: str) -> None:
        self._folder = posixpath.dirname(page) or "."

    def __call__(self, path: str) -> str:
        target, mark, fragment = path.partition("#")
        return f"{_relative(target, self._folder) if target else ''}{mark}{fragment}"


@lru_cache(maxsize=65536)
def _relative(target: str, folder: str) -> str:
    return posixpath.relpath(target, folder)


class _Ids:
    """Ids that are unique on a page, made from titles."""

    def __init__(self) -> None:
        self._seen: Counter[str] = Counter()

    def __call__(self, text: str) -> str:
        word = re.sub(r"[^a-z0-9]+", "-", text.lower())[:60].strip("-") or "part"
        if not word[0].isalpha():
            word = f"p-{word}"
        self._seen[word] += 1
        # No title ends in a full stop and a number once its punctuation is gone.
        return word if self._seen[word] == 1 else f"{word}.{self._seen[word]}"


class _Pages:
    """Builds the pages of a site."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self._papers: dict[str, dict[tuple[int, str, str], Beside]] = {}
        self._looks: dict[str, dict[str, Any]] = {}  # of the page under way: as in its figures

    def every(self) -> Iterable[Page]:
        """All pages."""
        boards = self.site.boards
        yield self._overview(boards)
        for board in boards:
            crumbs = (("Overview", "index.html"),)
            self._look(board)
            yield Page(board.path, f"{board.algorithm}, profile {board.group}", crumbs, self._summary(board), self._badges(board), self._board(board))
            for table in board.tables:
                self._looks = looks(table.methods)
                yield self._domain(board, table)
                for task in table.tasks:
                    yield self._task(board, table, task)
                yield from self._runs_of(board, table)
        self._looks = {}  # Colours beyond the paper's methods are those of one comparison.
        yield self._methods_page()
        yield from map(self._method, self.site.methods)
        yield self._datasets_page()
        yield from map(self._dataset, self.site.datasets)

    # ------------------------------------------------------------------------------------------------------------------- overview

    def _overview(self, boards: Sequence[Board]) -> Page:
        first = boards[0]
        self._look(first)
        tables = self.site.tables
        records = [record for table in tables for record in table.records]
        facts = [
            span([len(records)], "run"), span([len(self.site.methods)], "method"), span([len({t.domain for t in tables})], "domain"),
            span([len({(t.domain, task) for t in tables for task in t.tasks})], "task"), span([len(self.site.datasets)], "dataset"),
        ]  # fmt: skip
        lead = (
            "How much offline reinforcement learning gets out of data that were collected without rewards. Every number leads to the runs"
            f" behind it. {', '.join(facts)}.",
            f"Shown here: {first.algorithm}, profile {brief(first.group)}. {self._summary(first)[0]}",
        )
        exhibits = self._board(first)
        choose = Exhibit(
            "Comparisons",
            grids=(self._boards_grid(boards),),
            text=("Results of different profiles, settings or offline algorithms never share a table: each has a page of its own.",),
        )
        return Page("index.html", "Leaderboard of data collectors", (), lead, self._badges(first),
                    (*exhibits[:1], choose, *exhibits[1:], *self._problems(), self._reading(boards), self._behind(records)))  # fmt: skip

    def _boards_grid(self, boards: Sequence[Board]) -> Grid:
        lines = [
            Line(
                Item(brief(one.group), link=one.path),
                (Item(one.algorithm), Item(", ".join(table.domain for table in one.tables)), _count(len(one.methods)),
                 Item(span([cell.n for table in one.tables for cell in table.cells] or [0], "seed")
                      + (", preliminary" if one.preliminary else "")), _count(one.runs)),
            )
            for one in boards
        ]  # fmt: skip
        columns = (Heading("algorithm", number=False), Heading("domains", number=False), Heading("methods"), Heading("seeds", number=False),
                   Heading("runs"))  # fmt: skip
        return Grid("What may be compared, by profile with its settings and offline algorithm", "profile", columns, tuple(lines))

    def _problems(self) -> tuple[Exhibit, ...]:
        if not self.site.problems:
            return ()
        lines = [Item(problem) for problem in self.site.problems[:_MOST_LINES]]
        rest = len(self.site.problems) - len(lines)
        return (Exhibit("Problems", lines=tuple(lines), text=(f"… and {rest:,} more.",) if rest else (), folded=len(lines) > 5,
                        lead="What was left out of the tables, or is doubtful in them."),)  # fmt: skip

    def _reading(self, boards: Sequence[Board]) -> Exhibit:
        scores = ", ".join(f"{domain.max_return:,.0f} on {domain.name}" for domain in DOMAINS.values())
        lines = (
            "A return is the undiscounted sum of an episode's rewards, a mean over evaluation episodes. Normalised, it is divided by the"
            f" largest that is possible: {scores}.",
            "The unit of replication is the collector seed, that is: the dataset. Several training runs on one dataset count once, as"
            " their mean; ± is the sample standard deviation over seeds, and (5) or n the number of them.",
            "Scores are those after the last gradient step of each milestone, never the best of a training run.",
            "Bold and marked ● in a task: the largest mean, and all that are not significantly worse (two-sided Welch test over seeds, Holm's"
            " correction within the task, p ≥ 0.05).",
            "IQM: mean without the lowest and highest quarter of runs. Intervals: 95 %, by a cluster bootstrap that draws datasets with all"
            " their tasks. P(rank 1): how often a method has the largest IQM in it.",
            f"{PRELIMINARY} A single seed has no interval.",
            "The paper's numbers stand beside ours where it reports the same cell. They come from another implementation and are never"
            " ranked with ours; σ counts the paper's standard deviations between them.",
            f"{MISSING} is a cell without any run.",
        )
        return Exhibit("How to read it", lines=tuple(map(Item, lines)))

    def _behind(self, records: Sequence[Record]) -> Exhibit:
        def grid(caption: str, first: str, names: Sequence[str], counts: Counter[tuple[str, ...]]) -> Grid:
            shown = sorted(counts.items(), key=lambda one: (-one[1], one[0]))
            lines = [Line(Item(brief(key[0])), (*(Item(brief(text) or MISSING) for text in key[1:]), _count(n))) for key, n in shown[:20]]
            if len(shown) > 20:
                rest = sum(n for _, n in shown[20:])
                lines.append(Line(Item(f"{len(shown) - 20} others"), (*(Item() for _ in names), _count(rest))))
            return Grid(caption, first, (*(Heading(name, number=False) for name in names), Heading("runs")), tuple(lines))

        packages = ("torch", "mujoco", "numpy")
        codes = Counter((_version(r, "cudc-bench"), _commit(r), *(_version(r, name) for name in packages)) for r in records)
        machines = Counter((_machine(r, "processor"), _machine(r, "device"), _machine(r, "system")) for r in records)
        return Exhibit("Versions and machines behind it", grids=(
            grid("Versions and commits of the code that trained", "cudc-bench", ("commit", *packages), codes),
            grid("Machines that trained", "processor", ("device", "system"), machines),
        ))  # fmt: skip

    # ---------------------------------------------------------------------------------------------------------------------- board

    def _summary(self, board: Board) -> tuple[str, ...]:
        counts = (span([board.runs], "run"), span([len(board.methods)], "method"))
        domains = ", ".join(table.domain for table in board.tables)
        seeds = span([cell.n for table in board.tables for cell in table.cells] or [0], "seed")
        return (f"{', '.join(counts)} on {domains}; {seeds} behind a cell.",)

    def _badges(self, board: Board) -> tuple[str, ...]:
        return ("Preliminary: fewer than five seeds",) if board.preliminary else ()

    def _board(self, board: Board) -> tuple[Exhibit, ...]:
        parts: list[Exhibit] = []
        if board.overall is not None:
            parts += self._ranking(board, board.overall)
        matrix = tuple(self._matrix(board, milestone) for milestone in board.milestones)
        parts.append(Exhibit(
            "Methods and tasks", grids=matrix,
            text=("Each number leads to its runs, each task to its curves and intervals, each method to what it is.",),
        ))  # fmt: skip
        if board.overall is not None:
            parts += self._comparisons(board, board.overall)
        parts += self.site.exhibits.get(board.slug, ())
        parts += self._further(board.slug, {"intervals", "profiles", "ranks"}, {"overall", "scores"})
        missing = [one for one in self.site.missing if (one.group, one.algorithm) == (board.group, board.algorithm)]
        if missing:
            parts.append(_missing(missing))
        return tuple(parts)

    def _ranking(self, board: Board, overall: Overall) -> list[Exhibit]:
        headline = overall.headline
        grids = [self._standings(board, one) for one in overall.comparisons if one.scope == headline.scope]
        figures = self._figure(board.slug, "intervals", f"Aggregates of each method with 95 % intervals, {headline.title}; numbers above.")
        return [Exhibit(
            f"Ranking over {headline.scope}", grids=tuple(grids), figures=figures,
            downloads=self._downloads(board.slug, ("overall", "scores", "intervals")),
            text=(overall.caption, *(f"Left out: {line}" for line in headline.left_out)),
            lead=f"{PRELIMINARY}" if headline.preliminary else "",
        )]  # fmt: skip

    def _standings(self, board: Board, comparison: Comparison) -> Grid:
        standings = sorted(comparison.standings, key=lambda one: -one.estimates["iqm"].value)
        highs = [one.estimates["iqm"].cluster.high for one in standings if one.estimates["iqm"].cluster]  # type: ignore[union-attr]
        largest = ceil(10 * max([*highs, *(one.estimates["iqm"].value for one in standings), 0.1]) - 1e-9) / 10
        columns = (
            Heading("IQM"), Heading("95 % interval", number=False, sorts=False), Heading(f"0 to {largest:g}", number=False, sorts=False),
            Heading("P(rank 1)"), Heading("median"), Heading("mean"), Heading("optimality gap"), Heading("seeds"),
        )  # fmt: skip
        lines = [Line(self._name(one.method), self._standing(one, largest)) for one in standings]
        return Grid(f"{comparison.title}, {comparison.seeds}, by IQM", "method", columns, tuple(lines), milestone=comparison.milestone,
                    filters="methods")  # fmt: skip

    def _standing(self, standing: Standing, largest: float) -> tuple[Item, ...]:
        found = standing.estimates["iqm"]
        within = found.cluster
        low, high = (within.low, within.high) if within else (found.value, found.value)
        rest = [Item(f"{standing.estimates[name].value:.3f}", standing.estimates[name].value) for name in ("median", "mean", "optimality_gap")]
        return (
            Item(f"{found.value:.3f}", found.value),
            Item(f"{low:.3f} to {high:.3f}") if within else Item(),
            Item("", found.value, picture=bar(low, found.value, high, largest, self._colour(standing.method))),
            Item(f"{standing.ranks[0]:.2f}", standing.ranks[0]) if standing.ranks else Item(),
            *rest,
            _count(standing.n),
        )

    def _comparisons(self, board: Board, overall: Overall) -> list[Exhibit]:
        headline = overall.headline
        found = []
        figures = (
            *self._figure(board.slug, "profiles", f"Performance profiles, {headline.title}: share of runs above each score."),
            *self._figure(board.slug, "ranks", f"Probability of each rank by IQM, {headline.title}."),
        )
        if figures:
            found.append(Exhibit("How certain that is", figures=figures, downloads=self._downloads(board.slug, ("profiles", "ranks"))))
        others = [one for one in overall.comparisons if one.scope != headline.scope]
        if others:
            parts = [
                Exhibit(scope, grids=tuple(self._standings(board, one) for one in others if one.scope == scope),
                        text=tuple(f"Left out: {line}" for one in others if one.scope == scope for line in one.left_out))
                for scope in dict.fromkeys(one.scope for one in others)
            ]  # fmt: skip
            found.append(Exhibit("Ranking on each domain", parts=tuple(parts), folded=True))
        pairs = tuple(self._pairs(one) for one in overall.comparisons if one.scope == headline.scope and one.pairs)
        if pairs:
            found.append(Exhibit("Method against method", grids=pairs, text=(PAIRS_CAPTION.replace("Bold:", "Bold and ●:"),), folded=True))
        return found

    def _pairs(self, comparison: Comparison) -> Grid:
        found = {(pair.method, pair.other): pair for pair in comparison.pairs}
        lines = []
        for method in comparison.methods:
            items = []
            for other in comparison.methods:
                pair = found.get((method, other))
                within = f"{pair.interval.low:.2f} to {pair.interval.high:.2f}" if pair and pair.interval else ""
                items.append(Item() if pair is None else Item(f"{pair.probability:.2f}", pair.probability, best=pair.better, note=within))
            lines.append(Line(self._name(method), tuple(items)))
        return Grid(f"Probability that the row's method is better than the column's, {comparison.title}", "better than",
                    tuple(Heading(method) for method in comparison.methods), tuple(lines), milestone=comparison.milestone,
                    filters="methods")  # fmt: skip

    def _matrix(self, board: Board, milestone: int) -> Grid:
        columns, groups = [], []
        for table in board.tables:
            groups.append((table.domain, len(table.tasks), _domain_path(table)))
            columns += [Heading(task, link=_task_path(table, task)) for task in table.tasks]
        lines = []
        for method in board.methods:
            items: list[Item] = []
            for table in board.tables:
                section = next((one for one in table.sections if one.milestone == milestone), None)
                items += [self._cell(table, section, row, method) for row in section.rows] if section else [Item() for _ in table.tasks]
            lines.append(Line(self._name(method), tuple(items)))
        caption = f"{board.algorithm}, profile {brief(board.group)}, {short(milestone)} gradient steps: mean ± sample standard deviation (seeds)"
        return Grid(caption, "method", tuple(columns), tuple(lines), tuple(groups), milestone, "methods")

    def _cell(self, table: Table, section: Section, row: Row, method: str) -> Item:
        cell = row.cells[table.methods.index(method)] if method in table.methods else None
        if cell is None:
            return Item()
        largest = _largest(table.domain, row.task)
        paper = self._paper(table).get((section.milestone, row.task, method))
        beside = beside_scaled = None
        if paper is not None and paper.paper is not None:
            difference = "" if paper.difference is None else f", {paper.difference:+.1f} σ"
            beside = f"paper {_pm(*paper.paper)}{difference}"
            beside_scaled = f"paper {_pm_scaled(*paper.paper, largest)}{difference}" if largest else beside
        return Item(
            _pm(cell.mean, cell.std), cell.mean, _runs_path(table, row.task, method, section.milestone), cell.best,
            _pm_scaled(cell.mean, cell.std, largest) if largest else MISSING, f"({cell.n})", beside, beside_scaled,
        )  # fmt: skip

    def _paper(self, table: Table) -> dict[tuple[int, str, str], Beside]:
        if table.slug not in self._papers:
            paper = beside_paper(table)
            self._papers[table.slug] = {(one.milestone, one.task, one.method): one for one in (paper.rows if paper else ())}
        return self._papers[table.slug]

    # ------------------------------------------------------------------------------------------------------------ domains and tasks

    def _domain(self, board: Board, table: Table) -> Page:
        single = replace(board, tables=(table,))
        exhibits = [Exhibit(
            "Results", grids=tuple(self._matrix(single, section.milestone) for section in reversed(table.sections)),
            downloads=self._downloads(table.slug, ("table",)), text=(table.caption,),
        )]  # fmt: skip
        curves = self._figure(table.slug, "curves", f"Learning curves on {table.domain}: return over gradient steps, a panel for each task.")
        if curves:
            exhibits.append(Exhibit("Learning curves", figures=curves, downloads=self._downloads(table.slug, ("curves",))))
        paper = beside_paper(table)
        if paper is not None:
            grids = []
            for milestone in sorted({one.milestone for one in (*paper.rows, *paper.relative)}, reverse=True):
                if paper.relative:
                    lines = tuple(
                        Line(Item(one.task), (Item(one.method), Item(f"{one.relative:.3f}", one.relative),
                                              Item(f"{one.paper_relative:.3f}", one.paper_relative)))
                        for one in paper.relative if one.milestone == milestone
                    )  # fmt: skip
                    if lines:
                        columns = (Heading("method", number=False), Heading("here"), Heading("paper"))
                        caption = f"Scores relative to CUDC's, {short(milestone)} gradient steps"
                        grids.append(Grid(caption, "task", columns, lines, milestone=milestone))
            text = (paper.caption, *(["The numbers stand in the table above, behind the switch."] if paper.rows else []))
            exhibits.append(Exhibit("Beside the paper", grids=tuple(grids), text=text, downloads=self._downloads(table.slug, ("paper",))))
        exhibits += self.site.exhibits.get(table.slug, ())
        own = {f"task-{task}" for task in table.tasks}
        exhibits += self._further(table.slug, {"curves", *own}, {"table", "paper"})
        exhibits.append(Exhibit("Tasks", lines=tuple(Item(task, link=_task_path(table, task)) for task in table.tasks)))
        lead = (f"{domain_title(table.domain)}. {table.algorithm}, profile {brief(table.group)}, {table.seeds}.",)
        return Page(_domain_path(table), table.domain, self._crumbs(board), lead, self._badges(single), tuple(exhibits))

    def _task(self, board: Board, table: Table, task: str) -> Page:
        largest = _largest(table.domain, task)
        grids = []
        for section in reversed(table.sections):
            row = next(one for one in section.rows if one.task == task)
            grids.append(self._task_grid(table, section, row, largest))
        name = f"task-{task}" if f"task-{task}.svg" in self.site.files.get(table.slug, ()) else "curves"
        what = f"Learning curves of all methods on {table.domain} {task}: mean return over gradient steps, band: one standard deviation."
        exhibits = [
            Exhibit("Results", grids=tuple(grids), text=(
                "Interval: 95 % of the mean, by Student's t over collector seeds. Seeds: a dot for each, a bar at the mean"
                + (f", from 0 to {largest:,.0f}" if largest else "") + ". Paper: as reported there, from another implementation, not to be"
                " ranked with ours; difference in the paper's standard deviations.",
            )),
            Exhibit("Learning curves", figures=self._figure(table.slug, name, what), downloads=self._downloads(table.slug, (name,))),
        ]  # fmt: skip
        lead = (
            f"{table.algorithm}, profile {brief(table.group)}."
            + (f" The largest possible return is {largest:,.0f}." if largest else " The largest possible return is not known."),
        )
        others = tuple(Item(one, link=_task_path(table, one)) for one in table.tasks if one != task)
        if others:
            exhibits.append(Exhibit(f"Other tasks of {table.domain}", lines=others))
        crumbs = (*self._crumbs(board), (table.domain, _domain_path(table)))
        return Page(_task_path(table, task), f"{table.domain} {task}", crumbs, lead, self._badges(board), tuple(exhibits))

    def _task_grid(self, table: Table, section: Section, row: Row, largest: float | None) -> Grid:
        papers = self._paper(table)
        columns = [Heading("mean"), Heading("std"), Heading("95 % interval", number=False, sorts=False), Heading("seeds"),
                   Heading("each seed", number=False, sorts=False)]  # fmt: skip
        with_paper = any((section.milestone, row.task, method) in papers for method in table.methods)
        if with_paper:
            columns += [Heading("paper"), Heading("difference")]
        lines = []
        reach = largest or max([1.0, *(abs(cell.mean) for cell in row.cells if cell)])
        together = _by_column(table, row.task)
        for method, cell in zip(table.methods, row.cells, strict=True):
            items = [Item()] * len(columns)
            if cell is not None:
                link = _runs_path(table, row.task, method, section.milestone)
                items = [*self._numbers(cell, largest, link), _count(cell.n)]
                picture = dots(seed_scores(together[method], section.milestone), cell.mean, reach, self._colour(method))
                items.append(Item("", cell.mean, picture=picture))
                if with_paper:
                    items += _paper_items(papers.get((section.milestone, row.task, method)), largest)
            lines.append(Line(self._name(method), tuple(items)))
        low, high = section.episodes
        caption = (
            f"{table.domain} {row.task} after {short(section.milestone)} gradient steps, evaluation episodes:"
            f" {low if low == high else f'{low} to {high}'}"
        )
        return Grid(caption, "method", tuple(columns), tuple(lines), milestone=section.milestone, filters="methods")

    def _numbers(self, cell: Cell, largest: float | None, link: str) -> list[Item]:
        within = None if cell.std is None else student(cell.mean, cell.std, cell.n)

        def scaled(*values: float) -> str:
            return " to ".join(f"{value / largest:.3f}" for value in values) if largest else MISSING

        return [
            Item(f"{cell.mean:.1f}", cell.mean, link, cell.best, scaled(cell.mean)),
            Item() if cell.std is None else Item(f"{cell.std:.1f}", cell.std, scaled=scaled(cell.std)),
            Item() if within is None else Item(f"{within.low:.0f} to {within.high:.0f}", scaled=scaled(within.low, within.high)),
        ]

    # ------------------------------------------------------------------------------------------------------------------------ runs

    def _runs_of(self, board: Board, table: Table) -> Iterable[Page]:
        for task in table.tasks:
            for method, records in _by_column(table, task).items():
                records.sort(key=lambda one: (one.dataset.seed, one.seed, one.dataset.id))
                yield self._runs(board, table, task, method, records)

    def _runs(self, board: Board, table: Table, task: str, method: str, records: Sequence[Record]) -> Page:
        ids = {id(record): f"run-{index}" for index, record in enumerate(records, 1)}
        exhibits = []
        for section in reversed(table.sections):
            lines = []
            for record in records:
                found = evaluation_at(record, section.milestone)
                dataset = self.site.dataset_of[id(record)]
                numbers = [Item()] * 4
                if found is not None:
                    numbers = [_number(found.mean), _number(min(found.returns)), _number(max(found.returns)), _count(len(found.returns))]
                lines.append(Line(Item(f"seed {record.dataset.seed}", record.dataset.seed, f"#{ids[id(record)]}"), (
                    _count(record.seed), *numbers, Item(dataset.name, link=_dataset_path(dataset)),
                )))  # fmt: skip
            columns = (Heading("training seed"), Heading("mean return"), Heading("lowest"), Heading("highest"), Heading("episodes"),
                       Heading("dataset", number=False))  # fmt: skip
            cell = next((one.cells[table.methods.index(method)] for one in section.rows if one.task == task), None)
            result = "no result" if cell is None else f"{_pm(cell.mean, cell.std)} over {span([cell.n], 'seed')}"
            caption = f"{method} on {table.domain} {task} after {short(section.milestone)} gradient steps: {result}"
            grid = Grid(caption, "collector seed", columns, tuple(lines))
            exhibits.append(Exhibit(f"After {short(section.milestone)} gradient steps", grids=(grid,), id=f"at-{section.milestone}"))
        parts = tuple(self._run(table, record, ids[id(record)]) for record in records)
        exhibits.append(Exhibit("Each run", parts=parts))
        crumbs = (*self._crumbs(board), (table.domain, _domain_path(table)), (task, _task_path(table, task)))
        lead = (f"The runs behind {method} in the tables of {table.algorithm}, profile {brief(table.group)}.",)
        preliminary = len({record.dataset.seed for record in records}) < ENOUGH_SEEDS
        badges = ("Preliminary: fewer than five seeds",) if preliminary else ()
        return Page(_runs_path(table, task, method), f"{method} on {table.domain} {task}", crumbs, lead, badges, tuple(exhibits))

    def _run(self, table: Table, record: Record, anchor: str) -> Exhibit:
        dataset = self.site.dataset_of[id(record)]
        facts = [
            ("dataset", Item(record.dataset.id, link=_dataset_path(dataset))),
            ("fingerprint", Item(record.dataset.fingerprint)),
            ("final mean", Item(f"{record.final.mean:.1f} after {short(record.final.step)} steps, {span([len(record.final.returns)], 'episode')}")),
        ]
        for section in reversed(table.sections):
            found = evaluation_at(record, section.milestone)
            if found is not None:
                facts.append((f"returns at {short(section.milestone)}", Item(", ".join(f"{value:.1f}" for value in found.returns))))
        facts += [
            ("training", Item(f"{record.seconds:,.0f} seconds, seed {record.seed}, hyperparameters {brief(record.hyperparameters_hash)}")),
            ("machine", Item(_machine_text(record) or MISSING)),
            ("code", Item(f"cudc-bench {_version(record, 'cudc-bench')}, {_commit(record)}")),
            ("origin", Item(origin(record))),
            ("made", Item(record.created)),
        ]
        if place := self.site.place(record):
            facts.append(("record", Item(place)))
        return Exhibit(f"Collector seed {record.dataset.seed}, training seed {record.seed}", id=anchor, facts=tuple(facts),
                       code=(("Makes this record again", record.command),))  # fmt: skip

    # --------------------------------------------------------------------------------------------------------------------- methods

    def _methods_page(self) -> Page:
        lines = []
        counts: Counter[str] = Counter(column(record) for table in self.site.tables for record in table.records)
        sets: Counter[str] = Counter(dataset.method for dataset in self.site.datasets)
        for method in self.site.methods:
            known = describe(self._registered(method))
            lines.append(Line(self._name(method), (
                Item(known.family or MISSING), Item(known.citation or MISSING), _count(sets[method]), _count(counts[method]),
            )))  # fmt: skip
        columns = (Heading("explores by", number=False), Heading("from", number=False), Heading("datasets"), Heading("runs"))
        grid = Grid("Methods with results", "method", columns, tuple(lines), filters="methods")
        return Page("methods/index.html", "Methods", (("Overview", "index.html"),), (), (), (Exhibit("All methods", grids=(grid,)),))

    def _registered(self, method: str) -> str:
        """The name under which a column's method may be registered."""
        return next(r.dataset.method for table in self.site.tables for r in table.records if column(r) == method)

    def _method(self, method: str) -> Page:
        known = describe(self._registered(method))
        records = [record for table in self.site.tables for record in table.records if column(record) == method]
        origins = ", ".join(sorted({origin(record) for record in records}))
        facts = [(name, Item(text)) for name, text in (
            ("explores by", known.family), ("from", known.citation), ("registered by", known.package), ("data", origins),
        ) if text]  # fmt: skip
        text = known.text or ("Nothing more is known of it here: no collector of this name is installed, or its source cannot be read.",)
        exhibits = [Exhibit("What it is", facts=tuple(facts), text=text)]
        for board in self.site.boards:
            if method not in board.methods:
                continue
            exhibits.append(self._method_results(board, method))
        datasets = [dataset for dataset in self.site.datasets if dataset.method == method]
        exhibits.append(Exhibit("Datasets", grids=(self._datasets_grid(datasets),)))
        crumbs = (("Overview", "index.html"), ("Methods", "methods/index.html"))
        return Page(_method_path(method), method, crumbs, (), (), tuple(exhibits))

    def _method_results(self, board: Board, method: str) -> Exhibit:
        grids = []
        for milestone in board.milestones:
            lines = []
            for table in board.tables:
                section = next((one for one in table.sections if one.milestone == milestone), None)
                for row in section.rows if section else ():
                    cell = row.cells[table.methods.index(method)] if method in table.methods else None
                    item = self._cell(table, section, row, method) if section else Item()
                    within = student(cell.mean, cell.std, cell.n) if cell and cell.std is not None else None
                    lines.append(Line(Item(f"{table.domain} {row.task}", link=_task_path(table, row.task)), (
                        item, Item(f"{within.low:.0f} to {within.high:.0f}") if within else Item(),
                    )))  # fmt: skip
            grids.append(Grid(f"Mean ± sample standard deviation (seeds) after {short(milestone)} gradient steps", "task",
                              (Heading("return"), Heading("95 % interval", number=False, sorts=False)), tuple(lines), milestone=milestone))  # fmt: skip
        facts = []
        for comparison in board.overall.comparisons if board.overall else ():
            standing = next((one for one in comparison.standings if one.method == method), None)
            if standing is None:
                continue
            found = standing.estimates["iqm"]
            within = f" ({found.cluster.low:.3f} to {found.cluster.high:.3f})" if found.cluster else ""
            chance = f", rank 1 with probability {standing.ranks[0]:.2f}" if standing.ranks else ""
            facts.append((comparison.title, Item(f"IQM {found.value:.3f}{within}{chance}")))
        return Exhibit(f"Results of {board.name}", grids=tuple(grids), facts=tuple(facts))

    # -------------------------------------------------------------------------------------------------------------------- datasets

    def _datasets_page(self) -> Page:
        grid = self._datasets_grid(self.site.datasets, methods=True)
        lead = ("What was collected without rewards, and then trained on. One dataset is one seed of one method.",)
        return Page("datasets/index.html", "Datasets", (("Overview", "index.html"),), lead, (), (Exhibit("All datasets", grids=(grid,)),))

    def _datasets_grid(self, datasets: Sequence[Dataset], methods: bool = False) -> Grid:
        lines = []
        for dataset in datasets:
            local = self.site.local.get(dataset.word)
            cells = local.quality.coverage.coverage_cells if local and local.quality and local.quality.coverage else None
            method = self._name(dataset.method)
            lines.append(Line(Item(dataset.name, link=_dataset_path(dataset)), (
                *([method] if methods else []), Item(dataset.domain), _count(dataset.seed), Item(brief(dataset.settings)),
                _count(dataset.steps), Item() if cells is None else _count(cells), _count(len(dataset.records)),
            )))  # fmt: skip
        columns = [Heading("domain", number=False), Heading("seed"), Heading("collected at", number=False), Heading("steps"),
                   Heading("visited cells"), Heading("runs")]  # fmt: skip
        if methods:
            columns.insert(0, Heading("method", number=False))
        return Grid(f"Datasets: {len(datasets):,}", "dataset", tuple(columns), tuple(lines), filters="datasets" if methods else "")

    def _dataset(self, dataset: Dataset) -> Page:
        first = dataset.records[0]
        local = self.site.local.get(dataset.word)
        sources = sorted({origin(record) for record in dataset.records})
        facts = [
            ("method", self._name(dataset.method)), ("domain", Item(domain_title(dataset.domain))), ("seed", Item(str(dataset.seed))),
            ("steps", Item(f"{dataset.steps:,}")), ("collected at", Item(dataset.settings)), ("origin", Item(", ".join(sources))),
        ]  # fmt: skip
        labelled = Grid("What was trained on", "task", (Heading("dataset", number=False), Heading("fingerprint", number=False)), tuple(
            Line(Item(task), (Item(one), Item(fingerprint))) for task, one, fingerprint in dataset.labelled
        ))  # fmt: skip
        exhibits = [Exhibit("What it is", facts=tuple(facts), grids=(labelled,))]
        load = [("", f'minari.load_dataset("{one}")') for one in dict.fromkeys(one for _, one, _ in dataset.labelled)]
        if dataset.id is not None:
            load.insert(0, ("", f'minari.load_dataset("{dataset.id}")'))
            exhibits.append(Exhibit("Load it", lead="In Python, after: import minari", code=tuple(dict.fromkeys(load))))
        again = dataset.commands
        if again:
            exhibits.append(Exhibit("Make it again", code=tuple(again)))
        else:
            why = "It was imported; nobody can be told how to collect it again." if dataset.source else "Its records do not say enough."
            exhibits.append(Exhibit("Make it again", lead=f"There is no command for that. {why}"))
        if local is None:
            exhibits.append(Exhibit("Measures", lead="This dataset was not measured: with its records' fingerprint it was not in Minari's root"
                                    f" where this page was made.{' The commands above make it again.' if again else ''}"))  # fmt: skip
        else:
            exhibits += _measured(dataset, local)
        exhibits.append(self._trained(dataset))
        exhibits.append(Exhibit("Commands of its runs", folded=True, code=tuple(("", one) for one in sorted({r.command for r in dataset.records}))))
        crumbs = (("Overview", "index.html"), ("Datasets", "datasets/index.html"))
        title = f"{dataset.name}, collected at {brief(dataset.settings)}" if dataset.source is None else f"{dataset.name}, {first.dataset.source}"
        return Page(_dataset_path(dataset), title, crumbs, (), (), tuple(exhibits))

    def _trained(self, dataset: Dataset) -> Exhibit:
        lines = []
        for record in sorted(dataset.records, key=lambda r: (r.group, r.algorithm, r.dataset.task, r.seed)):
            table = self._table_of[record.group, record.algorithm, record.dataset.domain]
            link = _runs_path(table, record.dataset.task, column(record))
            lines.append(Line(Item(record.dataset.task, link=link), (
                Item(record.algorithm), Item(brief(plain(record.group))), _count(record.seed), _number(record.final.mean),
                Item(f"{record.seconds:,.0f}", record.seconds), Item(f"{_version(record, 'cudc-bench')}, {_commit(record)}"),
                Item(_machine_text(record) or MISSING),
            )))  # fmt: skip
        columns = (Heading("algorithm", number=False), Heading("profile", number=False), Heading("training seed"), Heading("final mean"),
                   Heading("seconds"), Heading("code", number=False), Heading("machine", number=False))  # fmt: skip
        return Exhibit("Runs on it", grids=(Grid("Trainings on this dataset", "task", columns, tuple(lines)),))

    # --------------------------------------------------------------------------------------------------------------------- helpers

    @cached_property
    def _table_of(self) -> dict[tuple[str, str, str], Table]:
        return {(table.records[0].group, table.algorithm, table.domain): table for table in self.site.tables}

    def _crumbs(self, board: Board) -> tuple[tuple[str, str], ...]:
        return ("Overview", "index.html"), (board.name, board.path)

    def _look(self, board: Board) -> None:
        compared = board.overall.headline.methods if board.overall else ()
        self._looks = looks(board.methods) | looks(compared)

    def _name(self, method: str) -> Item:
        if method not in self._looks:
            return Item(method, link=_method_path(method))
        style = self._looks[method]["linestyle"]
        dashes = _DASHES[style] if isinstance(style, str) else " ".join(f"{one:g}" for one in style[1])
        return Item(method, link=_method_path(method), picture=swatch(self._colour(method), dashes))

    def _colour(self, method: str) -> str:
        return str(self._looks[method]["color"])

    def _figure(self, slug: str, name: str, alt: str) -> tuple[Figure, ...]:
        return (Figure(f"{slug}/{name}.svg", alt),) if f"{name}.svg" in self.site.files.get(slug, ()) else ()

    def _downloads(self, slug: str, names: Iterable[str]) -> tuple[tuple[str, str], ...]:
        there = self.site.files.get(slug, ())
        kinds = ("md", "tex", "csv", "svg", "pdf")
        return tuple((f"{name}.{kind}", f"{slug}/{name}.{kind}") for name in names for kind in kinds if f"{name}.{kind}" in there)

    def _further(self, slug: str, figures: Collection[str], tables: Collection[str]) -> list[Exhibit]:
        """Files of a folder that nothing else shows: figures, and what can be downloaded."""
        there = sorted(self.site.files.get(slug, ()))
        shown = {*figures, *tables} | {name for one in self.site.exhibits.get(slug, ()) for name in _names(one)}
        rest = list(dict.fromkeys(name.rpartition(".")[0] for name in there if name.rpartition(".")[0] not in shown))
        if not rest:
            return []
        pictures = tuple(one for name in rest for one in self._figure(slug, name, f"Figure: {name.replace('-', ' ').replace('_', ' ')}."))
        return [Exhibit("More", figures=pictures, downloads=self._downloads(slug, rest))]


def origin(record: Record) -> str:
    """Whose a run's data are."""
    source = record.dataset.source
    return "collected with cudc-bench" if source is None else f"imported from {source}"


def _missing(missing: Sequence[Missing]) -> Exhibit:
    lines, code = [], []
    for one in missing:
        what = f"{one.method} on {one.domain}: {', '.join(one.tasks)}, {span([len(one.seeds)], 'seed')}"
        if one.command:
            code.append((what, one.command))
        else:
            lines.append(Item(f"{what} (by the commands of its other records)"))
    return Exhibit("What is missing", lead="Runs that would make the comparison complete, with the commands that make them.",
                   lines=tuple(lines), code=tuple(code), folded=len(missing) > 5)  # fmt: skip


def _measured(dataset: Dataset, local: Local) -> list[Exhibit]:
    quality = local.quality
    found = [Exhibit("Its manifest", facts=tuple((name, Item(value)) for name, value in facts_of(local.manifest)))]
    prefix = f"datasets/{dataset.word}"
    grids = []
    facts: list[tuple[str, Item]] = []
    if quality is not None:
        if quality.rewards:
            columns = tuple(map(Heading, ("mean", "25 %", "50 %", "75 %", "95 %", "best", "top 1 % of steps", "steps > 0.5", "steps > 0.9")))
            lines = [
                Line(Item(task), (
                    *(Item(f"{value:.3f}", value) for value in (one.mean, *one.quantiles, one.best, one.top)),
                    *(Item(f"{value:.1%}", value) for value in (one.above_half, one.above_nine)),
                ))
                for task, one in quality.rewards.items()
            ]  # fmt: skip
            grids.append(Grid("Rewards that its states are worth, per step; mean, quantiles and best of trajectories", "task", columns, tuple(lines)))
        if quality.coverage:
            facts += [("visited cells", Item(f"{quality.coverage.coverage_cells:,}")),
                      ("entropy of visits", Item(f"{quality.coverage.coverage_entropy:.2f} nats"))]  # fmt: skip
        facts += [("std of actions", Item(f"{sum(quality.action_std) / len(quality.action_std):.3f}")),
                  ("actions at their bounds", Item(f"{quality.action_saturated:.1%}"))]  # fmt: skip
        if quality.action_correlation is not None:
            facts.append(("correlation of consecutive actions", Item(f"{quality.action_correlation:.2f}")))
    alts = {
        "density": "Density of the rewards of single steps, a panel for each task; quantiles in the table.",
        "k": "k over environment steps.",
        "losses": "Losses of the collector over environment steps.",
    }
    figures = tuple(Figure(f"{prefix}.{name}.svg", alt) for name, alt in alts.items() if name in local.figures)
    found.append(Exhibit("Measures", grids=tuple(grids), facts=tuple(facts), figures=figures))
    return found


def _names(exhibit: Exhibit) -> list[str]:
    paths = [figure.path for figure in exhibit.figures] + [path for _, path in exhibit.downloads]
    return [posixpath.basename(path).rpartition(".")[0] for path in paths] + [name for part in exhibit.parts for name in _names(part)]


def _by_column(table: Table, task: str) -> dict[str, list[Record]]:
    found: dict[str, list[Record]] = defaultdict(list)
    for record in table.records:
        if record.dataset.task == task:
            found[column(record)].append(record)
    return {method: found[method] for method in table.methods if method in found}


def _paper_items(paper: Beside | None, largest: float | None) -> list[Item]:
    if paper is None or paper.paper is None:
        return [Item(), Item()]
    mean, std = paper.paper
    shown = Item(_pm(mean, std), mean, scaled=_pm_scaled(mean, std, largest) if largest else MISSING)
    return [shown, Item() if paper.difference is None else Item(f"{paper.difference:+.1f} σ", paper.difference)]


def _largest(domain: str, task: str) -> float | None:
    known = DOMAINS.get(domain)
    return known.max_return if known is not None and task in known.tasks else None


def _pm(mean: float, std: float | None) -> str:
    return f"{round(mean)}" if std is None else f"{round(mean)} ± {round(std)}"


def _pm_scaled(mean: float, std: float | None, largest: float) -> str:
    return f"{mean / largest:.3f}" if std is None else f"{mean / largest:.3f} ± {std / largest:.3f}"


def _number(value: float) -> Item:
    return Item(f"{value:.1f}", value)


def _count(value: int) -> Item:
    return Item(f"{value:,}", value)


def _version(record: Record, package: str) -> str:
    return record.versions.get(package, "unknown")


def _commit(record: Record) -> str:
    if not record.commit:
        return "no checkout"
    return f"commit {plain(record.commit)[:12]}{' with local changes' if record.dirty else ''}"


def _machine(record: Record, name: str) -> str:
    value = record.machine.get(name)
    return value if isinstance(value, str) else ""


def _machine_text(record: Record) -> str:
    return brief(", ".join(filter(None, (_machine(record, "processor"), _machine(record, "device")))))


def _domain_path(table: Table) -> str:
    return f"{table.slug}/index.html"


def _task_path(table: Table, task: str) -> str:
    return f"{table.slug}/task-{task}.html"


def _runs_path(table: Table, task: str, method: str, milestone: int | None = None) -> str:
    return f"{table.slug}/runs-{task}.{file_word(method)}.html{'' if milestone is None else f'#at-{milestone}'}"


def _method_path(method: str) -> str:
    # A method may be called "index".
    return f"methods/method-{file_word(method)}.html"


def _dataset_path(dataset: Dataset) -> str:
    return f"datasets/{dataset.word}.html"
