"""Pages of methods and datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from cudc_bench.artefacts.records import Record
from cudc_bench.data.card import facts_of
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.envs.layouts import observation_layout
from cudc_bench.settings.described import CATEGORIES
from cudc_bench.text import plain

from ..datasets.behind import Dataset, Local
from ..methods import styles
from ..numbers.columns import column, was_collected
from ..numbers.overall import LEAD, NAMES
from ..numbers.scale import CEILING, FLOOR
from ..numbers.statistics import student
from ..numbers.table import Table
from ..numbers.words import short, span
from .figures import collection, density
from .methods import Method, describe
from .models import MISSING, Figure, Heading, HtmlTable, Item, Page, Row, Section
from .pairs import Pairs
from .parts import (
    BEST_TEST,
    ComparisonPage,
    brief,
    commit,
    count,
    dataset_path,
    domain_pictures,
    domain_text,
    machine_text,
    method_path,
    number,
    origin,
    runs_path,
    task_path,
    version,
)

_ALTS = {
    "density": "Density of the rewards of single steps, a panel for each task; quantiles in the table.",
    "k": "k over environment steps.",
    "losses": "Losses of the collector over environment steps.",
    "representation": "What shows whether the collector's representation collapses, over environment steps.",
}
# Sections of the methods' page, in its order: collectors by category, and what no collector made.
_NOT_COLLECTED = "not collected"
_GROUPS = {
    "knowledge": "Knowledge-based", "data": "Data-based", "competence": "Competence-based", "other": "Other collectors",
    _NOT_COLLECTED: "Mixtures, tiers and imported data",
}  # fmt: skip
_LEADS = {name: f"Collectors that {what}." for name, what in CATEGORIES.items()} | {
    _NOT_COLLECTED: "Equal parts of several datasets, what online trainings on a task did, and what others collected.",
}


class Catalogue(Pairs):
    """Builds them."""

    def methods_page(self) -> Page:
        """The list of methods."""
        groups: dict[str, list[Row]] = {name: [] for name in _GROUPS}
        counts: Counter[str] = Counter(column(record) for table in self.site.every_table for record in table.records)
        sets: Counter[str] = Counter(dataset.method for dataset in self.site.datasets)
        for method in self.site.methods:
            known, group = self._about(method)
            paper = Item(known.citation or MISSING, link=known.paper or None)
            groups[group].append(Row(self.name(method), (Item(known.family or MISSING), paper, count(sets[method]), count(counts[method]))))
        columns = (Heading("explores by", number=False), Heading("from", number=False), Heading("datasets"), Heading("runs"))
        sections = tuple(
            Section(
                _GROUPS[name], lead=_LEADS[name],
                grids=(HtmlTable(f"{_GROUPS[name]}: {span([len(lines)], 'method')}", "method", columns, tuple(lines), filters="methods"),),
            )
            for name, lines in groups.items() if lines
        )  # fmt: skip
        lead = ("All that has results here, by the categories of the Unsupervised RL Benchmark (Laskin et al. 2021).",)
        return Page("methods/index.html", "Methods", (("Overview", "index.html"),), lead, (), sections)

    def _about(self, method: str) -> tuple[Method, str]:
        """What is known of a column's method, and which of the groups it is of; any of its records tells."""
        one = next(one for table in self.site.every_table for one in table.records if column(one) == method)
        known = describe(one.dataset.method)
        return known, known.category if was_collected(one) else _NOT_COLLECTED

    def method(self, method: str) -> Page:
        """The page of a method."""
        known, group = self._about(method)
        records = [record for table in self.site.every_table for record in table.records if column(record) == method]
        origins = ", ".join(sorted({origin(record) for record in records}))
        facts = [(name, Item(text, link=link)) for name, text, link in (
            ("group", _GROUPS[group], None), ("explores by", known.family, None), ("from", known.citation, known.paper or None),
            ("registered by", known.package, None), ("data", origins, None),
        ) if text]  # fmt: skip
        unknown = "Nothing more is known of it here: no collector of this name is installed, or its source cannot be read."
        text = known.text or ("No collector made it." if group == _NOT_COLLECTED else unknown,)
        sections = [Section("What it is", prose=text, facts=tuple(facts))]
        for board in self.site.boards:
            if not any(method in table.methods for table in (*board.tables, *board.hidden)):
                continue
            sections.append(self._method_results(board, method))
        datasets = [dataset for dataset in self.site.datasets if dataset.method == method]
        sections.append(Section("Datasets", grids=(self._datasets_grid(datasets),)))
        crumbs = (("Overview", "index.html"), ("Methods", "methods/index.html"))
        return Page(method_path(method), method, crumbs, (), (), tuple(sections))

    def _method_results(self, board: ComparisonPage, method: str) -> Section:
        tables = [table for table in (*board.tables, *board.hidden) if method in table.methods]
        grids = [self._method_grid(board, tables, method, milestone) for milestone in board.milestones]
        facts = _standings(board, method)
        return Section(f"Results of {board.name}", grids=tuple(grids), facts=tuple(facts))

    def _method_grid(self, board: ComparisonPage, tables: Sequence[Table], method: str, milestone: int) -> HtmlTable:
        referenced = any(table.references for table in tables)
        lines = []
        for table in tables:
            for task in table.tasks if milestone in table.milestones else ():
                cell = table.cells.get((milestone, task, method))
                within = student(cell.value, cell.std, cell.n) if cell and cell.std is not None else None
                bounds = table.references.get(task)
                ends = [self.end(name, getattr(bounds, name, None)) for name in (FLOOR, CEILING)] if referenced else []
                lines.append(Row(Item(f"{table.domain} {task}", link=self._task_link(board, table, task)), (
                    self.cell(table, milestone, task, method), Item(f"{within.low:.0f} to {within.high:.0f}") if within else Item(), *ends,
                )))  # fmt: skip
        caption = f"Mean ± sample standard deviation (seeds) after {short(milestone)} gradient steps"
        columns = (Heading("return"), Heading("95 % interval", sorts=False), *(map(Heading, (FLOOR, CEILING)) if referenced else ()))
        notes = (f"Bold and ●: among all methods the task's largest mean, or not significantly worse ({BEST_TEST}).",)
        return HtmlTable(caption, "task", columns, tuple(lines), milestone=milestone, notes=notes)

    @staticmethod
    def _task_link(board: ComparisonPage, table: Table, task: str) -> str | None:
        shown = any(one.slug == table.slug and task in one.tasks for one in board.tables)
        return task_path(table, task) if shown else None

    def datasets_page(self) -> Page:
        """The list of datasets."""
        grid = self._datasets_grid(self.site.datasets, methods=True)
        lead = (
            "What was trained on, collected without rewards unless its method is a tier of an online training, or it was imported. "
            "One dataset is one seed of one method.",
        )
        sections = (*self.pairs_of(), Section("All datasets", grids=(grid,)))
        return Page("datasets/index.html", "Datasets", (("Overview", "index.html"),), lead, (), sections)

    def _datasets_grid(self, datasets: Sequence[Dataset], methods: bool = False) -> HtmlTable:
        lines = []
        for dataset in datasets:
            local = self.site.local.get(dataset.slug)
            cells = local.quality.coverage.coverage_cells if local and local.quality and local.quality.coverage else None
            method = self.name(dataset.method)
            lines.append(Row(Item(dataset.name, link=dataset_path(dataset)), (
                *([method] if methods else []), Item(dataset.domain), count(dataset.seed), Item(brief(dataset.settings)),
                count(dataset.steps), Item() if cells is None else count(cells), count(len(dataset.records)),
            )))  # fmt: skip
        columns = [Heading("domain", number=False), Heading("seed"), Heading("collected at", number=False), Heading("steps"),
                   Heading("visited cells"), Heading("runs")]  # fmt: skip
        if methods:
            columns.insert(0, Heading("method", number=False))
        return HtmlTable(f"Datasets: {len(datasets):,}", "dataset", tuple(columns), tuple(lines), filters="datasets" if methods else "")

    def dataset(self, dataset: Dataset) -> Page:
        """The page of a dataset."""
        first = dataset.records[0]
        local = self.site.local.get(dataset.slug)
        sources = sorted({origin(record) for record in dataset.records})
        facts = [
            ("method", self.name(dataset.method)), ("domain", Item(domain_text(dataset.domain))), ("seed", Item(str(dataset.seed))),
            ("steps", Item(f"{dataset.steps:,}")), ("collected at", Item(dataset.settings)), ("origin", Item(", ".join(sources))),
        ]  # fmt: skip
        labelled = HtmlTable("What was trained on", "task", (Heading("dataset", number=False), Heading("fingerprint", number=False)), tuple(
            Row(Item(task), (Item(one), Item(fingerprint))) for task, one, fingerprint in dataset.labelled
        ))  # fmt: skip
        sections = [Section("What it is", facts=tuple(facts), grids=(labelled,))]
        load = [("", f'minari.load_dataset("{one}")') for one in dict.fromkeys(one for _, one, _ in dataset.labelled)]
        if dataset.id is not None:
            load.insert(0, ("", f'minari.load_dataset("{dataset.id}")'))
            sections.append(Section("Load it", lead="In Python, after: import minari", code=tuple(dict.fromkeys(load))))
        again = dataset.commands
        if again:
            sections.append(Section("Make it again", code=tuple(again)))
        else:
            why = "It was imported; nobody can be told how to collect it again." if dataset.source else "Its records do not say enough."
            sections.append(Section("Make it again", lead=f"There is no command for that. {why}"))
        if local is None:
            why = "This dataset was not measured: with its records' fingerprint it was not in Minari's root where this page was made."
            sections.append(Section("Measures", lead=f"{why}{' The commands above make it again.' if again else ''}"))
        else:
            sections += _measured(dataset, local)
        sections += self.pairs_of(dataset)
        sections += _contents(dataset)
        sections.append(self._trained(dataset))
        sections.append(
            Section("Commands of its runs", folded=True, code=tuple(("", one) for one in sorted({r.command for r in dataset.records})))
        )
        crumbs = (("Overview", "index.html"), ("Datasets", "datasets/index.html"))
        title = (
            f"{dataset.name}, collected at {brief(dataset.settings)}"
            if dataset.source is None
            else f"{dataset.name}, {first.dataset.source}"
        )
        return Page(dataset_path(dataset), title, crumbs, (), (), tuple(sections))

    def _final(self, table: Table, record: Record) -> Item:
        """The mean of a run's last evaluation, with its score where the task has a reference."""
        bounds = table.references.get(record.dataset.task)
        score = "" if bounds is None else f"score {bounds.normalise(record.conclusion.mean) + 0.0:.3f}"
        return replace(number(record.conclusion.mean), note=score)

    def _trained(self, dataset: Dataset) -> Section:
        lines = []
        for record in sorted(dataset.records, key=lambda r: (r.group, r.algorithm, r.dataset.task, r.seed)):
            table = self.table_of[id(record)]
            link = runs_path(table, record.dataset.task, column(record))
            lines.append(Row(Item(record.dataset.task, link=link), (
                Item(record.algorithm), Item(brief(plain(record.group))), count(record.seed), self._final(table, record),
                Item(f"{record.seconds:,.0f}", record.seconds), Item(f"{version(record, 'cudc-bench')}, {commit(record)}"),
                Item(machine_text(record) or MISSING),
            )))  # fmt: skip
        columns = (Heading("algorithm", number=False), Heading("profile", number=False), Heading("training seed"), Heading("final score"),
                   Heading("seconds"), Heading("code", number=False), Heading("machine", number=False))  # fmt: skip
        return Section("Runs on it", grids=(HtmlTable("Trainings on this dataset", "task", columns, tuple(lines)),))


def _contents(dataset: Dataset) -> list[Section]:
    """What the numbers of an observation are, where that is known without loading a simulator."""
    if dataset.domain not in DOMAINS or dataset.source is not None:
        return []
    facts, start = [], 0
    for block in observation_layout(dataset.domain):
        stop = start + len(block.elements)
        places = f"[{start}]" if stop == start + 1 else f"[{start}:{stop}]"
        facts.append((f"{block.name} {places}", Item(", ".join(block.elements))))
        start = stop
    lead = f"Each observation has {start} numbers and each action {DOMAINS[dataset.domain].action_size}, in [-1, 1]."
    return [Section("What is in an observation", lead=lead, facts=tuple(facts), pictures=domain_pictures(dataset.domain))]


def _standings(board: ComparisonPage, method: str) -> list[tuple[str, Item]]:
    """What became of a method in each comparison of a board."""
    facts = []
    for comparison in board.overall.comparisons if board.overall else ():
        standing = next((one for one in comparison.standings if one.method == method), None)
        if standing is None:
            continue
        found = standing.estimates[LEAD]
        around = f" ({found.interval.low:.3f} to {found.interval.high:.3f})" if found.interval else ""
        chance = f", rank 1 with probability {standing.ranks[0]:.2f}" if standing.ranks else ""
        facts.append((comparison.title, Item(f"{NAMES[LEAD]} {found.value:.3f}{around}{chance}")))
    return facts


def _measured(dataset: Dataset, local: Local) -> list[Section]:
    look = styles((dataset.method,))[dataset.method]
    quality = local.quality
    found = [Section("Its manifest", facts=tuple((name, Item(value)) for name, value in facts_of(local.manifest)))]
    grids = []
    facts: list[tuple[str, Item]] = []
    if quality is not None:
        if quality.rewards:
            columns = tuple(
                map(Heading, ("mean", "25 %", "50 %", "75 %", "95 %", "best", "top 1 % of steps", "steps > 0.5", "steps > 0.9"))
            )
            lines = [
                Row(Item(task), (
                    *(Item(f"{value:.3f}", value) for value in (one.mean, *one.quantiles, one.best, one.top)),
                    *(Item(f"{value:.1%}", value) for value in (one.above_half, one.above_nine)),
                ))
                for task, one in quality.rewards.items()
            ]  # fmt: skip
            grids.append(
                HtmlTable(
                    "Rewards that its states are worth, per step; mean, quantiles and best of trajectories", "task", columns, tuple(lines)
                )
            )
        if quality.coverage:
            facts += [("visited cells", Item(f"{quality.coverage.coverage_cells:,}")),
                      ("entropy of visits", Item(f"{quality.coverage.coverage_entropy:.2f} nats"))]  # fmt: skip
        facts += [("std of actions", Item(f"{sum(quality.action_std) / len(quality.action_std):.3f}")),
                  ("actions at their bounds", Item(f"{quality.action_saturated:.1%}"))]  # fmt: skip
        if quality.action_correlation is not None:
            facts.append(("correlation of consecutive actions", Item(f"{quality.action_correlation:.2f}")))
    figures = [] if quality is None else [Figure(density(quality, look), _ALTS["density"], "Density of the rewards of single steps.")]
    if local.collection is not None:
        figures += [Figure(panels, _ALTS[name], _ALTS[name]) for name, panels in collection(local.collection).items()]
    found.append(Section("Measures", grids=tuple(grids), facts=tuple(facts), figures=tuple(one for one in figures if one.panels)))
    return found
