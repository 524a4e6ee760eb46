"""Tables and figures of datasets' quality. Text from manifests is escaped in each of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from cudc_bench.text import plain

from ...datasets.quality import BINS, Quality, QualityTable
from ...methods import styles
from ...numbers.figures import Correlations
from .drawing import framed, plain_powers

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_COLUMNS = 4
_COLOUR = "#0072B2"  # Okabe and Ito's blue: no method's alone, of whom nothing is told


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


def draw_correlations(shown: Correlations) -> Figure:
    """A panel for each learner, a row for each measure: its rank correlation, from -1 to 1, and the 95 % interval; hollow without one."""
    from matplotlib.figure import Figure

    panels, measures = shown.panels, list(shown.measures)
    columns = min(len(panels), _COLUMNS)
    lines = ceil(len(panels) / columns)
    width = max(2.0 * columns + 1.8, 6.4)
    title = "\n".join(wrap(shown.title, int(width * 12.5)))
    figure = Figure(figsize=(width, lines * (0.22 * len(measures) + 0.9) + 0.2 * title.count("\n") + 0.4))
    axes = list(figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat)
    figure.suptitle(title, fontsize=9)
    for panel, (learner, found) in zip(axes, panels.items(), strict=False):
        panel.axvline(0.0, color="#404040", linewidth=0.8)
        for measure, one in found.items():
            row = measures.index(measure)
            if one.interval is not None:
                panel.plot([one.interval.low, one.interval.high], [row, row], color=_COLOUR, linewidth=2.4, solid_capstyle="butt")
            face = "white" if one.interval is None else _COLOUR
            panel.plot([one.value], [row], marker="o", markersize=4.5, color=face, markeredgecolor=_COLOUR, clip_on=False)
        panel.set_title(learner)
        panel.set_xlabel("Spearman's ρ")
        panel.grid(axis="x", linewidth=0.4, color="#DDDDDD")
        panel.set_axisbelow(True)
        panel.tick_params(labelbottom=True)
        panel.tick_params(axis="y", length=0)
        panel.spines["left"].set_visible(False)
    axes[0].set_xlim(-1, 1)
    axes[0].set_xticks([-1, -0.5, 0, 0.5, 1])
    axes[0].set_ylim(len(measures) - 0.5, -0.5)
    axes[0].set_yticks(range(len(measures)), measures)
    for panel in axes[len(panels) :]:
        panel.set_visible(False)
    return figure
