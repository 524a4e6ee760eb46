"""What figures show, as plain data; :mod:`..show.figures` draws it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean, stdev
from typing import TYPE_CHECKING

from cudc_bench.artefacts.records import Record

from .grid import Entry
from .scale import References
from .table import Cell, seed_scores

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class Sizes:
    """Scores over dataset sizes, for figures.

    Attributes:
        group, algorithm, domain: which; ``group`` on one line.
        milestone: after so many gradient steps.
        methods, tasks, sizes: what there is.
        cells: result by size, task and method.
        scores: mean score over the domain's tasks by size and method, where there is one.
        seeds: how many there are, in words.
        references: of the whole datasets' profile, by task; they serve every size, since neither random actions nor an agent that is
            trained online is trained on a part of anything.
    """

    group: str
    algorithm: str
    domain: str
    milestone: int
    methods: tuple[str, ...]
    tasks: tuple[str, ...]
    sizes: tuple[int, ...]
    cells: Mapping[tuple[int, str, str], Cell] = field(repr=False)
    scores: Mapping[tuple[int, str], Entry] = field(repr=False)
    seeds: str
    references: References = field(default_factory=dict, repr=False)


def curve(records: Sequence[Record]) -> tuple[list[int], list[float], list[float] | None]:
    """Steps, means and sample standard deviations over collector seeds; None for one seed.

    Only steps at which every record was evaluated count, so that a mean is always over the same seeds.
    """
    steps = sorted(set.intersection(*({evaluation.step for evaluation in record.curve} for record in records)))
    scores = [seed_scores(records, step) for step in steps]
    several = len({record.dataset.seed for record in records}) > 1
    return steps, [fmean(values) for values in scores], [stdev(values) for values in scores] if several else None
