"""Tables as CSV in full precision."""

from __future__ import annotations

import csv
import io
from dataclasses import fields

import numpy as np

from cudc_bench.text import plain

from ..datasets.quality import QUANTILES, QualityTable, TaskMeasures
from ..numbers.grid import Grid
from ..numbers.overall import Overall
from ..numbers.power import FOUND
from ..numbers.statistics import Interval
from ..numbers.study import Study
from ..numbers.table import Table


def of_table(table: Table) -> str:
    """One line for each cell in full precision; a missing cell has 0 seeds and neither mean nor standard deviation.

    ``floor``, ``untrained`` and ``ceiling`` are those of the task's reference, ``score`` and ``score_std`` the mean and its standard
    deviation between floor and ceiling; empty where a task has no reference.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "domain", "milestone", "task", "method", "mean", "std", "seeds", "best", "floor", "untrained",
                     "ceiling", "score", "score_std"])  # fmt: skip
    for part, line, column, entry in table.grid.entries():
        (task,) = line.labels
        bounds = table.references.get(task)
        of_task = [bounds.floor, bounds.untrained, bounds.ceiling] if bounds else [None] * 3
        values = [entry.value, entry.std, entry.n, entry.best] if entry else [None, None, 0, False]
        scored = entry.scored(bounds) if entry and bounds else None
        scores = [scored.value, scored.std] if scored else [None, None]
        where = [table.group, table.algorithm, table.domain, part.key, task, column.name]
        writer.writerow([*where, *values, *of_task, *scores])
    return text.getvalue()


def of_paper(paper: Grid, table: Table) -> str:
    """One line for each cell that the paper has, too, in full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "domain", "milestone", "task", "method", "mean", "std", "seeds", "paper_mean", "paper_std",
                     "difference_in_paper_std", "floor", "ceiling"])  # fmt: skip
    for part in paper.parts:
        for line in part.lines:
            ours, theirs, difference, *_ = line.entries
            assert ours is not None
            assert theirs is not None
            bounds = table.references.get(line.labels[0])
            ends = [bounds.floor, bounds.ceiling] if bounds else [None, None]
            values = [ours.value, ours.std, ours.n, theirs.value, theirs.std, difference and difference.value, *ends]
            writer.writerow([table.group, table.algorithm, table.domain, part.key, *line.labels, *values])
    return text.getvalue()


def of_grid(study: Study, grid: Grid) -> str:
    """One line for each cell in full precision; a missing cell has no value."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    head = ["study", "group", "algorithm", "domain", grid.split, *grid.head, "column"]
    writer.writerow([*head, "value", "std", "low", "high", "seeds", "best"])
    for part, line, column, entry in grid.entries():
        where = [study.name, study.group, study.algorithm, study.domain, part.key, *line.labels, column.name]
        values: list[object] = [None] * 6
        if entry is not None:
            low, high = (entry.interval.low, entry.interval.high) if entry.interval else (None, None)
            values = [entry.value, entry.std, low, high, entry.n or None, entry.best]
        writer.writerow([*where, *values])
    return file.getvalue()


def of_overall(overall: Overall) -> str:
    """One line for each number in full precision, with its intervals where it has them.

    ``statistic`` is one of the aggregates, ``probability_of_improvement`` (over ``other``), or ``rank_<i>`` (its probability). ``seeds``
    are the collector seeds in the domain with the fewest, ``datasets`` those of all domains.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "scope", "milestone", "tasks", "method", "seeds", "datasets", "statistic", "other", "value",
                     "low", "high", "stratified_low", "stratified_high", "p", "p_holm", "improvement"])  # fmt: skip
    for comparison in overall.comparisons:
        head = [overall.group, overall.algorithm, comparison.scope, comparison.milestone, len(comparison.tasks)]
        for standing in comparison.standings:
            who = [*head, standing.method, standing.n, sum(standing.counts)]
            for name, found in standing.estimates.items():
                writer.writerow([*who, name, None, found.value, *_ends(found.interval), *_ends(found.stratified), None, None, None])
            for rank, share in enumerate(standing.ranks or (), 1):
                writer.writerow([*who, f"rank_{rank}", None, share, *[None] * 7])
            for pair in comparison.pairs:
                if pair.method == standing.method:
                    tested = [pair.p, pair.holm, None if pair.p is None else pair.better]
                    name = "probability_of_improvement"
                    writer.writerow([*who, name, pair.other, pair.probability, *_ends(pair.interval), None, None, *tested])
    return text.getvalue()


def of_scores(overall: Overall) -> str:
    """One line for each run that entered a comparison: its return, and that divided by the task's largest."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "scope", "milestone", "domain", "task", "method", "seed", "return", "score"])
    for comparison in overall.comparisons:
        head = [overall.group, overall.algorithm, comparison.scope, comparison.milestone]
        for standing in comparison.standings:
            for domain, returns, scores in zip(comparison.domains, standing.returns, standing.scores, strict=True):
                tasks = [task for one, task in comparison.tasks if one == domain]
                for task, *columns in zip(tasks, returns.T, scores.T, strict=True):
                    for seed, found, score in zip(standing.seeds[domain], *columns, strict=True):
                        writer.writerow([*head, domain, task, standing.method, seed, float(found), float(score)])
    return text.getvalue()


def of_power(overall: Overall) -> str:
    """One line for each number of seeds: what the headline's test can find with them; no lines where that is not known."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "scope", "milestone", "seeds", "own", "comparisons", "least_p", "least_p_holm", "found_in",
                     "lead_score", "lead_points", "deviation", "deviation_low", "deviation_high", "degrees_of_freedom"])  # fmt: skip
    if (power := overall.power) is not None:
        headline = overall.headline
        where = [overall.group, overall.algorithm, headline.scope, headline.milestone]
        measured = [power.deviation, *_ends(power.within), power.freedom]
        for one in power.designs:
            points = None if one.lead is None or headline.points is None else one.lead * headline.points
            design = [one.seeds, one.seeds == power.own, power.comparisons, one.least, one.corrected, FOUND, one.lead, points]
            writer.writerow([*where, *design, *measured])
    return text.getvalue()


def of_quality(table: QualityTable) -> str:
    """One line for each dataset and task in full precision; empty where there is nothing to measure by."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rewards = ["mean", *(f"q{round(100 * share)}" for share in QUANTILES), "best", "top", "above_0.5", "above_0.9"]
    spread = ["coverage_cells", "coverage_entropy", "particle_entropy", "action_std", "action_saturated", "action_correlation"]
    beside = [field.name for field in fields(TaskMeasures)]
    writer.writerow(["group", "domain", "dataset", "method", "seed", "steps", "task", *rewards, *spread, "state_action_pairs", *beside])
    for one in table.datasets:
        cells, entropy = ("", "") if one.coverage is None else one.coverage.as_row().values()
        spreads = [cells, entropy, one.particle_entropy, np.mean(one.action_std), one.action_saturated, one.action_correlation]
        head = [table.group, table.domain, one.id, plain(one.manifest.label), one.manifest.seed, one.manifest.steps]
        for task, found in one.rewards.items():
            values = [found.mean, *found.quantiles, found.best, found.top, found.above_half, found.above_nine]
            measures = one.tasks.get(task)
            others = [one.visited and one.visited.pairs, *(measures and getattr(measures, name) for name in beside)]
            writer.writerow([*head, task, *values, *spreads, *others])
    return text.getvalue()


def _ends(interval: Interval | None) -> tuple[float | None, float | None]:
    return (interval.low, interval.high) if interval else (None, None)
