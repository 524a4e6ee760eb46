"""Pages of results: the overview, a page for each comparison, domain and task."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import metadata
from importlib.metadata import version as version_of
from math import ceil

from markupsafe import Markup

from cudc_bench.artefacts.records import Record
from cudc_bench.envs.domains import DOMAINS

from ..numbers.columns import column
from ..numbers.figures import by_domain, intervals, title_of
from ..numbers.grid import Entry
from ..numbers.missing import Missing
from ..numbers.overall import LEAD, NAMES, PAIRS_CAPTION, PRELIMINARY, Comparison, Overall, Standing
from ..numbers.power import FOUND
from ..numbers.published import beside_paper
from ..numbers.scale import Scale, largest_return
from ..numbers.statistics import student
from ..numbers.table import Table, seed_scores
from ..numbers.verdict import task_verdict, verdict
from ..numbers.words import short, span
from ..show.figures.drawing import seeds_text
from .figures import curves, estimates, profiles, ranks, returns, with_references
from .methods import describe
from .models import MISSING, Figure, Heading, HtmlTable, Item, Page, Picture, Row, Section, bar, dots
from .parts import (
    BEST_TEST,
    ComparisonPage,
    Paper,
    brief,
    by_column,
    clip_path,
    commit,
    count,
    domain_path,
    domain_pictures,
    domain_text,
    machine,
    pm,
    pm_scaled,
    reference_text,
    runs_path,
    task_path,
    version,
)
from .studies import Studies

_FURTHER = tuple(name for name in NAMES if name != LEAD)
_MARKS = " Thick: Student's t over datasets; thin and grey above it: the stratified bootstrap, which is too narrow; hollow: a single seed."
_MOST_LINES = 200  # of problems on a page; a folder of other files gives one for each


class Boards(Studies):
    """Builds them."""

    def overview(self, boards: Sequence[ComparisonPage], sections: Sequence[Section]) -> Page:
        """The first page, around what the first comparison shows."""
        first = boards[0]
        tables = self.site.tables
        records = [record for table in self.site.every_table for record in table.records]
        facts = [
            span([len(records)], "run"), span([len(self.site.methods)], "method"), span([len({t.domain for t in tables})], "domain"),
            span([len({(t.domain, task) for t in tables for task in t.tasks})], "task"), span([len(self.site.datasets)], "dataset"),
        ]  # fmt: skip
        lead = (
            "How much offline reinforcement learning gets out of data that were collected without rewards. Every number leads to the runs"
            f" behind it. {', '.join(facts)}.",
            f"Shown here: {first.algorithm}, profile {brief(first.group)}. {self.summary(first)[0]}",
        )
        choose = Section(
            "Comparisons",
            grids=(self._boards_grid(boards),),
            text=("Results of different profiles, settings or offline algorithms never share a table: each has a page of its own.",),
        )
        return Page(
            "index.html",
            "Leaderboard of data collectors",
            (),
            lead,
            self.badges(first),
            (*sections[:1], choose, *sections[1:], *self._problems(), self._reading(boards), self._behind(records), _about()),
        )

    def _boards_grid(self, boards: Sequence[ComparisonPage]) -> HtmlTable:
        lines = [
            Row(
                Item(brief(one.group), link=one.path),
                (Item(one.algorithm), Item(", ".join(table.domain for table in one.tables)), count(len(one.methods)),
                 Item(span([cell.n for table in one.tables for cell in table.cells.values()] or [0], "seed")
                      + (", preliminary" if one.preliminary else "")), count(one.runs)),
            )
            for one in boards
        ]  # fmt: skip
        columns = (Heading("algorithm", number=False), Heading("domains", number=False), Heading("methods"), Heading("seeds", number=False),
                   Heading("runs"))  # fmt: skip
        return HtmlTable("What may be compared, by profile with its settings and offline algorithm", "profile", columns, tuple(lines))

    def _problems(self) -> tuple[Section, ...]:
        if not self.site.problems:
            return ()
        lines = [Item(problem) for problem in self.site.problems[:_MOST_LINES]]
        rest = len(self.site.problems) - len(lines)
        return (Section("Problems", lines=tuple(lines), text=(f"… and {rest:,} more.",) if rest else (), folded=len(lines) > 5,
                        lead="What was left out of the tables, or is doubtful in them."),)  # fmt: skip

    def _reading(self, boards: Sequence[ComparisonPage]) -> Section:
        scores = ", ".join(f"{domain.max_return:,.0f} on {domain.name}" for domain in DOMAINS.values())
        lines = (
            "A return is the undiscounted sum of an episode's rewards, a mean over evaluation episodes. Normalised, it is divided by the"
            f" largest that is possible: {scores}. Where the task has a reference at exactly this profile, normalised is instead (return -"
            " floor) / (ceiling - floor): the floor is the mean return of random actions, the ceiling that of TD3 trained online on the"
            " task.",
            "The unit of replication is the collector seed, that is: the dataset. Several training runs on one dataset count once, as"
            " their mean; ± is the sample standard deviation over seeds, and (5) or n the number of them.",
            "Scores are those after the last gradient step of each milestone, never the best of a training run.",
            f"Bold and marked ● in a task: the largest mean, and all that are not significantly worse ({BEST_TEST}).",
            "Scores are normalised returns. Mean: over tasks of the means over seeds. IQM: mean without the lowest and highest quarter of"
            " runs; of tasks of unequal scale it leaves out the easiest and the hardest. Intervals: 95 %, by Student's t over datasets,"
            " each with all its tasks. P(rank 1): how probable it is by these that a method has the largest mean; only of methods with the"
            " same collector seeds.",
            f"{PRELIMINARY} A single seed has no interval.",
            "The paper's numbers stand beside ours where it reports the same cell. They come from another implementation and are never"
            " ranked with ours; σ counts the paper's standard deviations between them.",
            f"{MISSING} is a cell without any run.",
        )
        return Section("How to read it", lines=tuple(map(Item, lines)))

    def _behind(self, records: Sequence[Record]) -> Section:
        def grid(caption: str, first: str, names: Sequence[str], counts: Counter[tuple[str, ...]]) -> HtmlTable:
            shown = sorted(counts.items(), key=lambda one: (-one[1], one[0]))
            lines = [Row(Item(brief(key[0])), (*(Item(brief(text) or MISSING) for text in key[1:]), count(n))) for key, n in shown[:20]]
            if len(shown) > 20:
                rest = sum(n for _, n in shown[20:])
                lines.append(Row(Item(f"{len(shown) - 20} others"), (*(Item() for _ in names), count(rest))))
            return HtmlTable(caption, first, (*(Heading(name, number=False) for name in names), Heading("runs")), tuple(lines))

        packages = ("torch", "mujoco", "numpy")
        codes: Counter[tuple[str, ...]] = Counter(
            (version(r, "cudc-bench"), commit(r), *(version(r, name) for name in packages)) for r in records
        )
        machines: Counter[tuple[str, ...]] = Counter((machine(r, "processor"), machine(r, "device"), machine(r, "system")) for r in records)
        return Section("Versions and machines behind it", grids=(
            grid("Versions and commits of the code that trained", "cudc-bench", ("commit", *packages), codes),
            grid("Machines that trained", "processor", ("device", "system"), machines),
        ))  # fmt: skip

    def summary(self, board: ComparisonPage) -> tuple[str, ...]:
        """What a comparison is about."""
        counts = (span([board.runs], "run"), span([len(board.methods)], "method"))
        domains = ", ".join(table.domain for table in board.tables)
        seeds = span([cell.n for table in board.tables for cell in table.cells.values()] or [0], "seed")
        return (f"{', '.join(counts)} on {domains}; {seeds} behind a cell.",)

    def badges(self, board: ComparisonPage) -> tuple[str, ...]:
        """What to know before reading it."""
        return ("Preliminary: fewer than five seeds",) if board.preliminary else ()

    def board(self, board: ComparisonPage) -> tuple[Section, ...]:
        """All that a comparison shows."""
        parts: list[Section] = []
        if board.overall is not None:
            parts += self._ranking(board, board.overall)
        matrix = tuple(self._matrix(board, milestone) for milestone in board.milestones)
        parts.append(Section(
            "Methods and tasks", grids=matrix,
            text=("Each number leads to its runs, each task to its curves and intervals, each method to what it is.",),
        ))  # fmt: skip
        if board.overall is not None:
            parts += self._comparisons(board, board.overall)
        parts += self.studies_list(self.studies_of(board))
        parts += self.further(board.slug, {"overall", "scores", "power", "intervals", "profiles", "ranks", "domains"})
        missing = [one for one in self.site.missing if (one.group, one.algorithm) == (board.group, board.algorithm)]
        if missing:
            parts.append(_missing(missing))
        return tuple(parts)

    def _ranking(self, board: ComparisonPage, overall: Overall) -> list[Section]:
        headline = overall.headline
        compared = [one for one in overall.comparisons if one.scope == headline.scope]
        figures = tuple(
            self._drawn(one.milestone, estimates(intervals(overall, one), self._styles), intervals(overall, one).title,
                        f"Aggregates of each method with 95 % intervals, {one.title}; numbers in the table above.", after=_MARKS)
            for one in compared
        )  # fmt: skip
        return [Section(
            f"Ranking over {headline.scope}", grids=tuple(self._standings(board, one) for one in compared), figures=figures,
            verdict=_verdicts(board, headline.scope),
            downloads=self.downloads(board.slug, ("overall", "scores", "intervals")),
            text=(overall.caption, *headline.remarks, *(f"Left out: {line}" for line in headline.left_out)),
            lead=f"{PRELIMINARY}" if headline.preliminary else "",
        )]  # fmt: skip

    @staticmethod
    def _drawn(milestone: int | None, panels: tuple[Markup, ...], caption: str, alt: str, legend: tuple[Item, ...] = (), after: str = ""
               ) -> Figure:  # fmt: skip
        return Figure(panels, alt, f"{caption}.{after}", legend, milestone)

    def _standings(self, board: ComparisonPage, comparison: Comparison) -> HtmlTable:
        standings = sorted(comparison.standings, key=lambda one: -one.estimates[LEAD].value)
        highs = [within.high for one in standings if (within := one.estimates[LEAD].interval)]
        largest = ceil(10 * max([*highs, *(one.estimates[LEAD].value for one in standings), 0.1]) - 1e-9) / 10
        columns = (
            Heading(NAMES[LEAD]), Heading("95 % interval", sorts=False), Heading(f"0 to {largest:g}", number=False, sorts=False),
            *([] if comparison.unranked else [Heading("P(rank 1)")]), *(Heading(NAMES[name]) for name in _FURTHER), Heading("seeds"),
        )  # fmt: skip
        lines = [Row(self.name(one.method), self._standing(one, largest)) for one in standings]
        caption = f"{comparison.title}, {comparison.seeds}, by {NAMES[LEAD]}"
        notes = f"Interval: 95 %, by Student's t over datasets; of a single seed there is none. The picture has it from 0 to {largest:g}."
        if not comparison.unranked:
            notes += " P(rank 1): how probable it is that the method has the largest mean."
        return HtmlTable(
            caption, "method", columns, tuple(lines), milestone=comparison.milestone, filters="methods", notes=(notes,), sorted_by=0
        )

    def _standing(self, standing: Standing, largest: float) -> tuple[Item, ...]:
        found = standing.estimates[LEAD]
        within = found.interval
        low, high = (within.low, within.high) if within else (found.value, found.value)
        rest = [Item(f"{standing.estimates[name].value:.3f}", standing.estimates[name].value) for name in _FURTHER]
        return (
            Item(f"{found.value:.3f}", found.value),
            Item(f"{low:.3f} to {high:.3f}") if within else Item(),
            Item("", found.value, picture=bar(low, found.value, high, largest, self.colour(standing.method))),
            *([Item(f"{standing.ranks[0]:.2f}", standing.ranks[0])] if standing.ranks else []),
            *rest,
            Item(standing.seeds_text, standing.n),
        )

    def _comparisons(self, board: ComparisonPage, overall: Overall) -> list[Section]:
        headline = overall.headline
        found = []
        if overall.power_text:
            downloads = self.downloads(board.slug, ("power",))
            found.append(Section("What so many seeds can show", grids=_power(overall), text=(overall.power_text,), downloads=downloads))
        compared = [one for one in overall.comparisons if one.scope == headline.scope]
        figures = []
        for one in compared:
            figures.append(self._drawn(
                one.milestone, profiles(one, self._styles), title_of("Performance profiles, band: 95 %", overall, one),
                f"Performance profiles, {one.title}: share of runs above each score.", self.legend(one.methods),
            ))  # fmt: skip
            if panels := ranks(one, self._styles):
                figures.append(self._drawn(
                    one.milestone, panels, title_of("Probability of each rank by the mean, in per cent", overall, one),
                    f"Probability of each rank by the mean, {one.title}.",
                ))  # fmt: skip
        downloads = self.downloads(board.slug, ("profiles", "ranks"))
        found.append(Section("How certain that is", figures=tuple(figures), downloads=downloads))
        others = [one for one in overall.comparisons if one.scope != headline.scope]
        if others:
            parts = [
                Section(scope, grids=tuple(self._standings(board, one) for one in others if one.scope == scope),
                        text=tuple(line for one in others if one.scope == scope
                                   for line in (*one.remarks, *(f"Left out: {line}" for line in one.left_out))))
                for scope in dict.fromkeys(one.scope for one in others)
            ]  # fmt: skip
            by_domains = tuple(
                self._drawn(milestone, estimates(by_domain(overall, milestone), self._styles), by_domain(overall, milestone).title,
                            f"Mean score of each method with 95 % intervals on each domain, {short(milestone)} steps.", after=_MARKS)
                for milestone in dict.fromkeys(one.milestone for one in overall.comparisons)
            )  # fmt: skip
            downloads = self.downloads(board.slug, ("domains",))
            found.append(Section("Ranking on each domain", figures=by_domains, downloads=downloads, parts=tuple(parts), folded=True))
        pairs = tuple(self._pairs(one) for one in overall.comparisons if one.scope == headline.scope and one.pairs)
        if pairs:
            found.append(Section("Method against method", grids=pairs, folded=True))
        return found

    def _pairs(self, comparison: Comparison) -> HtmlTable:
        found = {(pair.method, pair.other): pair for pair in comparison.pairs}
        lines = []
        for method in comparison.methods:
            items = []
            for other in comparison.methods:
                pair = found.get((method, other))
                within = f"{pair.interval.low:.2f} to {pair.interval.high:.2f}" if pair and pair.interval else ""
                items.append(Item() if pair is None else Item(f"{pair.probability:.2f}", pair.probability, best=pair.better, note=within))
            lines.append(Row(self.name(method), tuple(items)))
        return HtmlTable(f"Probability that the row's method is better than the column's, {comparison.title}", "better than",
                    tuple(Heading(method) for method in comparison.methods), tuple(lines), milestone=comparison.milestone,
                    filters="methods", notes=(PAIRS_CAPTION.replace("Bold:", "Bold and ●:"),))  # fmt: skip

    def _matrix(self, board: ComparisonPage, milestone: int) -> HtmlTable:
        columns, groups = [], []
        for table in board.tables:
            groups.append((table.domain, len(table.tasks), domain_path(table)))
            columns += [Heading(task, link=task_path(table, task)) for task in table.tasks]
        lines = []
        for method in self._by_result(board, milestone):
            items: list[Item] = []
            for table in board.tables:
                items += [self.cell(table, milestone, task, method) for task in table.tasks]
            lines.append(Row(self.name(method), tuple(items)))
        foot = self.ends([(table, task) for table in board.tables for task in table.tasks], lambda name, value: [self.end(name, value)])
        caption = (
            f"{board.algorithm}, profile {brief(board.group)}, {short(milestone)} gradient steps: mean ± sample standard deviation (seeds)"
        )
        notes = (
            f"Bold and ●: the task's largest mean, and all that are not significantly worse ({BEST_TEST}). ±: the sample standard deviation"
            f" over collector seeds, whose number stands in brackets. {MISSING}: no run. Rows: by the ranking at these steps.",
        )
        return HtmlTable(caption, "method", tuple(columns), tuple(lines), tuple(groups), milestone, "methods", tuple(foot), notes)

    @staticmethod
    def _by_result(board: ComparisonPage, milestone: int) -> list[str]:
        """Its methods, those first that come first where they are compared on all of its domains; then those that are not compared."""
        comparisons = board.overall.comparisons if board.overall else ()
        domains = {table.domain for table in board.tables}
        compared = [one for one in comparisons if one.milestone == milestone and set(one.domains) <= domains]
        compared.sort(key=lambda one: -len(one.domains))
        order = [one.method for found in compared[:1] for one in sorted(found.standings, key=lambda one: -one.estimates[LEAD].value)]
        return sorted(board.methods, key=lambda method: order.index(method) if method in order else len(order))

    def domain(self, board: ComparisonPage, table: Table) -> Page:
        """The page of a table."""
        single = replace(board, tables=(table,))
        runs = table.runs
        of = f"{table.algorithm} on {table.domain}, profile {brief(table.group)}"
        sections = [Section(
            "Results", verdict=_verdicts(single, table.domain),
            grids=tuple(self._matrix(single, milestone) for milestone in reversed(table.milestones)),
            downloads=self.downloads(table.slug, ("table",)), text=(table.caption,),
        )]  # fmt: skip
        curved = self._drawn(
            None, curves(runs, self._styles), f"{of}: {seeds_text(runs.seeds)}, upright dots: milestones",
            f"Learning curves on {table.domain}: return over gradient steps, a panel for each task.", self.legend(runs.methods),
            with_references(runs.references),
        )  # fmt: skip
        sections.append(Section("Learning curves", figures=(curved,), downloads=self.downloads(table.slug, ("curves",))))
        paper = beside_paper(table)
        if paper is not None:
            text = (paper.caption, "The numbers stand in the table above, behind the switch.")
            sections.append(Section("Beside the paper", text=text, downloads=self.downloads(table.slug, ("paper",))))
        bars = tuple(
            self._drawn(milestone, returns(runs, milestone, self._styles),
                        f"{of}, after {short(milestone)} gradient steps: {seeds_text(runs.seeds, 'bar')}",
                        f"Mean returns on {table.domain} after {short(milestone)} gradient steps, a panel for each task; numbers above.",
                        after=with_references(runs.references))
            for milestone in reversed(table.milestones)
        )  # fmt: skip
        sections.append(Section("At the milestones", figures=bars, downloads=self.downloads(table.slug, ("bars",))))
        sections += self.studies_list([study for study in self.site.studies if study.folder == table.slug])
        sections += self.further(table.slug, {"curves", "bars", "table", "paper", *(f"task-{task}" for task in table.tasks)})
        sections.append(Section("Tasks", lines=tuple(Item(task, link=task_path(table, task)) for task in table.tasks)))
        lead = (f"{domain_text(table.domain)}. {table.algorithm}, profile {brief(table.group)}, {table.seeds}.",)
        if pictures := domain_pictures(table.domain):
            sections.insert(1, Section(f"What {table.domain} is", pictures=pictures))
        return Page(domain_path(table), table.domain, self.crumbs(board), lead, self.badges(single), tuple(sections))

    def task(self, board: ComparisonPage, table: Table, task: str) -> Page:
        """The page of a task of a table."""
        largest = largest_return(table.domain, task)
        grids = [self._task_grid(table, milestone, task) for milestone in reversed(table.milestones)]
        runs = table.runs
        what = f"Learning curves of all methods on {table.domain} {task}: mean return over gradient steps, band: one standard deviation."
        sections = [
            Section("Results", grids=tuple(grids), verdict=tuple(
                (milestone, task_verdict(_results(table, milestone, task))) for milestone in reversed(table.milestones)
            )),
        ]  # fmt: skip
        if task in runs.tasks:
            of = f"{table.algorithm} on {table.domain} {task}, profile {brief(table.group)}"
            caption = f"{of}: {seeds_text(runs.seeds)}, upright dots: milestones"
            figure = self._drawn(None, curves(runs, self._styles, task), caption, what, self.legend(runs.methods),
                                 with_references({task: runs.references[task]} if task in runs.references else {}))  # fmt: skip
            sections.append(Section("Learning curves", figures=(figure,), downloads=self.downloads(table.slug, (f"task-{task}",))))
        sections += self._best_policy(table, task)
        lead = (
            f"{table.algorithm}, profile {brief(table.group)}."
            + (f" The largest possible return is {largest:,.0f}." if largest else " The largest possible return is not known."),
            *reference_text(table, task),
        )
        others = tuple(Item(one, link=task_path(table, one)) for one in table.tasks if one != task)
        if others:
            sections.append(Section(f"Other tasks of {table.domain}", lines=others))
        crumbs = (*self.crumbs(board), (table.domain, domain_path(table)))
        return Page(task_path(table, task), f"{table.domain} {task}", crumbs, lead, self.badges(board), tuple(sections))

    def _best_policy(self, table: Table, task: str) -> list[Section]:
        """The best run of a task, with a video where somebody made one, and otherwise how to make it."""
        clip = self.site.clips.get((table.slug, task))
        if clip is None:
            return []
        best, link = clip.best, runs_path(table, task, column(clip.best))
        what = f"{column(best)}, collector seed {best.dataset.seed}, training seed {best.seed}"
        facts = [("run with the largest final score", Item(what, link=link)),
                 ("its final score", Item(f"{best.conclusion.mean:.1f}, the mean of {span([len(best.conclusion.returns)], 'episode')}")),
        ]  # fmt: skip
        pictures = domain_pictures(table.domain)
        code: tuple[tuple[str, str], ...] = ()
        lead = ""
        if clip.shown is not None:
            one = clip.shown
            whose = "The video that lies beside its record"
            if one is not best:
                whose = (
                    f"Of that run there is no video; this one lies beside the record of {column(one)}, collector seed {one.dataset.seed},"
                    f" whose final score is {one.conclusion.mean:.1f}"
                )
            alt = f"Video of a policy of {column(one)} on {table.domain} {task}."
            pictures = (Picture(clip_path(table, task, clip), alt, f"{whose}."),)
        elif clip.has_policy and (place := self.site.place(best)):
            lead = "There is no video of it yet. In the results' folder this makes one beside its record, which the next leaderboard shows."
            code = (("", shlex.join(["cudc-bench", "render", place])),)
        else:
            lead = "There is no video of it, and its policy is not beside its record; the run's page has the command that trains it again."
        return [Section("The best policy", lead=lead, facts=tuple(facts), pictures=pictures, code=code)]

    def _task_grid(self, table: Table, milestone: int, task: str) -> HtmlTable:
        largest, scale = largest_return(table.domain, task), self.scale(table, task)
        cells = _results(table, milestone, task)
        papers = self.paper(table)
        columns = [Heading("mean"), Heading("std"), Heading("95 % interval", sorts=False), Heading("seeds"),
                   Heading("each seed", number=False, sorts=False)]  # fmt: skip
        with_paper = any((milestone, task, method) in papers for method in table.methods)
        if with_paper:
            columns += [Heading("paper"), Heading("difference")]
        lines = []
        order = sorted(cells, key=lambda method: -cells[method].value)
        reach = largest or max([1.0, *(abs(cell.value) for cell in cells.values())])
        together = by_column(table, task)
        for method in (*order, *(method for method in table.methods if method not in cells)):
            cell = cells.get(method)
            items = [Item()] * len(columns)
            if cell is not None:
                link = runs_path(table, task, method, milestone)
                items = [*self._numbers(cell, scale, link), count(cell.n)]
                picture = dots(seed_scores(together[method], milestone), cell.value, reach, self.colour(method))
                items.append(Item("", cell.value, picture=picture))
                if with_paper:
                    items += _paper_items(papers.get((milestone, task, method)), scale)
            lines.append(Row(self.name(method), tuple(items)))
        foot = self.ends([(table, task)], lambda name, value: [self.end(name, value, 1), *[Item()] * (len(columns) - 1)])
        low, high = table.episodes[milestone]
        caption = (
            f"{table.domain} {task} after {short(milestone)} gradient steps, evaluation episodes:"
            f" {low if low == high else f'{low} to {high}'}"
        )
        notes = [
            f"Bold and ●: the largest mean, and all that are not significantly worse ({BEST_TEST}). Std: the sample standard deviation over"
            " collector seeds. Interval: 95 % of the mean, by Student's t over collector seeds; of few seeds it can pass what is possible."
            f" Each seed: a dot for each, a bar at the mean{f', from 0 to {largest:,.0f}' if largest else ''}. {MISSING}: no run."
        ]
        if with_paper:
            theirs = "Paper: as reported there, from another implementation, not to be ranked with ours."
            notes.append(f"{theirs} Difference: in the paper's standard deviations, σ.")
        return HtmlTable(caption, "method", tuple(columns), tuple(lines), milestone=milestone, filters="methods", foot=tuple(foot),
                         notes=tuple(notes), sorted_by=0)  # fmt: skip

    def _numbers(self, cell: Entry, scale: Scale | None, link: str) -> list[Item]:
        within = None if cell.std is None else student(cell.value, cell.std, cell.n)

        def scaled(*values: float) -> str:
            return " to ".join(f"{scale.score(value) + 0.0:.3f}" for value in values) if scale else MISSING

        return [
            Item(f"{cell.value:.1f}", cell.value, link, cell.best, scaled(cell.value)),
            Item() if cell.std is None else Item(f"{cell.std:.1f}", cell.std, scaled=f"{scale.width(cell.std):.3f}" if scale else MISSING),
            Item() if within is None else Item(f"{within.low:.0f} to {within.high:.0f}", scaled=scaled(within.low, within.high)),
        ]


def _about() -> Section:
    """What this is, and how to get it."""
    known = describe("cudc")
    addresses = dict(one.split(", ", 1) for one in metadata("cudc-bench").get_all("Project-URL") or () if ", https://" in one)
    facts = [("paper", Item(f"{known.citation}: CUDC (AAAI 2024)", link=known.paper or None)),
             ("code", Item(f"cudc-bench {version_of('cudc-bench')}")), ("licence", Item("MIT"))]  # fmt: skip
    facts += [(name.lower(), Item(address, link=address)) for name, address in addresses.items()]
    code = (("Install it, from a clone", "pip install ."), ("Make these pages again from the records", "cudc-bench leaderboard results"))
    return Section("Get it", facts=tuple(facts), code=code)


def _results(table: Table, milestone: int, task: str) -> dict[str, Entry]:
    """The results that a task has, by method."""
    return {method: cell for method in table.methods if (cell := table.cells.get((milestone, task, method)))}


def _verdicts(board: ComparisonPage, scope: str) -> tuple[tuple[int, tuple[str, ...]], ...]:
    """What the tests of each milestone say, over all domains or one."""
    overall = board.overall
    if overall is None:
        return ()
    compared = [one for one in overall.comparisons if one.scope == scope]
    return tuple((one.milestone, (*verdict(overall, one), *_absent(board, one))) for one in compared)


def _absent(board: ComparisonPage, comparison: Comparison) -> tuple[str, ...]:
    """Which of its methods a comparison says nothing of."""
    absent = [method for method in board.methods if method not in comparison.methods]
    them = "it" if len(absent) == 1 else "them"
    return (f"Not compared, since too little is there of {them}: {', '.join(absent)}.",) if absent else ()


def _power(overall: Overall) -> tuple[HtmlTable, ...]:
    """What several numbers of seeds can show."""
    if overall.power is None:
        return ()
    columns = tuple(map(Heading, ("least p", "after Holm's correction", f"lead found in {round(10 * FOUND)} of 10 cases")))
    lines = [
        Row(Item(f"{one.seeds}{' (as here)' if one.seeds == overall.power.own else ''}", one.seeds), (
            Item(f"{one.least:.2g}", one.least), Item(f"{one.corrected:.2g}", one.corrected),
            Item() if one.lead is None else Item(overall.lead(one.lead), one.lead),
        ))
        for one in overall.power.designs
    ]  # fmt: skip
    return (
        HtmlTable(
            f"Seeds of each method in a domain, and what the test can find: {overall.headline.title}", "seeds", columns, tuple(lines)
        ),
    )


def _missing(missing: Sequence[Missing]) -> Section:
    lines, code = [], []
    for one in missing:
        what = f"{one.method} on {one.domain}: {', '.join(one.tasks)}, {span([len(one.seeds)], 'seed')}"
        if one.command:
            code.append((what, one.command))
        else:
            lines.append(Item(f"{what} (by the commands of its other records)"))
    return Section("What is missing", lead="Runs that would make the comparison complete, with the commands that make them.",
                   lines=tuple(lines), code=tuple(code), folded=len(missing) > 5)  # fmt: skip


def _paper_items(paper: Paper | None, scale: Scale | None) -> list[Item]:
    if paper is None:
        return [Item(), Item()]
    theirs, difference = paper
    scaled = pm_scaled(theirs.value, theirs.std, scale) if scale else MISSING
    shown = Item(pm(theirs.value, theirs.std), theirs.value, scaled=scaled)
    return [shown, Item() if difference is None else Item(f"{difference.value:+.1f} σ", difference.value)]
