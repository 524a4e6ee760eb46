"""Figures of a comparison over all tasks: intervals of the aggregates, performance profiles, and how probable each rank is."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from cudc_bench.markup import plain

from .figures import figure_files, framed, looks
from .overall import THRESHOLDS, Comparison, Overall, Standing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AGGREGATES = {"iqm": "IQM", "median": "median", "mean": "mean", "optimality_gap": "optimality gap"}
_LONGEST_NAME = 28  # letters of a method beside an axis or in a legend


def overall_figure_files(overall: Overall) -> dict[str, bytes]:
    """``intervals``, ``profiles`` and ``ranks`` of the headline comparison as ``.svg`` and ``.pdf``; see ``figure_files``.

    Ranks are left out if no method has two seeds.
    """
    files = figure_files("intervals", lambda: draw_intervals(overall)) | figure_files("profiles", lambda: draw_profiles(overall))
    if any(standing.ranks for standing in overall.headline.standings):
        files |= figure_files("ranks", lambda: draw_ranks(overall))
    return files


def draw_intervals(overall: Overall) -> Figure:
    """A panel for each aggregate, a row for each method: its value, the 95 % interval by the cluster bootstrap, and above it, thin and
    grey, that of the plain stratified one. A single seed has a hollow mark and no interval."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    comparison = overall.headline
    rows = len(comparison.standings)
    title = _title("Aggregates and 95 % intervals", overall, 120)
    figure = Figure(figsize=(9.6, 0.26 * rows + 0.2 * title.count("\n") + 1.8))
    panels = figure.subplots(1, len(_AGGREGATES), sharey=True)
    figure.suptitle(title, fontsize=9)
    shown = looks(comparison.methods)
    for panel, (name, label) in zip(panels, _AGGREGATES.items(), strict=True):
        for row, standing in enumerate(comparison.standings):
            _draw_estimate(panel, row, standing, name, shown[standing.method]["color"])
        panel.set_title(label)
        panel.set_xlabel("smaller is better" if name == "optimality_gap" else "larger is better")
        panel.tick_params(axis="y", length=0)
        panel.margins(x=0.06)
        panel.grid(axis="x", linewidth=0.4, color="#DDDDDD")
        panel.set_axisbelow(True)
        panel.locator_params(axis="x", nbins=5)
    _name_rows(panels[0], comparison.standings)
    handles = [
        Line2D([], [], color="#404040", linewidth=3.2, label="cluster bootstrap (datasets)"),
        Line2D([], [], color="#909090", linewidth=1.0, label="stratified bootstrap (runs, too narrow)"),
        Line2D([], [], color="#404040", marker="o", markersize=4, linestyle="", markerfacecolor="white", label="a single seed"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def draw_profiles(overall: Overall) -> Figure:
    """The share of seeds x tasks whose score is above τ, for each method, with pointwise 95 % bands by the cluster bootstrap."""
    comparison = overall.headline
    shown = looks(comparison.methods)
    legend = {_short(method): look for method, look in shown.items()}
    figure, (panel,) = framed(_title("Performance profiles, band: 95 %", overall, 0), legend, 1, 1, height=3.4)
    for standing in comparison.standings:
        look = shown[standing.method]
        panel.plot(THRESHOLDS, standing.profile, linewidth=0.8 if standing.band is None else 1.4, **look)
        if standing.band is not None:
            panel.fill_between(THRESHOLDS, *standing.band, color=look["color"], alpha=0.12, linewidth=0)
    panel.set_xlim(0, 1)
    panel.set_ylim(0, 1)
    panel.set_xlabel("score τ (return / largest possible return)")
    panel.set_ylabel("share of runs above τ")
    return figure


def draw_ranks(overall: Overall) -> Figure:
    """How probable each rank by IQM is for each method with two or more seeds, in per cent; stronger colours are more probable."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    comparison = overall.headline
    standings = [standing for standing in comparison.standings if standing.ranks]
    count = len(standings)
    width = max(5.2, 0.46 * count + 2.4)
    title = _title("Probability of each rank by IQM, in per cent", overall, int(width * 13))
    figure = Figure(figsize=(width, 0.27 * count + 0.2 * title.count("\n") + 1.2))
    panel = figure.subplots()
    figure.suptitle(title, fontsize=9)
    shown = looks(comparison.methods)
    for row, standing in enumerate(standings):
        for rank, share in enumerate(standing.ranks or ()):
            colour = shown[standing.method]["color"]
            panel.add_patch(Rectangle((rank + 0.5, row - 0.5), 1, 1, facecolor=colour, alpha=share, linewidth=0))
            if share >= 0.005:
                ink = "white" if _is_dark(colour, share) else "black"
                panel.text(rank + 1, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=7.5, color=ink)
    panel.set_xlim(0.5, count + 0.5)
    panel.set_xticks(range(1, count + 1))
    panel.set_xlabel("rank (1: largest IQM)")
    _name_rows(panel, standings)
    return figure


def _draw_estimate(panel: Axes, row: int, standing: Standing, name: str, colour: Any) -> None:
    estimate = standing.estimates[name]
    if estimate.cluster and estimate.stratified:
        panel.plot([estimate.cluster.low, estimate.cluster.high], [row, row], color=colour, linewidth=3.2, solid_capstyle="butt")
        # Above the other, and not on it: where both are alike each can be seen.
        above = row - 0.3
        panel.plot([estimate.stratified.low, estimate.stratified.high], [above, above], color="#909090", linewidth=1.0)
    face = colour if estimate.cluster else "white"
    panel.plot([estimate.value], [row], marker="o", markersize=4.5, color=face, markeredgecolor="black" if estimate.cluster else colour)


def _is_dark(colour: str, alpha: float) -> bool:
    """Whether black text is hard to read on a colour of that strength over white (relative luminance of ITU-R BT.709, below one half)."""
    from matplotlib.colors import to_rgb

    red, green, blue = (1 - alpha * (1 - part) for part in to_rgb(colour))
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue < 0.5


def _name_rows(panel: Axes, standings: Sequence[Standing]) -> None:
    panel.set_ylim(len(standings) - 0.5, -0.5)
    panel.set_yticks(range(len(standings)), [_short(standing.method) for standing in standings])
    panel.tick_params(axis="y", length=0)


def _title(what: str, overall: Overall, width: int) -> str:
    text = f"{what}: {overall.algorithm}, profile {overall.group}: {_scope(overall.headline)}"
    return "\n".join(wrap(text, width)) if width else text


def _scope(comparison: Comparison) -> str:
    return f"{comparison.title}, {comparison.seeds}{', preliminary' if comparison.preliminary else ''}"


def _short(method: str) -> str:
    name = plain(method)
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"
