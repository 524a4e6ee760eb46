"""Tables as Markdown, LaTeX, CSV and for the terminal. Text from records is escaped in each of them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cudc_bench.artefacts.references import Bounds
from cudc_bench.text import escape_markdown, plain, templates

from ..datasets.diagnostics import Comparison
from ..numbers.overall import LEAD, NAMES, PAIRS_CAPTION, PRELIMINARY, Estimate, Overall, Pair
from ..numbers.power import FOUND
from ..numbers.published import PaperTable
from ..numbers.statistics import Interval
from ..numbers.table import Cell, Table
from ..numbers.words import short

if TYPE_CHECKING:
    from rich.console import Group


_TEX = {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", **{c: f"\\{c}" for c in "&%$#_{}"},
}  # fmt: skip


def to_markdown(table: Table) -> str:
    """A heading, one GitHub-flavoured table for each milestone, the caption, and the commands that make the records again."""
    return _render("table.md.j2", escape_markdown, table=table)


def to_latex(table: Table) -> str:
    """A ``table`` environment with the caption; its document needs ``\\usepackage{booktabs}``."""
    return _render("table.tex.j2", escape_latex, table=table)


def to_csv(table: Table) -> str:
    """One line for each cell in full precision; a missing cell has 0 seeds and neither mean nor standard deviation.

    ``floor``, ``untrained`` and ``ceiling`` are those of the task's reference, ``score`` and ``score_std`` the mean and its standard
    deviation between floor and ceiling; empty where a task has no reference.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "domain", "milestone", "task", "method", "mean", "std", "seeds", "best", "floor", "untrained",
                     "ceiling", "score", "score_std"])  # fmt: skip
    for section in table.sections:
        for row in section.rows:
            bounds = table.references.get(row.task)
            of_task = [bounds.floor, bounds.untrained, bounds.ceiling] if bounds else [None] * 3
            for method, cell in zip(table.methods, row.cells, strict=True):
                values = [cell.mean, cell.std, cell.n, cell.best] if cell else [None, None, 0, False]
                scored = cell.scored(bounds) if cell and bounds else None
                scores = [scored.mean, scored.std] if scored else [None, None]
                where = [table.group, table.algorithm, table.domain, section.milestone, row.task, method]
                writer.writerow([*where, *values, *of_task, *scores])
    return text.getvalue()


_SIDE_BY_SIDE = 6


def to_rich(table: Table) -> Group:
    """For a terminal: title, table and caption; ``rich`` objects throughout, so that nothing in a record is taken for markup.

    Tasks are the rows as in the files, but methods are where there are too many of them to stand side by side in 80 columns.
    """
    from rich import box
    from rich.console import Group
    from rich.table import Table as Grid
    from rich.text import Text

    shown = Grid(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    shown.add_column("")
    turned = len(table.headings) > _SIDE_BY_SIDE
    for name in table.tasks if turned else table.headings:
        shown.add_column(Text(name), justify="right")

    def block(title: str, tasks: Sequence[str], rows: Sequence[Sequence[tuple[str, bool]]]) -> None:
        shown.add_row(Text(title, style="bold"))
        cells = [[Text(text, style="bold" if best else "") for text, best in row] for row in rows]
        for name, line in zip(table.headings if turned else tasks, zip(*cells, strict=True) if turned else cells, strict=True):
            shown.add_row(Text(name), *line)
        shown.add_section()

    for section in table.sections:
        rows, scores = [], []
        for row in section.rows:
            bounds = table.references.get(row.task)
            marks = [bool(cell and cell.best) for cell in row.cells]
            ends = [(str(round(end)) if bounds else "–", False) for end in ((bounds.floor, bounds.ceiling) if bounds else (0.0, 0.0))]
            texts = list(zip(map(_text, row.cells), marks, strict=True))
            rows.append([ends[0], *texts, ends[1]] if table.references else texts)
            scored = [score(cell, bounds, "±") if cell and bounds else "–" for cell in row.cells]
            scores.append(
                [("0", False), *zip(scored, marks, strict=True), ("1", False)] if bounds else [("–", False)] * len(table.headings)
            )
        block(f"{short(section.milestone)} steps", table.tasks, rows)
        if table.references:
            block(f"{short(section.milestone)} steps, scores", table.tasks, scores)
    title = Text(f"{table.domain}, {table.algorithm}, profile {table.group}", style="bold")
    return Group(title, shown, Text(table.caption, style="dim"))


def score(cell: Cell, bounds: Bounds, plus_minus: str) -> str:
    """A cell's mean and standard deviation between a floor and a ceiling."""
    found = cell.scored(bounds)
    return f"{found.mean + 0.0:.2f}" + ("" if found.std is None else f"{plus_minus}{found.std:.2f}")


def paper_to_markdown(paper: PaperTable) -> str:
    """Our cells beside the paper's, a table for each milestone."""
    return _render("paper.md.j2", escape_markdown, paper=paper)


def paper_to_latex(paper: PaperTable) -> str:
    """The same as one table for ``booktabs``."""
    return _render("paper.tex.j2", escape_latex, paper=paper)


def paper_to_csv(paper: PaperTable) -> str:
    """One line for each cell that the paper has, too, in full precision."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "domain", "milestone", "task", "method", "mean", "std", "seeds", "paper_mean", "paper_std",
                     "difference_in_paper_std", "floor", "ceiling"])  # fmt: skip
    table = paper.table
    for row in paper.rows:
        bounds = table.references.get(row.task)
        ends = [bounds.floor, bounds.ceiling] if bounds else [None, None]
        values = [row.ours.mean, row.ours.std, row.ours.n, *row.paper, row.difference, *ends]
        writer.writerow([table.group, table.algorithm, table.domain, row.milestone, row.task, row.method, *values])
    return text.getvalue()


def overall_to_markdown(overall: Overall) -> str:
    """For each comparison its aggregates, the probabilities of improvement and what was left out."""
    return _render("overall.md.j2", escape_markdown, overall=overall, names=NAMES, pairs_caption=PAIRS_CAPTION,
                   estimate=_estimate, chance=_chance)  # fmt: skip


def overall_to_latex(overall: Overall) -> str:
    """A table of all comparisons' aggregates and one of the headline's probabilities of improvement, for ``booktabs``."""
    return _render("overall.tex.j2", escape_latex, overall=overall, names=NAMES, pairs_caption=PAIRS_CAPTION,
                   estimate=_estimate, chance=lambda pair: f"{pair.probability:.2f}")  # fmt: skip


def overall_to_csv(overall: Overall) -> str:
    """One line for each number in full precision, with its intervals where it has them.

    ``statistic`` is one of the aggregates, ``probability_of_improvement`` (over ``other``), or ``rank_<i>`` (its probability). ``seeds``
    are the collector seeds in the domain with the fewest, ``datasets`` those of all domains.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "scope", "milestone", "tasks", "method", "seeds", "datasets", "statistic", "other", "value",
                     "low", "high", "stratified_low", "stratified_high", "p", "p_holm", "improvement"])  # fmt: skip
    for comparison in overall.comparisons:
        head = [overall.group, overall.algorithm, comparison.scope, comparison.milestone, len(comparison.tasks)]
        for standing in comparison.standings:
            who = [*head, standing.method, standing.n, sum(standing.counts)]
            for name, found in standing.estimates.items():
                writer.writerow([*who, name, None, found.value, *_ends(found.interval), *_ends(found.stratified), None, None, None])
            for rank, share in enumerate(standing.ranks or (), 1):
                writer.writerow([*who, f"rank_{rank}", None, share, *[None] * 7])
            for pair in comparison.pairs:
                if pair.method == standing.method:
                    tested = [pair.p, pair.holm, None if pair.p is None else pair.better]
                    name = "probability_of_improvement"
                    writer.writerow([*who, name, pair.other, pair.probability, *_ends(pair.interval), None, None, *tested])
    return text.getvalue()


def scores_to_csv(overall: Overall) -> str:
    """One line for each run that entered a comparison: its return, and that divided by the task's largest."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "scope", "milestone", "domain", "task", "method", "seed", "return", "score"])
    for comparison in overall.comparisons:
        head = [overall.group, overall.algorithm, comparison.scope, comparison.milestone]
        for standing in comparison.standings:
            for domain, returns, scores in zip(comparison.domains, standing.returns, standing.scores, strict=True):
                tasks = [task for one, task in comparison.tasks if one == domain]
                for task, *columns in zip(tasks, returns.T, scores.T, strict=True):
                    for seed, found, score in zip(standing.seeds[domain], *columns, strict=True):
                        writer.writerow([*head, domain, task, standing.method, seed, float(found), float(score)])
    return text.getvalue()


def power_to_csv(overall: Overall) -> str:
    """One line for each number of seeds: what the headline's test can find with them; no lines where that is not known."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["group", "algorithm", "scope", "milestone", "seeds", "own", "comparisons", "least_p", "least_p_holm", "found_in",
                     "lead_score", "lead_points", "deviation", "deviation_low", "deviation_high", "degrees_of_freedom"])  # fmt: skip
    if (power := overall.power) is not None:
        headline = overall.headline
        where = [overall.group, overall.algorithm, headline.scope, headline.milestone]
        measured = [power.deviation, *_ends(power.within), power.freedom]
        for one in power.designs:
            points = None if one.lead is None or headline.points is None else one.lead * headline.points
            design = [one.seeds, one.seeds == power.own, power.comparisons, one.least, one.corrected, FOUND, one.lead, points]
            writer.writerow([*where, *design, *measured])
    return text.getvalue()


def overall_to_rich(overall: Overall) -> Group:
    """For a terminal: the headline comparison, the mean with its interval first."""
    from rich import box
    from rich.console import Group
    from rich.table import Table as Grid
    from rich.text import Text

    comparison = overall.headline
    shown = Grid(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    shown.add_column("")
    for name in ("mean", "95 % interval", "IQM", "median", "gap", "P(rank 1)", "seeds"):
        shown.add_column(name, justify="right")
    for standing in comparison.standings:
        headline = standing.estimates[LEAD]
        rest = [f"{standing.estimates[name].value:.3f}" for name in ("iqm", "median", "optimality_gap")]
        first = "–" if standing.ranks is None else f"{standing.ranks[0]:.2f}"
        row = (standing.method, f"{headline.value:.3f}", _bracketed(headline.interval) or "–", *rest, first, standing.seeds_text)
        shown.add_row(*map(Text, row))
    wins = [f"{pair.method} over {pair.other} ({_chance(pair)})" for pair in comparison.pairs if pair.better]
    lines = [
        f"Scores: {comparison.unit}. IQM: mean without the lowest and highest quarter of runs; gap: mean of max(0, 1 - score).",
        f"Improvements (interval above 0.5, Holm's p < 0.05): {len(wins)}{f', such as {wins[-1]}' if wins else ''}.",
        *comparison.remarks,
        *([overall.power_text] if overall.power_text else []),
        *([PRELIMINARY] if comparison.preliminary else []),
        *(f"Left out: {line}" for line in comparison.left_out),
    ]
    title = Text(f"Overall: {overall.algorithm}, profile {overall.group}: {comparison.title}", style="bold")
    return Group(title, shown, Text("\n".join(lines), style="dim"))


REPRESENTATION_COLUMNS = {"error_over_persistence": "error", "effective_rank": "rank", "state_spread": "spread"}


def diagnostics_to_rich(comparison: Comparison) -> Group:
    """For a terminal: a line for each dataset, with k at the end, when it grew, whether that is suspect, and the last coverage.

    Where some have a representation, also its last forward error over persistence, effective rank and spread.
    """
    from rich import box
    from rich.console import Group
    from rich.table import Table as Grid
    from rich.text import Text

    shown = Grid(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, collapse_padding=True)
    measured = REPRESENTATION_COLUMNS if comparison.having(REPRESENTATION_COLUMNS) else {}
    for name in ("method", "seed", "steps", "k", "k grew", "suspect", "cells", "entropy", *measured.values()):
        shown.add_column(name, justify="left" if name in {"method", "k grew", "suspect"} else "right")
    for run in comparison.runs:
        cells, entropy = run.last("coverage_cells"), run.last("coverage_entropy")
        # Only methods whose k can grow tell whether its schedule is suspect.
        adapts = "k_schedule_suspect" in run.manifest.diagnostics
        row = (
            plain(run.manifest.method), str(run.manifest.seed), f"{run.manifest.steps:,}", "" if run.k is None else f"{run.k:g}",
            "\n".join(map(str, run.manifest.k_growth)),
            ("yes" if run.manifest.has_suspect_schedule else "no") if adapts else "",
            "" if cells is None else f"{cells:,.0f}", "" if entropy is None else f"{entropy:.2f}",
            *("" if (value := run.last(name)) is None else f"{value:.3g}" for name in measured),
        )  # fmt: skip
        shown.add_row(*(Text(cell or "–") for cell in row))
    return Group(Text(f"{comparison.domain}, profile {comparison.group}", style="bold"), shown)


def escape_latex(text: str) -> str:
    """Text that LaTeX shows as it is; characters beyond ASCII, which a font may lack, by their numbers."""
    ascii_only = plain(text).encode("ascii", "backslashreplace").decode()
    escaped = "".join(_TEX.get(c, c) for c in ascii_only)
    return re.sub("-(?=-)", "-{}", escaped)  # Two hyphens would become a dash.


def _text(cell: Cell | None) -> str:
    if cell is None:
        return "–"
    spread = "" if cell.std is None else f"±{round(cell.std)}"
    return f"{round(cell.mean)}{spread} ({cell.n})"


def _estimate(estimate: Estimate) -> str:
    stratified = f" {{{_ends_text(estimate.stratified)}}}" if estimate.stratified else ""
    return " ".join(filter(None, (f"{estimate.value:.3f}", _bracketed(estimate.interval)))) + stratified


def _chance(pair: Pair) -> str:
    return f"{pair.probability:.2f}" + (f" [{pair.interval.low:.2f}, {pair.interval.high:.2f}]" if pair.interval else "")


def _bracketed(interval: Interval | None) -> str:
    return f"[{_ends_text(interval)}]" if interval else ""


def _ends_text(interval: Interval) -> str:
    return f"{interval.low:.3f}, {interval.high:.3f}"


def _ends(interval: Interval | None) -> tuple[float | None, float | None]:
    return (interval.low, interval.high) if interval else (None, None)


def _render(template: str, escape: Callable[[str], str], **values: Any) -> str:
    environment = templates(Path(__file__).with_name("templates"), escape)
    return environment.get_template(template).render(round=round, short=short, score=score, **values)
