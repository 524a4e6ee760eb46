"""Panels of figures as inline SVG, which follows the page: its colours are classes of ``site.css``, and a milestone's part can be hidden.

A panel is a few hundred pixels wide and has axes that fit what is drawn in it; several stand beside or below one another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, pairwise
from math import asinh, ceil, floor, log10
from typing import Any, TypeVar

from markupsafe import Markup

from cudc_bench.text import plain

from .palette import colour_class

T = TypeVar("T")
WIDTH, HEIGHT = 320.0, 200.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 44.0, 10.0, 24.0, 38.0
_ROW = 19.0
_ALONE = 1.25  # so much larger is a panel that stands alone; those side by side take the room there is
_LETTER = 6.8  # pixels of a letter of 11, of most
_HUGE = 1e100  # Nothing that means something is larger, and squares of it are still numbers.
_MOST_POINTS = 160  # of a line: one for each two pixels
DASHES = {"-": "", "--": "5 2", "-.": "5 2 1.5 2", ":": "1.5 2"}


@dataclass(frozen=True)
class Axis:
    """A range of values, where its ticks are, and what these are called; ``warp`` makes its values even, such as a logarithm."""

    low: float
    high: float
    ticks: Mapping[float, str]
    label: str = ""
    warp: Callable[[float], float] = float

    def place(self, value: float, start: float, end: float) -> float:
        """Where a value is between two pixels; what lies outside is at the edge."""
        low, high = self.warp(self.low), self.warp(self.high)
        share = (self.warp(min(max(value, self.low), self.high)) - low) / (high - low)
        return start + share * (end - start)

    def has(self, value: float) -> bool:
        """Whether a value lies on it."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Line:
    """Values over an axis.

    Attributes:
        style: ``color`` and ``linestyle``, as ``methods.styles`` gives them.
        points: x and y, by x.
        band: x, and the borders of what surrounds the line there.
        title: shown beside a pointer.
        thin: a single seed.
        stairs: each value holds until the next.
        marks: whether each point has a mark.
        milestone: the gradient steps that it belongs to.
    """

    style: Mapping[str, Any]
    points: Sequence[tuple[float, float]]
    band: Sequence[tuple[float, float, float]] = ()
    title: str = ""
    thin: bool = False
    stairs: bool = False
    marks: bool = False
    milestone: int | None = None


@dataclass(frozen=True)
class Mark:
    """A row's value with its interval, if it has one, and thinner above it a second interval."""

    name: str
    style: Mapping[str, Any]
    value: float
    interval: tuple[float, float] | None = None
    second: tuple[float, float] | None = None
    title: str = ""


@dataclass(frozen=True)
class References:
    """Lines across a panel: values by name. One that lies far from everything else is named at the edge instead."""

    values: Mapping[str, float] = field(default_factory=dict)


def linear(values: Iterable[float], label: str = "", *, also: Iterable[float] = (), bounds: tuple[float, float] | None = None,
           text: Callable[[float], str] | None = None, ticks: int = 5) -> Axis:  # fmt: skip
    """An axis that fits some values, with ticks at round numbers.

    Args:
        values: what must be on it.
        label: what it is.
        also: what should be on it unless that leaves little room for the values.
        bounds: it never passes these.
        text: writes a tick; as few digits as ticks need unless given.
        ticks: about how many.
    """
    found = [min(max(value, -_HUGE), _HUGE) for value in values] or [0.0, 1.0]
    low, high = min(found), max(found)
    reach = _reach(low, high)
    near = [value for value in also if low - 0.4 * reach <= value <= high + 0.4 * reach]
    low, high = min([low, *near]), max([high, *near])
    if 0 < low < 0.4 * high:
        low = 0.0
    margin = 0.05 * _reach(low, high)
    low, high = (low if low == 0 else low - margin), high + margin
    if bounds is not None:
        low, high = max(low, bounds[0]), min(high, bounds[1])
    if not low < high:
        low, high = low - 0.5, low + 0.5
    size, part = _step((high - low) / ticks)
    step = size * part
    digits = max(0, -round(log10(size)) + (part == 2.5))
    write = text or (lambda value: f"{value:,.{digits}f}" if 0 < digits < 7 or (abs(value) < 1e7 and digits == 0) else f"{value:.3g}")
    places = [float(f"{index * step:.12g}") + 0.0 for index in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]
    return Axis(low, high, {place: write(place) for place in places}, label)


def _reach(low: float, high: float) -> float:
    """How far apart two values are; of values that are as good as one, how large they are."""
    reach, size = high - low, max(abs(low), abs(high))
    return reach if reach > 1e-9 * size else size or 1.0


def logarithmic(low: float, high: float, ticks: Mapping[float, str], label: str = "") -> Axis:
    """A logarithmic axis from one positive value to another."""
    return Axis(low, high, {place: text for place, text in ticks.items() if low <= place <= high}, label, log10)


def symmetric(low: float, high: float, threshold: float, ticks: Iterable[float], label: str = "") -> Axis:
    """A logarithmic axis that goes on through 0 below a threshold."""
    return Axis(low, high, {place: f"{place:g}" for place in ticks}, label, lambda value: asinh(value / threshold))


def _step(least: float) -> tuple[float, float]:
    """A round number that is at least so large, as a power of ten and its factor."""
    size = 10.0 ** floor(log10(least))
    return next(((size, part) for part in (1, 2, 2.5, 5) if size * part >= least * (1 - 1e-9)), (10 * size, 1))


def lines_panel(title: str, lines: Sequence[Line], across: Axis, up: Axis, references: References | None = None,
                marks: Iterable[tuple[float, int | None]] = (), size: tuple[float, float] = (WIDTH, HEIGHT)) -> Markup:  # fmt: skip
    """A panel of lines.

    Args:
        title: above it.
        lines: what is drawn.
        across, up: its axes.
        references: horizontal lines.
        marks: vertical dotted lines, each with the milestone that shows it as one that is chosen.
        size: in pixels.
    """
    width, height = size
    left, right, top, bottom = _LEFT, width - _RIGHT, _TOP, height - _BOTTOM
    x, y = (lambda value: across.place(value, left, right)), (lambda value: up.place(value, bottom, top))
    parts = [_frame(title, across, up, size, left)]
    for at, milestone in marks:
        path = Markup('<path class="milestone" d="M{} {}V{}"/>').format(_n(x(at)), _n(top), _n(bottom))
        parts.append(path)
        if milestone is not None:
            parts.append(Markup('<g data-milestone="{}"><path class="chosen" d="M{} {}V{}"/></g>').format(
                milestone, _n(x(at)), _n(top), _n(bottom)))  # fmt: skip
    parts += _across(references, up, lambda value: f"M{_n(left)} {_n(y(value))}H{_n(right)}", right, "↓↑")
    parts += [_line(one, x, y) for one in lines]
    return _svg(size, parts)


def rows_panel(title: str, names: Sequence[str], marks: Sequence[Mark], axis: Axis, references: References | None = None) -> Markup:
    """A panel with a row for each name, in which its value and interval are; a name without a mark has an empty row."""
    left = min(max(map(len, names), default=0) * _LETTER + 10, 0.55 * WIDTH)
    size = (WIDTH, _TOP + _ROW * len(names) + _BOTTOM)
    right, top, bottom = WIDTH - _RIGHT, _TOP, size[1] - _BOTTOM

    def x(value: float) -> float:
        return axis.place(value, left, right)

    parts = [_frame(title, axis, None, size, left)]
    parts += _across(references, axis, lambda value: f"M{_n(x(value))} {_n(top)}V{_n(bottom)}", right, "←→")
    found = {one.name: one for one in marks}
    for row, name in enumerate(names):
        middle = top + _ROW * (row + 0.5)
        parts.append(Markup('<text class="row" x="{}" y="{}">{}</text>').format(_n(left - 6), _n(middle + 3.8), plain(name)))
        if name in found:
            parts.append(_mark(found[name], x, middle))
    return _svg(size, parts)


def shares_panel(names: Sequence[str], shares: Sequence[Sequence[float]], styles: Mapping[str, Mapping[str, Any]], label: str) -> Markup:
    """A grid of shares, a row for each name: stronger colours are larger ones, and each is written in per cent."""
    left = max(map(len, names)) * _LETTER + 10
    columns = max(map(len, shares))
    cell = min(46.0, max(30.0, (2 * WIDTH - left - _RIGHT) / columns))
    size = (left + cell * columns + _RIGHT, _ROW * len(names) + _BOTTOM + 4)
    parts = []
    for row, (name, values) in enumerate(zip(names, shares, strict=True)):
        y = 4 + _ROW * row
        parts.append(Markup('<text class="row" x="{}" y="{}">{}</text>').format(_n(left - 6), _n(y + _ROW / 2 + 3.8), plain(name)))
        parts.append(Markup('<g class="{}">').format(colour_class(styles[name]["color"])))
        for place, share in enumerate(values):
            # Never so strong that what is written on it could not be read, on a light or a dark ground.
            parts.append(Markup('<rect x="{}" y="{}" width="{}" height="{}" fill-opacity="{}"/>').format(
                _n(left + cell * place), _n(y), _n(cell - 1), _n(_ROW - 1), f"{0.45 * share:.3f}"))  # fmt: skip
        parts.append(Markup("</g>"))
        parts += [
            Markup('<text class="share" x="{}" y="{}">{}</text>').format(
                _n(left + cell * (place + 0.5)), _n(y + _ROW / 2 + 3.8), f"{100 * share:.0f}")
            for place, share in enumerate(values) if share >= 0.005
        ]  # fmt: skip
    bottom = 4 + _ROW * len(names)
    parts += [
        Markup('<text class="tick" x="{}" y="{}">{}</text>').format(_n(left + cell * (place + 0.5)), _n(bottom + 14), place + 1)
        for place in range(columns)
    ]
    parts.append(Markup('<text class="label" x="{}" y="{}">{}</text>').format(_n((left + size[0]) / 2), _n(size[1] - 5), label))
    return _svg(size, parts)


def _svg(size: tuple[float, float], parts: Iterable[Markup]) -> Markup:
    box, shown = map(_n, size), (_n(_ALONE * one) for one in size)
    return Markup('<svg class="plot" width="{2}" height="{3}" viewBox="0 0 {0} {1}">{4}</svg>').format(*box, *shown, Markup().join(parts))


def _frame(title: str, across: Axis, up: Axis | None, size: tuple[float, float], left: float) -> Markup:
    """Title, axes, ticks and what they are."""
    width, height = size
    right, top, bottom = width - _RIGHT, _TOP, height - _BOTTOM
    parts = [Markup('<text class="title" x="{}" y="13">{}</text>').format(_n(left if up else 0), plain(title))] if title else []
    grid, texts = [], []
    for value, text in across.ticks.items():
        x = _n(across.place(value, left, right))
        grid.append(f"M{x} {_n(top)}V{_n(bottom)}" if up is None else f"M{x} {_n(bottom)}v4")
        texts.append(Markup('<text class="tick" x="{}" y="{}">{}</text>').format(x, _n(bottom + 15), text))
    for value, text in up.ticks.items() if up else ():
        y = up.place(value, bottom, top) if up else 0.0
        grid.append(f"M{_n(left)} {_n(y)}H{_n(right)}")
        texts.append(Markup('<text class="up" x="{}" y="{}">{}</text>').format(_n(left - 5), _n(y + 3.8), text))
    parts.append(Markup('<path class="grid" d="{}"/>').format("".join(grid)))
    parts.append(Markup('<path class="axis" d="M{} {}H{}"/>').format(_n(left), _n(bottom), _n(right)))
    parts += texts
    parts.append(Markup('<text class="label" x="{}" y="{}">{}</text>').format(_n((left + right) / 2), _n(height - 5), plain(across.label)))
    if up is not None and up.label:
        parts.append(Markup('<text class="label" transform="translate(9 {}) rotate(-90)">{}</text>').format(
            _n((top + bottom) / 2), up.label))  # fmt: skip
    return Markup().join(parts)


def _across(references: References | None, axis: Axis, path: Callable[[float], str], right: float, arrows: str) -> list[Markup]:
    """Lines at references; those that the axis does not reach are named."""
    parts, beyond = [], []
    for name, value in (references.values if references else {}).items():
        if axis.has(value):
            shown = Markup("<title>{}: {}</title>").format(name, f"{value:.4g}")
            parts.append(Markup('<g class="reference"><path class="{}" d="{}"/>{}</g>').format(name, path(value), shown))
        else:
            number = f"{value:.0f}" if abs(value) >= 10 else f"{value:.3g}"
            beyond.append(f"{name} {number} {arrows[1]}" if value > axis.high else f"{arrows[0]} {name} {number}")
    if beyond:
        parts.append(Markup('<text class="beyond" x="{}" y="13">{}</text>').format(_n(right), ", ".join(beyond)))
    return parts


def _line(one: Line, x: Callable[[float], float], y: Callable[[float], float]) -> Markup:
    points = _fewer(one.points)
    corners = [(x(a), y(b)) for a, b in points]
    if one.stairs:
        corners = [*corners[:1], *chain.from_iterable(((after[0], before[1]), after) for before, after in pairwise(corners))]
    dashes = one.style["linestyle"]
    pattern = DASHES[dashes] if isinstance(dashes, str) else " ".join(f"{part:g}" for part in dashes[1])
    band = _fewer(one.band)
    parts = []
    if band:
        low, high = [(x(a), y(b)) for a, b, _ in band], [(x(a), y(b)) for a, _, b in band]
        parts.append(Markup('<path class="band" d="M{}Z"/>').format(_path([*low, *reversed(high)])))
    if len(corners) > 1:
        parts.append(Markup('<path class="line{}" d="M{}"{}/>').format(
            " thin" if one.thin else "", _path(corners), Markup(' stroke-dasharray="{}"').format(pattern) if pattern else ""))  # fmt: skip
    if one.marks or len(corners) == 1:
        parts += [Markup('<circle cx="{}" cy="{}" r="3"/>').format(_n(a), _n(b)) for a, b in corners]
    title = Markup("<title>{}</title>").format(plain(one.title)) if one.title else ""
    milestone = "" if one.milestone is None else Markup(' data-milestone="{}"').format(one.milestone)
    return Markup('<g class="{}"{}>{}{}</g>').format(colour_class(one.style["color"]), milestone, Markup().join(parts), title)


def _mark(one: Mark, x: Callable[[float], float], middle: float) -> Markup:
    parts = []
    if one.second is not None:
        low, high = one.second
        parts.append(Markup('<path class="second" d="M{} {}H{}"/>').format(_n(x(low)), _n(middle - 5.5), _n(x(high))))
    if one.interval is not None:
        low, high = one.interval
        parts.append(Markup('<path class="interval" d="M{} {}H{}"/>').format(_n(x(low)), _n(middle), _n(x(high))))
    hollow = Markup(' class="hollow"') if one.interval is None else ""
    parts.append(Markup('<circle{} cx="{}" cy="{}" r="3.6"/>').format(hollow, _n(x(one.value)), _n(middle)))
    title = Markup("<title>{}</title>").format(plain(one.title)) if one.title else ""
    return Markup('<g class="{}">{}{}</g>').format(colour_class(one.style["color"]), Markup().join(parts), title)


def _fewer(points: Sequence[T]) -> Sequence[T]:
    """No more of them than can be seen, the last among them."""
    every = ceil(len(points) / _MOST_POINTS)
    return points if every < 2 else [*points[:-1:every], points[-1]]


def _path(points: Iterable[tuple[float, float]]) -> str:
    return " ".join(f"{_n(a)} {_n(b)}" for a, b in points)


def _n(value: float) -> str:
    text = f"{value:.1f}"
    return text.removesuffix(".0") if text != "-0.0" else "0"
