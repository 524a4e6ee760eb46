"""What ``leaderboard --json`` and ``stats --json`` print (see ``cudc_bench.cli.documents``): the numbers of their tables."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cudc_bench.cli.documents import Document, Number

from ..datasets.prediction import Prediction
from ..datasets.quality import Quality, QualityTable
from ..numbers.grid import Grid
from ..numbers.missing import Missing
from ..numbers.overall import Comparison, Overall, Pair, Standing
from ..numbers.statistics import Interval
from ..numbers.study import Study
from ..numbers.table import Table


class TableReference(Document):
    """Between what the returns of a task lie.

    Attributes:
        task: which.
        floor, ceiling: mean returns of random actions, and of TD3 trained online; scores are 0 and 1 there.
        seeds: of the online trainings.
    """

    task: str
    floor: Number
    ceiling: Number
    seeds: int


class TableCell(Document):
    """A method on a task at a milestone.

    Attributes:
        milestone: gradient steps.
        task, method: which.
        mean, std: of the return over collector seeds; no deviation of a single seed.
        seeds: how many there are.
        best: whether it is the largest mean of its row, or not significantly worse.
        score, score_std: the same between floor and ceiling; null where the task has no reference.
    """

    milestone: int
    task: str
    method: str
    mean: Number
    std: Number
    seeds: int
    best: bool
    score: Number
    score_std: Number


class LeaderboardTable(Document):
    """A table of returns.

    Attributes:
        group: the profile, and whatever differs from it; results of different groups are never compared.
        profile: of the trainings.
        algorithm, domain: what its records have in common.
        slug: the folder of its files.
        milestones, tasks, methods: of its cells, in their order.
        references: of the tasks that have one.
        cells: those that there are.
        submitted: one line for each column that others handed in.
        caption: what the numbers are.
    """

    group: str
    profile: str
    algorithm: str
    domain: str
    slug: str
    milestones: list[int]
    tasks: list[str]
    methods: list[str]
    references: list[TableReference]
    cells: list[TableCell]
    submitted: list[str]
    caption: str


class EstimateDocument(Document):
    """A statistic of one method.

    Attributes:
        value: of its scores.
        low, high: the 95 % interval by Student's t over datasets; null where there is none.
    """

    value: Number
    low: Number
    high: Number


class StandingDocument(Document):
    """One method in a comparison.

    Attributes:
        method: its name.
        seeds: for each domain the collector seeds.
        mean, iqm, median, optimality_gap: of its scores over tasks.
        ranks: the probability of each rank by the mean, from 1; null where there is none.
    """

    method: str
    seeds: dict[str, list[int]]
    mean: EstimateDocument
    iqm: EstimateDocument
    median: EstimateDocument
    optimality_gap: EstimateDocument
    ranks: list[float] | None


class PairDocument(Document):
    """One method against another.

    Attributes:
        method, other: their names.
        probability: that a run of the first is better than one of the second on the same task.
        low, high: its 95 % interval; null where there is none.
        p, holm: of the permutation test, and corrected by Holm; null where there is none.
        better: whether it is an improvement.
    """

    method: str
    other: str
    probability: Number
    low: Number
    high: Number
    p: Number
    holm: Number
    better: bool


class ComparisonDocument(Document):
    """Methods on the same tasks at one milestone.

    Attributes:
        scope: ``all domains``, or one.
        milestone: gradient steps.
        headline: whether it is the one that a terminal shows.
        tasks: each as domain and task.
        between_references: whether scores lie between floor and ceiling; otherwise they are returns divided by the largest possible one.
        standings: the methods.
        pairs: each of them against each other.
        preliminary: whether a method has fewer than five seeds.
        remarks, left_out: what to know of it, and what did not enter.
    """

    scope: str
    milestone: int
    headline: bool
    tasks: list[tuple[str, str]]
    between_references: bool
    standings: list[StandingDocument]
    pairs: list[PairDocument]
    preliminary: bool
    remarks: list[str]
    left_out: list[str]


class OverallDocument(Document):
    """All comparisons of one group and algorithm.

    Attributes:
        group, algorithm: of its records.
        slug: the folder of its files.
        comparisons: the last milestone first.
        power: what so many seeds can show, in sentences; empty where there is nothing to be tested.
    """

    group: str
    algorithm: str
    slug: str
    comparisons: list[ComparisonDocument]
    power: str


class StudyCell(Document):
    """A number of a study's table.

    Attributes:
        part: of the table, by the value that its parts differ in.
        labels: of the row.
        column: the name of the column.
        value, std: the number, and its deviation over seeds.
        low, high: its 95 % interval; null where there is none.
        seeds: how many collector seeds it is a mean over; 0 for what is none.
        best: whether it is marked.
    """

    part: int | str
    labels: list[str]
    column: str
    value: Number
    std: Number
    low: Number
    high: Number
    seeds: int
    best: bool


class StudyTable(Document):
    """A table of a study.

    Attributes:
        name, title: of the table.
        split: what its parts differ in.
        head: what each of a row's labels is.
        cells: those that there are.
        caption: what the numbers are.
    """

    name: str
    title: str
    split: str
    head: list[str]
    cells: list[StudyCell]
    caption: str


class StudyDocument(Document):
    """Tables that answer one question.

    Attributes:
        name, title: of the study.
        group, algorithm, domain: what its records have in common; algorithm and domain are null where they differ.
        tables: of numbers.
        notes: one line for each thing that was left out or is worth knowing.
        caption: what it compares.
    """

    name: str
    title: str
    group: str
    algorithm: str | None
    domain: str | None
    tables: list[StudyTable]
    notes: list[str]
    caption: str


class MissingDocument(Document):
    """Runs that a comparison lacks.

    Attributes:
        study: that lacks them; null for the main tables.
        group, algorithm, domain, method, tasks, seeds: which.
        command: makes them; null where no single one can.
    """

    study: str | None
    group: str
    algorithm: str
    domain: str
    method: str
    tasks: list[str]
    seeds: list[int]
    command: str | None


class LeaderboardDocument(Document):
    """What ``leaderboard --json`` prints.

    Attributes:
        schema_version: of this document.
        tables: one for each domain, algorithm and group.
        overall: the comparisons of each group and algorithm.
        studies: of which there are records.
        missing: runs that would make all of this complete.
        problems: one line for each thing that was left out or is doubtful.
        files: that were written, as the command names them without ``--json``.
    """

    schema_version: Literal[1] = 1
    tables: list[LeaderboardTable]
    overall: list[OverallDocument]
    studies: list[StudyDocument]
    missing: list[MissingDocument]
    problems: list[str]
    files: list[str]


class RewardDocument(Document):
    """What a dataset's states are worth to one task, per step.

    Attributes:
        mean: over trajectories.
        quantiles: 25, 50, 75 and 95 % of the trajectories.
        best: the largest of a trajectory.
        top: mean of the 1 % largest rewards of single steps.
        above_half, above_nine: shares of the steps with rewards above 0.5 and 0.9.
    """

    mean: Number
    quantiles: list[Number]
    best: Number
    top: Number
    above_half: Number
    above_nine: Number


class TaskMeasuresDocument(Document):
    """What a dataset has of a task beside others; null where there is nothing to measure it by.

    Attributes:
        trajectory_quality: TQ, the mean return of its episodes between the task's floor, 0, and its ceiling, 1.
        coverage_ratio: SACo, how many state-action pairs it has for each that a replay of the task has.
        expert_recall: share of an expert's states in whose cells it has been.
        expert_precision: share of its states in whose cells an expert has been.
    """

    trajectory_quality: Number
    coverage_ratio: Number
    expert_recall: Number
    expert_precision: Number


class QualityDocument(Document):
    """One dataset.

    Attributes:
        id: which.
        method: that collected it, with its source where it was imported.
        seed: of the collection.
        rewards: by task.
        coverage_cells, coverage_entropy: cells of the domain's descriptors that were visited, and the entropy of the visits in nats; null
            for a domain without descriptors.
        particle_entropy: of the observations in nats, comparable within its table alone; null for few observations.
        action_std: of each actuator.
        action_saturated: share of action components with a size above 0.95.
        action_correlation: of a component with that of the next step; null where actions never vary.
        state_action_pairs: different ones of a state's cell and of 64 directions of its action; null for a domain without descriptors.
        tasks: what it has of tasks beside others, of those that have a reference, an expert or a replay of its table's profile.
    """

    id: str
    method: str
    seed: int
    rewards: dict[str, RewardDocument]
    coverage_cells: int | None
    coverage_entropy: Number
    particle_entropy: Number
    action_std: list[Number]
    action_saturated: Number
    action_correlation: Number
    state_action_pairs: int | None
    tasks: dict[str, TaskMeasuresDocument]


class QualityTableDocument(Document):
    """Datasets that may be compared.

    Attributes:
        group: the profile, and whatever differs from it.
        domain, tasks: what was explored.
        slug: the folder of its files.
        datasets: by method and seed.
    """

    group: str
    domain: str
    tasks: list[str]
    slug: str
    datasets: list[QualityDocument]


class StatsDocument(Document):
    """What ``stats --json`` prints.

    Attributes:
        schema_version: of this document.
        tables: one for each domain and group.
        predictions: for each table whose datasets have records, the correlations of measures with scores.
        remarks: one line for each thing that was left out.
        files: that were written.
    """

    schema_version: Literal[1] = 1
    tables: list[QualityTableDocument]
    predictions: list[StudyDocument]
    remarks: list[str]
    files: list[str]


def of_leaderboard(
    tables: list[Table], overall: list[Overall], studies: list[Study], missing: list[Missing], problems: list[str], files: list[Path]
) -> LeaderboardDocument:
    """All of a leaderboard."""
    return LeaderboardDocument(
        tables=list(map(_table, tables)),
        overall=list(map(_overall, overall)),
        studies=list(map(_study, studies)),
        missing=[
            MissingDocument(
                study=one.study, group=one.group, algorithm=one.algorithm, domain=one.domain, method=one.method, tasks=list(one.tasks),
                seeds=list(one.seeds), command=one.command,
            )
            for one in missing
        ],
        problems=problems,
        files=list(map(str, files)),
    )  # fmt: skip


def of_stats(tables: list[QualityTable], predictions: list[Prediction], remarks: list[str], files: list[Path]) -> StatsDocument:
    """All that was measured."""
    return StatsDocument(
        tables=list(map(_quality_table, tables)), predictions=[_study(one.study) for one in predictions], remarks=remarks,
        files=list(map(str, files)),
    )  # fmt: skip


def _table(table: Table) -> LeaderboardTable:
    cells = []
    for (milestone, task, method), entry in table.cells.items():
        bounds = table.references.get(task)
        scored = None if bounds is None else entry.scored(bounds)
        cells.append(
            TableCell(
                milestone=milestone, task=task, method=method, mean=entry.value, std=entry.std, seeds=entry.n, best=entry.best,
                score=None if scored is None else scored.value, score_std=None if scored is None else scored.std,
            )
        )  # fmt: skip
    references = [
        TableReference(task=task, floor=one.floor, ceiling=one.ceiling, seeds=one.seeds) for task, one in table.references.items()
    ]
    return LeaderboardTable(
        group=table.group, profile=table.records[0].profile, algorithm=table.algorithm, domain=table.domain, slug=table.slug,
        milestones=list(table.milestones), tasks=list(table.tasks), methods=list(table.methods), references=references, cells=cells,
        submitted=table.submissions, caption=table.caption,
    )  # fmt: skip


def _overall(overall: Overall) -> OverallDocument:
    comparisons = [_comparison(one, one is overall.headline) for one in overall.comparisons]
    return OverallDocument(
        group=overall.group, algorithm=overall.algorithm, slug=overall.slug, comparisons=comparisons, power=overall.power_text
    )


def _comparison(comparison: Comparison, headline: bool) -> ComparisonDocument:
    return ComparisonDocument(
        scope=comparison.scope, milestone=comparison.milestone, headline=headline, tasks=list(comparison.tasks),
        between_references=comparison.references is not None, standings=list(map(_standing, comparison.standings)),
        pairs=list(map(_pair, comparison.pairs)), preliminary=comparison.preliminary, remarks=list(comparison.remarks),
        left_out=list(comparison.left_out),
    )  # fmt: skip


def _standing(standing: Standing) -> StandingDocument:
    estimates = {
        name: EstimateDocument(value=one.value, low=_low(one.interval), high=_high(one.interval))
        for name, one in standing.estimates.items()
    }
    return StandingDocument(
        method=standing.method, seeds={domain: list(seeds) for domain, seeds in standing.seeds.items()},
        ranks=None if standing.ranks is None else list(standing.ranks), **estimates,
    )  # fmt: skip


def _pair(pair: Pair) -> PairDocument:
    return PairDocument(
        method=pair.method, other=pair.other, probability=pair.probability, low=_low(pair.interval), high=_high(pair.interval), p=pair.p,
        holm=pair.holm, better=pair.better,
    )  # fmt: skip


def _study(study: Study) -> StudyDocument:
    return StudyDocument(
        name=study.name, title=study.title, group=study.group, algorithm=study.algorithm, domain=study.domain,
        tables=list(map(_grid, study.tables)), notes=list(study.notes), caption=study.caption,
    )  # fmt: skip


def _grid(grid: Grid) -> StudyTable:
    cells = [
        StudyCell(
            part=part.key, labels=list(line.labels), column=column.name, value=entry.value, std=entry.std, low=_low(entry.interval),
            high=_high(entry.interval), seeds=entry.n, best=entry.best,
        )
        for part, line, column, entry in grid.entries() if entry is not None
    ]  # fmt: skip
    return StudyTable(name=grid.name, title=grid.title, split=grid.split, head=list(grid.head), cells=cells, caption=grid.caption)


def _quality_table(table: QualityTable) -> QualityTableDocument:
    return QualityTableDocument(
        group=table.group, domain=table.domain, tasks=list(table.tasks), slug=table.slug, datasets=list(map(_quality, table.datasets))
    )


def _quality(one: Quality) -> QualityDocument:
    rewards = {
        task: RewardDocument(
            mean=found.mean, quantiles=list(found.quantiles), best=found.best, top=found.top, above_half=found.above_half,
            above_nine=found.above_nine,
        )
        for task, found in one.rewards.items()
    }  # fmt: skip
    return QualityDocument(
        id=one.id, method=one.manifest.label, seed=one.manifest.seed, rewards=rewards,
        coverage_cells=None if one.coverage is None else one.coverage.coverage_cells,
        coverage_entropy=None if one.coverage is None else one.coverage.coverage_entropy, particle_entropy=one.particle_entropy,
        action_std=list(one.action_std), action_saturated=one.action_saturated, action_correlation=one.action_correlation,
        state_action_pairs=None if one.visited is None else one.visited.pairs,
        tasks={task: TaskMeasuresDocument(**vars(found)) for task, found in one.tasks.items()},
    )  # fmt: skip


def _low(interval: Interval | None) -> float | None:
    return None if interval is None else interval.low


def _high(interval: Interval | None) -> float | None:
    return None if interval is None else interval.high
