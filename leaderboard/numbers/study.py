"""What every study is: tables, figures, and what it lacks. :mod:`.studies` builds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.settings.seeds import format_seeds

from . import statistics
from .columns import is_own
from .figures import Figure
from .grid import Column, Entry, Grid, Line, Part
from .missing import Wanted
from .scale import BETWEEN, CEILING, FLOOR, LABELS, OF_LARGEST, References, Scale, references_caption, scale_of
from .statistics import Floats
from .table import commands, scores_by_seed

SCORE = "mean score"


@dataclass(frozen=True)
class Study:
    """Tables and figures that answer one question.

    Attributes:
        name: of its kind, such as ``"ablation"``; its files begin with it.
        folder: the folder of its files below the output.
        title, caption: what it compares, and on what; plain ASCII except for what records bring along.
        group, algorithm, domain: what its records have in common; ``algorithm`` and ``domain`` are None where they differ.
        tables: each cell has the records behind it.
        figures: by name, what each shows.
        notes: one line for each thing that was left out or is worth knowing.
        records: all that it was made from.
        wanted: what would make it complete.
    """

    name: str
    folder: str
    title: str
    caption: str
    group: str
    algorithm: str | None
    domain: str | None
    tables: tuple[Grid, ...]
    figures: Mapping[str, Figure] = field(repr=False)
    notes: tuple[str, ...]
    records: tuple[Record, ...] = field(repr=False)
    wanted: tuple[Wanted, ...] = field(repr=False)

    @property
    def slug(self) -> str:
        """A safe and unique name."""
        return f"{self.folder}.{self.name}"

    @property
    def heading(self) -> str:
        """The title with what the records have in common."""
        return f"{self.title}: {', '.join(filter(None, (self.domain, self.algorithm, f'profile {self.group}')))}"

    @property
    def commands(self) -> list[str]:
        """The commands that make the records again, without repeats."""
        return commands(self.records)


# The records of a method on each task.
ByTask = Mapping[str, Sequence[Record]]


def score_matrix(records: ByTask, tasks: Sequence[str], milestone: int) -> tuple[tuple[int, ...], Floats]:
    """Collector seeds that have all of the tasks, and their returns: (n,), (n, tasks)."""
    found = [scores_by_seed(records.get(task, ()), milestone) for task in tasks]
    seeds = sorted(set.intersection(*map(set, found))) if found else []
    return tuple(seeds), np.array([[one[seed] for one in found] for seed in seeds], np.float64).reshape(len(seeds), len(tasks))


@dataclass(frozen=True)
class Scales:
    """How the returns of a domain become scores.

    Attributes:
        tasks: all of the domain, whose largest return is known; none if the domain is not.
        scales: of each, all by references or all by the largest return.
        text: what its mean scores are, for a caption.
    """

    tasks: tuple[str, ...]
    scales: tuple[Scale, ...]
    text: str

    def scores(self, returns: Floats, tasks: Sequence[str]) -> Floats:
        """Returns of some of the tasks, the last axis, as scores."""
        of = [self.scales[self.tasks.index(task)] for task in tasks]
        return np.stack([scale.score(returns[..., index]) for index, scale in enumerate(of)], -1)

    def mean_entry(self, scores: Floats, tasks: Sequence[str], records: tuple[Record, ...]) -> Entry:
        """The mean of some seeds' scores over some of the tasks, (n, T), with its interval."""
        of = [self.scales[self.tasks.index(task)] for task in tasks]
        lowest, highest = ([self.scores(np.array([[getattr(scale, end) for scale in of]]), tasks)] for end in ("least", "largest"))
        interval = statistics.aggregate_interval([scores], "mean", lowest, highest)
        return Entry(statistics.mean([scores]), None, interval, len(scores), False, records)


def scales_of(domain: str, references: References) -> Scales:
    """By references if all of the domain's tasks have one."""
    tasks = known_tasks(domain)
    by_references = all(task in references for task in tasks)
    found = [scale_of(domain, task, references if by_references else {}) for task in tasks]
    text = (
        f"Mean score: of {BETWEEN if by_references else OF_LARGEST}, over the domain's tasks and the collector seeds that have all of them;"
        " 95 % intervals by Student's t over datasets, each with all its tasks."
    )
    return Scales(tasks, tuple(scale for scale in found if scale), text)


def score_entry(records: ByTask, scales: Scales, milestone: int) -> Entry | None:
    """The mean score of a method's records over all tasks of a domain; None if the domain is unknown or no seed has all of them."""
    seeds, returns = score_matrix(records, scales.tasks, milestone)
    if not scales.tasks or not seeds:
        return None
    return scales.mean_entry(scales.scores(returns, scales.tasks), scales.tasks, of_seeds(records, scales.tasks, seeds))


def reference_lines(references: References, tasks: Sequence[str], further: int) -> list[Line]:
    """Rows of floors and ceilings below those of methods: an entry for each task, and ``further`` empty ones; none without references."""
    if not any(task in references for task in tasks):
        return []
    ends = {FLOOR: lambda bounds: bounds.floor, CEILING: lambda bounds: bounds.ceiling}
    return [
        Line((LABELS[name],), (*(Entry(end(references[task])) if task in references else None for task in tasks), *[None] * further))
        for name, end in ends.items()
    ]


def scored_entry(entry: Entry | None, bounds: Bounds | None) -> Entry | None:
    """A mean return as a score between floor and ceiling; None if either is missing."""
    if entry is None or bounds is None:
        return None
    return entry.scored(bounds)


def scored_grid(returns: Grid, tasks: Sequence[str], references: References) -> list[Grid]:
    """A grid of returns, whose first columns are tasks, as scores; none without references."""
    chosen = [(index, task) for index, task in enumerate(tasks) if task in references]
    if not chosen:
        return []
    parts = tuple(
        Part(part.title, part.key, tuple(
            Line(line.labels, tuple(scored_entry(line.entries[index], references[task]) for index, task in chosen)) for line in part.lines
        ))
        for part in returns.parts
    )  # fmt: skip
    caption = f"{returns.title} as scores: mean and sample standard deviation over collector seeds.{references_caption(references, tasks)}"
    columns = tuple(Column(task, 2) for _, task in chosen)
    return [Grid("scores", "Scores", caption, returns.split, returns.head, columns, parts)]


def known_tasks(domain: str) -> tuple[str, ...]:
    """The tasks whose largest return is known."""
    return DOMAINS[domain].tasks if domain in DOMAINS else ()


def of_seeds(records: ByTask, tasks: Sequence[str], seeds: Sequence[int]) -> tuple[Record, ...]:
    """The records of some tasks and collector seeds."""
    return tuple(one for task in tasks for one in records.get(task, ()) if one.dataset.seed in seeds)


def alias_notes(label: str, records: Sequence[Record]) -> list[str]:
    """Which seeds of a method were collected under another name of the same setting."""
    others: dict[str, set[int]] = {}
    for one in records:
        if is_own(one) and one.dataset.method != label:
            others.setdefault(one.dataset.method, set()).add(one.dataset.seed)
    return [
        f"{label}: seeds {format_seeds(sorted(seeds))} are runs of {name}, another name of the same setting."
        for name, seeds in sorted(others.items())
    ]
