"""Methods compared over tasks and domains: which scores enter, and what follows from them. The statistics are in :mod:`.statistics`.

What enters a comparison, for one group, algorithm and milestone:

1. Its *scope* is all domains of the group, or one of them. Methods without results in one of the scope's domains are left out of it.
2. Its tasks are those on which every one of these methods has a score. Only tasks with a known largest return enter, since scores are
   returns divided by it.
3. A collector seed of a method enters with all tasks of its domain or not at all, since it is the unit of replication. Several training
   runs on one dataset count once, as their mean.
4. A method has the same number of seeds in each domain, so that no domain weighs more than another: if it has more in some, the first
   ones by number enter.

So methods are always compared on the same tasks; what was left out is said in :attr:`Comparison.left_out`. The numbers of seeds may
differ between methods: they are independent samples.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from statistics import fmean

import numpy as np

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.markup import plain
from cudc_bench.records import Record

from . import statistics
from .incremental import computed
from .load import column, short, submitted_columns
from .statistics import SIGNIFICANCE, Counts, Floats, Integers, Interval
from .table import ENOUGH_SEEDS, METHOD_ORDER, Table, group_slug, ordered, span, submitted_caption

THRESHOLDS = np.linspace(0.0, 1.0, 101)  # of performance profiles
ALL = "all domains"
PRELIMINARY = "Preliminary: fewer than five seeds, whose intervals hold the truth less often than they say."
Task = tuple[str, str]
Resamples = Callable[[int, int, str], Counts]  # of so many seeds in so many blocks, by name


@dataclass(frozen=True)
class Estimate:
    """A statistic of one method and its 95 % intervals, which do not exist for a single seed.

    Attributes:
        value: of the scores themselves.
        cluster: datasets resampled with all their tasks; this is the one to read.
        stratified: runs resampled independently for each task, plain percentiles, as rliable does; too narrow where tasks share a dataset.
    """

    value: float
    cluster: Interval | None
    stratified: Interval | None


@dataclass(frozen=True)
class Standing:
    """One method in a comparison.

    Attributes:
        method: its name, as in tables.
        returns: (n, T) mean undiscounted returns; row i of a domain's columns is that domain's i-th collector seed.
        scores: the same divided by the tasks' largest returns.
        seeds: for each domain the n collector seeds.
        estimates: of ``iqm``, ``median``, ``mean`` and ``optimality_gap``, see :mod:`.statistics`.
        profile: share of runs above each of :data:`THRESHOLDS`.
        band: borders of its pointwise 95 % intervals; None for one seed.
        ranks: probability of each rank by IQM, from 1; None for one seed.
    """

    method: str
    returns: Floats = field(repr=False)
    scores: Floats = field(repr=False)
    seeds: Mapping[str, tuple[int, ...]]
    estimates: Mapping[str, Estimate]
    profile: Floats = field(repr=False)
    band: tuple[Floats, Floats] | None = field(repr=False)
    ranks: tuple[float, ...] | None

    @property
    def n(self) -> int:
        """Collector seeds in each domain."""
        return len(self.scores)


@dataclass(frozen=True)
class Pair:
    """One method against another.

    Attributes:
        method, other: their names.
        probability: that a run of ``method`` is better than one of ``other`` on the same task.
        interval: its 95 % interval by the cluster bootstrap; None if either has a single seed, as p-values are then.
        p: two-sided, by permutation of datasets.
        holm: p corrected for the comparisons of ``method`` with all others.
        better: whether it is an improvement: the whole interval is above ½ and the corrected p below 0.05.
    """

    method: str
    other: str
    probability: float
    interval: Interval | None
    p: float | None
    holm: float | None
    better: bool


@dataclass(frozen=True)
class Comparison:
    """Methods on the same tasks at one milestone.

    Attributes:
        scope: ``"all domains"``, or the name of one.
        milestone: gradient steps.
        tasks: (domain, task) of each column of scores.
        standings: one for each method, in tables' order.
        pairs: of every method with every other, in both directions.
        left_out: one line for each thing that did not enter, and why.
    """

    scope: str
    milestone: int
    tasks: tuple[Task, ...]
    standings: tuple[Standing, ...]
    pairs: tuple[Pair, ...]
    left_out: tuple[str, ...]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods."""
        return tuple(standing.method for standing in self.standings)

    @property
    def seeds(self) -> str:
        """How many collector seeds a method has in a domain, such as ``"5 seeds"``."""
        return span([standing.n for standing in self.standings], "seed")

    @property
    def preliminary(self) -> bool:
        """Whether a method has fewer than five seeds."""
        return any(standing.n < ENOUGH_SEEDS for standing in self.standings)

    @property
    def title(self) -> str:
        """Scope, milestone and number of tasks on one line."""
        return f"{self.scope}, {short(self.milestone)} steps, {span([len(self.tasks)], 'task')}"

    def pair(self, method: str, other: str) -> Pair:
        """One method against another."""
        return next(pair for pair in self.pairs if (pair.method, pair.other) == (method, other))


@dataclass(frozen=True)
class Overall:
    """All comparisons of one group and algorithm.

    Attributes:
        group, algorithm: as of its tables.
        slug: a safe and unique name for files.
        comparisons: by milestone, the last first; for each all domains together and then, if there are several, each by itself.
        submitted: methods that others handed in, and nobody ran again here.
    """

    group: str
    algorithm: str
    slug: str
    comparisons: tuple[Comparison, ...]
    submitted: tuple[str, ...] = ()

    @property
    def headline(self) -> Comparison:
        """Of the last milestone, all domains; or, if no two methods share all of them, the domain with most methods."""
        last = [one for one in self.comparisons if one.milestone == self.comparisons[0].milestone]
        return last[0] if len(last[0].methods) > 1 else max(last, key=lambda one: len(one.methods))

    @property
    def caption(self) -> str:
        """What the numbers are, in plain ASCII except for what records bring along."""
        return (
            f"Returns of {self.algorithm} divided by each task's largest possible return, over collector seeds and tasks."
            f" Profile: {self.group}. IQM: mean without the lowest and highest quarter of runs. Median: of the tasks' means. Optimality"
            " gap: mean of max(0, 1 - score), smaller is better. In square brackets: 95 % intervals by a cluster bootstrap"
            " (datasets resampled with all their tasks; expanded percentiles; 10,000 resamples, fixed seed)."
            " In braces: the plain stratified bootstrap, which takes a dataset's tasks for independent and is too narrow."
            " A single seed has no interval."
            + submitted_caption(self.submitted)
            + (f" {PRELIMINARY}" if any(comparison.preliminary for comparison in self.comparisons) else "")
        )


PAIRS_CAPTION = (
    "Probability that a run of the row's method is better than one of the column's on the same task (ties count half). Bold: an"
    " improvement, which is a 95 % interval by the cluster bootstrap above 0.5 and a two-sided p below 0.05 by a permutation of datasets,"
    " after Holm's correction for the row's comparisons."
)


def build_overall(tables: Sequence[Table]) -> list[Overall]:
    """Compare methods over the tables of each group and algorithm; see this module's docstring for what enters.

    A group none of whose tasks has a known largest return has none.

    Returns:
        By group and algorithm. The same tables give the same numbers, in whatever order their records are.
    """
    groups: dict[tuple[str, str], list[Table]] = defaultdict(list)
    for table in tables:
        groups[table.records[0].group, table.algorithm].append(table)
    found = []
    # Every milestone and algorithm draws the same for a method; they need no more memory than one of them.
    resamples = cache(lambda n, blocks, name: statistics.counted(statistics.draw(n, blocks, name)))
    wanted = [(group, algorithm, one) for group, algorithm in sorted(groups) for one in _comparisons(groups[group, algorithm], resamples)]
    compared_all: dict[tuple[str, str], list[Comparison]] = defaultdict(list)
    results = computed([compare for _, _, compare in wanted], "comparing methods", "comparisons")
    for (group, algorithm, _), comparison in zip(wanted, results, strict=True):
        if comparison is not None:
            compared_all[group, algorithm].append(comparison)
    for group, algorithm in sorted(groups):
        comparisons = tuple(compared_all[group, algorithm])
        if comparisons:
            compared = {method for comparison in comparisons for method in comparison.methods}
            handed = submitted_columns(record for table in groups[group, algorithm] for record in table.records)
            submitted = tuple(method for method in handed if method in compared)
            found.append(Overall(plain(group), algorithm, group_slug(group, algorithm), comparisons, submitted))
    return found


# For each domain, method and task the mean return of each collector seed.
_Domain = dict[str, dict[str, dict[int, float]]]


def _comparisons(tables: Sequence[Table], resamples: Resamples) -> list[Callable[[], Comparison | None]]:
    """Functions that make them, where they can be made."""
    found: list[Callable[[], Comparison | None]] = []
    for milestone in sorted({section.milestone for table in tables for section in table.sections}, reverse=True):
        domains, notes = {}, []
        for table in sorted(tables, key=lambda table: _place(table.domain)):
            if all(section.milestone != milestone for section in table.sections):
                notes.append(f"{table.domain}: {short(milestone)} steps is none of its milestones.")
                continue
            results = _results(table.records, milestone)
            known = DOMAINS[table.domain].tasks if table.domain in DOMAINS else ()
            unknown = sorted({task for tasks in results.values() for task in tasks} - set(known))
            if unknown:
                notes.append(f"{table.domain}: {', '.join(unknown)}: their largest return is not known.")
            results = {m: kept for m, tasks in results.items() if (kept := {t: tasks[t] for t in known if t in tasks})}
            if results:
                domains[table.domain] = results
            elif not unknown:
                notes.append(f"{table.domain}: nothing was evaluated there at {short(milestone)} steps.")
        scopes = [(ALL if len(domains) > 1 else next(iter(domains)), domains)] if domains else []
        if len(domains) > 1:
            scopes += [(name, {name: results}) for name, results in domains.items()]
        for scope, part in scopes:
            left_out = notes if scope == ALL or len(domains) == 1 else []
            found.append(partial(_compare, scope, milestone, part, left_out, resamples))
    return found


def _place(domain: str) -> tuple[int, str]:
    names = list(DOMAINS)
    return (names.index(domain) if domain in names else len(names), domain)


def _results(records: Sequence[Record], milestone: int) -> _Domain:
    runs: dict[tuple[str, str, int], list[float]] = defaultdict(list)
    for record in records:
        score = record.score(milestone)
        if score is not None:
            runs[column(record), record.dataset.task, record.dataset.seed].append(score)
    found: _Domain = {}
    for (method, task, seed), scores in runs.items():
        found.setdefault(method, {}).setdefault(task, {})[seed] = fmean(scores)
    return found


def _compare(
    scope: str, milestone: int, domains: Mapping[str, _Domain], notes: Sequence[str], resamples: Resamples
) -> Comparison | None:  # fmt: skip
    left_out = list(notes)
    every = ordered({method for results in domains.values() for method in results}, METHOD_ORDER)
    methods = []
    for method in every:
        lacking = [domain for domain, results in domains.items() if method not in results]
        if lacking:
            left_out.append(f"{method}: it has no results on {', '.join(lacking)}.")
        else:
            methods.append(method)
    tasks: list[Task] = []
    for domain, results in domains.items():
        for task in DOMAINS[domain].tasks:
            having = [method for method in methods if task in results[method]]
            if methods and len(having) == len(methods):
                tasks.append((domain, task))
            elif having:
                left_out.append(f"{domain} {task}: {', '.join(m for m in methods if m not in having)} lacks it.")
    entering: dict[str, tuple[Floats, dict[str, tuple[int, ...]]]] = {}
    for method in methods:
        chosen, lines = _seeds(method, domains, tasks)
        left_out += lines
        if chosen:
            columns = [[domains[domain][method][task][seed] for seed in chosen[domain]] for domain, task in tasks]
            entering[method] = np.array(columns, np.float64).T, chosen
    if not entering:
        return None
    return _comparison(scope, milestone, tuple(tasks), entering, [plain(line) for line in left_out], resamples)


def _seeds(method: str, domains: Mapping[str, _Domain], tasks: Sequence[Task]) -> tuple[dict[str, tuple[int, ...]], list[str]]:
    """The seeds of a method that enter, for each domain with tasks; none if a domain has none."""
    lines = []
    complete: dict[str, list[int]] = {}
    for domain in dict.fromkeys(domain for domain, _ in tasks):
        wanted = [domains[domain][method][task] for one, task in tasks if one == domain]
        having = sorted(set.intersection(*(set(seeds) for seeds in wanted)))
        partial = sorted(set.union(*(set(seeds) for seeds in wanted)) - set(having))
        if partial:
            lines.append(f"{method}, {domain}, {_numbers(partial)}: without all of the tasks.")
        complete[domain] = having
    count = min(map(len, complete.values()), default=0)
    if count == 0:
        return {}, [*lines, f"{method}: no collector seed has all of a domain's tasks."] if tasks else lines
    for domain, seeds in complete.items():
        if len(seeds) > count:
            lines.append(f"{method}, {domain}, {_numbers(seeds[count:])}: on other domains it has {span([count], 'seed')} only.")
    return {domain: tuple(seeds[:count]) for domain, seeds in complete.items()}, lines


def _numbers(seeds: Sequence[int]) -> str:
    shown = ", ".join(map(str, seeds[:10]))
    return f"seed{'s' if len(seeds) > 1 else ''} {shown}{', …' if len(seeds) > 10 else ''}"


def _comparison(
    scope: str, milestone: int, tasks: tuple[Task, ...],
    entering: Mapping[str, tuple[Floats, dict[str, tuple[int, ...]]]], left_out: Sequence[str], resamples: Resamples,
) -> Comparison:  # fmt: skip
    names = list(dict.fromkeys(domain for domain, _ in tasks))
    blocks = np.array([names.index(domain) for domain, _ in tasks], np.int64)
    largest = np.array([DOMAINS[domain].max_return for domain, _ in tasks])
    scores = {method: returns / largest for method, (returns, _) in entering.items()}
    several = [method for method in scores if len(scores[method]) > 1]
    draws = {method: resamples(len(scores[method]), len(names), f"cluster {method}") for method in several}
    found = {method: _estimates(method, scores[method], blocks, draws.get(method), resamples) for method in scores}
    ranks = statistics.rank_shares(np.stack([found[method][1] for method in several])) if several else np.zeros((0, 0))
    standings = []
    for method, (returns, seeds) in entering.items():
        counts = draws.get(method)
        standings.append(
            Standing(
                method=method,
                returns=returns,
                scores=scores[method],
                seeds=seeds,
                estimates=found[method][0],
                profile=statistics.profile(scores[method], THRESHOLDS),
                band=None if counts is None else statistics.profile_band(scores[method], blocks, counts, THRESHOLDS),
                ranks=None if counts is None else tuple(ranks[several.index(method)].tolist()),
            )
        )
    return Comparison(scope, milestone, tasks, tuple(standings), tuple(_pairs(scores, blocks, draws)), tuple(left_out))


def _estimates(
    method: str, scores: Floats, blocks: Integers, counts: Counts | None, resamples: Resamples
) -> tuple[dict[str, Estimate], Floats]:  # fmt: skip
    """Each aggregate, and the IQM of every resample."""
    values = {name: float(aggregate(scores)) for name, aggregate in statistics.AGGREGATES.items()}
    if counts is None:
        return {name: Estimate(value, None, None) for name, value in values.items()}, np.empty(0)
    n, tasks = scores.shape
    cluster = statistics.bootstrapped(scores, blocks, counts)
    stratified = statistics.bootstrapped(scores, np.arange(tasks), resamples(n, tasks, f"stratified {method}"))
    expanded, plain_tail = statistics.tail([n] * len(counts)), (1 - statistics.CONFIDENCE) / 2
    estimates = {
        name: Estimate(value, statistics.interval(of_cluster, expanded), statistics.interval(of_stratified, plain_tail))
        for (name, value), of_cluster, of_stratified in zip(values.items(), cluster, stratified, strict=True)
    }
    return estimates, cluster[0]


def _pairs(scores: Mapping[str, Floats], blocks: Integers, draws: Mapping[str, Counts]) -> list[Pair]:
    methods = list(scores)
    found: dict[tuple[str, str], tuple[float, Interval | None, float | None]] = {}
    for index, x in enumerate(methods):
        for y in methods[index + 1 :]:
            probability = statistics.improvement(scores[x], scores[y])
            if x in draws and y in draws:
                interval = statistics.improvement_interval(scores[x], scores[y], blocks, draws[x], draws[y])
                p = statistics.improvement_p(scores[x], scores[y], blocks)
                found[x, y] = probability, interval, p
                # The other way round is this one mirrored at one half.
                found[y, x] = 1 - probability, Interval(1 - interval.high, 1 - interval.low), p
            else:
                found[x, y], found[y, x] = (probability, None, None), (1 - probability, None, None)
    pairs = []
    for x in methods:
        others = [y for y in methods if y != x]
        tested = [y for y in others if found[x, y][2] is not None]
        corrected = dict(zip(tested, statistics.holm([found[x, y][2] or 0.0 for y in tested]), strict=True))
        for y in others:
            chance, within, p_value = found[x, y]
            holm = corrected.get(y)
            better = within is not None and holm is not None and within.low > 0.5 and holm < SIGNIFICANCE
            pairs.append(Pair(x, y, chance, within, p_value, holm, better))
    return pairs
