"""Figures of a comparison over all tasks: intervals of the aggregates, performance profiles, and how probable each rank is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from ...methods import styles
from ...numbers.figures import Intervals, by_domain, intervals, title_of
from ...numbers.overall import ALL, THRESHOLDS, Estimate, Overall
from .drawing import figure_files, framed, legend, luminance

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def overall_figure_files(overall: Overall) -> dict[str, bytes]:
    """The figures of a comparison, see :func:`overall_figures`, as ``.svg`` and ``.pdf``; see ``figure_files``."""
    return {file: data for name, draw in overall_figures(overall).items() for file, data in figure_files(name, draw).items()}


def overall_figures(overall: Overall) -> dict[str, Callable[[], Figure]]:
    """What draws ``intervals``, ``profiles`` and ``ranks`` of the headline comparison, and ``domains``.

    Ranks are left out where methods have none, domains if there is only one.
    """
    found = {"intervals": lambda: draw_intervals(overall), "profiles": lambda: draw_profiles(overall)}
    if any(standing.ranks for standing in overall.headline.standings):
        found["ranks"] = lambda: draw_ranks(overall)
    if any(one.scope == ALL for one in overall.comparisons):
        found["domains"] = lambda: draw_domains(overall)
    return found


def draw_intervals(overall: Overall) -> Figure:
    """A panel for each aggregate, as :func:`draw_estimates` draws them."""
    return draw_estimates(intervals(overall, overall.headline))


def draw_domains(overall: Overall) -> Figure:
    """The mean score of each method at the last milestone, a panel for each domain and one for all together."""
    return draw_estimates(by_domain(overall, overall.comparisons[0].milestone))


def draw_estimates(shown: Intervals) -> Figure:
    """A panel for each name, a row for each method: its value, the 95 % interval by Student's t over datasets, and above it, thin
    and grey, that of the stratified bootstrap. A single seed has a hollow mark and no interval."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    methods, panels = shown.methods, shown.panels
    columns = min(len(panels), 4)
    lines = ceil(len(panels) / columns)
    width = max(2.0 * columns + 1.8, 6.4)
    title = "\n".join(wrap(shown.title, int(width * 12.5)))
    figure = Figure(figsize=(width, lines * (0.26 * len(methods) + 0.8) + 0.2 * title.count("\n") + 1.0))
    axes = list(figure.subplots(lines, columns, sharey=True, sharex=shown.alike, squeeze=False).flat)
    figure.suptitle(title, fontsize=9)
    colours = styles(methods)
    for place, (panel, (label, estimates)) in enumerate(zip(axes, panels.items(), strict=False)):
        for row, method in enumerate(methods):
            if method in estimates:
                _draw_estimate(panel, row, estimates[method], colours[method]["color"])
        panel.set_title(label)
        panel.set_xlabel("smaller is better" if label == shown.smaller else "larger is better")
        panel.tick_params(axis="y", length=0)
        panel.margins(x=0.06)
        panel.grid(axis="x", linewidth=0.4, color="#DDDDDD")
        panel.set_axisbelow(True)
        panel.locator_params(axis="x", nbins=5)
        if place % columns == 0:
            _name_rows(panel, methods)
    for panel in axes[len(panels) :]:
        panel.set_visible(False)
    every = [estimate for estimates in panels.values() for estimate in estimates.values()]
    handles = [Line2D([], [], color="#404040", linewidth=3.2, label="Student's t over datasets")]
    if any(estimate.stratified for estimate in every):
        handles.append(Line2D([], [], color="#909090", linewidth=1.0, label="stratified bootstrap (runs, too narrow)"))
    if any(estimate.interval is None for estimate in every):
        single: dict[str, Any] = {"marker": "o", "markersize": 4, "linestyle": "", "markerfacecolor": "white"}
        handles.append(Line2D([], [], color="#404040", label="a single seed", **single))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_profiles(overall: Overall) -> Figure:
    """The share of seeds x tasks whose score is above τ, for each method, with pointwise 95 % bands over datasets."""
    comparison = overall.headline
    shown = styles(comparison.methods)
    figure, (panel,) = framed(_title("Performance profiles, band: 95 %", overall, 0), legend(shown), 1, 1, height=3.4)
    for standing in comparison.standings:
        style = shown[standing.method]
        panel.plot(THRESHOLDS, standing.profile, linewidth=0.8 if standing.band is None else 1.4, **style)
        if standing.band is not None:
            panel.fill_between(THRESHOLDS, *standing.band, color=style["color"], alpha=0.08, linewidth=0)
    panel.set_xlim(0, 1)
    panel.set_ylim(0, 1)
    panel.set_xlabel(f"score τ ({comparison.axis})")
    panel.set_ylabel("share of runs above τ")
    return figure


def draw_ranks(overall: Overall) -> Figure:
    """How probable each rank by the mean is for each method, in per cent; stronger colours are more probable."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    comparison = overall.headline
    standings = [standing for standing in comparison.standings if standing.ranks]
    count = len(standings)
    width = max(5.2, 0.46 * count + 2.4)
    title = _title("Probability of each rank by the mean, in per cent", overall, int(width * 13))
    figure = Figure(figsize=(width, 0.27 * count + 0.2 * title.count("\n") + 1.2))
    panel = figure.subplots()
    figure.suptitle(title, fontsize=9)
    shown = styles(comparison.methods)
    for row, standing in enumerate(standings):
        for rank, share in enumerate(standing.ranks or ()):
            colour = shown[standing.method]["color"]
            panel.add_patch(Rectangle((rank + 0.5, row - 0.5), 1, 1, facecolor=colour, alpha=share, linewidth=0))
            if share >= 0.005:
                ink = "white" if luminance(colour, share) < 0.5 else "black"
                panel.text(rank + 1, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=7.5, color=ink)
    panel.set_xlim(0.5, count + 0.5)
    panel.set_xticks(range(1, count + 1))
    panel.set_xlabel("rank (1: largest mean)")
    _name_rows(panel, [standing.method for standing in standings])
    return figure


def _draw_estimate(panel: Axes, row: int, estimate: Estimate, colour: Any) -> None:
    if estimate.interval:
        panel.plot([estimate.interval.low, estimate.interval.high], [row, row], color=colour, linewidth=3.2, solid_capstyle="butt")
    if estimate.stratified:
        # Above the other, and not on it: where both are alike each can be seen.
        above = row - 0.3
        panel.plot([estimate.stratified.low, estimate.stratified.high], [above, above], color="#909090", linewidth=1.0)
    face = colour if estimate.interval else "white"
    panel.plot([estimate.value], [row], marker="o", markersize=4.5, color=face, markeredgecolor="black" if estimate.interval else colour)


def _name_rows(panel: Axes, methods: Sequence[str]) -> None:
    panel.set_ylim(len(methods) - 0.5, -0.5)
    panel.set_yticks(range(len(methods)), list(legend(styles(methods))))
    panel.tick_params(axis="y", length=0)


def _title(what: str, overall: Overall, width: int) -> str:
    text = title_of(what, overall, overall.headline)
    return "\n".join(wrap(text, width)) if width else text
