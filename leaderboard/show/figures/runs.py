"""Learning curves and bars: a panel for each task, a line or a bar for each method."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from ...methods import styles
from ...numbers.figures import curve
from ...numbers.table import Runs, Table
from ...numbers.words import short
from .drawing import (
    COLUMNS,
    draw_line,
    draw_references,
    figure_files,
    filled,
    framed,
    legend,
    references_legend,
    returns_axis,
    seeds_text,
    steps_axis,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_BARS = 14  # so many bars can be told apart in a panel of the ordinary width


def curve_files(table: Table) -> dict[str, bytes]:
    """``curves.svg`` and ``curves.pdf``, as :func:`figure_files` makes them."""
    return figure_files("curves", lambda: draw_curves(table.runs))


def task_files(runs: Runs) -> dict[str, bytes]:
    """``task-<task>.svg`` for each task that has records: its curves alone, larger, for the site; on paper there is ``curves.pdf``."""
    files: dict[str, bytes] = {}
    for task in runs.tasks:
        files |= figure_files(f"task-{task}", partial(draw_task, runs, task), ("svg",))
    return files


def draw_curves(runs: Runs) -> Figure:
    """Return over gradient steps for each task that has records.

    A line is the mean over collector seeds with a band of ± one sample standard deviation; a single seed is a thin line. Vertical
    dotted lines mark the milestones. The value after the last step is the mean of the larger evaluations at the end, as in tables.
    """
    what = f"{seeds_text(runs.seeds)}, dotted: milestones"
    title = f"{runs.algorithm} on {runs.domain}, profile {runs.group}: {what}"
    shown = styles(runs.methods)
    figure, panels = framed(title, legend(shown) | references_legend(runs.references), len(runs.tasks), COLUMNS, sharey=True)
    for index, (panel, task) in enumerate(zip(panels, runs.tasks, strict=True)):
        _draw_panel(panel, runs, task, shown)
        if index % COLUMNS == 0:
            panel.set_ylabel("return")
    return figure


def draw_bars(runs: Runs) -> Figure:
    """The mean return of each method at each milestone, a panel for each task, with ± one sample standard deviation over seeds.

    Bars stand in the legend's order; a single seed has no error bar.
    """
    title = f"{runs.algorithm} on {runs.domain}, profile {runs.group}, after so many gradient steps: {seeds_text(runs.seeds, 'bar')}"
    shown = styles(runs.methods)
    columns = COLUMNS if len(runs.methods) * len(runs.milestones) <= _BARS else 2
    entries = {name: filled(style) for name, style in legend(shown).items()} | references_legend(runs.references)
    figure, panels = framed(title, entries, len(runs.tasks), columns, sharey=True, width=2.4 if columns == COLUMNS else 4.8)
    group = 1 + len(runs.methods)
    for index, (panel, task) in enumerate(zip(panels, runs.tasks, strict=True)):
        for place, (method, style) in enumerate(shown.items()):
            cells = {
                number * group + place: cell
                for number, milestone in enumerate(runs.milestones)
                if (cell := runs.cells.get((milestone, task, method)))
            }
            panel.bar(list(cells), [cell.value for cell in cells.values()], 0.9, **filled(style))
            spread = {at: cell for at, cell in cells.items() if cell.std is not None}
            panel.errorbar(
                list(spread), [cell.value for cell in spread.values()], [cell.std or 0.0 for cell in spread.values()],
                color="black", linestyle="", elinewidth=0.8, capsize=1.5, capthick=0.8,
            )  # fmt: skip
        middles = [number * group + (len(runs.methods) - 1) / 2 for number in range(len(runs.milestones))]
        panel.set_xticks(middles, [f"{short(milestone)} steps" for milestone in runs.milestones])
        panel.set_xlim(-1, len(runs.milestones) * group - 1)
        panel.tick_params(axis="x", length=0)
        panel.set_title(task)
        if index % columns == 0:
            panel.set_ylabel("return")
        draw_references(panel, task, runs.references)
        returns_axis(panel, runs.domain, runs.tasks)
    return figure


def draw_task(runs: Runs, task: str) -> Figure:
    """The curves of one task, wide enough to follow each line."""
    title = f"{runs.algorithm} on {runs.domain} {task}, profile {runs.group}: {seeds_text(runs.seeds)}, dotted: milestones"
    shown = styles(runs.methods)
    references = {task: runs.references[task]} if task in runs.references else {}
    figure, (panel,) = framed(title, legend(shown) | references_legend(references), 1, 1, height=3.6, width=7.2)
    _draw_panel(panel, runs, task, shown)
    panel.set_title("")  # The figure's says it.
    panel.set_ylabel("return")
    return figure


def _draw_panel(panel: Axes, runs: Runs, task: str, shown: Mapping[str, dict[str, Any]]) -> None:
    for milestone in runs.milestones:
        panel.axvline(milestone, color="#B0B0B0", linewidth=0.8, linestyle=":", zorder=0)
    for method, style in shown.items():
        records = runs.records.get((method, task))
        if records:
            draw_line(panel, *curve(records), style)
    draw_references(panel, task, runs.references)
    panel.set_title(task)
    steps_axis(panel, "gradient steps", (record.final.step for records in runs.records.values() for record in records))
    returns_axis(panel, runs.domain, runs.tasks)
