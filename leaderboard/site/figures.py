"""What each kind of figure looks like on a page; :mod:`.drawing` has the panels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import ceil, floor, log10
from typing import Any

import numpy as np
from markupsafe import Markup

from cudc_bench.artefacts.references import Bounds as Reference

from ..datasets.diagnostics import REPRESENTATION, series
from ..datasets.diagnostics import Comparison as Collections
from ..datasets.quality import BINS, Quality
from ..methods import LOSSES, PALETTE, styles
from ..numbers import figures
from ..numbers.figures import Intervals, curve
from ..numbers.overall import THRESHOLDS, Comparison, Estimate
from ..numbers.scale import CEILING, FLOOR, References
from ..numbers.table import Runs
from ..numbers.words import short
from ..show.figures.drawing import legend, seeds_text
from . import drawing
from .drawing import Axis, Line, Mark

Styles = Mapping[str, Mapping[str, Any]]
LARGE = (460.0, 250.0)
RETURNS = "mean return"
_SHADES = ("#7F7F7F", "#D55E00", "#4A1C00", "#0072B2")  # of milestones, all of them of one method
assert set(_SHADES) <= set(PALETTE)
_DECADES = 4  # Below these a loss is as good as 0.


def curves(runs: Runs, look: Styles, task: str | None = None) -> tuple[Markup, ...]:
    """Returns over gradient steps, a panel for each task or a large one for one of them; the milestones are dotted."""
    tasks = runs.tasks if task is None else (task,)
    return tuple(_curves(runs, one, look, one if task is None else "", LARGE if task else (drawing.WIDTH, drawing.HEIGHT)) for one in tasks)


def _curves(runs: Runs, task: str, look: Styles, title: str, size: tuple[float, float]) -> Markup:
    lines = []
    for method in runs.methods:
        records = runs.records.get((method, task))
        steps, means, stds = curve(records) if records else ([], [], None)
        if not steps:
            continue
        spread = "" if stds is None else f" ± {stds[-1]:.0f}"
        lines.append(Line(
            look[method], list(zip(steps, means, strict=True)), _around(steps, means, stds), thin=stds is None,
            title=f"{method}: {means[-1]:.0f}{spread} after {short(steps[-1])} steps",
        ))  # fmt: skip
    last = max(record.final.step for records in runs.records.values() for record in records)
    across = drawing.linear([0, last], "gradient steps", bounds=(0, last), text=short, ticks=4 if title else 6)
    ends = _ends(runs.references.get(task))
    marks = [(milestone, milestone) for milestone in runs.milestones]
    return drawing.lines_panel(title, lines, across, _fitted(lines, "return", ends), ends, marks, size)


def returns(runs: Runs, milestone: int, look: Styles) -> tuple[Markup, ...]:
    """Mean returns at a milestone with ± one standard deviation, a panel for each task, the largest above."""
    panels = []
    for task in runs.tasks:
        cells = {method: cell for method in runs.methods if (cell := runs.cells.get((milestone, task, method)))}
        names = _names(sorted(cells, key=lambda method: -cells[method].value))
        marks = []
        for method, name in names.items():
            cell = cells[method]
            within = None if cell.std is None else (cell.value - cell.std, cell.value + cell.std)
            title = f"{method}: {cell.value:.0f}{'' if cell.std is None else f' ± {cell.std:.0f}'}"
            marks.append(Mark(name, look[method], cell.value, within, title=title))
        if marks:
            ends = _ends(runs.references.get(task))
            axis = drawing.linear(_reach(marks), RETURNS, also=ends.values.values(), bounds=_from_zero(one.value for one in marks))
            panels.append(drawing.rows_panel(task, list(names.values()), marks, axis, ends))
    return tuple(panels)


def estimates(shown: Intervals, look: Styles) -> tuple[Markup, ...]:
    """Estimates with their intervals, a panel for each name, the best above."""
    alike = None
    if shown.alike:
        alike = drawing.linear([end for panel in shown.panels.values() for one in panel.values() for end in _estimate_ends(one)])
    panels = []
    for label, of_methods in shown.panels.items():
        smaller = label == shown.smaller
        order = sorted(of_methods, key=lambda method: of_methods[method].value * (1 if smaller else -1))
        names = _names(order)
        marks = [_estimate(names[method], method, of_methods[method], look) for method in order]
        text = "smaller is better" if smaller else "larger is better"
        axis = drawing.linear(_reach(marks), text) if alike is None else Axis(alike.low, alike.high, alike.ticks, text)
        panels.append(drawing.rows_panel(label.replace("\n", " "), [names[method] for method in order], marks, axis))
    return tuple(panels)


def _estimate(name: str, method: str, found: Estimate, look: Styles) -> Mark:
    within, second = ((one.low, one.high) if one else None for one in (found.interval, found.stratified))
    around = f" ({within[0]:.3f} to {within[1]:.3f})" if within else ", a single seed"
    return Mark(name, look[method], found.value, within, second, f"{method}: {found.value:.3f}{around}")


def _estimate_ends(found: Estimate) -> list[float]:
    return [found.value, *(end for one in (found.interval, found.stratified) if one for end in (one.low, one.high))]


def profiles(comparison: Comparison, look: Styles) -> tuple[Markup, ...]:
    """The share of runs above each score, as far as any has one, with 95 % bands."""
    last = max((float(THRESHOLDS[one.profile > 0][-1]) for one in comparison.standings if (one.profile > 0).any()), default=1.0)
    shown = min(last + 0.05, 1.0)
    upto = int(np.searchsorted(THRESHOLDS, shown + 1e-9))
    at = THRESHOLDS[:upto].tolist()
    lines = []
    for standing in comparison.standings:
        band = () if standing.band is None else tuple(zip(at, *(side[:upto].tolist() for side in standing.band), strict=True))
        lines.append(Line(look[standing.method], list(zip(at, standing.profile[:upto].tolist(), strict=True)), band,
                          standing.method, standing.band is None))  # fmt: skip
    across = drawing.linear([0, at[-1]], f"score τ ({comparison.axis})", bounds=(0, at[-1]), ticks=8)
    up = drawing.linear([0, 1], "share of runs above τ", bounds=(0, 1))
    return (drawing.lines_panel("", lines, across, up, size=LARGE),)


def ranks(comparison: Comparison, look: Styles) -> tuple[Markup, ...]:
    """How probable each rank is for each method, the most probable first; nothing where that is not known."""
    standings = [standing for standing in comparison.standings if standing.ranks]
    standings.sort(key=lambda one: sum(rank * share for rank, share in enumerate(one.ranks or ())))
    if not standings:
        return ()
    names = _names([one.method for one in standings])
    of_names = {names[one.method]: look[one.method] for one in standings}
    return (drawing.shares_panel(list(of_names), [one.ranks or () for one in standings], of_names, "rank (1: largest mean), per cent"),)


def of_study(figure: figures.Figure, look: Styles) -> list[tuple[int | None, tuple[Markup, ...]]]:
    """The panels of a study's figure, once for each milestone if that is what it is of."""
    match figure:
        case figures.Curves():
            return [(None, curves(figure.runs, look))]
        case figures.Bars():
            return [(milestone, returns(figure.runs, milestone, look)) for milestone in reversed(figure.runs.milestones)]
        case figures.Bounds():
            return [(None, _bounds(figure))]
        case figures.Intervals():
            return [(None, estimates(figure, look))]
        case figures.Sizes():
            return [(None, _sizes(figure, look))]


def methods_of(figure: figures.Figure) -> tuple[str, ...]:
    """The methods that a legend of a study's figure has; none where each row has its name."""
    match figure:
        case figures.Curves():
            return figure.runs.methods
        case figures.Sizes():
            return figure.methods
        case _:
            return ()


def look_of(figure: figures.Figure) -> Styles:
    """The looks of the methods of a study's figure."""
    return styles(figure.methods if isinstance(figure, figures.Intervals | figures.Sizes) else figure.runs.methods)


def captions(figure: figures.Figure) -> str:
    """What a study's figure shows."""
    match figure:
        case figures.Curves():
            return f"Returns over gradient steps: {seeds_text(figure.runs.seeds)}, upright dots: milestones."
        case figures.Bars():
            return f"Mean returns: {seeds_text(figure.runs.seeds, 'bar')}."
        case figures.Bounds():
            return f"The upper bound of k: {seeds_text(figure.runs.seeds)}."
        case figures.Intervals():
            return f"{figure.title}."
        case figures.Sizes():
            scores = "; of the mean score: 95 %" if figure.scores else ""
            return f"{figure.subject} after {short(figure.milestone)} steps: {seeds_text(figure.seeds)}{scores}."


def references_of(figure: figures.Figure) -> References:
    """The references that a study's figure has lines of."""
    match figure:
        case figures.Intervals():
            return {}
        case figures.Sizes():
            return figure.references
        case _:
            return figure.runs.references


def _bounds(shown: figures.Bounds) -> tuple[Markup, ...]:
    runs, panels = shown.runs, []
    for task in runs.tasks:
        lines = []
        for place, milestone in enumerate(runs.milestones):
            cells = {shown.largest[method]: cell for method in runs.methods if (cell := runs.cells.get((milestone, task, method)))}
            points = [(float(k), cells[k].value) for k in sorted(cells)]
            band = [(float(k), cells[k].value - std, cells[k].value + std) for k in sorted(cells) if (std := cells[k].std) is not None]
            style = {"color": _SHADES[place % len(_SHADES)], "linestyle": "-"}
            lines.append(Line(style, points, band, f"{short(milestone)} steps", marks=True, milestone=milestone))
        found = sorted(shown.largest.values())
        across = Axis(found[0] - 0.4, found[-1] + 0.4, {float(k): str(k) for k in found}, "largest k")
        ends = _ends(runs.references.get(task))
        panels.append(drawing.lines_panel(task, lines, across, _fitted(lines, "return", ends), ends))
    return tuple(panels)


def milestone_styles(milestones: Sequence[int]) -> dict[str, dict[str, Any]]:
    """The looks of milestones where they are lines of one figure, for its legend."""
    return {f"{short(one)} steps": {"color": _SHADES[place % len(_SHADES)], "linestyle": "-"} for place, one in enumerate(milestones)}


def _sizes(shown: figures.Sizes, look: Styles) -> tuple[Markup, ...]:
    low, high = shown.sizes[0], shown.sizes[-1]
    across = drawing.logarithmic(low / 1.15, high * 1.15, {size: short(size) for size in _apart(shown.sizes)}, shown.unit)
    panels = []
    for task in shown.tasks:
        lines = []
        for method in shown.methods:
            cells = {size: cell for size in shown.sizes if (cell := shown.cells.get((size, task, method)))}
            band = [(float(size), cell.value - cell.std, cell.value + cell.std) for size, cell in cells.items() if cell.std is not None]
            lines.append(_over_sizes(method, {size: cell.value for size, cell in cells.items()}, band, look))
        ends = _ends(shown.references.get(task))
        panels.append(drawing.lines_panel(task, lines, across, _fitted(lines, "return", ends), ends))
    if shown.scores:
        lines = []
        for method in shown.methods:
            entries = {size: entry for size in shown.sizes if (entry := shown.scores.get((size, method)))}
            band = [(float(size), one.interval.low, one.interval.high) for size, one in entries.items() if one.interval]
            lines.append(_over_sizes(method, {size: entry.value for size, entry in entries.items()}, band, look))
        panels.append(drawing.lines_panel("mean score over all tasks", lines, across, _fitted(lines, "score")))
    return tuple(panels)


def _over_sizes(method: str, values: Mapping[int, float], band: Sequence[tuple[float, float, float]], look: Styles) -> Line:
    return Line(look[method], [(float(size), value) for size, value in values.items()], band, method, not band, marks=True)


def _apart(sizes: Sequence[int]) -> list[int]:
    """Those sizes whose labels do not overlap on a logarithmic axis."""
    least = (sizes[-1] / sizes[0]) ** 0.13
    kept = [sizes[0]]
    for size in sizes[1:]:
        if size >= kept[-1] * least:
            kept.append(size)
    return kept


def density(quality: Quality, look: Mapping[str, Any]) -> tuple[Markup, ...]:
    """The density of the rewards of single steps, a panel for each task, on a logarithmic axis: most steps are worth close to nothing."""
    edges = np.linspace(0.0, 1.0, BINS + 1)
    above = [value for one in quality.rewards.values() for value in one.density if value > 0]
    if not above:
        return ()
    low, high = 10.0 ** floor(log10(max(min(above), 1e-5))), 10.0 ** ceil(log10(max(above)) + 1e-9)
    powers = range(round(log10(low)), round(log10(high)) + 1)
    up = drawing.logarithmic(low, high, {10.0**power: f"{10.0**power:g}" for power in powers}, "density")
    across = drawing.linear([0, 1], "reward of a step", bounds=(0, 1))
    panels = []
    for task, one in quality.rewards.items():
        lines = [
            Line(look, [(float(edges[first]), one.density[first]), *((float(edges[at + 1]), one.density[min(at + 1, last - 1)])
                        for at in range(first, last))], stairs=True, title=f"{task}, {one.mean:.3f} on average")
            for first, last in _filled(one.density)
        ]  # fmt: skip
        panels.append(drawing.lines_panel(task, lines, across, up))
    return tuple(panels)


def _filled(values: Sequence[float]) -> list[tuple[int, int]]:
    """Where values are above 0: beginnings and ends."""
    found: list[tuple[int, int]] = []
    for place, value in enumerate(values):
        if value > 0:
            if found and found[-1][1] == place:
                found[-1] = found[-1][0], place + 1
            else:
                found.append((place, place + 1))
    return found


def collection(shown: Collections) -> dict[str, tuple[Markup, ...]]:
    """What a collector measured of itself over environment steps, by name; without what it did not."""
    look = styles(shown.methods)
    last = max(run.last_step for run in shown.runs)
    across = drawing.linear([0, last], "environment steps", bounds=(0, last), text=short, ticks=4)
    found: dict[str, tuple[Markup, ...]] = {}
    for name, titles in (("k", {"k": "k"}), ("losses", {one: f"{text} loss" for one, text in LOSSES.items()}),
                         ("representation", REPRESENTATION)):  # fmt: skip
        panels = []
        for measure, title in titles.items():
            lines = [
                Line(look[method], list(zip(steps, means, strict=True)), _around(steps, means, stds), method, stds is None, name == "k")
                for method in shown.methods
                if (runs := shown.of(method, measure))
                for steps, means, stds in [series(runs, measure)]
                if steps
            ]
            if lines:
                up = _whole(lines) if name == "k" else _loss_axis(lines)
                panels.append(drawing.lines_panel(title, lines, across, up))
        if panels:
            found[name] = tuple(panels)
    return found


def _whole(lines: Sequence[Line]) -> Axis:
    values = [value for one in lines for value in _heights(one)]
    low, high = floor(min(values)), ceil(max(values))
    every = max(1, ceil((high - low) / 6))
    return Axis(low - 0.3, high + 0.3, {float(k): str(k) for k in range(low, high + 1, every)}, "k")


def _loss_axis(lines: Sequence[Line]) -> Axis:
    """Logarithmic, with a place for 0 and below, where there is more than a decade to show; otherwise it fits."""
    means = [y for one in lines for _, y in one.points]
    reach = [value for one in lines for value in _heights(one)]
    largest = max(map(abs, reach))
    if not 1e-30 < largest < 1e100 or largest < 10 * min(means):
        return drawing.linear(reach)
    decade = floor(log10(largest))
    threshold = 10.0 ** (decade - _DECADES)
    low, high = min(means), max(reach)
    low, high = low / 1.3 if low > threshold else min(-threshold / 3, low * 1.3), high * 1.3
    sizes = [10.0**power for power in range(decade - _DECADES, decade + 2)]
    signed = [0.0, *(sign * size for size in sizes for sign in (1, -1))]
    inside = [tick for tick in signed if low <= tick <= high]
    if len(inside) < 2:
        inside = [tick * part for tick in signed for part in (1, 2, 5) if low <= tick * part <= high]
    return drawing.symmetric(low, high, threshold, inside)


def _fitted(lines: Sequence[Line], label: str, ends: drawing.References | None = None) -> Axis:
    """An axis for lines with their bands, and for references that are not far away. What is never below 0 has no axis below 0."""
    values = [value for one in lines for value in _heights(one)]
    bounds = _from_zero(y for one in lines for _, y in one.points)
    return drawing.linear(values, label, also=(ends.values.values() if ends else ()), bounds=bounds)


def _from_zero(values: Iterable[float]) -> tuple[float, float] | None:
    return (0.0, float("inf")) if min(values, default=-1.0) >= 0 else None


def _heights(one: Line) -> list[float]:
    return [*(y for _, y in one.points), *(end for _, low, high in one.band for end in (low, high))]


def _reach(marks: Iterable[Mark]) -> list[float]:
    return [value for one in marks for value in (one.value, *(one.interval or ()), *(one.second or ()))]


def _around(steps: Sequence[int], means: Sequence[float], stds: Sequence[float] | None) -> list[tuple[float, float, float]]:
    return [] if stds is None else [(step, mean - std, mean + std) for step, mean, std in zip(steps, means, stds, strict=True)]


def _ends(bounds: Reference | None) -> drawing.References:
    return drawing.References({} if bounds is None else {FLOOR: bounds.floor, CEILING: bounds.ceiling})


def _names(methods: Sequence[str]) -> dict[str, str]:
    """Names that fit beside an axis, by method."""
    return dict(zip(methods, legend({method: {} for method in methods}), strict=True))


def with_references(references: References) -> str:
    """What the lines of floors and ceilings are, for a caption; empty if there are none."""
    return " Across, dotted: floor, the mean return of random actions; dashed: ceiling, that of TD3 trained online." if references else ""
