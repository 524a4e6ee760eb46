"""How much of the spread of returns is between datasets, and how much between trainings on one dataset.

A one-way random-effects analysis of variance: a return is its method's mean, plus what is peculiar to the dataset, plus what is peculiar to
the training. Estimates are those of the mean squares' expectations (Searle, Casella and McCulloch 1992, "Variance Components", section 3.6,
for datasets with different numbers of trainings); one between datasets may come out negative. The interval within is that of a normal
variance; that between is Williams's and Tukey's (Williams 1962, Biometrika 49) on unweighted means of datasets, as Thomas and Hultquist
(1978, Annals of Statistics 6) take them where numbers of trainings differ. Pooled over methods, each with its own mean, sums of squares and
degrees of freedom add up.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cudc_bench.artefacts.records import Record
from cudc_bench.text import plain

from .grid import Column, Entry, Grid, Line, Part
from .statistics import CONFIDENCE, Floats, Interval
from .study import Study
from .table import ENOUGH_SEEDS, Block
from .words import ordered, short

POOLED = "pooled"
ALL_TASKS = "mean over tasks"
BETWEEN, WITHIN = "between datasets", "within a dataset"
_ENOUGH = 4  # degrees of freedom for an interval: five datasets of one method
# The returns of each training on each dataset.
Datasets = Sequence[Sequence[float]]


@dataclass(frozen=True)
class Components:
    """Two parts of a variance.

    Attributes:
        between, within: variance between datasets and between trainings on one; ``between`` is never below 0, and None for one dataset of
            each method.
        estimate: between datasets as it came out, which may be negative.
        between_interval, within_interval: of 95 %; None for fewer than 4 degrees of freedom.
        datasets, trainings: how many.
    """

    between: float | None
    within: float
    estimate: float | None
    between_interval: Interval | None
    within_interval: Interval | None
    datasets: int
    trainings: int

    @property
    def share(self) -> float | None:
        """How much of the variance of one training on one dataset is between datasets; None where there is no variance."""
        whole = (self.between or 0.0) + self.within
        return None if self.between is None or whole <= 0 else self.between / whole


def components(methods: Sequence[Datasets]) -> Components | None:
    """The components of one method's returns, or pooled over several; None if no dataset has two trainings."""
    groups = [[np.asarray(one, np.float64) for one in datasets if len(one)] for datasets in methods]
    groups = [datasets for datasets in groups if datasets]
    sizes = [np.array([len(one) for one in datasets], np.float64) for datasets in groups]
    trainings, datasets = int(sum(of.sum() for of in sizes)), sum(len(of) for of in sizes)
    free_within, free_between = trainings - datasets, datasets - len(groups)
    if free_within < 1:
        return None
    within = float(sum(((one - one.mean()) ** 2).sum() for datasets in groups for one in datasets)) / free_within
    means = [np.array([one.mean() for one in datasets]) for datasets in groups]
    estimate = _between_estimate(means, sizes, within, free_between) if free_between > 0 else None
    return Components(
        None if estimate is None else max(0.0, estimate), within, estimate,
        _between_interval(means, sizes, within, free_between, free_within) if min(free_between, free_within) >= _ENOUGH else None,
        _within_interval(within, free_within) if free_within >= _ENOUGH else None, datasets, trainings,
    )  # fmt: skip


def _between_estimate(means: Sequence[Floats], sizes: Sequence[Floats], within: float, freedom: int) -> float:
    squares = sum(float((n * (mean - (n * mean).sum() / n.sum()) ** 2).sum()) for n, mean in zip(sizes, means, strict=True))
    # How often the variance between datasets is in the expectation of these squares.
    weight = sum(float(n.sum() - (n**2).sum() / n.sum()) for n in sizes)
    return (squares - freedom * within) / weight


_TAILS = ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2)


def _within_interval(within: float, freedom: int) -> Interval:
    from scipy.special import chdtri

    return Interval(*(float(within * freedom / chdtri(freedom, tail)) for tail in _TAILS))


def _between_interval(means: Sequence[Floats], sizes: Sequence[Floats], within: float, freedom: int, free_within: int) -> Interval:
    from scipy.special import chdtri, fdtri

    squares = sum(float(((mean - mean.mean()) ** 2).sum()) for mean in means)
    # What trainings add to the variance of a dataset's mean.
    added = within * sum(float((len(n) - 1) * (1 / n).mean()) for n in sizes) / freedom
    ratio = squares / freedom / added if added > 0 else np.inf
    low, high = (
        float(squares / chdtri(freedom, tail) * (1 - fdtri(freedom, free_within, 1 - tail) / ratio)) if squares > 0 else 0.0
        for tail in _TAILS
    )
    return Interval(max(0.0, low), max(0.0, high))


def build_components(blocks: Iterable[Block]) -> list[Study]:
    """A study for each group, algorithm and domain in which a dataset was trained on with two seeds or more."""
    return [study for block in blocks if (study := _study(block)) is not None]


# Of each method, and of all pooled, the components and what they are of.
_Found = dict[str, tuple[Components | None, tuple[Record, ...]]]


def _study(block: Block) -> Study | None:
    methods = _repeated(block)
    records = tuple(one for method in methods for task in block.tasks for one in block.records.get((method, task), ()))
    tasks = ordered({one.dataset.task for one in records}, block.tasks)
    rows = {
        (milestone, task): found
        for milestone in block.milestones
        for task in (*tasks, *([ALL_TASKS] if len(tasks) > 1 else []))
        if (found := _found(block, methods, tasks if task == ALL_TASKS else (task,), milestone))
    }
    if not rows:
        return None
    columns = (*methods, *([POOLED] if len(methods) > 1 else []))
    preliminary = any(len({one.dataset.seed for one in block.records.get((m, t), ())}) < ENOUGH_SEEDS for m in methods for t in tasks)
    group = plain(block.group)
    return Study(
        name="variance",
        folder=block.slug,
        title="Variance between datasets and between trainings",
        caption=f"Methods of which a dataset was trained on with several seeds. {block.algorithm} on {block.domain}. Profile: {group}. In"
        " all other tables and figures trainings on one dataset count once, as their mean."
        + (" Preliminary: fewer than five seeds." if preliminary else ""),
        group=group,
        algorithm=block.algorithm,
        domain=block.domain,
        tables=(
            Grid(
                "components", "Variance components",
                "Variance of returns, in points squared, between collector seeds (datasets), and between training seeds within a dataset; a"
                " single training on a single dataset has the sum of both. Estimates of a one-way random-effects analysis of variance;"
                " pooled: over these methods, each with a mean of its own. In square brackets: 95 % intervals, for 4 degrees of freedom or"
                " more. In brackets: datasets, or trainings. The mean over tasks is of training seeds that have all of them.",
                "milestone", ("task", "variance"), tuple(Column(name) for name in columns), _parts(rows, _both),
            ),
            Grid(
                "share", "Share between datasets",
                "How much of the variance of a single training on a single dataset is between datasets: the first component divided by the"
                " sum of both. In brackets: datasets.",
                "milestone", ("task",), tuple(Column(name, 2) for name in columns), _parts(rows, _shares),
            ),
        ),
        figures={},
        notes=tuple(_negative(rows)),
        records=records,
        wanted=(),
    )  # fmt: skip


def _repeated(block: Block) -> list[str]:
    """Methods of which a dataset was trained on several times."""
    return [
        method
        for method in block.methods
        if any(len(of) > 1 for task in block.tasks for of in _by_dataset(block.records.get((method, task), ())).values())
    ]


def _found(block: Block, methods: Sequence[str], tasks: Sequence[str], milestone: int) -> _Found:
    """The components on some tasks; empty if there are none pooled over all methods."""
    of_method = {method: _scores(block.records, method, tasks, milestone) for method in methods}
    pooled = components([datasets for datasets, _ in of_method.values()])
    if pooled is None:
        return {}
    found: _Found = {method: (components([datasets]), used) for method, (datasets, used) in of_method.items()}
    if len(methods) > 1:
        found[POOLED] = pooled, tuple(one for _, used in of_method.values() for one in used)
    return found


def _parts(rows: Mapping[tuple[int, str], _Found], lines: Callable[[str, _Found], Sequence[Line]]) -> tuple[Part, ...]:
    """For each milestone the lines of its tasks."""
    parts: dict[int, list[Line]] = defaultdict(list)
    for (milestone, task), found in rows.items():
        parts[milestone] += lines(task, found)
    return tuple(Part(f"{short(milestone)} steps", milestone, tuple(of)) for milestone, of in parts.items())


def _both(task: str, found: _Found) -> list[Line]:
    return [
        Line((task, BETWEEN), tuple(_between(one, used) for one, used in found.values())),
        Line((task, WITHIN), tuple(_within(one, used) for one, used in found.values())),
    ]


def _shares(task: str, found: _Found) -> list[Line]:
    return [Line((task,), tuple(_share(one, used) for one, used in found.values()))]


def _negative(rows: Mapping[tuple[int, str], _Found]) -> list[str]:
    """Estimates that cannot be a variance."""
    return [
        f"{name}, {task}, {short(milestone)} steps: {BETWEEN} the estimate is negative, {one.estimate:.4g}, and shown as 0."
        for (milestone, task), found in rows.items()
        for name, (one, _) in found.items()
        if one is not None and one.estimate is not None and one.estimate < 0
    ]


def _by_dataset(records: Iterable[Record]) -> Mapping[int, Sequence[Record]]:
    found: dict[int, list[Record]] = defaultdict(list)
    for one in records:
        found[one.dataset.seed].append(one)
    return found


def _scores(
    records: Mapping[tuple[str, str], Sequence[Record]], method: str, tasks: Sequence[str], milestone: int
) -> tuple[list[list[float]], tuple[Record, ...]]:  # fmt: skip
    """For each dataset the mean over tasks of each training seed that has all of them, and the records behind that."""
    runs: dict[tuple[int, int], dict[str, Record]] = defaultdict(dict)
    for task in tasks:
        for one in records.get((method, task), ()):
            if one.score(milestone) is not None:
                runs[one.dataset.seed, one.seed][task] = one
    complete = {key: of for key, of in sorted(runs.items()) if len(of) == len(tasks)}
    datasets: dict[int, list[float]] = defaultdict(list)
    for (dataset, _), of in complete.items():
        datasets[dataset].append(sum(one.score(milestone) or 0.0 for one in of.values()) / len(tasks))
    return list(datasets.values()), tuple(one for of in complete.values() for one in of.values())


def _between(found: Components | None, records: tuple[Record, ...]) -> Entry | None:
    if found is None or found.between is None:
        return None
    return Entry(found.between, None, found.between_interval, found.datasets, False, records)


def _within(found: Components | None, records: tuple[Record, ...]) -> Entry | None:
    return None if found is None else Entry(found.within, None, found.within_interval, found.trainings, False, records)


def _share(found: Components | None, records: tuple[Record, ...]) -> Entry | None:
    return None if found is None or found.share is None else Entry(found.share, None, None, found.datasets, False, records)
