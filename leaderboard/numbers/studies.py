"""The studies that records allow, beside the main tables: the paper's other tables and figures, and what they lack.

Each study is of one group, algorithm and domain, except for that of learners, which is of one group. It exists as soon as there is a record
of a method (or a size, or a second learner) that is its own; what it then lacks is in :attr:`~.study.Study.wanted`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from cudc_bench.artefacts.records import Record
from cudc_bench.text import plain

from ..methods import BASELINES, canonical
from . import statistics
from .components import build_components
from .figures import Bars, Bounds, Curves, Figure
from .grid import Column, Entry, Grid, Line, Part, with_records
from .learners import build_learners
from .missing import Wanted
from .overall import Overall
from .published import CITATION, MEAN, beside, caption, reported_relative, scale
from .scale import LABELS, references_caption
from .sizes import LABEL_BUDGETS, build_sizes
from .study import SCORE, Study, alias_notes, known_tasks, of_seeds, reference_lines, scales_of, score_entry, score_matrix, scored_grid
from .study_specs import SPECS, StudySpec
from .table import ENOUGH_SEEDS, Block, Runs, build_cell, mark_best
from .words import ordered, short

_MARKS = (
    " Mean and sample standard deviation over collector seeds, whose number is in brackets. Bold in each task: the largest mean and those"
    " that are not significantly worse (Welch, Holm, as in the main table)."
)
_RELATIVE = (
    "Score divided by CUDC's on the same task: a ratio of means over collector seeds. Mean: of the ratios, over the domain's tasks and the"
    " seeds that have all of them. In square brackets: 95 % intervals by Student's t over both methods' datasets (jackknife); the whole of"
    " an interval below 1 says that the part matters."
)


def build_studies(blocks: Sequence[Block], overall: Sequence[Overall]) -> list[Study]:
    """All studies that have begun.

    Args:
        blocks: as ``build_blocks`` returns them.
        overall: as ``build_overall`` makes them of the same records.

    Returns:
        By domain, algorithm and group in the order of :data:`~.study_specs.SPECS`; then those of sizes, labels, learners, and of
        variance between datasets and between trainings.
    """
    found = [study for block in blocks for spec in SPECS if (study := _of_spec(block, spec)) is not None]
    return [*found, *build_sizes(blocks), *build_sizes(blocks, LABEL_BUDGETS), *build_learners(blocks, overall), *build_components(blocks)]


def _of_spec(block: Block, spec: StudySpec) -> Study | None:
    theirs = {canonical(label): label for label in spec.methods}
    chosen = {(theirs[method], task): found for (method, task), found in block.records.items() if method in theirs}
    records = tuple(one for found in chosen.values() for one in found)
    if not any(one.dataset.method in spec.own for one in records):
        return None
    runs = _runs(block, spec, chosen)
    returns = _returns(runs)
    tables = [returns, *scored_grid(returns, runs.tasks, runs.references)]
    if spec.relative and (relative := _relative(runs)):
        tables = [relative, *tables, *_beside_relative(runs, relative)]
    tables += _beside(runs, spec)
    figures: dict[str, Figure] = {"bars": Bars(runs), "curves": Curves(runs)}
    if spec.bounds:
        figures["bound"] = Bounds(runs, dict(zip(spec.methods, spec.bounds, strict=True)))
    preliminary = any(cell.n < ENOUGH_SEEDS for cell in runs.cells.values())
    notes = [
        note
        for label in runs.methods
        for note in alias_notes(label, [one for (method, _), found in chosen.items() if method == label for one in found])
    ]
    return Study(
        name=spec.name,
        folder=block.slug,
        title=spec.title,
        caption=f"{spec.about} {runs.algorithm} on {runs.domain}. Profile: {runs.group}."
        + (" Preliminary: fewer than five seeds." if preliminary else ""),
        group=runs.group,
        algorithm=block.algorithm,
        domain=block.domain,
        tables=tuple(tables),
        figures=figures,
        notes=tuple(notes),
        records=records,
        wanted=_wanted(block, spec, runs),
    )


def _runs(block: Block, spec: StudySpec, chosen: dict[tuple[str, str], Sequence[Record]]) -> Runs:
    methods = tuple(label for label in spec.methods if any(method == label for method, _ in chosen))
    tasks = ordered({task for _, task in chosen}, block.tasks)
    cells: dict[tuple[int, str, str], Entry] = {}
    for milestone in block.milestones:
        for task in tasks:
            row = mark_best([build_cell(chosen.get((method, task), ()), milestone) for method in methods])
            cells |= {(milestone, task, method): cell for method, cell in zip(methods, row, strict=True) if cell}
    references = {task: block.references[task] for task in tasks if task in block.references}
    return Runs(plain(block.group), block.algorithm, block.domain, methods, tasks, block.milestones, chosen, cells, references)


def _by_task(runs: Runs, method: str) -> dict[str, Sequence[Record]]:
    return {task: runs.records.get((method, task), ()) for task in runs.tasks}


def _heading(milestone: int) -> str:
    return f"{short(milestone)} steps"


def _returns(runs: Runs) -> Grid:
    scales = scales_of(runs.domain, runs.references)
    known = bool(scales.tasks)
    parts = []
    for milestone in runs.milestones:
        lines = []
        for method in runs.methods:
            entries = [with_records(runs.cells.get((milestone, task, method)), runs.records.get((method, task), ())) for task in runs.tasks]
            if known:
                entries.append(score_entry(_by_task(runs, method), scales, milestone))
            lines.append(Line((method,), tuple(entries)))
        lines += reference_lines(runs.references, runs.tasks, int(known))
        parts.append(Part(_heading(milestone), milestone, tuple(lines)))
    return Grid(
        name="returns",
        title="Returns",
        caption=f"Returns of {runs.algorithm} on {runs.domain} after so many gradient steps.{_MARKS}{f' {scales.text}' if known else ''}"
        f"{references_caption(runs.references, runs.tasks)}",
        split="milestone",
        head=("method",),
        columns=(*map(Column, runs.tasks), *([Column(SCORE, 3)] if known else [])),
        parts=tuple(parts),
    )


def _relative(runs: Runs) -> Grid | None:
    if "cudc" not in runs.methods:
        return None
    tasks = known_tasks(runs.domain)
    columns = (*map(partial(Column, digits=3), runs.tasks), *([Column(MEAN, 3)] if tasks else []))
    others = [method for method in runs.methods if method != "cudc"]
    parts = []
    for milestone in runs.milestones:
        lines = []
        for method in others:
            entries = [_ratio(runs, method, (task,), milestone) for task in runs.tasks]
            if tasks:
                entries.append(_ratio(runs, method, tasks, milestone))
            lines.append(Line((method,), tuple(entries)))
        if runs.references:
            lines += _ends_relative(runs, milestone, [*((task,) for task in runs.tasks), *([tasks] if tasks else [])])
        parts.append(Part(_heading(milestone), milestone, tuple(lines)))
    return Grid("relative", "Relative to CUDC", _RELATIVE, "milestone", ("method",), columns, tuple(parts))


def _ratio(runs: Runs, method: str, tasks: Sequence[str], milestone: int) -> Entry | None:
    """The score of a method as a share of CUDC's, over seeds of either that have all of some tasks; ``n`` is the smaller number of them."""
    ours, cudc = _by_task(runs, method), _by_task(runs, "cudc")
    (seeds, above), (cudc_seeds, below) = (score_matrix(one, tasks, milestone) for one in (ours, cudc))
    if not seeds or not cudc_seeds or (value := statistics.relative(above, below)) is None:
        return None
    interval = statistics.relative_interval(above, below)
    records = (*of_seeds(ours, tasks, seeds), *of_seeds(cudc, tasks, cudc_seeds))
    return Entry(value, None, interval, min(len(seeds), len(cudc_seeds)), False, records)


def _ends_relative(runs: Runs, milestone: int, columns: Sequence[Sequence[str]]) -> list[Line]:
    """Floor and ceiling as a share of CUDC's score, the mean over the tasks of each column."""
    cudc = _by_task(runs, "cudc")
    lines = []
    for name, label in LABELS.items():
        entries: list[Entry | None] = []
        for tasks in columns:
            seeds, below = score_matrix(cudc, tasks, milestone)
            value = None
            if seeds and all(task in runs.references for task in tasks):
                ends = [getattr(runs.references[task], name) for task in tasks]
                value = statistics.relative(np.array([ends], np.float64), below)
            entries.append(None if value is None else Entry(value))
        lines.append(Line((label,), tuple(entries)))
    return lines


def _beside(runs: Runs, spec: StudySpec) -> list[Grid]:
    """The paper's returns beside ours, if it has those of a method that is the study's own."""
    parts, own = [], False
    for milestone in runs.milestones:
        lines = []
        for task in runs.tasks:
            for method in runs.methods:
                found = beside(runs.algorithm, runs.domain, milestone, task, method, runs.cells.get((milestone, task, method)))
                if found:
                    own |= method in spec.own
                    ours, *others = found.entries
                    lines.append(Line(found.labels, (with_records(ours, runs.records[method, task]), *others)))
        if lines:
            parts.append(Part(_heading(milestone), milestone, tuple(lines)))
    if not own:
        return []
    columns = (Column("here"), Column("reported in the paper"), Column("difference", 1, signed=True))
    return [Grid("paper", "Beside the paper", caption(runs.group), "milestone", ("task", "method"), columns, tuple(parts), long=True)]


def _beside_relative(runs: Runs, relative: Grid) -> list[Grid]:
    parts = []
    for part in relative.parts:
        lines = []
        for line in part.lines:
            for column, entry in zip(relative.columns, line.entries, strict=True):
                paper = reported_relative().get((runs.algorithm, runs.domain, column.name, line.labels[0], int(part.key)))
                if entry and paper is not None:
                    lines.append(Line((column.name, line.labels[0]), (entry, Entry(paper), Entry(entry.value - paper))))
        if lines:
            parts.append(Part(part.title, part.key, tuple(lines)))
    if not parts:
        return []
    text = f"{scale(runs.group)} Relative to CUDC: here with 95 % intervals as above; the paper gives none. Source: {CITATION}."
    columns = (Column("here", 3), Column("reported in the paper", 3), Column("difference", 3, signed=True))
    return [Grid("paper", "Beside the paper", text, "milestone", ("task", "method"), columns, tuple(parts), long=True)]


def _wanted(block: Block, spec: StudySpec, runs: Runs) -> tuple[Wanted, ...]:
    """Every method of the spec on all tasks, with the collector seeds that its own methods have."""
    own = [
        one
        for method in spec.own
        for task in runs.tasks
        for one in runs.records.get((method, task), ())
        if canonical(method) not in BASELINES or one.dataset.method == method
    ]
    seeds = tuple(sorted({one.dataset.seed for one in own}))
    # A user's own reward has no other tasks.
    tasks = runs.tasks if own[0].dataset.reward is not None else ordered({*known_tasks(block.domain), *runs.tasks}, block.tasks)
    return tuple(
        Wanted(
            study=spec.name,
            group=block.group,
            algorithm=block.algorithm,
            domain=block.domain,
            method="cudc" if canonical(method) == "cudc" else method,
            tasks=tasks,
            seeds=seeds,
            used=own[0].dataset.used,
            have=frozenset((task, one.dataset.seed) for task in runs.tasks for one in runs.records.get((method, task), ())),
            like=own[0],
        )
        for method in spec.methods
    )
