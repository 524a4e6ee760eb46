"""Figures that a study has of its own: scores over the largest k, and over the size of the dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ...methods import COLOURS, styles
from ...numbers.words import short
from .drawing import draw_references, framed, legend, references_legend, returns_axis, seeds_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...numbers.figures import Bounds, Sizes


_COLUMNS = 4
# Milestones are told apart by marker and lightness: all of them are CUDC.
_SHADES = ("#8C8C8C", COLOURS["cudc"], "#4A1C00", "#0072B2")
_MARKERS = ("s", "o", "^", "D")


def draw_bounds(shown: Bounds) -> Figure:
    """The mean return over the largest k, a panel for each task, a line for each milestone, ± one sample standard deviation over seeds."""
    runs, bounds = shown.runs, shown.largest
    lines: dict[str, dict[str, Any]] = {
        f"{short(milestone)} steps": {"color": _SHADES[i % len(_SHADES)], "marker": _MARKERS[i % len(_MARKERS)], "linestyle": "-"}
        for i, milestone in enumerate(runs.milestones)
    }
    title = f"The upper bound of k: {runs.algorithm} on {runs.domain}, profile {runs.group}: {seeds_text(runs.seeds, 'bar')}"
    figure, panels = framed(title, lines | references_legend(runs.references), len(runs.tasks), _COLUMNS, sharey=True)
    for index, (panel, task) in enumerate(zip(panels, runs.tasks, strict=True)):
        for place, (milestone, style) in enumerate(zip(runs.milestones, lines.values(), strict=True)):
            cells = {bounds[method]: cell for method in runs.methods if (cell := runs.cells.get((milestone, task, method)))}
            # A little beside each other, so that no error bar hides another.
            at = [bound + 0.08 * (place - (len(runs.milestones) - 1) / 2) for bound in cells]
            panel.plot(at, [cell.value for cell in cells.values()], markersize=4, linewidth=1.2, **style)
            for x, cell in zip(at, cells.values(), strict=True):
                if cell.std is not None:
                    panel.errorbar(x, cell.value, cell.std, color=style["color"], elinewidth=0.9, capsize=2, capthick=0.9)
        panel.set_title(task)
        panel.set_xlabel("largest k")
        panel.set_xticks(sorted(bounds.values()))
        panel.set_xlim(min(bounds.values()) - 0.4, max(bounds.values()) + 0.4)
        if index % _COLUMNS == 0:
            panel.set_ylabel("return")
        draw_references(panel, task, runs.references)
        returns_axis(panel, runs.domain, runs.tasks)
    return figure


def draw_sizes(sizes: Sizes) -> Figure:
    """The mean return over the number of transitions, a panel for each task, band: ± one sample standard deviation; and the mean score
    over the domain's tasks, band: 95 % intervals by Student's t. A single seed is a thin line."""
    shown = styles(sizes.methods)
    title = (
        f"{sizes.subject}: {sizes.algorithm} on {sizes.domain}, profile {sizes.group}, {short(sizes.milestone)} steps:"
        f" {seeds_text(sizes.seeds)}{'; of the mean score: 95 %' if sizes.scores else ''}"
    )
    count = len(sizes.tasks) + bool(sizes.scores)
    columns = 3 if count in (3, 5, 6, 9) else _COLUMNS
    figure, panels = framed(title, legend(shown) | references_legend(sizes.references), count, columns)
    for index, (panel, task) in enumerate(zip(panels, sizes.tasks, strict=False)):
        _draw_returns(panel, sizes, task, shown)
        panel.set_ylabel("return" if index % columns == 0 else "")
    if sizes.scores:
        _draw_scores(panels[-1], sizes, shown)
    for panel in panels:
        _sizes_axis(panel, sizes)
    return figure


def _draw_returns(panel: Axes, sizes: Sizes, task: str, shown: Mapping[str, dict[str, Any]]) -> None:
    for method, style in shown.items():
        cells = {size: cell for size in sizes.sizes if (cell := sizes.cells.get((size, task, method)))}
        spread = {size: (cell.value - cell.std, cell.value + cell.std) for size, cell in cells.items() if cell.std is not None}
        _draw_points(panel, {size: cell.value for size, cell in cells.items()}, spread, style)
    panel.set_title(task)
    draw_references(panel, task, sizes.references)
    returns_axis(panel, sizes.domain, sizes.tasks)


def _draw_scores(panel: Axes, sizes: Sizes, shown: Mapping[str, dict[str, Any]]) -> None:
    for method, style in shown.items():
        entries = {size: entry for size in sizes.sizes if (entry := sizes.scores.get((size, method)))}
        spread = {size: (one.interval.low, one.interval.high) for size, one in entries.items() if one.interval}
        _draw_points(panel, {size: entry.value for size, entry in entries.items()}, spread, style)
    panel.set_title("mean score over all tasks")
    # Between floor and ceiling is not all there is.
    ends = [end for one in sizes.scores.values() for end in ((one.interval.low, one.interval.high) if one.interval else (one.value,))]
    panel.set_ylim(min(0.0, *ends), max(1.0, *ends))


def _draw_points(panel: Axes, values: Mapping[int, float], spread: Mapping[int, tuple[float, float]], style: Mapping[str, Any]) -> None:
    panel.plot(list(values), list(values.values()), marker="o", markersize=3, linewidth=1.4 if spread else 0.8, **style)
    if spread:
        low, high = zip(*spread.values(), strict=True)
        panel.fill_between(list(spread), low, high, color=style["color"], alpha=0.12, linewidth=0)


def _sizes_axis(panel: Axes, sizes: Sizes) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    panel.set_xscale("log")
    panel.set_xlabel(sizes.unit)
    panel.xaxis.set_major_locator(FixedLocator(_apart(sizes.sizes)))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_major_formatter(FuncFormatter(lambda size, _: short(size)))


def _apart(sizes: tuple[int, ...]) -> list[float]:
    """Those sizes whose labels do not overlap on a logarithmic axis: each at least an eighth of its length from the one before."""
    least = (sizes[-1] / sizes[0]) ** 0.13
    kept = [float(sizes[0])]
    for size in sizes[1:]:
        if size >= kept[-1] * least:
            kept.append(float(size))
    return kept
