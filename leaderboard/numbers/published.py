"""The numbers that the paper reports, beside our own for the same cells; they are never ranked with ours.

``published.csv`` holds the paper's Table 1 and its build-up study on Walker: mean ± standard deviation of returns over five seeds.
``published_relative.csv`` holds its removal study: scores as a share of CUDC's. Source: Sun, Qian and Miao 2024 (:data:`CITATION`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeVar

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.errors import RunError

from .scale import references_caption
from .table import Cell, Table

CITATION = (
    "Sun, Qian and Miao, CUDC: A Curiosity-Driven Unsupervised Data Collection Method with Adaptive Temporal Distances for Offline"
    " Reinforcement Learning, AAAI 2024, arXiv 2312.12191"
)
MEAN = "mean"  # stands for a task where a row is the mean over a domain's tasks
Key = tuple[str, str, str, str, int]  # evaluator, domain, task, method, gradient steps
T = TypeVar("T")


@dataclass(frozen=True)
class Beside:
    """A cell of ours beside the paper's, for the same evaluator, domain, task, method and number of gradient steps.

    Attributes:
        milestone, task, method: which.
        ours: our cell.
        paper: its mean and standard deviation.
    """

    milestone: int
    task: str
    method: str
    ours: Cell
    paper: tuple[float, float]

    @property
    def difference(self) -> float | None:
        """Our mean minus the paper's, in units of the paper's standard deviation."""
        return (self.ours.mean - self.paper[0]) / self.paper[1] if self.paper[1] > 0 else None


@dataclass(frozen=True)
class PaperTable:
    """What the paper reports beside a table of ours.

    Attributes:
        table: ours.
        rows: cells that both have, by milestone, task and method.
    """

    table: Table
    rows: tuple[Beside, ...]

    @property
    def caption(self) -> str:
        """What the numbers are, and that the two columns do not belong in one ranking."""
        return caption(self.table.group) + references_caption(self.table.references, self.table.tasks)


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


def beside_paper(table: Table) -> PaperTable | None:
    """The cells of a table that the paper reports, too; None if there are none."""
    rows = [
        found
        for section in table.sections
        for row in section.rows
        for method, cell in zip(table.methods, row.cells, strict=True)
        if (found := beside(table.algorithm, table.domain, section.milestone, row.task, method, cell))
    ]
    return PaperTable(table, tuple(rows)) if rows else None


def beside(algorithm: str, domain: str, milestone: int, task: str, method: str, cell: Cell | None) -> Beside | None:
    """A cell beside the paper's; None if either is missing. ``method`` is the name that the paper's study has for it."""
    paper = reported().get((algorithm, domain, task, method, milestone))
    return Beside(milestone, task, method, cell, paper) if cell and paper else None


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
