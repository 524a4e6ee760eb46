"""Learning curves: a panel for each task, a line for each method. The same records give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
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
_OTHER_COLOURS = ("#0072B2", "#000000", "#8C6D1F")
_OTHER_DASHES = ("--", "-.", ":")
_COLUMNS = 4
_STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "cudc-bench", "pdf.fonttype": 42, "text.parse_math": False,
    "figure.constrained_layout.use": True, "font.size": 9.0, "axes.titlesize": 9.0, "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
}  # fmt: skip


def curve_files(table: Table) -> dict[str, bytes]:
    """``curves.svg``, whose text stays text, and ``curves.pdf``; neither holds a date."""
    from matplotlib import style

    # The user's own matplotlib settings must not change the figure.
    with style.context(_STYLE, after_reset=True):
        figure = draw_curves(table)
        return {
            "curves.svg": _saved(figure, "svg", {"Date": None}),
            "curves.pdf": _saved(figure, "pdf", {"CreationDate": None}),
        }


def draw_curves(table: Table) -> Figure:
    """Return over gradient steps for each task that has records.

    A line is the mean over collector seeds with a band of ± one sample standard deviation; a single seed is a thin line. Vertical
    dotted lines mark the milestones. The value after the last step is that of the final, larger evaluation, as in tables.
    """
    from matplotlib.figure import Figure

    tasks = [task for task in table.tasks if any(record.dataset.task == task for record in table.records)]
    columns = min(len(tasks), _COLUMNS)
    rows = ceil(len(tasks) / columns)
    width = max(2.4 * columns + 0.4, 5.2)
    bands = "" if table.seeds == "1 seed" else "mean, band: ± sample standard deviation, "
    what = f"{table.seeds}, {bands}dotted: milestones"
    title = wrap(f"{table.algorithm} on {table.domain}, profile {table.group}: {what}", int(width * 13))
    # Points that an entry of the legend takes: its line and gaps, then about 5.5 for each letter.
    entries = max(1, int(width * 72 / (45 + 5.5 * max(map(len, table.methods)))))
    lines = len(title) + ceil(len(table.methods) / entries)
    figure = Figure(figsize=(width, 2.1 * rows + 0.2 * lines + 0.6))
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for panel, task in zip(axes.flat, tasks, strict=False):
        _draw_panel(panel, table, task)
    for panel in axes.flat[len(tasks) :]:
        panel.set_visible(False)
    for panel in axes[:, 0]:
        panel.set_ylabel("return")
    figure.suptitle("\n".join(title), fontsize=9)
    handles = [_handle(method, look) for method, look in looks(table.methods).items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=entries, frameon=False)
    return figure


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


def _draw_panel(panel: Axes, table: Table, task: str) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    for section in table.sections:
        panel.axvline(section.milestone, color="#B0B0B0", linewidth=0.8, linestyle=":", zorder=0)
    for method, look in looks(table.methods).items():
        records = [r for r in table.records if (r.dataset.task, column(r)) == (task, method)]
        if not records:
            continue
        steps, means, stds = curve(records)
        panel.plot(steps, means, linewidth=0.8 if stds is None else 1.6, clip_on=False, **look)
        if stds is not None:
            low = [mean - std for mean, std in zip(means, stds, strict=True)]
            high = [mean + std for mean, std in zip(means, stds, strict=True)]
            panel.fill_between(steps, low, high, color=look["color"], alpha=0.15, linewidth=0)
    panel.set_title(task)
    panel.set_xlabel("gradient steps")
    panel.set_xlim(0, max(record.final.step for record in table.records))
    panel.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda step, _: short(step)))
    if table.domain in DOMAINS and table.tasks == DOMAINS[table.domain].tasks:
        panel.set_ylim(0, DOMAINS[table.domain].max_return)


def _handle(method: str, look: dict[str, Any]) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=method, linewidth=1.6, **look)


def _saved(figure: Figure, kind: str, metadata: dict[str, None]) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()
