"""Figures of two datasets side by side: where their states lie, what they are worth to tasks, and how their actions change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...datasets.pair import Pair
from .drawing import figure_files, framed, plain_powers
from .quality import density_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Blue and vermilion of Okabe and Ito's palette: two datasets may be of one method, whose colour both would have.
_STYLES: tuple[dict[str, Any], dict[str, Any]] = ({"color": "#0072B2", "linestyle": "-"}, {"color": "#D55E00", "linestyle": "--"})
_LOWEST = 1e-9  # variance; an actuator that never moves has none, and a logarithm needs some


def pair_files(pair: Pair) -> dict[str, bytes]:
    """``map``, ``density`` where the domain has tasks, and ``spectra`` where there are some, each as ``.svg`` and ``.pdf``."""
    files = figure_files("map", lambda: draw_map(pair))
    if pair.domain.tasks:
        files |= figure_files("density", lambda: draw_densities(pair))
    if any(side.spectrum is not None for side in pair.sides):
        files |= figure_files("spectra", lambda: draw_spectra(pair))
    return files


def draw_map(pair: Pair) -> Figure:
    """The share of each dataset's states in the cells of two quantities, and whose they are: first's, second's, or shared."""
    from matplotlib.colors import LinearSegmentedColormap, LogNorm
    from matplotlib.figure import Figure

    first, second = (np.ma.masked_equal(side.visits, 0.0) for side in pair.sides)
    both = pair.sides[0].visits + pair.sides[1].visits
    lowest = min(float(first.min()), float(second.min()))
    figure = Figure(figsize=(9.4, 3.0))
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    norm = LogNorm(lowest, max(float(first.max()), float(second.max()), 10 * lowest))
    for panel, shares, side in zip(panels, (first, second), pair.sides, strict=False):
        shown = panel.pcolormesh(pair.x.edges, pair.y.edges, shares.T, norm=norm, cmap="viridis", rasterized=True)
        panel.set_title(side.name)
    plain_powers(figure.colorbar(shown, ax=list(panels[:2]), label="share of its states").ax.yaxis)
    hues = LinearSegmentedColormap.from_list("whose", [_STYLES[0]["color"], "#E8E8E8", _STYLES[1]["color"]])
    whose = np.ma.masked_invalid(np.divide(second.filled(0) - first.filled(0), both, out=np.full_like(both, np.nan), where=both > 0))
    shown = panels[2].pcolormesh(pair.x.edges, pair.y.edges, whose.T, vmin=-1, vmax=1, cmap=hues, rasterized=True)
    panels[2].set_title(f"whose they are; {pair.shared:.0%} in common")
    bar = figure.colorbar(shown, ax=panels[2], ticks=[-1, 0, 1])
    bar.ax.set_yticklabels(["first's", "both's", "second's"])
    for panel in panels:
        panel.set_xlabel(pair.x.name)
    panels[0].set_ylabel(pair.y.name)
    return figure


def draw_densities(pair: Pair) -> Figure:
    """The density of the rewards of single steps, a panel for each task."""
    sides = {side.name: ([side.quality], style) for side, style in zip(pair.sides, _STYLES, strict=True)}
    return density_panels(f"Density of rewards in {pair.domain.name}", pair.domain.tasks, sides)


def draw_spectra(pair: Pair) -> Figure:
    """The variance of actions at each frequency, mean over actuators: slow ways of moving on the left, trembling on the right."""
    named = {side.name: style for side, style in zip(pair.sides, _STYLES, strict=True)}
    figure, (panel,) = framed("Spectra of actions: variance in each band, mean over actuators", named, 1, 1, height=2.6, width=5.0)
    for side, style in zip(pair.sides, _STYLES, strict=True):
        if side.spectrum is not None:
            # A piece's mean was taken off, so that nothing is left at 0 Hz; the last band is half as wide as the others.
            panel.plot(pair.frequencies[1:-1], np.maximum(side.spectrum[1:-1], _LOWEST), linewidth=1.2, **style)
    panel.set_yscale("log")
    low, high = panel.get_ylim()
    panel.set_ylim(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
    plain_powers(panel.yaxis)
    panel.set_xlabel("Hz")
    panel.set_ylabel("variance")
    panel.set_xlim(0, pair.frequencies[-1])
    return figure
