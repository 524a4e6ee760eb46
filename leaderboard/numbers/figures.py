"""What figures show, as plain data; :func:`~..show.figures.draw.draw` knows how each kind is drawn."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean

import numpy as np

from cudc_bench.artefacts.records import Record

from ..methods import METHOD_ORDER
from .grid import Entry
from .overall import LEAD, NAMES, Comparison, Estimate, Overall
from .scale import References
from .table import Runs
from .words import ordered, short, span


@dataclass(frozen=True)
class Curves:
    """Returns over gradient steps, a panel for each task, a line for each method."""

    runs: Runs


@dataclass(frozen=True)
class Bars:
    """Mean returns at each milestone, a panel for each task, a bar for each method."""

    runs: Runs


@dataclass(frozen=True)
class Bounds:
    """Mean returns over the largest k, a panel for each task, a line for each milestone.

    Attributes:
        runs: the study's.
        largest: the largest k of each method.
    """

    runs: Runs
    largest: Mapping[str, int]


@dataclass(frozen=True)
class Intervals:
    """Estimates with their intervals, a panel for each name, a row for each method.

    Attributes:
        title: of the whole.
        methods: the rows.
        panels: what to draw of them; a method may be absent from some.
        smaller: the panel in which smaller values are better.
        alike: whether all panels are of one quantity, and so have one axis.
    """

    title: str
    methods: tuple[str, ...]
    panels: Mapping[str, Mapping[str, Estimate]]
    smaller: str | None = None
    alike: bool = False


@dataclass(frozen=True)
class Correlations:
    """Rank correlations with their intervals, a panel for each learner, a row for each measure.

    Attributes:
        title: of the whole.
        measures: the rows.
        panels: what to draw of them; a measure may be absent from some.
    """

    title: str
    measures: tuple[str, ...]
    panels: Mapping[str, Mapping[str, Estimate]]


@dataclass(frozen=True)
class Sizes:
    """Scores over dataset sizes, or over other amounts, a panel for each task and one for their mean, a line for each method.

    Attributes:
        group, algorithm, domain: which; ``group`` on one line.
        milestone: after so many gradient steps.
        methods, tasks, sizes: what there is.
        cells: result by size, task and method.
        scores: mean score over the domain's tasks by size and method, where there is one.
        seeds: how many there are, in words.
        references: of the whole datasets' profile, by task; they serve every size, since neither random actions nor an agent that is
            trained online is trained on a part of anything.
        unit: of the sizes, in the plural.
    """

    group: str
    algorithm: str
    domain: str
    milestone: int
    methods: tuple[str, ...]
    tasks: tuple[str, ...]
    sizes: tuple[int, ...]
    cells: Mapping[tuple[int, str, str], Entry] = field(repr=False)
    scores: Mapping[tuple[int, str], Entry] = field(repr=False)
    seeds: str
    references: References = field(default_factory=dict, repr=False)
    unit: str = "transitions"

    @property
    def subject(self) -> str:
        """What it shows, in two words."""
        return "Sample efficiency" if self.unit == "transitions" else f"Returns by {self.unit}"


Figure = Curves | Bars | Bounds | Intervals | Sizes


def curve(records: Sequence[Record]) -> tuple[list[int], list[float], list[float] | None]:
    """Steps, means and sample standard deviations over collector seeds; None for one seed.

    Only steps at which every record was evaluated count, so that a mean is always over the same seeds.
    """
    steps = sorted(set.intersection(*({evaluation.step for evaluation in record.curve} for record in records)))
    runs: dict[int, list[list[float]]] = defaultdict(list)
    for record in records:
        means = {evaluation.step: evaluation.mean for evaluation in reversed(record.curve)}  # the first of a step counts
        if record.final.step in means:
            means[record.final.step] = record.conclusion.mean
        runs[record.dataset.seed].append([means[step] for step in steps])
    seeds = [of[0] if len(of) == 1 else list(map(fmean, zip(*of, strict=True))) for of in runs.values()]
    # Of ten thousand records exact sums of squares would take most of the time.
    stds = np.std(np.array(seeds), 0, ddof=1).tolist() if len(seeds) > 1 else None
    return steps, list(map(fmean, zip(*seeds, strict=True))), stds


def intervals(overall: Overall, comparison: Comparison) -> Intervals:
    """A panel for each aggregate of one of its comparisons."""
    panels = {label: {standing.method: standing.estimates[name] for standing in comparison.standings} for name, label in NAMES.items()}
    what = f"Aggregates of scores ({comparison.axis}) and 95 % intervals"
    return Intervals(title_of(what, overall, comparison), comparison.methods, panels, NAMES["optimality_gap"])


def by_domain(overall: Overall, milestone: int) -> Intervals:
    """The mean score of each method at a milestone, a panel for each domain and one for all together."""
    compared = [one for one in overall.comparisons if one.milestone == milestone]
    alike = len({one.axis for one in compared}) == 1
    panels = {
        one.scope if alike else f"{one.scope}\n({one.axis})": {standing.method: standing.estimates[LEAD] for standing in one.standings}
        for one in compared
    }
    methods = ordered({method for panel in panels.values() for method in panel}, METHOD_ORDER)
    seeds = span([count for one in compared for standing in one.standings for count in standing.counts], "seed")
    what = f"{overall.algorithm}, profile {overall.group}: {short(milestone)} steps, {seeds}"
    title = f"Mean score{f' ({compared[0].axis})' if alike else ''} and 95 % intervals by domain: {what}"
    return Intervals(title, methods, panels, alike=alike)


def title_of(what: str, overall: Overall, comparison: Comparison) -> str:
    """What is drawn, with what the comparison is over."""
    over = f"{comparison.title}, {comparison.seeds}{', preliminary' if comparison.preliminary else ''}"
    return f"{what}: {overall.algorithm}, profile {overall.group}: {over}"
