"""What every study is: tables, figures, and what it lacks. :mod:`.studies` builds them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.options import format_seeds
from cudc_bench.records import Record

from . import statistics
from .figures import figure_files
from .grid import Entry, Grid
from .load import is_own
from .missing import Wanted
from .statistics import Floats
from .table import commands, scores_by_seed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SCORE = "mean score"
SCORE_TEXT = (
    "Mean score: of returns divided by the largest possible one, over the domain's tasks and the collector seeds that have all of them; 95"
    " % intervals by Student's t over datasets, each with all its tasks."
)


@dataclass(frozen=True)
class Study:
    """Tables and figures that answer one question.

    Attributes:
        name: of its kind, such as ``"ablation"``; its files begin with it.
        folder: the folder of its files below the output.
        title, caption: what it compares, and on what; plain ASCII except for what records bring along.
        group, algorithm, domain: what its records have in common; ``algorithm`` and ``domain`` are None where they differ.
        tables: each cell has the records behind it.
        figures: by name, what draws each.
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
    figures: Mapping[str, Callable[[], Figure]] = field(repr=False)
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
        return f"{self.title}: {', '.join(filter(None, (self.domain, self.algorithm)))}{', ' if self.algorithm else ''}profile {self.group}"

    @property
    def commands(self) -> list[str]:
        """The commands that make the records again, without repeats."""
        return commands(self.records)

    def figure_files(self) -> dict[str, bytes]:
        """Each figure as ``<study>-<figure>.svg`` and ``.pdf``."""
        return {name: data for figure, draw in self.figures.items() for name, data in figure_files(f"{self.name}-{figure}", draw).items()}


# The records of a method on each task.
ByTask = Mapping[str, Sequence[Record]]


def score_matrix(records: ByTask, tasks: Sequence[str], milestone: int) -> tuple[tuple[int, ...], Floats]:
    """Collector seeds that have all of the tasks, and their returns: (n,), (n, tasks)."""
    found = [scores_by_seed(records.get(task, ()), milestone) for task in tasks]
    seeds = sorted(set.intersection(*map(set, found))) if found else []
    return tuple(seeds), np.array([[one[seed] for one in found] for seed in seeds], np.float64).reshape(len(seeds), len(tasks))


def score_entry(records: ByTask, domain: str, milestone: int) -> Entry | None:
    """The mean score of a method's records over all tasks of a domain; None if the domain is unknown or no seed has all of them."""
    tasks = known_tasks(domain)
    seeds, returns = score_matrix(records, tasks, milestone)
    if not tasks or not seeds:
        return None
    return mean_entry(returns / DOMAINS[domain].max_return, of_seeds(records, tasks, seeds))


def mean_entry(scores: Floats, records: tuple[Record, ...]) -> Entry:
    """The mean of some seeds' scores over tasks, (n, T), with its interval."""
    lowest, highest = (np.full((1, scores.shape[1]), end) for end in (0.0, 1.0))
    interval = statistics.aggregate_interval([scores], "mean", [lowest], [highest])
    return Entry(statistics.mean([scores]), None, interval, len(scores), False, records)


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
