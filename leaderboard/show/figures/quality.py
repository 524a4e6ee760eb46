"""Tables and figures of datasets' quality. Text from manifests is escaped in each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from cudc_bench.text import plain

from ...datasets.quality import BINS, Quality, QualityTable
from ...methods import styles
from .drawing import framed, plain_powers

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_COLUMNS = 4


def draw_density(table: QualityTable) -> Figure:
    """The density of the rewards of single steps, a panel for each task, a line for each method: the mean over its datasets."""
    shown = {plain(method): (table.of(method), style) for method, style in styles(table.methods).items()}
    counts = sorted({len(found) for found, _ in shown.values()})
    seeds = f"{counts[0]} dataset{'s' if counts[-1] > 1 else ''}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]} datasets"
    title = f"Density of rewards in {table.domain}, profile {table.group}: mean over {seeds} of a method"
    return density_panels(title, table.tasks, shown)


def density_panels(title: str, tasks: Sequence[str], lines: Mapping[str, tuple[Sequence[Quality], dict[str, Any]]]) -> Figure:
    """A panel for each task, and in it a line for each name: the mean over some datasets.

    The vertical axis is logarithmic: most steps of most datasets are worth close to nothing, and what matters is how many are not.
    """
    edges = np.linspace(0.0, 1.0, BINS + 1)
    figure, panels = framed(title, {name: style for name, (_, style) in lines.items()}, len(tasks), _COLUMNS, sharey=True, height=2.3)
    lowest = 1.0
    for index, (panel, task) in enumerate(zip(panels, tasks, strict=True)):
        for found, style in lines.values():
            density = np.mean([one.rewards[task].density for one in found], axis=0)
            lowest = min(lowest, *density[density > 0])
            panel.stairs(np.where(density > 0, density, np.nan), edges, linewidth=1.2, baseline=None, **style)
        panel.set_title(task)
        panel.set_xlabel("reward of a step")
        panel.set_xlim(0, 1)
        panel.set_yscale("log")
        plain_powers(panel.yaxis)
        if index % _COLUMNS == 0:
            panel.set_ylabel("density")
    panels[0].set_ylim(bottom=max(lowest / 2, 1e-5))
    return figure
