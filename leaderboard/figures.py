"""Learning curves: a panel for each task, a line for each method. The same records give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import ceil
from statistics import fmean, stdev
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.records import Record

from .load import column, short
from .table import Table, seed_scores

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# From Okabe and Ito's palette, which colour-blind people can tell apart; a method has the same colour in every figure.
COLOURS = {
    "random": "#7F7F7F", "icm": "#56B4E9", "apt": "#009E73", "proto": "#CC79A7", "aps": "#E69F00", "cudc": "#D55E00",
}  # fmt: skip
_OTHER_COLOURS = ("#0072B2", "#000000", "#8C6D1F", "#882255", "#117733", "#7B5FD0")
_OTHER_DASHES = ("--", "-.", ":", (0, (6.0, 1.5, 1.0, 1.5, 1.0, 1.5)), "-")
_COLUMNS = 4
_STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "cudc-bench", "pdf.fonttype": 42, "text.parse_math": False,
    "figure.constrained_layout.use": True, "font.size": 9.0, "axes.titlesize": 9.0, "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
}  # fmt: skip


def curve_files(table: Table) -> dict[str, bytes]:
    """``curves.svg`` and ``curves.pdf``, as :func:`figure_files` makes them."""
    return figure_files("curves", lambda: draw_curves(table))


def task_files(table: Table) -> dict[str, bytes]:
    """``task-<task>.svg`` and ``.pdf`` for each task that has records: its curves alone, larger."""
    files: dict[str, bytes] = {}
    for task in _with_records(table):
        files |= figure_files(f"task-{task}", lambda task=task: draw_task(table, task))  # type: ignore[misc]
    return files


def figure_files(name: str, draw: Callable[[], Figure]) -> dict[str, bytes]:
    """``<name>.svg``, whose text stays text, and ``<name>.pdf`` of the figure that ``draw`` returns; neither holds a date."""
    from matplotlib import style

    # The user's own matplotlib settings must not change the figure.
    with style.context(_STYLE, after_reset=True):
        figure = draw()
        return {
            f"{name}.svg": _saved(figure, "svg", {"Date": None}),
            f"{name}.pdf": _saved(figure, "pdf", {"CreationDate": None}),
        }


def draw_curves(table: Table) -> Figure:
    """Return over gradient steps for each task that has records.

    A line is the mean over collector seeds with a band of ± one sample standard deviation; a single seed is a thin line. Vertical
    dotted lines mark the milestones. The value after the last step is that of the final, larger evaluation, as in tables.
    """
    tasks = _with_records(table)
    what = f"{seeds_text(table.seeds)}, dotted: milestones"
    title = f"{table.algorithm} on {table.domain}, profile {table.group}: {what}"
    figure, panels = framed(title, looks(table.methods), len(tasks), _COLUMNS, sharey=True)
    for index, (panel, task) in enumerate(zip(panels, tasks, strict=True)):
        _draw_panel(panel, table, task)
        if index % _COLUMNS == 0:
            panel.set_ylabel("return")
    return figure


def draw_task(table: Table, task: str) -> Figure:
    """The same for one task, wide enough to follow each line."""
    title = f"{table.algorithm} on {table.domain} {task}, profile {table.group}: {seeds_text(table.seeds)}, dotted: milestones"
    figure, (panel,) = framed(title, looks(table.methods), 1, 1, height=3.6, width=7.6)
    _draw_panel(panel, table, task)
    panel.set_title("")  # The figure's says it.
    panel.set_ylabel("return")
    return figure


def _with_records(table: Table) -> list[str]:
    having = {record.dataset.task for record in table.records}
    return [task for task in table.tasks if task in having]


def framed(
    title: str, methods: Mapping[str, dict[str, Any]], panels: int, columns: int, *, sharey: bool = False, height: float = 2.1,
    width: float = 5.2,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """A figure of empty panels with a title above and the legend below, and the panels in reading order.

    Args:
        title: wrapped where it is too long.
        methods: the entries of the legend: names and their :func:`looks`.
        panels: how many; ``columns``: at most so many beside each other.
        sharey: one vertical axis for all.
        height: of a row of panels, in inches; ``width``: of the figure, at least.
    """
    from matplotlib.figure import Figure

    columns = min(panels, columns)
    rows = ceil(panels / columns)
    width = max(2.4 * columns + 0.4, width)
    lines = wrap(title, int(width * 13))
    # Points that an entry of the legend takes: its line and gaps, then about 5.5 for each letter.
    entries = max(1, int(width * 72 / (45 + 5.5 * max(map(len, methods)))))
    figure = Figure(figsize=(width, height * rows + 0.2 * (len(lines) + ceil(len(methods) / entries)) + 0.6))
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
    for panel in axes[panels:]:
        panel.set_visible(False)
    figure.suptitle("\n".join(lines), fontsize=9)
    handles = [_handle(method, look) for method, look in methods.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=entries, frameon=False)
    return figure, axes[:panels]


def seeds_text(seeds: str) -> str:
    """What lines and bands are, for a title: ``"1 seed"``, or ``"3 seeds, mean, band: ± sample standard deviation"``."""
    return seeds if seeds == "1 seed" else f"{seeds}, mean, band: ± sample standard deviation"


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each method: fixed for the paper's, in turn for others."""
    others = [method for method in methods if method not in COLOURS]
    found: dict[str, dict[str, Any]] = {}
    for method in methods:
        if method in COLOURS:
            found[method] = {"color": COLOURS[method], "linestyle": "-"}
        else:
            turn, colour = divmod(others.index(method), len(_OTHER_COLOURS))
            found[method] = {"color": _OTHER_COLOURS[colour], "linestyle": _OTHER_DASHES[turn % len(_OTHER_DASHES)]}
    return found


def curve(records: Sequence[Record]) -> tuple[list[int], list[float], list[float] | None]:
    """Steps, means and sample standard deviations over collector seeds; None for one seed.

    Only steps at which every record was evaluated count, so that a mean is always over the same seeds.
    """
    steps = sorted(set.intersection(*({evaluation.step for evaluation in record.curve} for record in records)))
    scores = [seed_scores(records, step) for step in steps]
    several = len({record.dataset.seed for record in records}) > 1
    return steps, [fmean(values) for values in scores], [stdev(values) for values in scores] if several else None


def draw_line(
    panel: Axes, steps: Sequence[int], means: Sequence[float], stds: Sequence[float] | None, look: Mapping[str, Any], *,
    stairs: bool = False, clip: bool = False,
) -> None:  # fmt: skip
    """A method's line and its band of ± one standard deviation; without one a thin line.

    Args:
        panel: where to.
        steps, means, stds: as :func:`curve` returns them.
        look: one of :func:`looks`.
        stairs: hold each value until the next.
        clip: hide what is outside the panel; otherwise a line on its edge keeps its full width.
    """
    panel.plot(steps, means, linewidth=line_width(stds), clip_on=clip, drawstyle="steps-post" if stairs else "default", **look)
    if stds is not None:
        low = [mean - std for mean, std in zip(means, stds, strict=True)]
        high = [mean + std for mean, std in zip(means, stds, strict=True)]
        panel.fill_between(steps, low, high, color=look["color"], alpha=0.15, linewidth=0, step="post" if stairs else None)


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


def _draw_panel(panel: Axes, table: Table, task: str) -> None:
    for section in table.sections:
        panel.axvline(section.milestone, color="#B0B0B0", linewidth=0.8, linestyle=":", zorder=0)
    for method, look in looks(table.methods).items():
        records = [r for r in table.records if (r.dataset.task, column(r)) == (task, method)]
        if not records:
            continue
        draw_line(panel, *curve(records), look)
    panel.set_title(task)
    steps_axis(panel, "gradient steps", (record.final.step for record in table.records))
    if table.domain in DOMAINS and table.tasks == DOMAINS[table.domain].tasks:
        panel.set_ylim(0, DOMAINS[table.domain].max_return)


def _handle(method: str, look: dict[str, Any]) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=method, linewidth=1.6, **look)


def _saved(figure: Figure, kind: str, metadata: dict[str, None]) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()
