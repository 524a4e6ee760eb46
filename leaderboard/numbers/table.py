"""The model behind every rendering: one table for each (group, algorithm, domain), like the two halves of the paper's Table 1.

Conventions. The unit of replication is the collector seed: several training runs on one dataset count once, as their mean. The
paper prints "mean ± std over five seeds" without saying which; here it is the *sample* standard deviation (divisor n - 1), the usual
estimate for seeds that stand for all others, and with five seeds 12 % above the population's. It does not exist for n = 1, where
a cell shows its mean and n alone.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import fmean, stdev
from typing import Any

from cudc_bench.artefacts.again import commands_from_nothing
from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.settings.evaluate_config import in_full
from cudc_bench.text import plain

from ..methods import METHOD_ORDER, canonical
from .columns import column, submitted_caption, submitted_columns
from .grid import Column, Entry, Grid, Line, Part
from .scale import CEILING, FLOOR, References, references_caption, serving
from .statistics import SIGNIFICANCE, holm
from .study_specs import STUDY_METHODS
from .words import extent, ordered, short, slug, span

ENOUGH_SEEDS = 5


@dataclass(frozen=True)
class Block:
    """Records of one group, algorithm and domain with the same milestones: they may be compared with one another.

    Attributes:
        group, algorithm, domain: as of its records; ``group`` is not yet fit for showing.
        milestones: gradient steps, ascending.
        records: those of each method (see :func:`~.columns.column`) on each task.
        references: what may serve them, by task (see :func:`~.scale.serving`).
    """

    group: str
    algorithm: str
    domain: str
    milestones: tuple[int, ...]
    records: Mapping[tuple[str, str], Sequence[Record]] = field(repr=False)
    references: References = field(default_factory=dict, repr=False)

    @property
    def methods(self) -> tuple[str, ...]:
        """The paper's baselines and CUDC in the paper's order, then others by name."""
        return ordered({method for method, _ in self.records}, METHOD_ORDER)

    @property
    def tasks(self) -> tuple[str, ...]:
        """Those that have records: the domain's in its order, then others by name. Nobody asked for the rest."""
        return ordered({task for _, task in self.records}, tasks_of(self.domain))

    @property
    def is_zero_shot(self) -> bool:
        """Whether its learner trained without rewards, and was told of tasks afterwards."""
        return any(one.zero_shot is not None for found in self.records.values() for one in found)

    @property
    def slug(self) -> str:
        """A safe and unique name for files."""
        return slug(self.group, self.algorithm, self.domain)


@dataclass(frozen=True)
class Runs:
    """Some methods of a block as figures show them.

    Attributes:
        group, algorithm, domain: which block; ``group`` on one line.
        methods, tasks, milestones: what there is to show; every task has records.
        records: those of a method on a task, if there are some.
        cells: the result of a method on a task at a milestone, if there is one.
        references: floor and ceiling of tasks that have a reference.
    """

    group: str
    algorithm: str
    domain: str
    methods: tuple[str, ...]
    tasks: tuple[str, ...]
    milestones: tuple[int, ...]
    records: Mapping[tuple[str, str], Sequence[Record]] = field(repr=False)
    cells: Mapping[tuple[int, str, str], Entry] = field(repr=False)
    references: References = field(default_factory=dict, repr=False)

    @property
    def seeds(self) -> str:
        """How many collector seeds are behind a cell, such as ``"5 seeds"`` or ``"1 to 3 seeds"``."""
        return span([cell.n for cell in self.cells.values()] or [0], "seed")


@dataclass(frozen=True)
class Table:
    """Results that may be compared with one another: all methods but those that exist for studies only.

    Attributes:
        group: profile and whatever differs from it, on one line (see ``Record.group``).
        algorithm, domain: evaluator and domain.
        slug: a safe and unique name for files.
        grid: mean returns; a part for each milestone, ascending, a line for each task, and a column for each method: the paper's baselines
            and CUDC in the paper's order, then others by name; imported datasets have their own.
        episodes: at each milestone the smallest and largest number behind one score.
        records: all that it was made from.
        references: floor and ceiling of tasks that have a reference.
    """

    group: str
    algorithm: str
    domain: str
    slug: str
    grid: Grid
    episodes: Mapping[int, tuple[int, int]]
    records: tuple[Record, ...] = field(repr=False)
    references: References = field(default_factory=dict, repr=False)

    @property
    def methods(self) -> tuple[str, ...]:
        """The columns."""
        return tuple(column.name for column in self.grid.columns)

    @property
    def milestones(self) -> tuple[int, ...]:
        """Of its parts: gradient steps, ascending."""
        return tuple(self.episodes)

    @property
    def tasks(self) -> tuple[str, ...]:
        """The rows: the domain's tasks that have records in its order, then others by name."""
        return tuple(line.labels[0] for line in self.grid.parts[0].lines)

    @property
    def headings(self) -> tuple[str, ...]:
        """The heads of its columns: the methods, between floor and ceiling if a task has a reference."""
        return (FLOOR, *self.methods, CEILING) if self.references else self.methods

    @cached_property
    def cells(self) -> dict[tuple[int, str, str], Entry]:
        """The results that there are, by milestone, task and method."""
        return {(int(part.key), line.labels[0], column.name): entry for part, line, column, entry in self.grid.entries() if entry}

    @property
    def seeds(self) -> str:
        """How many collector seeds are behind a cell, such as ``"5 seeds"`` or ``"1 to 3 seeds"``."""
        return span([cell.n for cell in self.cells.values()] or [0], "seed")

    @property
    def runs(self) -> Runs:
        """The same for figures."""
        records = by_cell(self.records)
        tasks = tuple(task for task in self.tasks if any((method, task) in records for method in self.methods))
        return Runs(self.group, self.algorithm, self.domain, self.methods, tasks, self.milestones, records, self.cells, self.references)

    @property
    def commands(self) -> list[str]:
        """The commands that make the records again, without repeats."""
        return commands(self.records)

    @property
    def submissions(self) -> list[str]:
        """What is known of the columns that were handed in: by how many runs, from where, of which commits."""
        handed: dict[tuple[str, str, str], list[Record]] = defaultdict(list)
        for record in self.records:
            if record.submission is not None:
                handed[column(record), record.submission.url or "", record.submission.note or ""].append(record)
        return [
            plain("; ".join(filter(None, (f"{name}: {span([len(records)], 'run')}", origins(records), url, note))))
            for (name, url, note), records in sorted(handed.items(), key=lambda entry: entry[0])
        ]

    @property
    def caption(self) -> str:
        """What the numbers are, in plain ASCII except for what records bring along."""
        steps = " and ".join(map(short, self.milestones))
        episodes = ", ".join(f"{extent(*count)} at {short(milestone)}" for milestone, count in self.episodes.items())
        preliminary = any(cell.n < ENOUGH_SEEDS for cell in self.cells.values())
        imported = any(record.dataset.source for record in self.records)
        aliases = sorted({f"{one.dataset.method} under {canonical(one.dataset.method)}" for one in self.records
                        if one.dataset.source is None and canonical(one.dataset.method) != one.dataset.method})  # fmt: skip
        own = any(record.dataset.reward is not None for record in self.records)
        unasked = [] if own else [task for task in tasks_of(self.domain) if task not in self.tasks]
        return (
            f"Mean and sample standard deviation (divisor n-1) over collector seeds of the return of {self.algorithm} on"
            f" {self.domain} after {steps} gradient steps; the number of seeds is in brackets. Bold in each task:"
            " the largest mean and those that are not significantly worse (two-sided Welch test over seeds, p >= 0.05 after Holm's"
            " correction within the row; a single seed cannot be tested)."
            f" Profile: {self.group}. {self.seeds}. Evaluation episodes: {episodes}."
            + references_caption(self.references, self.tasks)
            + zero_shot_caption(self.records)
            + (f" Tasks of {self.domain} without any run: {', '.join(unasked)}." if unasked else "")
            + (" A source and a number of steps behind a method: that dataset was imported, not collected here." if imported else "")
            + (f" Another name of the same setting: {', '.join(aliases)}." if aliases else "")
            + submitted_caption(submitted_columns(self.records))
            + (" Preliminary: fewer than five seeds." if preliminary else "")
        )


def origins(records: Iterable[Record]) -> str:
    """The commits that some records say they were made with: ``"commit 0123456 with local changes, no commit"``."""
    told = {
        "no commit" if record.commit is None else f"commit {record.commit[:7]}{' with local changes' if record.dirty else ''}"
        for record in records
    }
    return ", ".join(sorted(told))


def build_tables(
    records: Iterable[Record], references: Mapping[tuple[str, str, str], Bounds] | None = None
) -> tuple[list[Table], list[str]]:
    """Sort records into the main tables; results of different groups never share one.

    Returns:
        The tables, by domain, algorithm and group, and one line for each problem.
    """
    blocks, problems = build_blocks(records, references)
    return tables_of(blocks), problems


def build_blocks(
    records: Iterable[Record], references: Mapping[tuple[str, str, str], Bounds] | None = None
) -> tuple[list[Block], list[str]]:  # fmt: skip
    """Sort records into what may be compared.

    Records whose milestones differ from those of most others in their block are left out of it. Of two datasets of one setting and seed
    under two names (see ``methods.ALIASES``) one is left out: they would otherwise count as two trainings on one dataset.

    Args:
        records: of any group.
        references: by profile, domain and task, as ``cudc_bench.artefacts.references.read_references`` returns them.

    Returns:
        The blocks, by domain, algorithm and group, and one line for each problem.
    """
    split: dict[tuple[str, str, str], list[Record]] = defaultdict(list)
    for record in records:
        split[record.dataset.domain, record.algorithm, record.group].append(record)
    blocks, problems = [], []
    for domain, algorithm, group in sorted(split):
        single, aliases = _without_aliases(split[domain, algorithm, group])
        same, odd = _agree(single)
        block = Block(group, algorithm, domain, _milestones(same[0]), by_cell(same), serving(references or {}, same[0]))
        blocks.append(block)
        problems += [f"table {block.slug}: {problem}" for problem in (*aliases, *odd, *_doubts(same))]
    return blocks, problems


def tables_of(blocks: Iterable[Block], studies: bool = False) -> list[Table]:
    """The main table of each block that has methods for one; with ``studies`` that of the methods that exist for studies only."""
    chosen = [(block, [name for name in block.methods if (name in STUDY_METHODS) == studies]) for block in blocks]
    return [_build(block, methods, marked=not studies) for block, methods in chosen if methods]


def zero_shot_caption(records: Iterable[Record]) -> str:
    """How learners without rewards were told of their tasks, as a caption goes on."""
    told = sorted({one.zero_shot.labels for one in records if one.zero_shot is not None})
    if not told:
        return ""
    how = f"told of each by the rewards of {told[0]:,} transitions, or of all where there are fewer"
    return f" Trained without rewards, once for all tasks of a dataset, and {how}."


def tasks_of(domain: str) -> tuple[str, ...]:
    """The tasks that come with a domain, in its order; none of a domain that is not known here."""
    return DOMAINS[domain].tasks if domain in DOMAINS else ()


def by_cell(records: Iterable[Record]) -> dict[tuple[str, str], list[Record]]:
    """Records of each method (see :func:`~.columns.column`) on each task."""
    found: dict[tuple[str, str], list[Record]] = defaultdict(list)
    for record in records:
        found[column(record), record.dataset.task].append(record)
    return dict(found)


def commands(records: Iterable[Record]) -> list[str]:
    """The commands that make records again from nothing, without repeats: collections, mixtures, tiers, labels, trainings."""
    steps: dict[str, set[str]] = {"collect": set(), "mix": set(), "tiers": set(), "relabel": set(), "": set()}
    for record in records:
        *before, last = commands_from_nothing(record)
        steps[""].add(plain(last))
        for command in before:
            steps[command.split()[1]].add(plain(command))
    return [command for step in steps.values() for command in sorted(step)]


def seed_scores(records: Iterable[Record], step: int) -> list[float]:
    """The mean return of each collector seed after ``step`` gradient steps; seeds without an evaluation there are absent."""
    return list(scores_by_seed(records, step).values())


def scores_by_seed(records: Iterable[Record], step: int) -> dict[int, float]:
    """The same by collector seed, ascending. Several training runs on one dataset count once, as their mean."""
    seeds: dict[int, list[float]] = defaultdict(list)
    for record in records:
        score = record.score(step)
        if score is not None:
            seeds[record.dataset.seed].append(score)
    return {seed: fmean(scores) for seed, scores in sorted(seeds.items())}


def _without_aliases(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    names: dict[tuple[str, int], Counter[str]] = defaultdict(Counter)
    for record in records:
        names[column(record), record.dataset.seed][record.dataset.method] += 1
    kept = {}
    problems = []
    for (name, seed), found in sorted(names.items()):
        # The one with more runs; if both have as many, that under whose name both are compared.
        kept[name, seed] = max(found, key=lambda method: (found[method], method == name, method))
        problems += [
            f"{method}, seed {seed}, is left out: it is the same setting as {kept[name, seed]}, which has that seed, too."
            for method in sorted(found.keys() - {kept[name, seed]})
        ]
    return [one for one in records if one.dataset.method == kept[column(one), one.dataset.seed]], problems


def _agree(records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    # Nobody else's runs decide which of ours are odd.
    ours = [record for record in records if record.submission is None]
    found = Counter(_milestones(record) for record in ours or records)
    most = max(found, key=lambda milestones: (found[milestones], milestones))
    odd = [
        f"{record.labelled_id} (seed {record.seed}) is left out: its milestones {_listed(_milestones(record))} are not the"
        f" table's {_listed(most)}."
        for record in records
        if _milestones(record) != most
    ]
    return [record for record in records if _milestones(record) == most], odd


def _doubts(records: Sequence[Record]) -> list[str]:
    problems = [
        f"{record.labelled_id} (seed {record.seed}) was not evaluated at milestone {milestone}."
        for record in records
        for milestone in _milestones(record)
        if record.score(milestone) is None
    ]
    if names := differing([in_full(record.hyperparameters) for record in records]):
        problems.append(plain(f"its records were trained with different hyperparameters: {', '.join(names)}."))
    return problems


def differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """The names whose values are not the same in all of some settings, sorted; a name that is missing from one of them counts."""
    first = settings[0]
    return sorted({name for one in settings for name in first.keys() | one.keys() if name not in one or first.get(name) != one[name]})


def _build(block: Block, methods: Sequence[str], marked: bool) -> Table:
    own = {key: records for key, records in block.records.items() if key[0] in methods}
    records = tuple(record for found in own.values() for record in found)
    tasks = ordered({task for _, task in own}, tasks_of(block.domain))
    parts, episodes = [], {}
    for milestone in block.milestones:
        cells = [[build_cell(own.get((name, task), ()), milestone) for name in methods] for task in tasks]
        lines = [Line((task,), mark_best(row) if marked else tuple(row)) for task, row in zip(tasks, cells, strict=True)]
        evaluations = [record.evaluation(milestone) for record in records]
        counts = [len(evaluation.returns) for evaluation in evaluations if evaluation] or [0]
        episodes[milestone] = min(counts), max(counts)
        parts.append(Part(f"{short(milestone)} steps", milestone, tuple(lines)))
    shown = {task: block.references[task] for task in tasks if task in block.references}
    grid = Grid("table", "Returns", "", "milestone", ("task",), tuple(map(Column, methods)), tuple(parts))
    return Table(plain(block.group), block.algorithm, block.domain, block.slug, grid, episodes, records, shown)


def build_cell(records: Iterable[Record], milestone: int) -> Entry | None:
    """The result of one method's records on one task; None if none was evaluated at the milestone."""
    scores = seed_scores(records, milestone)
    return Entry(fmean(scores), stdev(scores) if len(scores) > 1 else None, None, len(scores)) if scores else None


def mark_best(cells: Sequence[Entry | None]) -> tuple[Entry | None, ...]:
    """The same cells; the best of several methods on one task, and those that are not significantly worse, are marked."""
    present = [cell for cell in cells if cell]
    if len(present) < 2:
        return tuple(cells)
    first = max(present, key=lambda cell: (cell.value, cell.n))
    tested = [cell for cell in present if cell is not first and min(cell.n, first.n) > 1]
    kept = [cell for cell, p in zip(tested, holm([_welch(first, cell) for cell in tested]), strict=True) if p >= SIGNIFICANCE]
    best = {id(cell) for cell in (*kept, *(cell for cell in present if round(cell.value) == round(first.value)))}
    return tuple(cell and replace(cell, best=id(cell) in best) for cell in cells)


def _welch(first: Entry, second: Entry) -> float:
    """Two-sided p-value of the hypothesis that two cells of several seeds each have the same true mean (Welch 1947).

    Welch's test, because methods' deviations differ by much (the paper's by up to 40 times) and seeds are not paired. Measured with 5
    seeds each, at a level of 0.05: it errs in 3 to 5 % of pairs that vary alike, in 5 to 10 % if one varies 5 times as much. A
    permutation of the seeds errs in 5 % and in 7 to 12 %, and it cannot say less than 2 / 252: in a row of 12 methods it would, after
    Holm's correction, call nothing worse than the best, whatever the returns. Welch's test then finds those that are 3.5 deviations worse
    in 97 % of cases, and marks both of two methods that are equally good in 96 %.
    """
    if not first.std and not second.std:
        return float(first.value == second.value)
    from scipy.stats import ttest_ind_from_stats

    found = ttest_ind_from_stats(first.value, first.std, first.n, second.value, second.std, second.n, equal_var=False)
    return float(found.pvalue)


def _milestones(record: Record) -> tuple[int, ...]:
    return tuple(sorted(set(record.milestones)))


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))
