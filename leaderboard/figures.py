"""Learning curves: a panel for each task, a line for each method. The same records give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import ceil
from statistics import fmean, stdev
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from cudc_bench.artefacts.records import Record
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.text import plain

from .load import short
from .scale import CEILING, FLOOR, MEANING, References
from .table import Runs, Table, seed_scores

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# From Okabe and Ito's palette, which colour-blind people can tell apart; a method has the same colour in every figure.
COLOURS = {
    "random": "#7F7F7F", "icm": "#56B4E9", "apt": "#009E73", "proto": "#CC79A7", "aps": "#E69F00", "cudc": "#D55E00",
}  # fmt: skip
_OTHER_COLOURS = ("#0072B2", "#000000", "#8C6D1F", "#882255", "#117733", "#7B5FD0")
_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (6.0, 1.5, 1.0, 1.5, 1.0, 1.5)))
_HATCHES = ("", "////", "....", "xxxx", "\\\\\\\\")
_LIGHT, _OWN, _DIM, _DARK, _RED = "#F4B183", COLOURS["cudc"], "#9A4400", "#4A1C00", "#A11D33"
# CUDC's relatives have its hue, lighter or darker, or that of the method that they start from; dashes tell apart those of one colour.
_STYLED: dict[str, tuple[str, Any]] = {
    name: (colour, dashes)
    for colour, names in (
        *((colour, ("", name)) for colour, name in zip(_OTHER_COLOURS, ("be", "cic", "diayn", "disagreement", "rnd", "smm"), strict=True)),
        (COLOURS["icm"], ("", "cudc-vary-icm")),
        (COLOURS["apt"], ("", "cudc-vary-apt", "apt-k6", "apt-ksched")),
        (_LIGHT, ("cudc-kmax3", "cudc-kmax4", "cudc-no-regularize", "cudc-no-reach", "cudc-uniform-k")),
        (_OWN, ("", "cudc-kmax5", "cudc-reward", "cudc-one-setting", "cudc-kmax6")),
        (_RED, ("cudc-live", "cudc-stopgrad", "cudc-momentum")),
        (_DIM, ("cudc-no-entropy", "cudc-no-inverse", "cudc-no-pe", "cudc-reach", "cudc-kmix")),
        (_DARK, ("cudc-kmax8", "cudc-kmax7", "cudc-normal-k", "cudc-no-vary", "cudc-literal")),
    )
    for dashes, name in zip(_DASHES, names, strict=False)
    if name
}
_COLUMNS = 4
_BARS = 14  # so many bars can be told apart in a panel of the ordinary width
LONGEST_NAME = 28  # letters of a method beside an axis or in a legend
_STYLE = {
    "svg.fonttype": "none", "svg.hashsalt": "cudc-bench", "pdf.fonttype": 42, "text.parse_math": False,
    "figure.constrained_layout.use": True, "font.size": 9.0, "axes.titlesize": 9.0, "axes.spines.top": False,
    "axes.spines.right": False, "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "xtick.labelsize": 8.0, "ytick.labelsize": 8.0,
}  # fmt: skip


def curve_files(table: Table) -> dict[str, bytes]:
    """``curves.svg`` and ``curves.pdf``, as :func:`figure_files` makes them."""
    return figure_files("curves", lambda: draw_curves(table.runs))


def task_files(runs: Runs) -> dict[str, bytes]:
    """``task-<task>.svg`` for each task that has records: its curves alone, larger, for the site; on paper there is ``curves.pdf``."""
    files: dict[str, bytes] = {}
    for task in runs.tasks:
        files |= figure_files(f"task-{task}", lambda task=task: draw_task(runs, task), ("svg",))  # type: ignore[misc]
    return files


def figure_files(name: str, draw: Callable[[], Figure], kinds: Sequence[str] = ("svg", "pdf")) -> dict[str, bytes]:
    """``<name>.svg``, whose text stays text, and ``<name>.pdf`` of the figure that ``draw`` returns; neither holds a date."""
    from matplotlib import style

    # The user's own matplotlib settings must not change the figure.
    with style.context(_STYLE, after_reset=True):
        figure = draw()
        # One layout for both; each would otherwise draw everything once more to find its own.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
        dates = {"svg": "Date", "pdf": "CreationDate"}
        return {f"{name}.{kind}": _saved(figure, kind, {dates[kind]: None}) for kind in kinds}


def draw_curves(runs: Runs) -> Figure:
    """Return over gradient steps for each task that has records.

    A line is the mean over collector seeds with a band of ± one sample standard deviation; a single seed is a thin line. Vertical
    dotted lines mark the milestones. The value after the last step is the mean of the larger evaluations at the end, as in tables.
    """
    what = f"{seeds_text(runs.seeds)}, dotted: milestones"
    title = f"{runs.algorithm} on {runs.domain}, profile {runs.group}: {what}"
    shown = looks(runs.methods)
    figure, panels = framed(title, legend(shown) | references_legend(runs.references), len(runs.tasks), _COLUMNS, sharey=True)
    for index, (panel, task) in enumerate(zip(panels, runs.tasks, strict=True)):
        _draw_panel(panel, runs, task, shown)
        if index % _COLUMNS == 0:
            panel.set_ylabel("return")
    return figure


def draw_bars(runs: Runs) -> Figure:
    """The mean return of each method at each milestone, a panel for each task, with ± one sample standard deviation over seeds.

    Bars stand in the legend's order; a single seed has no error bar.
    """
    title = f"{runs.algorithm} on {runs.domain}, profile {runs.group}, after so many gradient steps: {seeds_text(runs.seeds, 'bar')}"
    shown = looks(runs.methods)
    columns = _COLUMNS if len(runs.methods) * len(runs.milestones) <= _BARS else 2
    entries = {name: filled(look) for name, look in legend(shown).items()} | references_legend(runs.references)
    figure, panels = framed(title, entries, len(runs.tasks), columns, sharey=True, width=2.4 if columns == _COLUMNS else 4.8)
    group = 1 + len(runs.methods)
    for index, (panel, task) in enumerate(zip(panels, runs.tasks, strict=True)):
        for place, (method, look) in enumerate(shown.items()):
            cells = {
                number * group + place: cell
                for number, milestone in enumerate(runs.milestones)
                if (cell := runs.cells.get((milestone, task, method)))
            }
            panel.bar(list(cells), [cell.mean for cell in cells.values()], 0.9, **filled(look))
            spread = {at: cell for at, cell in cells.items() if cell.std is not None}
            panel.errorbar(
                list(spread), [cell.mean for cell in spread.values()], [cell.std or 0.0 for cell in spread.values()],
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
    shown = looks(runs.methods)
    references = {task: runs.references[task]} if task in runs.references else {}
    figure, (panel,) = framed(title, legend(shown) | references_legend(references), 1, 1, height=3.6, width=7.2)
    _draw_panel(panel, runs, task, shown)
    panel.set_title("")  # The figure's says it.
    panel.set_ylabel("return")
    return figure


def framed(
    title: str, methods: Mapping[str, dict[str, Any]], panels: int, columns: int, *, sharey: bool = False, height: float = 2.1,
    width: float = 2.4,
) -> tuple[Figure, list[Axes]]:  # fmt: skip
    """A figure of empty panels with a title above and the legend below, and the panels in reading order.

    Args:
        title: wrapped where it is too long.
        methods: the entries of the legend: names and their :func:`looks`, or how they are :func:`filled`.
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
    handles = [_handle(method, look) for method, look in methods.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=entries, frameon=False)
    return figure, axes[:panels]


def seeds_text(seeds: str, spread: str = "band") -> str:
    """What lines and bands are, for a title: ``"1 seed"``, or ``"3 seeds, mean, band: ± sample standard deviation"``."""
    return seeds if seeds == "1 seed" else f"{seeds}, mean, {spread}: ± sample standard deviation"


def looks(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and line style of each method: fixed for this project's, in turn for others."""
    others = [method for method in methods if method not in COLOURS and method not in _STYLED]
    found: dict[str, dict[str, Any]] = {}
    for method in methods:
        if method in COLOURS:
            colour, dashes = COLOURS[method], _DASHES[0]
        elif method in _STYLED:
            colour, dashes = _STYLED[method]
        else:
            turn, place = divmod(others.index(method), len(_OTHER_COLOURS))
            colour, dashes = _OTHER_COLOURS[place], _DASHES[(turn + 2) % len(_DASHES)]
        found[method] = {"color": colour, "linestyle": dashes}
    return found


def filled(look: Mapping[str, Any]) -> dict[str, Any]:
    """The same look for an area: dashes become a texture, so that methods of one colour can be told apart there, too."""
    hatch = _HATCHES[_DASHES.index(look["linestyle"])]
    return {
        "facecolor": look["color"],
        "hatch": hatch,
        "edgecolor": "#303030" if luminance(look["color"]) > 0.6 else "white",
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
    for method, look in shown.items():
        name = whole = plain(method)
        number = 1
        while len(name) > LONGEST_NAME or name in found:
            mark = f"…{number if number > 1 else ''}"
            name, number = whole[: LONGEST_NAME - len(mark)] + mark, number + 1
        found[name] = look
    return found


_REFERENCES: Mapping[str, dict[str, Any]] = {
    CEILING: {"color": "#404040", "linestyle": (0, (5.0, 2.0))},
    FLOOR: {"color": "#404040", "linestyle": (0, (1.0, 1.5))},
}


def references_legend(references: References) -> dict[str, dict[str, Any]]:
    """What the lines of floors and ceilings mean, for a legend; nothing if there are none. No method has a name with a colon."""
    return {f"{name}: {MEANING[name]}": look for name, look in _REFERENCES.items()} if references else {}


def draw_references(panel: Axes, task: str, references: References) -> None:
    """Lines at a task's floor and ceiling, if it has a reference."""
    if (bounds := references.get(task)) is not None:
        for value, look in zip((bounds.ceiling, bounds.floor), _REFERENCES.values(), strict=True):
            panel.axhline(value, linewidth=0.9, zorder=0.5, **look)


def returns_axis(panel: Axes, domain: str, tasks: Sequence[str]) -> None:
    """The vertical axis of returns: up to the largest possible, where that is known for all tasks."""
    if domain in DOMAINS and set(tasks) <= set(DOMAINS[domain].tasks):
        panel.set_ylim(0, DOMAINS[domain].max_return)


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


def _draw_panel(panel: Axes, runs: Runs, task: str, shown: Mapping[str, dict[str, Any]]) -> None:
    for milestone in runs.milestones:
        panel.axvline(milestone, color="#B0B0B0", linewidth=0.8, linestyle=":", zorder=0)
    for method, look in shown.items():
        records = runs.records.get((method, task))
        if records:
            draw_line(panel, *curve(records), look)
    draw_references(panel, task, runs.references)
    panel.set_title(task)
    steps_axis(panel, "gradient steps", (record.final.step for records in runs.records.values() for record in records))
    returns_axis(panel, runs.domain, runs.tasks)


def _handle(method: str, look: dict[str, Any]) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return Patch(label=method, **look) if "facecolor" in look else Line2D([], [], label=method, linewidth=1.6, **look)


def _saved(figure: Figure, kind: str, metadata: dict[str, None]) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format=kind, metadata=metadata)
    return file.getvalue()
