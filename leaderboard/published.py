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
from statistics import fmean
from typing import TypeVar

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.errors import RunError

from .table import Cell, Row, Section, Table

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
        milestone, task, method: which; ``task`` may be ``"mean"`` for relative scores.
        ours: our cell; None for a mean over tasks.
        paper: its mean and standard deviation; None where the paper has only a relative score.
        relative: our mean divided by our CUDC's (for ``"mean"``: the mean of these over tasks); None where the paper has none or CUDC is
            missing.
        paper_relative: the paper's relative score, if it has one.
    """

    milestone: int
    task: str
    method: str
    ours: Cell | None
    paper: tuple[float, float] | None
    relative: float | None = None
    paper_relative: float | None = None

    @property
    def difference(self) -> float | None:
        """Our mean minus the paper's, in units of the paper's standard deviation."""
        return (self.ours.mean - self.paper[0]) / self.paper[1] if self.ours and self.paper and self.paper[1] > 0 else None


@dataclass(frozen=True)
class PaperTable:
    """What the paper reports beside a table of ours.

    Attributes:
        table: ours.
        rows: cells that both have, by milestone, task and method.
        relative: relative scores that both have.
    """

    table: Table
    rows: tuple[Beside, ...]
    relative: tuple[Beside, ...]

    @property
    def caption(self) -> str:
        """What the numbers are, and that the two columns do not belong in one ranking."""
        group = self.table.group
        scale = (
            "Profile paper: the paper's sizes, but another implementation."
            if group == "paper"
            else f"SIZES DIFFER: this is profile {group}, not the paper's 1M steps of collection and 500K gradient steps at width 1024."
        )
        return (
            f"Reported in the paper; another protocol scale, not to be ranked with our own results. {scale}"
            " Here: mean and sample standard deviation over collector seeds, whose number is in brackets. Paper: mean and standard"
            " deviation over five seeds. Difference: here minus paper, in units of the paper's standard deviation. Relative: score divided"
            f" by CUDC's. Source: {CITATION}."
        )


def beside_paper(table: Table) -> PaperTable | None:
    """The cells of a table that the paper reports, too; None if there are none."""
    rows, relative = [], []
    for section in table.sections:
        for row in section.rows:
            for method, cell in zip(table.methods, row.cells, strict=True):
                paper = reported().get((table.algorithm, table.domain, row.task, method, section.milestone))
                if cell and paper:
                    rows.append(Beside(section.milestone, row.task, method, cell, paper))
        relative += _relative(table, section)
    return PaperTable(table, tuple(rows), tuple(relative)) if rows or relative else None


def _relative(table: Table, section: Section) -> list[Beside]:
    found: list[Beside] = []
    known = DOMAINS[table.domain].tasks if table.domain in DOMAINS else ()
    for index, method in enumerate(table.methods):
        ratios = {row.task: ratio for row in section.rows if row.task in known and (ratio := _ratio(table, row, index)) is not None}
        if known and all(task in ratios for task in known):
            ratios[MEAN] = fmean(ratios[task] for task in known)
        for task, ratio in ratios.items():
            paper = reported_relative().get((table.algorithm, table.domain, task, method, section.milestone))
            # CUDC's own are 1 by definition.
            if paper is not None and method != "cudc":
                cell = next((row.cells[index] for row in section.rows if row.task == task), None)
                found.append(Beside(section.milestone, task, method, cell, None, ratio, paper))
    return sorted(found, key=lambda one: [*table.tasks, MEAN].index(one.task))


def _ratio(table: Table, row: Row, index: int) -> float | None:
    cudc = row.cells[table.methods.index("cudc")] if "cudc" in table.methods else None
    cell = row.cells[index]
    return cell.mean / cudc.mean if cell and cudc and cudc.mean > 0 else None


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
