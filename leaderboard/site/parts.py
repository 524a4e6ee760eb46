"""What the pages of the static site share: what they are made from, names, paths, and the cells that several of them show."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from markupsafe import Markup

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import reference_path
from cudc_bench.artefacts.tiers import TIERS
from cudc_bench.envs.domains import DOMAINS, SUITE, domain_title
from cudc_bench.text import plain

from ..datasets.behind import Dataset, Local, datasets_of
from ..datasets.pair import PairSummary
from ..methods import METHOD_ORDER, styles
from ..numbers.columns import column
from ..numbers.grid import Entry
from ..numbers.missing import Missing
from ..numbers.overall import Overall
from ..numbers.published import beside_paper
from ..numbers.scale import CEILING, FLOOR, LABELS, Scale, scale_of
from ..numbers.study import Study
from ..numbers.table import ENOUGH_SEEDS, Table
from ..numbers.words import file_slug, group_slug, ordered, span
from .drawing import DASHES
from .models import MISSING, Item, Picture, Row, Section, swatch

Paper = tuple[Entry, Entry | None]  # the paper's number, and how far ours is from it
Run = tuple[str, str, str, int, str]  # group, dataset id, algorithm, seed, who handed it in: what records are told apart by
BEST_TEST = "two-sided Welch test over seeds, Holm's correction within the task, p ≥ 0.05"
_LONG = 90  # letters of a name that stands in a line with others


@dataclass(frozen=True)
class Clip:
    """What there is to see of a task's policies.

    Attributes:
        best: the run with the largest final score.
        has_policy: whether its policy lies beside its record.
        shown: the best run of which there is a video, if there is one.
        suffix, content: of that video.
    """

    best: Record
    has_policy: bool
    shown: Record | None = None
    suffix: str = ""
    content: bytes = field(default=b"", repr=False)


@dataclass(frozen=True)
class Site:
    """What the site is made from.

    Attributes:
        tables, overall, problems, missing: as in ``api.Report``.
        files: names of the files that lie in each slug's folder; they can be shown and downloaded.
        places: where each record is below the results that were read.
        local: datasets that are on this machine, by ``Dataset.slug``.
        studies: as in ``api.Report``.
        hidden: tables of the methods that only studies show, for the pages of their runs.
        links: addresses of records from the site's root, of those that are near it.
        clips: what there is to see of each table's policies, by its slug and the task.
        pairs: datasets side by side, whose files lie in the folders of their slugs.
    """

    tables: Sequence[Table]
    overall: Sequence[Overall]
    problems: Sequence[str] = ()
    missing: Sequence[Missing] = ()
    files: Mapping[str, Collection[str]] = field(default_factory=dict)
    places: Mapping[Run, str] = field(default_factory=dict)
    local: Mapping[str, Local] = field(default_factory=dict)
    studies: Sequence[Study] = ()
    hidden: Sequence[Table] = ()
    links: Mapping[Run, str] = field(default_factory=dict)
    clips: Mapping[tuple[str, str], Clip] = field(default_factory=dict)
    pairs: Sequence[PairSummary] = ()

    @cached_property
    def boards(self) -> list[ComparisonPage]:
        """What may be compared, the one to show first in front."""
        found: dict[tuple[str, str], list[Table]] = defaultdict(list)
        hidden: dict[tuple[str, str], list[Table]] = defaultdict(list)
        for tables, into in ((self.tables, found), (self.hidden, hidden)):
            for table in tables:
                into[table.records[0].group, table.algorithm].append(table)
        # Where there is nothing else, methods of studies are what there is to compare.
        found |= {key: tables for key, tables in hidden.items() if key not in found}
        places = list(DOMAINS)
        boards = []
        for (group, algorithm), tables in found.items():
            tables.sort(key=lambda one: (places.index(one.domain) if one.domain in places else len(places), one.domain))
            slug = group_slug(group, algorithm)
            overall = next((one for one in self.overall if one.slug == slug), None)
            others = [table for table in hidden[group, algorithm] if all(table is not one for one in tables)]
            boards.append(ComparisonPage(tables[0].group, algorithm, slug, tuple(tables), overall, tuple(others)))
        first = {"paper": 0, "cpu": 1}
        # A single method is no comparison, whatever it was made with.
        return sorted(boards, key=lambda one: (
            len(one.methods) < 2, first.get(one.group, 2), one.algorithm != "td3", -one.runs, one.group, one.algorithm,
        ))  # fmt: skip

    @cached_property
    def datasets(self) -> list[Dataset]:
        """All that were trained on."""
        return datasets_of(self.every_table)

    @property
    def every_table(self) -> list[Table]:
        """Those that are shown, and the hidden ones."""
        return [*self.tables, *self.hidden]

    @cached_property
    def methods(self) -> tuple[str, ...]:
        """All columns of all tables."""
        return ordered({method for table in self.every_table for method in table.methods}, METHOD_ORDER)

    @cached_property
    def dataset_of(self) -> dict[int, Dataset]:
        """By the identity of a record."""
        return {id(record): dataset for dataset in self.datasets for record in dataset.records}

    def place(self, record: Record) -> str:
        """Where a record was found; empty if that is not known."""
        return self.places.get(run_of(record), "")


@dataclass(frozen=True)
class ComparisonPage:
    """The tables of one group and algorithm, and their comparison, if there is one."""

    group: str
    algorithm: str
    slug: str
    tables: tuple[Table, ...]
    overall: Overall | None
    hidden: tuple[Table, ...] = ()

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
        return sorted({milestone for table in self.tables for milestone in table.milestones}, reverse=True)

    @property
    def runs(self) -> int:
        """How many records it has."""
        return sum(len(table.records) for table in self.tables)

    @property
    def preliminary(self) -> bool:
        """Whether a cell has fewer than five seeds."""
        return any(cell.n < ENOUGH_SEEDS for table in self.tables for cell in table.cells.values())


def line_swatch(style: Mapping[str, Any]) -> Markup:
    """A line as figures draw it."""
    dashes = style["linestyle"]
    return swatch(str(style["color"]), DASHES[dashes] if isinstance(dashes, str) else " ".join(f"{one:g}" for one in dashes[1]))


def run_of(record: Record) -> Run:
    """What tells a record from others."""
    return record.group, record.labelled_id, record.algorithm, record.seed, record.submission.by if record.submission else ""


def brief(text: str) -> str:
    """A name without its middle, where it is so long that it would bury the others."""
    return text if len(text) <= _LONG else f"{text[: _LONG * 2 // 3]} … {text[-_LONG // 4 :]}"


class Parts:
    """What builders of pages have in common."""

    def __init__(self, site: Site) -> None:
        self.site = site
        self._papers: dict[str, dict[tuple[int, str, str], Paper]] = {}
        self._styles: dict[str, dict[str, Any]] = {}  # of the page under way: as in its figures

    @cached_property
    def table_of(self) -> dict[int, Table]:
        """By the identity of a record."""
        return {id(record): table for table in self.site.every_table for record in table.records}

    def crumbs(self, board: ComparisonPage) -> tuple[tuple[str, str], ...]:
        """The way from the overview to a comparison."""
        return ("Overview", "index.html"), (board.name, board.path)

    def use_styles(self, board: ComparisonPage) -> None:
        """Take the colours of a comparison's figures."""
        compared = board.overall.headline.methods if board.overall else ()
        self._styles = styles(board.methods) | styles(compared)

    def name(self, method: str) -> Item:
        """A method as the head of a row: its line in figures, and the way to its page."""
        if method not in self._styles:
            return Item(method, link=method_path(method))
        return Item(method, link=method_path(method), picture=line_swatch(self._styles[method]))

    def colour(self, method: str) -> str:
        """Its colour in figures."""
        return str(self._styles[method]["color"])

    def legend(self, methods: Iterable[str]) -> tuple[Item, ...]:
        """Methods as lines of a figure."""
        return tuple(self.name(method) for method in methods)

    def downloads(self, slug: str, names: Iterable[str]) -> tuple[tuple[str, str], ...]:
        """Those of some files of a slug's folder that are there."""
        there = self.site.files.get(slug, ())
        kinds = ("md", "tex", "csv", "svg", "pdf")
        return tuple((f"{name}.{kind}", f"{slug}/{name}.{kind}") for name in names for kind in kinds if f"{name}.{kind}" in there)

    def further(self, slug: str, shown: Collection[str]) -> list[Section]:
        """Files of a folder that nothing else offers."""
        there = sorted(self.site.files.get(slug, ()))
        of_studies = {study.name for study in self.site.studies if study.folder == slug}
        there = [name for name in there if not name.startswith(tuple(f"{one}{mark}" for one in of_studies for mark in ".-"))]
        rest = list(dict.fromkeys(name.rpartition(".")[0] for name in there if name.rpartition(".")[0] not in shown))
        if not rest:
            return []
        return [Section("More", downloads=self.downloads(slug, rest))]

    def cell(self, table: Table, milestone: int, task: str, method: str) -> Item:
        """A method's result on a task, with the paper's beside it."""
        cell = table.cells.get((milestone, task, method))
        if cell is None:
            return Item()
        scale = self.scale(table, task)
        paper = self.paper(table).get((milestone, task, method))
        beside = beside_scaled = None
        if paper is not None:
            theirs, difference = paper
            apart = "" if difference is None else f", {difference.value:+.1f} σ"
            beside = f"paper {pm(theirs.value, theirs.std)}{apart}"
            beside_scaled = f"paper {pm_scaled(theirs.value, theirs.std, scale)}{apart}" if scale else beside
        return Item(
            pm(cell.value, cell.std), cell.value, runs_path(table, task, method, milestone), cell.best,
            pm_scaled(cell.value, cell.std, scale) if scale else MISSING, f"({cell.n})", beside, beside_scaled,
        )  # fmt: skip

    def scale(self, table: Table, task: str) -> Scale | None:
        """By what a task's returns are normalised where a reader asks for it."""
        return scale_of(table.domain, task, table.references)

    def ends(self, places: Sequence[tuple[Table, str]], items: Callable[[str, float | None], Sequence[Item]]) -> list[Row]:
        """Rows of floors and ceilings below those of methods; none if no task has a reference.

        Args:
            places: tables and tasks of theirs that are side by side.
            items: the cells of a place in the row ``"floor"`` or ``"ceiling"``, whose return there is None without a reference.
        """
        if not any(table.references for table, _ in places):
            return []
        return [
            Row(Item(LABELS[name]), tuple(
                item
                for table, task in places
                for item in items(name, getattr(table.references[task], name) if task in table.references else None)
            ))
            for name in (FLOOR, CEILING)
        ]  # fmt: skip

    @staticmethod
    def end(name: str, value: float | None, digits: int = 0) -> Item:
        """A floor or a ceiling as a cell."""
        return Item() if value is None else Item(f"{value:.{digits}f}", value, scaled=f"{float(name == CEILING):.3f}")

    def paper(self, table: Table) -> dict[tuple[int, str, str], Paper]:
        """The paper's cells beside a table's, by milestone, task and method."""
        if table.slug not in self._papers:
            paper = beside_paper(table)
            lines = [(int(part.key), line) for part in (paper.parts if paper else ()) for line in part.lines]
            self._papers[table.slug] = {
                (milestone, *line.labels): (theirs, difference)  # type: ignore[misc]
                for milestone, line in lines
                if (theirs := line.entries[1])
                for difference in [line.entries[2]]
            }
        return self._papers[table.slug]


def origin(record: Record) -> str:
    """Whose a run's data are."""
    source = record.dataset.source
    data = "collected with cudc-bench" if source is None else f"imported from {source}"
    if record.dataset.parts:
        data = f"mixed of {', '.join(part.id for part in record.dataset.parts)}"
    if record.dataset.method in TIERS:
        data = "made by an online training with cudc-bench"
    if record.submission is None:
        return data
    if record.submission.reran is None:
        return f"{data}; submitted by {record.submission.by}, not run again here"
    with_data = " with its dataset" if record.submission.reran.collected else ""
    return f"{data}; submitted by {record.submission.by}, run again{with_data} here with the same numbers"


def by_column(table: Table, task: str) -> dict[str, list[Record]]:
    """A table's records of a task, by column."""
    found: dict[str, list[Record]] = defaultdict(list)
    for record in table.records:
        if record.dataset.task == task:
            found[column(record)].append(record)
    return {method: found[method] for method in table.methods if method in found}


def pm(mean: float, std: float | None) -> str:
    """A mean with its standard deviation, as tables show them."""
    return f"{round(mean)}" if std is None else f"{round(mean)} ± {round(std)}"


def pm_scaled(mean: float, std: float | None, scale: Scale) -> str:
    """The same normalised."""
    score = f"{scale.score(mean) + 0.0:.3f}"
    return score if std is None else f"{score} ± {scale.width(std):.3f}"


def reference_text(table: Table, task: str) -> tuple[str, ...]:
    """What a task's reference is, if it has one."""
    bounds = table.references.get(task)
    if bounds is None:
        return ()
    return (
        f"Floor: {bounds.floor:.1f}, the mean return of random actions; a policy before any training gets {bounds.untrained:.1f}. Ceiling:"
        f" {bounds.ceiling:.1f}, that of TD3 trained online on the task at this profile. {span([bounds.seeds], 'seed')} each; the record is"
        f" {reference_path(Path(), table.domain, task, table.records[0].profile).as_posix()} below the results.",
    )


def domain_text(name: str) -> str:
    """What a domain is, if that is known; else its name."""
    return domain_title(name) if name in DOMAINS or name.startswith(SUITE) else name


def domain_pictures(name: str) -> tuple[Picture, ...]:
    """The moving picture of a domain, if there is one."""
    if name not in DOMAINS:
        return ()
    text, still = domain_text(name), picture_path(name)
    return (Picture(moving_path(name), f"{text} in MuJoCo, moved by random actions.", f"{text}, moved by random actions", still),)


def number(value: float) -> Item:
    """A cell of one number."""
    return Item(f"{value:.1f}", value)


def count(value: int) -> Item:
    """A cell of a whole number."""
    return Item(f"{value:,}", value)


def version(record: Record, package: str) -> str:
    """The version of a package that a run was made with."""
    return record.versions.get(package, "unknown")


def commit(record: Record) -> str:
    """The commit of this project that a run was made with."""
    if not record.commit:
        return "no checkout"
    return f"commit {plain(record.commit)[:12]}{' with local changes' if record.dirty else ''}"


def machine(record: Record, name: str) -> str:
    """What a record says of its machine under a name; empty if that is no text."""
    value = record.machine.get(name)
    return value if isinstance(value, str) else ""


def machine_text(record: Record) -> str:
    """The machine in a few words."""
    return brief(", ".join(filter(None, (machine(record, "processor"), machine(record, "device")))))


def domain_path(table: Table) -> str:
    """The page of a table."""
    return f"{table.slug}/index.html"


def study_path(study: Study) -> str:
    """The page of a study."""
    return f"{study.folder}/{study.name}.html"


def clip_path(table: Table, task: str, clip: Clip) -> str:
    """The video of a task's policy."""
    return f"{table.slug}/best-{task}{clip.suffix}"


def pictures_of(site: Site) -> set[str]:
    """The domains of a site of which there is a picture."""
    return {table.domain for table in site.every_table if table.domain in DOMAINS}


def picture_path(domain: str) -> str:
    """The still picture of a domain."""
    return f"site/{domain}.webp"


def moving_path(domain: str) -> str:
    """A few seconds of a domain."""
    return f"site/{domain}-moving.webp"


def task_path(table: Table, task: str) -> str:
    """The page of a task."""
    return f"{table.slug}/task-{task}.html"


def runs_path(table: Table, task: str, method: str, milestone: int | None = None) -> str:
    """The page of the runs of a method on a task, or the part of it that is about a milestone."""
    return f"{table.slug}/runs-{task}.{file_slug(method)}.html{'' if milestone is None else f'#at-{milestone}'}"


def method_path(method: str) -> str:
    """The page of a method."""
    # A method may be called "index".
    return f"methods/method-{file_slug(method)}.html"


def dataset_path(dataset: Dataset) -> str:
    """The page of a dataset."""
    return f"datasets/{dataset.slug}.html"


def pair_path(pair: PairSummary) -> str:
    """The page of two datasets, beside their figures."""
    return f"{pair.slug}/index.html"
