"""Learning curves: a panel for each task, a line for each method. The same records give the same bytes."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from math import ceil
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.text import plain

from ...methods import DASHES
from ...numbers.scale import CEILING, FLOOR, MEANING, References
from ...numbers.words import short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure


_HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\")
COLUMNS = 4
LONGEST_NAME = 28  # letters of a method beside an axis or in a legend
_STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "cudc-bench", "pdf.fonttype": 42, "text.parse_math": False,
    "figure.constrained_layout.use": True, "font.size": 9.0, "axes.titlesize": 9.0, "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
}  # fmt: skip


def figure_files(name: str, draw: Callable[[], Figure], kinds: Sequence[str] = ("svg", "pdf")) -> dict[str, bytes]:
    """``<name>.svg``, whose text stays text, and ``<name>.pdf`` of the figure that ``draw`` returns; neither holds a date."""
    _import_matplotlib()
    from matplotlib import style

    # The user's own matplotlib settings must not change the figure.
    with style.context(_STYLE, after_reset=True):
        figure = draw()
        # One layout for both; each would otherwise draw everything once more to find its own.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        dates = {"svg": "Date", "pdf": "CreationDate"}
        return {f"{name}.{kind}": _saved(figure, kind, {dates[kind]: None}) for kind in kinds}


def _import_matplotlib() -> None:
    """Import it though ``MPLBACKEND`` may name what it does not know, which it would not survive: nothing here opens a window."""
    if "matplotlib" in sys.modules or not (asked := os.environ.pop("MPLBACKEND", "")):
        return
    try:
        import matplotlib

        with suppress(ValueError):
            matplotlib.rcParams["backend"] = asked  # as it does itself
    finally:
        os.environ["MPLBACKEND"] = asked


def framed(
    title: str, methods: Mapping[str, dict[str, Any]], panels: int, columns: int, *, sharey: bool = False, height: float = 2.1,
    width: float = 2.4,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """A figure of empty panels with a title above and the legend below, and the panels in reading order.

    Args:
        title: wrapped where it is too long.
        methods: the entries of the legend: names and their :func:`styles`, or how they are :func:`filled`.
        panels: how many; ``columns``: at most so many beside each other.
        sharey: one vertical axis for all.
        height, width: of a panel, in inches.
    """
    from matplotlib.figure import Figure

    columns = min(panels, columns)
    rows = ceil(panels / columns)
    across = max(width * columns + 0.4, 5.2)
    lines = wrap(title, int(across * 13))
    # Points that an entry of the legend takes: its line and gaps, then about 5.5 for each letter.
    entries = max(1, int(across * 72 / (45 + 5.5 * max(map(len, methods)))))
    figure = Figure(figsize=(across, height * rows + 0.2 * (len(lines) + ceil(len(methods) / entries)) + 0.6))
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
    for panel in axes[panels:]:
        panel.set_visible(False)
    figure.suptitle("\n".join(lines), fontsize=9)
    handles = [_handle(method, style) for method, style in methods.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=entries, frameon=False)
    return figure, axes[:panels]


def seeds_text(seeds: str, spread: str = "band") -> str:
    """What lines and bands are, for a title: ``"1 seed"``, or ``"3 seeds, mean, band: ± sample standard deviation"``."""
    return seeds if seeds == "1 seed" else f"{seeds}, mean, {spread}: ± sample standard deviation"


def filled(style: Mapping[str, Any]) -> dict[str, Any]:
    """The same style for an area: dashes become a texture, so that methods of one colour can be told apart there, too."""
    hatch = _HATCHES[DASHES.index(style["linestyle"])]
    return {
        "facecolor": style["color"],
        "hatch": hatch,
        "edgecolor": "#303030" if luminance(style["color"]) > 0.6 else "white",
        "linewidth": 0,
    }


def luminance(colour: Any, alpha: float = 1.0) -> float:
    """Of a colour of that strength over white: 0 is black, 1 is white (relative luminance of ITU-R BT.709, without its gamma)."""
    from matplotlib.colors import to_rgb

    red, green, blue = (1 - alpha * (1 - part) for part in to_rgb(colour))
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def legend(shown: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Looks by names that fit into a legend or beside an axis, in the same order; no two methods get one name."""
    found: dict[str, dict[str, Any]] = {}
    for method, style in shown.items():
        name = whole = plain(method)
        number = 1
        while len(name) > LONGEST_NAME or name in found:
            mark = f"…{number if number > 1 else ''}"
            name, number = whole[: LONGEST_NAME - len(mark)] + mark, number + 1
        found[name] = style
    return found


_REFERENCES: Mapping[str, dict[str, Any]] = {
    CEILING: {"color": "#404040", "linestyle": (0, (5.0, 2.0))},
    FLOOR: {"color": "#404040", "linestyle": (0, (1.0, 1.5))},
}


def references_legend(references: References) -> dict[str, dict[str, Any]]:
    """What the lines of floors and ceilings mean, for a legend; nothing if there are none. No method has a name with a colon."""
    return {f"{name}: {MEANING[name]}": style for name, style in _REFERENCES.items()} if references else {}


def draw_references(panel: Axes, task: str, references: References) -> None:
    """Lines at a task's floor and ceiling, if it has a reference."""
    if (bounds := references.get(task)) is not None:
        for value, style in zip((bounds.ceiling, bounds.floor), _REFERENCES.values(), strict=True):
            panel.axhline(value, linewidth=0.9, zorder=0.5, **style)


def returns_axis(panel: Axes, domain: str, tasks: Sequence[str]) -> None:
    """The vertical axis of returns: up to the largest possible, where that is known for all tasks."""
    if domain in DOMAINS and set(tasks) <= set(DOMAINS[domain].tasks):
        panel.set_ylim(0, DOMAINS[domain].max_return)


def draw_line(
    panel: Axes, steps: Sequence[int], means: Sequence[float], stds: Sequence[float] | None, style: Mapping[str, Any], *,
    stairs: bool = False, clip: bool = False,
) -> None:  # fmt: skip
    """A method's line and its band of ± one standard deviation; without one a thin line.

    Args:
        panel: where to.
        steps, means, stds: as :func:`curve` returns them.
        style: one of :func:`styles`.
        stairs: hold each value until the next.
        clip: hide what is outside the panel; otherwise a line on its edge keeps its full width.
    """
    panel.plot(steps, means, linewidth=line_width(stds), clip_on=clip, drawstyle="steps-post" if stairs else "default", **style)
    if stds is not None:
        low = [mean - std for mean, std in zip(means, stds, strict=True)]
        high = [mean + std for mean, std in zip(means, stds, strict=True)]
        panel.fill_between(steps, low, high, color=style["color"], alpha=0.15, linewidth=0, step="post" if stairs else None)


def line_width(stds: Sequence[float] | None) -> float:
    """The width of a line in points: thin where it is of a single seed."""
    return 0.8 if stds is None else 1.6


def steps_axis(panel: Axes, what: str, steps: Iterable[int]) -> None:
    """The horizontal axis of everything that is measured over steps, from 0 to the largest of ``steps``."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    panel.set_xlabel(what)
    panel.set_xlim(0, max(steps))
    panel.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda step, _: short(step)))


def plain_powers(axis: Axis) -> None:
    """Name the powers on a logarithmic axis, and nothing between them; by itself it writes formulas, which nothing here typesets."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _handle(method: str, style: dict[str, Any]) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return Patch(label=method, **style) if "facecolor" in style else Line2D([], [], label=method, linewidth=1.6, **style)


def _saved(figure: Figure, kind: str, metadata: dict[str, None]) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()
