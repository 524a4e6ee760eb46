"""The study of dataset sizes: the same training on the first transitions of each dataset, and on all of them; and that of labels: the same
training without rewards, told of its tasks by fewer labelled transitions or by more.

Joined is what differs in nothing but how much of a dataset was used, or how many labels. The *area under the curve* is that of the score
(see :mod:`.scale`) over log10 of the number of transitions, by the trapezoidal rule between the smallest and the largest
size, divided by the distance of these two. So it is a mean score in which a doubling of the data weighs the same wherever
it is. Each collector seed has an area of its own; means and intervals are over those.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from cudc_bench.artefacts.records import LABELS, Record
from cudc_bench.text import plain

from ..methods import METHOD_ORDER
from .columns import column, is_own
from .figures import Sizes
from .grid import Column, Entry, Grid, Line, Part, with_records
from .missing import Wanted
from .scale import References, references_caption
from .statistics import Floats
from .study import SCORE, ByTask, Scales, Study, known_tasks, of_seeds, reference_lines, scales_of, score_entry, score_matrix, scored_grid
from .table import ENOUGH_SEEDS, Block, build_cell, mark_best
from .words import ordered, short, slug, span

AREA_TEXT = (
    "Area under the curve of scores over log10 of the number of {unit}, by the trapezoidal rule between the smallest and the largest,"
    " divided by the distance of these two: a mean score in which a doubling weighs the same everywhere. Each collector seed has its own"
    " area, if it has all of them."
)


@dataclass(frozen=True)
class Amount:
    """What a study of this kind has more of and less of.

    Attributes:
        study, title, lead: the study's name, its title, and the first sentence of its caption.
        unit: of the amounts, in the plural.
        of: a record's amount.
        is_part: whether a record is of another amount than the usual one.
        group: that of the same record with the usual amount.
        on: how a training has such an amount, in a caption.
    """

    study: str
    title: str
    lead: str
    unit: str
    of: Callable[[Record], int]
    is_part: Callable[[Record], bool]
    group: Callable[[Record], str]
    on: str


def _labels(record: Record) -> int:
    return 0 if record.zero_shot is None else record.zero_shot.labels


SIZES = Amount(
    "sizes", "Dataset size", "The paper's study of sample efficiency: trained on the first so many transitions of each dataset.",
    "transitions", lambda record: record.dataset.used or record.dataset.steps, lambda record: record.dataset.used is not None,
    lambda record: record.group_of_all_sizes, "on the first so many transitions",
)  # fmt: skip
LABEL_BUDGETS = Amount(
    "labels", "Labels", "How many labelled transitions a learner without rewards needs to be told a task: the same trainings, asked with"
    " so many labels.", "labels", _labels, lambda record: _labels(record) not in (0, LABELS), lambda record: record.group_of_all_labels,
    "told of each task by so many labelled transitions",
)  # fmt: skip
_WHOLE = " They are those of the whole datasets' profile at every size: neither is trained on a part of a dataset."


def area_weights(sizes: Sequence[int]) -> Floats:
    """Weights of the scores at ascending sizes whose sum is the area under the curve; they add up to 1."""
    x = np.log10(np.asarray(sizes, np.float64))
    steps = np.diff(x)
    weights = np.zeros(len(x))
    weights[:-1] += steps / 2
    weights[1:] += steps / 2
    return weights / (x[-1] - x[0])


def build_sizes(blocks: Sequence[Block], amount: Amount = SIZES) -> list[Study]:
    """A study for each group, algorithm and domain in which something was trained on a part of a dataset, or told fewer labels or more."""
    together: dict[tuple[str, str, str], list[Block]] = defaultdict(list)
    for block in blocks:
        together[block.domain, block.algorithm, amount.group(_first(block))].append(block)
    found = []
    for (_, _, group), same in sorted(together.items()):
        if any(amount.is_part(_first(one)) for one in same):
            whole = next((one.references for one in same if not amount.is_part(_first(one))), {})
            found.append(_study(amount, group, same, whole))
    return [study for study in found if study is not None]


def _first(block: Block) -> Record:
    return next(iter(block.records.values()))[0]


# Records by size, method and task.
_Chosen = dict[tuple[int, str], dict[str, list[Record]]]


def _study(amount: Amount, group: str, blocks: Sequence[Block], references: References) -> Study | None:
    lasts = Counter(block.milestones[-1] for block in blocks)
    milestone = max(lasts, key=lambda last: (lasts[last], last))
    left_out = [
        f"{plain(block.group)} is left out: {short(milestone)} steps is none of its milestones."
        for block in blocks
        if milestone not in block.milestones
    ]
    chosen = _chosen(amount, [block for block in blocks if milestone in block.milestones])
    if not chosen:
        return None
    shown, scales = _shown(amount, group, chosen, blocks[0], milestone, references)
    returns = _returns(amount, shown, chosen, scales)
    tables = [returns, *scored_grid(returns, shown.tasks, shown.references)]
    areas, lines = _areas(amount, shown, chosen, scales)
    if areas:
        tables.append(areas)
    preliminary = any(cell.n < ENOUGH_SEEDS for cell in shown.cells.values())
    return Study(
        name=amount.study,
        folder=slug(group, shown.algorithm, shown.domain),
        title=amount.title,
        caption=f"{amount.lead} {shown.algorithm} on"
        f" {shown.domain} after {short(milestone)} gradient steps. Profile: {shown.group}."
        + (" Preliminary: fewer than five seeds." if preliminary else ""),
        group=shown.group,
        algorithm=shown.algorithm,
        domain=shown.domain,
        tables=tuple(tables),
        figures={"curves": shown},
        notes=(*left_out, *lines),
        records=tuple(_records(chosen)),
        # One training gives the records of all numbers of labels, so that no command is needed for some of them.
        wanted=_wanted(group, blocks, shown, chosen) if amount is SIZES else (),
    )


def _chosen(amount: Amount, blocks: Sequence[Block]) -> _Chosen:
    """What was made with each amount, of methods of which there is more than the usual one."""
    columns = [(method, one) for block in blocks for (method, _), found in block.records.items() for one in found]
    cut = {method for method, one in columns if amount.is_part(one)}
    chosen: _Chosen = defaultdict(lambda: defaultdict(list))
    for method, one in columns:
        if method in cut:
            chosen[amount.of(one), method][one.dataset.task].append(one)
    return chosen


def _records(chosen: _Chosen) -> Iterator[Record]:
    for by_task in chosen.values():
        for found in by_task.values():
            yield from found


def _shown(amount: Amount, group: str, chosen: _Chosen, first: Block, milestone: int, references: References) -> tuple[Sizes, Scales]:
    """The returns and mean scores at each size, and by what they became scores."""
    methods = ordered({method for _, method in chosen}, METHOD_ORDER)
    sizes = tuple(sorted({size for size, _ in chosen}))
    tasks = ordered({one.dataset.task for one in _records(chosen)}, known_tasks(first.domain))
    served = {task: references[task] for task in tasks if task in references}
    scales = scales_of(first.domain, served)
    cells: dict[tuple[int, str, str], Entry] = {}
    scores: dict[tuple[int, str], Entry] = {}
    for size in sizes:
        for task in tasks:
            row = mark_best([build_cell(chosen[size, method][task], milestone) for method in methods])
            cells |= {(size, task, method): cell for method, cell in zip(methods, row, strict=True) if cell}
        for method in methods:
            if entry := score_entry(chosen[size, method], scales, milestone):
                scores[size, method] = entry
    seeds = span([cell.n for cell in cells.values()] or [0], "seed")
    shown = Sizes(plain(group), first.algorithm, first.domain, milestone, methods, tasks, sizes, cells, scores, seeds, served, amount.unit)
    return shown, scales


def _returns(amount: Amount, shown: Sizes, chosen: _Chosen, scales: Scales) -> Grid:
    known = bool(scales.tasks)
    parts = []
    for size in shown.sizes:
        lines = []
        for method in shown.methods:
            entries = [with_records(shown.cells.get((size, task, method)), chosen[size, method][task]) for task in shown.tasks]
            lines.append(Line((method,), (*entries, *([shown.scores.get((size, method))] if known else []))))
        lines += reference_lines(shown.references, shown.tasks, int(known))
        parts.append(Part(f"{short(size)} {amount.unit}", size, tuple(lines)))
    return Grid(
        name="returns",
        title=f"Returns by {'dataset size' if amount is SIZES else amount.unit}",
        caption=f"Returns of {shown.algorithm} after {short(shown.milestone)} gradient steps {amount.on}. Mean and"
        " sample standard deviation over collector seeds, whose number is in brackets. Bold in each task: the largest mean and those that"
        f" are not significantly worse (Welch, Holm, as in the main table).{f' {scales.text}' if known else ''}"
        f"{references_caption(shown.references, shown.tasks)}{_WHOLE if shown.references and amount is SIZES else ''}",
        split=amount.unit,
        head=("method",),
        columns=(*map(Column, shown.tasks), *([Column(SCORE, 3)] if known else [])),
        parts=tuple(parts),
    )


def _areas(amount: Amount, shown: Sizes, chosen: _Chosen, scales: Scales) -> tuple[Grid | None, list[str]]:
    known = known_tasks(shown.domain)
    having = {method: tuple(size for size in shown.sizes if any(chosen[size, method].values())) for method in shown.methods}
    # The sizes that most methods have, so that one that lacks some, or has others, takes nothing from the rest.
    counts = Counter(having.values())
    sizes = max(counts, key=lambda one: (counts[one], len(one), one))
    if not known or len(sizes) < 2:
        return None, []
    weights = area_weights(sizes)
    notes, lines = [], []
    for method in shown.methods:
        lacking = [short(size) for size in sizes if size not in having[method]]
        if lacking:
            notes.append(f"{method} has no area under the curve: it lacks {', '.join(lacking)} {amount.unit}.")
            continue
        entries = []
        for tasks in (*((task,) for task in shown.tasks), known):
            entries.append(_area(shown, [chosen[size, method] for size in sizes], tasks, scales, weights))
        lines.append(Line((method,), tuple(entries)))
    heading = f"{short(sizes[0])} to {short(sizes[-1])} {amount.unit} ({len(sizes)} {'sizes' if amount is SIZES else 'numbers'})"
    caption = f"{AREA_TEXT.format(unit=amount.unit)} Mean over seeds. {scales.text}"
    columns = (*map(partial(Column, digits=3), shown.tasks), Column(SCORE, 3))
    part = Part(heading, f"{sizes[0]}-{sizes[-1]}", tuple(lines))
    return Grid("area", "Area under the curve", caption, amount.unit, ("method",), columns, (part,)), notes


def _area(shown: Sizes, records: Sequence[ByTask], tasks: Sequence[str], scales: Scales, weights: Floats) -> Entry | None:
    """The mean of the seeds' areas over some tasks, over seeds that have all sizes and tasks."""
    if not set(tasks) <= set(scales.tasks):
        return None
    found = [score_matrix(one, tasks, shown.milestone) for one in records]
    seeds = sorted(set.intersection(*(set(seeds) for seeds, _ in found)))
    if not seeds:
        return None
    returns = np.stack([returns[[having.index(seed) for seed in seeds]] for having, returns in found])
    areas = np.tensordot(weights, scales.scores(returns, tasks), 1)
    return scales.mean_entry(areas, tasks, tuple(record for one in records for record in of_seeds(one, tasks, seeds)))


def _wanted(group: str, blocks: Sequence[Block], shown: Sizes, chosen: _Chosen) -> tuple[Wanted, ...]:
    """Every size that some method has, for every method with the seeds that were trained on a part of a dataset."""
    own = [one for one in _records(chosen) if is_own(one)]
    if not own:
        return ()
    seeds = tuple(sorted({one.dataset.seed for one in own if one.dataset.used}))
    collected = {column(one) for one in own}
    tasks = shown.tasks if own[0].dataset.reward is not None else ordered({*known_tasks(shown.domain), *shown.tasks}, shown.tasks)
    whole = {one.dataset.steps for one in own}
    groups = {_first(block).dataset.used: block.group for block in blocks}

    def wanted(size: int, method: str) -> Wanted:
        used = None if size in whole else size
        return Wanted(
            study="sizes",
            group=groups.get(used, group),
            algorithm=shown.algorithm,
            domain=shown.domain,
            method=method,
            tasks=tasks,
            seeds=seeds,
            used=used,
            have=frozenset((task, one.dataset.seed) for task, found in chosen[size, method].items() for one in found),
            like=own[0],
        )

    sizes = sorted({one.dataset.used or one.dataset.steps for one in own})
    return tuple(wanted(size, method) for size in sizes for method in shown.methods if method in collected)
