"""Which cheap measure of a dataset goes with what a learner gets on it: rank correlations over the datasets that have both.

Measures are of datasets that are on this machine, with the fingerprints that records name: records hold none of them. On each task the
datasets are ranked by a measure and by a learner's scores (Spearman's correlation), and the mean over tasks is taken; so it does not
matter that one task is easier than another, nor on what scale its scores are. TQ is a linear function of a task's mean reward, and SACo
of the number of state-action pairs: they rank datasets as these do, and are one measure with them. Datasets of ``tiers`` do not count,
since recall, precision and SACo are measured by them.

Intervals are percentiles of a cluster bootstrap whose clusters are collectors, each with all of its datasets, and these with all tasks.
Datasets of one collector are alike: where nine tenths of the variance is between collectors, percentiles of resampled datasets hold the
truth in 61 to 76 % of cases, those of resampled collectors in 92 to 96 % (docs/explanation/statistics.md).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean

import numpy as np

from cudc_bench.artefacts.records import Record
from cudc_bench.errors import CudcBenchError
from cudc_bench.text import plain

from ..methods import LEARNER_ORDER
from ..numbers.figures import Correlations
from ..numbers.grid import Column, Entry, Grid, Line, Part
from ..numbers.overall import Estimate
from ..numbers.statistics import Floats, rank_correlation, rank_correlation_interval
from ..numbers.study import Study
from ..numbers.table import Block, build_blocks
from ..numbers.words import extent, ordered, short
from .behind import find_base
from .quality import Quality, QualityTable, TaskMeasures

FEWEST = 5  # datasets for a correlation, and collectors for its interval

Measure = Callable[[Quality, str], float | None]


def _beside(name: str) -> Measure:
    nothing = TaskMeasures(None, None, None, None)
    return lambda one, task: getattr(one.tasks.get(task, nothing), name)


# By the names that tables have; each of a dataset and a task.
MEASURES: Mapping[str, Measure] = {
    "visited cells": lambda one, _: None if one.coverage is None else one.coverage.coverage_cells,
    "entropy of visits": lambda one, _: None if one.coverage is None else one.coverage.coverage_entropy,
    "state-action pairs (SACo)": lambda one, _: None if one.visited is None else one.visited.pairs,
    "particle entropy": lambda one, _: one.particle_entropy,
    "mean reward (TQ)": lambda one, task: one.rewards[task].mean,
    "95 % of trajectories": lambda one, task: one.rewards[task].quantiles[-1],
    "best trajectory": lambda one, task: one.rewards[task].best,
    "top 1 % of steps": lambda one, task: one.rewards[task].top,
    "steps > 0.5": lambda one, task: one.rewards[task].above_half,
    "steps > 0.9": lambda one, task: one.rewards[task].above_nine,
    "expert recall": _beside("expert_recall"),
    "expert precision": _beside("expert_precision"),
    "std of actions": lambda one, _: fmean(one.action_std),
    "actions at bounds": lambda one, _: one.action_saturated,
    "consecutive actions": lambda one, _: one.action_correlation,
}


@dataclass(frozen=True)
class Prediction:
    """What goes with the scores of learners on the datasets of one table.

    Attributes:
        study: its tables: over tasks, and of each task.
        figure: the first of them.
    """

    study: Study
    figure: Correlations


@dataclass(frozen=True)
class _Scored:
    """The datasets that a learner has scores of on all tasks.

    Attributes:
        block: whose records these are.
        tasks: of the domain, with records.
        collectors, datasets: of each row (n,).
        scores: (n, tasks), means over trainings.
    """

    block: Block
    tasks: tuple[str, ...]
    collectors: list[str]
    datasets: list[Quality] = field(repr=False)
    scores: Floats = field(repr=False)


def predict(tables: Sequence[QualityTable], records: Iterable[Record]) -> tuple[list[Prediction], list[str]]:
    """The correlations of each table's measures with scores, and a line for each thing that was left out.

    Args:
        tables: of measured datasets.
        records: of learners, of any group. Those of a part of a dataset do not count: the measures are of all of it.
    """
    places = {one.id: (table.slug, one) for table in tables for one in table.datasets if one.manifest.tier is None}
    domains = {table.domain for table in tables}
    own: dict[str, list[Record]] = defaultdict(list)
    qualities: dict[tuple[str, str], Quality] = {}
    absent: dict[tuple[str, str], None] = {}
    for record in records:
        key = record.dataset.id, record.dataset.fingerprint
        if record.dataset.domain not in domains or record.dataset.used is not None or key in absent:
            continue
        if key not in qualities:
            base = _base(*key)
            if base is None:
                absent[key] = None
                continue
            if base not in places:
                continue  # Nobody asked for it.
            qualities[key] = places[base][1]
        own[places[qualities[key].id][0]].append(record)
    remarks = []
    if absent:
        first = plain(next(iter(absent))[0])
        remarks.append(
            f"scores on {len(absent)} labelled datasets, such as {first}, go with no measure: records hold none, and these datasets are"
            " not here, or are others than the records name."
        )
    found = []
    for table in tables:
        blocks, problems = build_blocks(own.get(table.slug, ()))
        remarks += problems
        scored = [one for block in blocks if (one := _scored(block, table, qualities)).tasks]
        remarks += [
            f"{table.slug}: no correlation of measures with scores of {one.block.algorithm}: it takes {FEWEST} datasets that have both on"
            f" {', '.join(one.tasks)}, not {len(one.datasets)}."
            for one in scored if len(one.datasets) < FEWEST
        ]  # fmt: skip
        if enough := [one for one in scored if len(one.datasets) >= FEWEST]:
            found.append(_prediction(table, enough))
    return found, remarks


def _base(dataset_id: str, fingerprint: str) -> str | None:
    try:
        found = find_base(dataset_id, fingerprint)
    except (CudcBenchError, OSError):
        return None
    return None if found is None else found[0]


def _scored(block: Block, table: QualityTable, qualities: Mapping[tuple[str, str], Quality]) -> _Scored:
    tasks = tuple(task for task in block.tasks if task in table.tasks)
    returns: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    collectors, datasets = {}, {}
    for (method, task), found in block.records.items():
        for record in found:
            score = record.score(block.milestones[-1])
            if task in tasks and score is not None:
                one = qualities[record.dataset.id, record.dataset.fingerprint]
                collectors[one.id], datasets[one.id] = method, one
                returns[one.id][task].append(score)
    chosen = [one for one in sorted(returns) if all(task in returns[one] for task in tasks)]
    scores = np.array([[fmean(returns[one][task]) for task in tasks] for one in chosen], np.float64).reshape(len(chosen), len(tasks))
    return _Scored(block, tasks, [collectors[one] for one in chosen], [datasets[one] for one in chosen], scores)


def _prediction(table: QualityTable, scored: Sequence[_Scored]) -> Prediction:
    groups = dict.fromkeys(one.block.group for one in scored)
    learners = ordered({one.block.algorithm for one in scored}, LEARNER_ORDER)
    tasks = tuple(task for task in table.tasks if any(task in one.tasks for one in scored))
    places = {(one.block.group, one.block.algorithm): one for one in scored}
    means = {place: {measure: _entry(one, measure, one.tasks) for measure in MEASURES} for place, one in places.items()}
    titles = {
        (group, name): f"{name}, {short(one.block.milestones[-1])} steps{f', profile {plain(group)}' if len(groups) > 1 else ''}"
        for (group, name), one in places.items()
    }
    over_tasks = [
        _part(plain(group), {measure: [means.get((group, name), {}).get(measure) for name in learners] for measure in MEASURES})
        for group in groups
    ]
    of_each = [
        _part(titles[place], {measure: [_entry(one, measure, (task,)) for task in tasks] for measure in MEASURES})
        for place, one in places.items()
    ]
    counts = [len(one.datasets) for one in scored]
    few = [f"{one.block.algorithm} has {number}" for one in scored if (number := len(set(one.collectors))) < FEWEST]
    study = Study(
        name="prediction",
        folder=table.slug,
        title="Which measure predicts a learner's score",
        caption=f"{extent(min(counts), max(counts))} datasets. Spearman's rank correlation between a measure of a dataset and a learner's"
        " score on it after its last milestone, mean over tasks: 1 if both rank the datasets of each task alike, 0 if one says nothing of"
        " the other. Intervals: 95 %, by a cluster bootstrap over collectors; none is corrected for the number of measures. TQ ranks"
        " datasets as the mean reward does, and SACo as the number of state-action pairs.",
        group=table.group,
        algorithm=None,
        domain=table.domain,
        tables=(
            _grid("mean", "Over tasks", "Mean over the tasks on which all datasets have the measure, and it and the scores vary.",
                  "profile", learners, over_tasks),
            _grid("tasks", "Of each task", "Each task by itself.", "learner", tasks, of_each),
        ),
        figures={},
        notes=(f"there are no intervals where there are fewer than {FEWEST} collectors: {', '.join(few)}.",) if few else (),
        records=tuple(record for one in scored for found in one.block.records.values() for record in found),
        wanted=(),
    )  # fmt: skip
    panels = {
        titles[place]: {measure: Estimate(entry.value, entry.interval, None) for measure, entry in of.items() if entry is not None}
        for place, of in means.items()
    }
    shown = tuple(measure for measure in MEASURES if any(measure in panel for panel in panels.values()))
    title = f"Rank correlation of measures with scores, 95 % intervals over collectors: {table.domain}, profile {table.group}"
    return Prediction(study, Correlations(title, shown, panels))


def _grid(name: str, title: str, caption: str, split: str, columns: Sequence[str], parts: Sequence[Part]) -> Grid:
    caption += " In square brackets: the interval; in brackets the number of datasets."
    shown = tuple(Column(column, 2, signed=True) for column in columns)
    return Grid(name, title, caption, split, ("measure",), shown, tuple(parts), long=split == "learner")


def _part(title: str, rows: Mapping[str, Sequence[Entry | None]]) -> Part:
    """The rows that have a number."""
    return Part(title, title, tuple(Line((measure,), tuple(entries)) for measure, entries in rows.items() if any(entries)))


def _entry(scored: _Scored, measure: str, tasks: Sequence[str]) -> Entry | None:
    """The correlation over some tasks; None where there is none."""
    chosen = [task for task in tasks if task in scored.tasks]
    if not chosen:
        return None
    # What a dataset lacks is NaN, so that its task does not count.
    x = np.array([[MEASURES[measure](one, task) for task in chosen] for one in scored.datasets], np.float64)
    y = scored.scores[:, [scored.tasks.index(task) for task in chosen]]
    value, interval = rank_correlation(x, y), None
    if value is not None and len(set(scored.collectors)) >= FEWEST:
        interval = rank_correlation_interval(x, y, scored.collectors, f"rank correlation {scored.block.slug}")
    return None if value is None else Entry(value, None, interval, len(scored.datasets))
