"""The numbers that the paper reports, beside our own for the same cells; they are never ranked with ours.

``published.csv`` holds the paper's Table 1 and its build-up study on Walker: mean ± standard deviation of returns over five seeds.
``published_relative.csv`` holds its removal study: scores as a share of CUDC's. Source: Sun, Qian and Miao 2024 (:data:`CITATION`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TypeVar

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.errors import RunError

from .grid import Column, Entry, Grid, Line, Part
from .scale import CEILING, FLOOR, references_caption
from .table import Table

CITATION = (
    "Sun, Qian and Miao, CUDC: A Curiosity-Driven Unsupervised Data Collection Method with Adaptive Temporal Distances for Offline"
    " Reinforcement Learning, AAAI 2024, arXiv 2312.12191"
)
MEAN = "mean"  # stands for a task where a row is the mean over a domain's tasks
Key = tuple[str, str, str, str, int]  # evaluator, domain, task, method, gradient steps
T = TypeVar("T")


def caption(group: str) -> str:
    """What the numbers of a table are that shows the paper's beside those of a group of ours."""
    return (
        f"{scale(group)} Here: mean and sample standard deviation over collector seeds, whose number is in brackets. Paper: mean and"
        " standard deviation over five seeds. Difference: here minus paper, in units of the paper's standard deviation."
        f" Source: {CITATION}."
    )


def scale(group: str) -> str:
    """How far a group of ours can be compared with the paper."""
    sizes = (
        "Profile paper: the paper's sizes, but another implementation."
        if group == "paper"
        else f"SIZES DIFFER: this is profile {group}, not the paper's 1M steps of collection and 500K gradient steps at width 1024."
    )
    return f"Reported in the paper; another protocol scale, not to be ranked with our own results. {sizes}"


def beside_paper(table: Table) -> Grid | None:
    """The cells of a table that the paper reports, too, and its references, which the paper has not; None if there are none."""
    parts = []
    for part in table.grid.parts:
        lines = []
        for line in part.lines:
            (task,) = line.labels
            bounds = table.references.get(task)
            ends = (None, None) if bounds is None else (Entry(bounds.floor), Entry(bounds.ceiling))
            for method, ours in zip(table.methods, line.entries, strict=True):
                # What is best among ours says nothing here.
                unmarked = None if ours is None else replace(ours, best=False)
                if found := beside(table.algorithm, table.domain, int(part.key), task, method, unmarked):
                    lines.append(Line(found.labels, (*found.entries, *ends) if table.references else found.entries))
        if lines:
            parts.append(Part(part.title, part.key, tuple(lines)))
    if not parts:
        return None
    return Grid(
        name="paper",
        title=f"Beside the paper: {table.domain}, {table.algorithm}, profile {table.group}",
        caption=caption(table.group) + references_caption(table.references, table.tasks),
        split="milestone",
        head=("task", "method"),
        columns=(Column("here"), Column("reported in the paper", None), Column("difference", 1, signed=True),
                 *(map(Column, (FLOOR, CEILING)) if table.references else ())),
        parts=tuple(parts),
    )  # fmt: skip


def beside(algorithm: str, domain: str, milestone: int, task: str, method: str, ours: Entry | None) -> Line | None:
    """A cell of ours, the paper's for the same evaluator, domain, task, method and number of gradient steps, and our mean minus the paper's
    in units of the paper's standard deviation; None if either is missing. ``method`` is the name that the paper's study has for it."""
    paper = reported().get((algorithm, domain, task, method, milestone))
    if ours is None or paper is None:
        return None
    mean, std = paper
    return Line((task, method), (ours, Entry(mean, std), Entry((ours.value - mean) / std) if std > 0 else None))


@cache
def reported() -> Mapping[Key, tuple[float, float]]:
    """Mean and standard deviation of returns over five seeds.

    Raises:
        RunError: the package's file is damaged.
    """
    return _read("published.csv", ("mean", "std"), lambda numbers: (numbers[0], numbers[1]))


@cache
def reported_relative() -> Mapping[Key, float]:
    """Scores as a share of CUDC's; the task ``"mean"`` stands for the mean over a domain's tasks.

    Raises:
        RunError: the package's file is damaged.
    """
    return _read("published_relative.csv", ("relative_to_cudc",), lambda numbers: numbers[0])


def _read(name: str, columns: tuple[str, ...], value: Callable[[list[float]], T]) -> dict[Key, T]:
    path = Path(__file__).with_name(name)
    found: dict[Key, T] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = csv.DictReader(file, strict=True)
            if lines.fieldnames != ["table", "evaluator", "domain", "task", "method", "gradient_steps", *columns]:
                raise ValueError("its columns are not as expected")
            for line in lines:
                key = (line["evaluator"], line["domain"], line["task"], line["method"], int(line["gradient_steps"]))
                numbers = [float(line[column]) for column in columns]
                if line["task"] not in (*DOMAINS[line["domain"]].tasks, MEAN) or not all(0 <= x < math.inf for x in numbers):
                    raise ValueError(f"line {lines.line_num} is impossible")
                # The build-up study repeats some rows of Table 1.
                if found.setdefault(key, value(numbers)) != value(numbers):
                    raise ValueError(f"line {lines.line_num} contradicts an earlier one")
    except (OSError, ValueError, KeyError, TypeError, csv.Error) as error:
        raise RunError(f"the package's file {path} is damaged: {error}; install cudc-bench again.") from None
    return found
