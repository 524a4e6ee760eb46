"""What a dataset is worth, as Markdown, CSV and for a terminal."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cudc_bench.text import escape_markdown, plain, templates

from ..datasets.quality import QUANTILES, Quality, QualityTable
from .figures.drawing import figure_files
from .figures.quality import draw_density

if TYPE_CHECKING:
    from rich.console import Group


def quality_files(table: QualityTable) -> dict[str, str | bytes]:
    """``quality.md``, ``quality.csv``, and ``density.svg`` and ``density.pdf`` where the domain has tasks."""
    figures = figure_files("density", lambda: draw_density(table)) if table.tasks else {}
    return {"quality.md": to_markdown(table), "quality.csv": to_csv(table), **figures}


def to_markdown(table: QualityTable) -> str:
    """A heading, a table of what datasets are worth to each task, one of how far they spread, and what the numbers are."""
    return templates(Path(__file__).with_name("templates"), escape_markdown).get_template("quality.md.j2").render(table=table)


def to_csv(table: QualityTable) -> str:
    """One line for each dataset and task in full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    rewards = ["mean", *(f"q{round(100 * share)}" for share in QUANTILES), "best", "top", "above_0.5", "above_0.9"]
    spread = ["coverage_cells", "coverage_entropy", "particle_entropy", "action_std", "action_saturated", "action_correlation"]
    writer.writerow(["group", "domain", "dataset", "method", "seed", "steps", "task", *rewards, *spread])
    for one in table.datasets:
        cells, entropy = ("", "") if one.coverage is None else one.coverage.as_row().values()
        spreads = [cells, entropy, one.particle_entropy, np.mean(one.action_std), one.action_saturated, one.action_correlation]
        head = [table.group, table.domain, one.id, plain(one.manifest.label), one.manifest.seed, one.manifest.steps]
        for task, found in one.rewards.items():
            values = [found.mean, *found.quantiles, found.best, found.top, found.above_half, found.above_nine]
            writer.writerow([*head, task, *values, *spreads])
    return text.getvalue()


def to_rich(table: QualityTable) -> Group:
    """For a terminal: a line for each dataset."""
    from rich import box
    from rich.console import Group
    from rich.table import Table as Grid
    from rich.text import Text

    shown = Grid(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    for index, name in enumerate(
        (
            "method",
            "seed",
            *(task.replace("_", "\n") for task in table.tasks),
            "visited\ncells",
            "visits\n(nats)",
            "states\n(nats)",
            "|a|\n>0.95",
            "a·a'",
        )
    ):
        shown.add_column(name, justify="left" if index == 0 else "right")
    for one in table.datasets:
        shown.add_row(*(Text(cell) for cell in (plain(one.manifest.label), str(one.manifest.seed), *_rewards(one), *_spread(one))))
    title = Text(f"{table.domain}, profile {table.group}: mean reward per step of each task, and how far the data spread", style="bold")
    return Group(title, shown)


def _rewards(one: Quality) -> list[str]:
    return [f"{found.mean:.3f}" for found in one.rewards.values()]


def _spread(one: Quality) -> list[str]:
    coverage = ["–", "–"] if one.coverage is None else [f"{one.coverage.coverage_cells:,}", f"{one.coverage.coverage_entropy:.2f}"]
    particle = "–" if one.particle_entropy is None else f"{one.particle_entropy:.2f}"
    correlation = "–" if one.action_correlation is None else f"{one.action_correlation:.2f}"
    return [*coverage, particle, f"{one.action_saturated:.1%}", correlation]
