"""Figures of a collection's diagnostics over environment steps: k, the losses of the auxiliary model, and the representation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import floor, log10
from typing import TYPE_CHECKING, Any

from cudc_bench.text import plain

from ...datasets.diagnostics import REPRESENTATION, Comparison, series
from ...methods import LOSSES, styles
from .drawing import draw_line, figure_files, framed, line_width, seeds_text, steps_axis

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_MARKS = 12  # More dotted lines than these cannot be told apart.
_DECADES = 4  # Below these a loss is as good as 0, and its changes would hide those that matter.
_SMALLEST = 1e-30  # A loss without anything above it is 0 for every purpose.
_DASH = 12.0  # points
_LONGEST_NAME = 40  # letters of a method in a legend
Series = tuple[list[int], list[float], list[float] | None]


def diagnostic_files(comparison: Comparison) -> dict[str, bytes]:
    """``k``, ``losses`` and ``representation``, without those that no method has values for; see ``figure_files``."""
    files: dict[str, bytes] = {}
    if comparison.having(["k"]):
        files |= figure_files("k", lambda: draw_k(comparison))
    if comparison.having(LOSSES):
        files |= figure_files("losses", lambda: draw_losses(comparison))
    if comparison.having(REPRESENTATION):
        files |= figure_files("representation", lambda: draw_representation(comparison))
    return files


def draw_k(comparison: Comparison) -> Figure:
    """k over environment steps for each method that reports one, held from each line of the diagnostics to the next.

    A line is the mean over seeds with a band of ± one sample standard deviation; a single seed is a thin line. Lines that coincide from
    beginning to end, such as those of all methods that never change their k, share it in dashes of their colours.
    """
    from matplotlib.ticker import MaxNLocator

    shown = _styles(comparison, comparison.having(["k"]))
    title = f"k on {comparison.domain}, profile {comparison.group}: {seeds_text(comparison.seeds(['k']))}"
    figure, (panel,) = framed(title, _legend(shown), 1, 1, height=2.6)
    lines = {method: series(comparison.of(method, "k"), "k") for method in shown}
    for method, style in _shared(lines, shown).items():
        draw_line(panel, *lines[method], style, stairs=True)
    values = [value for line in lines.values() for value in _reach(line)] or [0.0]
    panel.set_ylim(min(values) - 0.3, max(values) + 0.3)
    panel.yaxis.set_major_locator(MaxNLocator(integer=True))
    panel.set_ylabel("k")
    steps_axis(panel, "environment steps", (run.last_step for run in comparison.runs))
    return figure


def draw_losses(comparison: Comparison) -> Figure:
    """Each loss over environment steps; see :func:`_draw_panels`."""
    return _draw_panels(comparison, "Losses", {name: f"{loss} loss" for name, loss in LOSSES.items()})


def draw_representation(comparison: Comparison) -> Figure:
    """What shows a collapse over environment steps; see :func:`_draw_panels`. Errors of 1 are those of a model that predicts no change."""
    figure = _draw_panels(comparison, "Representations", REPRESENTATION)
    for panel in figure.axes:
        if panel.get_title() == REPRESENTATION["error_over_persistence"]:
            panel.axhline(1.0, color="#7F7F7F", linewidth=0.8, linestyle=":", zorder=0)
    return figure


def _draw_panels(comparison: Comparison, what: str, titles: Mapping[str, str]) -> Figure:
    """Each measure over environment steps in a panel of its own, lines as in :func:`draw_k`; dotted lines, if few, mark where k grew.

    Panels with more than a decade are logarithmic down to 4 decades below their largest value's, and linear from there through 0.
    """
    names = [name for name in titles if comparison.having([name])]
    shown = _styles(comparison, comparison.having(names))
    grew = {(run.manifest.method, growth.step) for run in comparison.runs for growth in run.schedule.growth}
    marks = sorted((method, step) for method, step in grew if method in shown)
    marks = marks if len(marks) <= _MARKS else []
    behind = f"{seeds_text(comparison.seeds(names))}{', dotted: k grew' if marks else ''}"
    title = f"{what} on {comparison.domain}, profile {comparison.group}: {behind}"
    figure, panels = framed(title, _legend(shown), len(names), 2)
    for panel, name in zip(panels, names, strict=True):
        for method, step in marks:
            panel.axvline(step, color=shown[method]["color"], linewidth=0.8, linestyle=":", zorder=0)
        lines = {method: series(runs, name) for method in shown if (runs := comparison.of(method, name))}
        for method, line in lines.items():
            draw_line(panel, *line, shown[method], clip=True)
        _scale(panel, list(lines.values()))
        panel.set_title(titles[name])
        steps_axis(panel, "environment steps", (run.last_step for run in comparison.runs))
    return figure


def _styles(comparison: Comparison, shown: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Those of the methods that are shown; all figures of a comparison agree on them."""
    every = styles(comparison.methods)
    return {method: every[method] for method in shown}


def _legend(shown: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    names = {method: plain(method) for method in shown}
    return {name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…": shown[method] for method, name in names.items()}


def _shared(lines: Mapping[str, Series], shown: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The styles with which lines that coincide can all be seen."""
    same: dict[str, list[str]] = defaultdict(list)
    for method, (steps, means, _) in lines.items():
        same[repr((steps, means))].append(method)
    found = {}
    for methods in same.values():
        for index, method in enumerate(methods):
            # Dashes are counted in widths of the line.
            dash = _DASH / line_width(lines[method][2])
            dashes = {"linestyle": (index * -dash, (dash, dash * (len(methods) - 1)))} if len(methods) > 1 else {}
            found[method] = shown[method] | dashes
    return found


def _reach(line: Series) -> list[float]:
    """A line's values and the borders of its band."""
    _, means, stds = line
    spread = stds or [0.0] * len(means)
    return [mean + sign * std for mean, std in zip(means, spread, strict=True) for sign in (-1, 0, 1)]


def _scale(panel: Axes, lines: Sequence[Series]) -> None:
    """A logarithmic axis that has a place for 0 and below, for what needs one."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    means = [mean for _, means, _ in lines for mean in means]
    reach = [value for line in lines for value in _reach(line)]
    largest = max(map(abs, reach), default=0.0)
    if largest < _SMALLEST or largest < 10 * min(means):
        return
    decade = floor(log10(largest))
    threshold = 10.0 ** (decade - _DECADES)
    low, high = min(means), max(reach)
    # A line at 0 stands clear of the frame.
    low, high = low / 1.3 if low > threshold else min(-threshold / 3, low * 1.3), high * 1.3
    panel.set_yscale("symlog", linthresh=threshold, linscale=0.5)
    panel.set_ylim(low, high)
    sizes = [10.0**power for power in range(decade - _DECADES, decade + 2)]
    signed = [0.0, *(sign * size for size in sizes for sign in (1, -1))]
    inside = [tick for tick in signed if low <= tick <= high]
    if len(inside) < 2:
        inside = [tick * part for tick in signed for part in (1, 2, 5) if low <= tick * part <= high]
    panel.yaxis.set_major_locator(FixedLocator(inside))
    panel.yaxis.set_minor_locator(NullLocator())
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
