"""Tables and figures of datasets' quality. Text from manifests is escaped in each of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cudc_bench.files import check_folder
from cudc_bench.text import escape_markdown, plain, templates

from .figures import figure_files, framed, looks
from .files import write_files
from .quality import BINS, QUANTILES, Quality, QualityReport, QualityTable, measure_stored

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Group

_COLUMNS = 4


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


def draw_density(table: QualityTable) -> Figure:
    """The density of the rewards of single steps, a panel for each task, a line for each method: the mean over its datasets.

    The vertical axis is logarithmic: most steps of most datasets are worth close to nothing, and what matters is how many are not.
    """
    from matplotlib.ticker import FuncFormatter

    edges = np.linspace(0.0, 1.0, BINS + 1)
    shown = {plain(method): look for method, look in looks(table.methods).items()}
    counts = sorted({len(table.of(method)) for method in table.methods})
    seeds = f"{counts[0]} dataset{'s' if counts[-1] > 1 else ''}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} datasets"
    title = f"Density of rewards in {table.domain}, profile {table.group}: mean over {seeds} of a method"
    figure, panels = framed(title, shown, len(table.tasks), _COLUMNS, sharey=True, height=2.3)
    lowest = 1.0
    for index, (panel, task) in enumerate(zip(panels, table.tasks, strict=True)):
        for method, look in zip(table.methods, shown.values(), strict=True):
            density = np.mean([one.rewards[task].density for one in table.of(method)], axis=0)
            lowest = min(lowest, *density[density > 0])
            panel.stairs(np.where(density > 0, density, np.nan), edges, linewidth=1.2, baseline=None, **look)
        panel.set_title(task)
        panel.set_xlabel("reward of a step")
        panel.set_xlim(0, 1)
        panel.set_yscale("log")
        panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        if index % _COLUMNS == 0:
            panel.set_ylabel("density")
    panels[0].set_ylim(bottom=max(lowest / 2, 1e-5))
    return figure


def _rewards(one: Quality) -> list[str]:
    return [f"{found.mean:.3f}" for found in one.rewards.values()]


def _spread(one: Quality) -> list[str]:
    coverage = ["–", "–"] if one.coverage is None else [f"{one.coverage.coverage_cells:,}", f"{one.coverage.coverage_entropy:.2f}"]
    particle = "–" if one.particle_entropy is None else f"{one.particle_entropy:.2f}"
    correlation = "–" if one.action_correlation is None else f"{one.action_correlation:.2f}"
    return [*coverage, particle, f"{one.action_saturated:.1%}", correlation]


def measure_quality(
    dataset_ids: str | Sequence[str] | None = None,
    output: str | Path | None = "report",
    domain: str | None = None,
    methods: Sequence[str] | None = None,
) -> QualityReport:
    """Measure datasets without training on them: reward density for all tasks, coverage, entropy, statistics of actions.

    For each domain and group ``<output>/<slug>/`` gets ``quality.md``, ``quality.csv``, ``density.svg`` and ``density.pdf``; each file is
    replaced whole. The same datasets give the same bytes.

    Args:
        dataset_ids: task-agnostic datasets; all below the dataset root unless given.
        output: the folder to write to; None writes nothing.
        domain, methods: only datasets of that domain, of these methods.

    Raises:
        UsageError: there is no such dataset, or one that was named is labelled or holds no physics states; the output cannot be a folder.
        RunError: a dataset is damaged, or a file could not be written.
    """
    folder = None if output is None else check_folder(output, "output")
    tables, remarks = measure_stored(dataset_ids, domain, methods)
    files = [] if folder is None else [file for one in tables for file in write_files(folder / one.slug, quality_files(one))]
    return QualityReport(tables, remarks, files)
