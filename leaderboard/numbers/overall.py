"""Methods compared over tasks and domains: which scores enter, and what follows from them. The statistics are in :mod:`.statistics`.

What enters a comparison, for one group, algorithm and milestone:

1. Its *scope* is all domains of the group, or one of them. Methods without results in one of the scope's domains are left out of it.
2. Its tasks are those on which every one of these methods has a score. Only tasks with a known largest return enter.
3. A collector seed of a method enters with all tasks of its domain or not at all, since it is the unit of replication. Several training
   runs on one dataset count once, as their mean.

Scores are returns between the task's floor and its ceiling (:mod:`cudc_bench.artefacts.references`) if every task of the comparison has a
reference, and otherwise returns divided by the task's largest possible one. Never both in one comparison.

So methods are always compared on the same tasks; what was left out is said in :attr:`Comparison.left_out`. The numbers of seeds may differ
between methods, which are independent samples, and between a method's domains: every task weighs the same, however many seeds it has.

The mean over tasks leads: it weighs every task alike for every method. The interquartile mean, which other papers lead with, is shown
beside it; over few tasks of unequal scale it cuts off the easiest and the hardest and not runs that went
astray.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations
from statistics import fmean

import numpy as np

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.execution.parallel import computed
from cudc_bench.text import plain

from ..methods import METHOD_ORDER
from . import statistics
from .columns import Submitted, column, submitted_caption, submitted_columns
from .power import FOUND, Power, power_of
from .scale import BETWEEN, OF_LARGEST, References, scale_of
from .statistics import SIGNIFICANCE, Floats, Interval, Scores
from .table import ENOUGH_SEEDS, Table
from .words import extent, group_slug, ordered, short, span

THRESHOLDS = np.linspace(0.0, 1.0, 101)  # of performance profiles
LEAD = next(iter(statistics.AGGREGATES))
NAMES = {"mean": "mean", "iqm": "IQM", "median": "median", "optimality_gap": "optimality gap"}
ALL = "all domains"
PRELIMINARY = "Preliminary: fewer than five seeds."
Task = tuple[str, str]


@dataclass(frozen=True)
class Estimate:
    """A statistic of one method and its 95 % intervals.

    Attributes:
        value: of the scores themselves.
        interval: Student's over datasets, each with all its tasks; this is the one to read. None if a domain has a single seed.
        stratified: runs resampled independently for each task, plain percentiles, as rliable does; too narrow where tasks share a
            dataset. None also if the method has more seeds in one domain than in another.
    """

    value: float
    interval: Interval | None
    stratified: Interval | None


@dataclass(frozen=True)
class Standing:
    """One method in a comparison.

    Attributes:
        method: its name, as in tables.
        returns: mean undiscounted returns, (n, T) for each domain; row i is the domain's i-th collector seed.
        scores: the same normalised, see :attr:`Comparison.references`.
        seeds: for each domain the collector seeds.
        estimates: of ``mean``, ``iqm``, ``median`` and ``optimality_gap``, see :mod:`.statistics`.
        profile: share of runs above each of :data:`THRESHOLDS`.
        band: borders of its pointwise 95 % intervals; None where estimates have none.
        ranks: probability of each rank by the mean, from 1; None unless all methods have the same seeds, see :attr:`Comparison.unranked`.
    """

    method: str
    returns: Scores = field(repr=False)
    scores: Scores = field(repr=False)
    seeds: Mapping[str, tuple[int, ...]]
    estimates: Mapping[str, Estimate]
    profile: Floats = field(repr=False)
    band: tuple[Floats, Floats] | None = field(repr=False)
    ranks: tuple[float, ...] | None

    @property
    def counts(self) -> list[int]:
        """Collector seeds in each domain."""
        return [len(seeds) for seeds in self.seeds.values()]

    @property
    def n(self) -> int:
        """Collector seeds in the domain with the fewest."""
        return min(self.counts)

    @property
    def seeds_text(self) -> str:
        """How many collector seeds it has in a domain: ``"5"``, or ``"3 to 5"``."""
        return extent(min(self.counts), max(self.counts))


@dataclass(frozen=True)
class Pair:
    """One method against another.

    Attributes:
        method, other: their names.
        probability: that a run of ``method`` is better than one of ``other`` on the same task.
        interval: its 95 % interval; None if either has a single seed in a domain, as p-values are then.
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
        references: of each task, if all of them have one: scores are then between its floor and its ceiling. Otherwise None: they are
            returns divided by the task's largest.
        unreferenced: tasks without a reference, where others have one.
    """

    scope: str
    milestone: int
    tasks: tuple[Task, ...]
    standings: tuple[Standing, ...]
    pairs: tuple[Pair, ...]
    left_out: tuple[str, ...]
    references: tuple[Bounds, ...] | None = None
    unreferenced: tuple[Task, ...] = ()

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods."""
        return tuple(standing.method for standing in self.standings)

    @property
    def domains(self) -> tuple[str, ...]:
        """Those of its tasks, in the order of scores."""
        return tuple(dict.fromkeys(domain for domain, _ in self.tasks))

    @property
    def seeds(self) -> str:
        """How many collector seeds a method has in a domain, such as ``"5 seeds"``."""
        return span([count for standing in self.standings for count in standing.counts], "seed")

    @property
    def unranked(self) -> str | None:
        """Why no method has a probability of a rank; None if all have.

        How likely a method is to come first depends on how sure its own mean is and on how sure all others' are: of methods with other
        seeds it would say who was run more often.
        """
        if len(self.standings) < 2:
            return "there is one method only"
        if any(standing.seeds != self.standings[0].seeds for standing in self.standings):
            return "the methods do not have the same collector seeds"
        return "each method has a single seed in a domain" if self.standings[0].n < 2 else None

    @property
    def preliminary(self) -> bool:
        """Whether a method has fewer than five seeds."""
        return any(standing.n < ENOUGH_SEEDS for standing in self.standings)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What to know of it, in sentences."""
        found = []
        if self.unreferenced:
            lacking = ", ".join(f"{domain} {task}" for domain, task in self.unreferenced)
            found.append(f"Not by references, which these tasks have not: {lacking}.")
        if self.unranked and len(self.standings) > 1:
            found.append(f"No probabilities of ranks: {self.unranked}.")
        return (*found, *self._least())

    def _least(self) -> list[str]:
        """What no p-value can go below."""
        tested = [standing for standing in self.standings if standing.n > 1]
        if len(tested) < 2:
            return []
        least, corrected = self._least_values
        each = " in each domain" if len(self.domains) > 1 else ""
        alike = len({count for standing in tested for count in standing.counts}) == 1
        which = f"of {tested[0].n} against {tested[0].n} seeds{each}" if alike else "of its pairs, which have different numbers of seeds,"
        text = f"The permutation test {which} can give no p below {_numbers_text(least)}"
        if len(tested) > 2:
            text += f", which Holm's correction for {len(tested) - 1} comparisons makes {_numbers_text(corrected)}"
        return [f"{text}{': no difference can pass it' if self.hopeless else ''}."]

    @cached_property
    def _least_values(self) -> tuple[list[float], list[float]]:
        """The least p-values of its pairs, ascending, and what Holm's correction makes of them."""
        tested = [standing for standing in self.standings if standing.n > 1]
        counts = [(x.counts, y.counts) for x, y in combinations(tested, 2)]
        least = sorted({statistics.least_p(list(zip(x, y, strict=True))) for x, y in counts})
        return least, sorted({min(1.0, (len(tested) - 1) * p) for p in least})

    @property
    def hopeless(self) -> bool:
        """Whether no difference between two of its methods can pass the test, whatever their scores."""
        _, corrected = self._least_values
        return not corrected or corrected[0] >= SIGNIFICANCE

    @property
    def points(self) -> float | None:
        """How many points of return a score of 1 is, on average over tasks; None over domains whose returns are of different size."""
        if len({DOMAINS[domain].max_return for domain in self.domains}) > 1:
            return None
        if self.references:
            return fmean(bounds.ceiling - bounds.floor for bounds in self.references)
        return DOMAINS[self.domains[0]].max_return

    @property
    def unit(self) -> str:
        """What its scores are."""
        return BETWEEN if self.references else OF_LARGEST

    @property
    def axis(self) -> str:
        """The same in few words, for a figure."""
        return "0: floor, 1: ceiling" if self.references else "return / largest possible return"

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
        submitted: methods that others handed in.
        power: what the seeds of the headline, and other numbers of them, can show; None if that is not known.
    """

    group: str
    algorithm: str
    slug: str
    comparisons: tuple[Comparison, ...]
    submitted: tuple[Submitted, ...] = ()
    power: Power | None = None

    @property
    def power_text(self) -> str:
        """The same in a few sentences; empty where there is nothing to be tested."""
        headline = self.headline
        if sum(standing.n > 1 for standing in headline.standings) < 2:
            return ""
        if self.power is None:
            return "Power: not known, since too few seeds say how much seeds differ."
        power = self.power
        own = power.design.lead
        found = "no lead is" if own is None else f"a lead of {self.lead(own)} is"
        more = [(one.seeds, one.lead) for one in power.designs if one.lead is not None and one.seeds > power.own]
        others = ", ".join(f"with {seeds} one of {self.lead(lead, bare=True)}" for seeds, lead in more)
        low, high = (self.lead(end, bare=True) for end in (power.within.low, power.within.high))
        return (
            f"Power: with {span([power.own], 'seed')} {found} found in {round(10 * FOUND)} of 10 cases{f' ({others})' if others else ''},"
            f" by what makes an improvement: an interval above 0.5, and the two-sided permutation test at {SIGNIFICANCE} after Holm's"
            f" correction for {span([power.comparisons], 'comparison')}. Simulated with the covariance that was measured between seeds,"
            f" pooled over methods: one seed's mean over tasks has a standard deviation of {self.lead(power.deviation)} (95 % interval"
            f" {low} to {high}, {power.freedom} degrees of freedom)."
        )

    def lead(self, score: float, bare: bool = False) -> str:
        """A difference of scores in the headline: in points of return where scores are returns divided by one number; ``bare``: alone."""
        points, by_references = self.headline.points, self.headline.references is not None
        in_points = "" if points is None else f"{points * score:.0f}"
        text = in_points if in_points and not by_references else f"{score:.3f}"
        if bare:
            return text
        # On average, since tasks have ceilings of their own.
        also = f" ({in_points} points)" if in_points and by_references else ""
        return f"{text} {'points' if text == in_points else 'in score'}{also} a task"

    @property
    def headline(self) -> Comparison:
        """Of the last milestone, all domains; or, if no two methods share all of them, the domain with most methods."""
        last = [one for one in self.comparisons if one.milestone == self.comparisons[0].milestone]
        return last[0] if len(last[0].methods) > 1 else max(last, key=lambda one: len(one.methods))

    @property
    def caption(self) -> str:
        """What the numbers are, in plain ASCII except for what records bring along."""
        return (
            f"Scores of {self.algorithm} over collector seeds and tasks: {unit_of(self.comparisons)}."
            f" Profile: {self.group}. Mean: of the tasks' means. IQM: mean without the lowest and highest quarter of runs; of tasks of"
            " unequal scale it leaves out the easiest and the hardest. Median: of the tasks' means. Optimality gap: mean of max(0, 1 -"
            " score), smaller is better. In square brackets: 95 % intervals by Student's t over datasets, each with all its tasks"
            " (jackknife). In braces: rliable's stratified bootstrap (10,000 resamples, fixed seed), which takes a dataset's tasks for"
            " independent and is too narrow."
            " A single seed has no interval."
            + submitted_caption(self.submitted)
            + (f" {PRELIMINARY}" if any(comparison.preliminary for comparison in self.comparisons) else "")
        )


def unit_of(comparisons: Iterable[Comparison]) -> str:
    """What the scores of some comparisons are, which may differ in that."""
    units: dict[str, list[Comparison]] = defaultdict(list)
    for one in comparisons:
        units[one.unit].append(one)
    if len(units) == 1:
        return next(iter(units))
    # Milestones of one scope differ only if their tasks do.
    both = set.intersection(*({one.scope for one in found} for found in units.values()))
    return "; ".join(
        f"{unit}, on "
        + ", ".join(dict.fromkeys(f"{one.scope} at {short(one.milestone)} steps" if one.scope in both else one.scope for one in found))
        for unit, found in units.items()
    )


PAIRS_CAPTION = (
    "Probability that a run of the row's method is better than one of the column's on the same task (ties count half), with 95 % intervals"
    " over datasets. Bold: an improvement, which is an interval above 0.5 and a two-sided p below 0.05 by a permutation of datasets, after"
    " Holm's correction for the row's comparisons."
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
    wanted = [(group, algorithm, one) for group, algorithm in sorted(groups) for one in _comparisons(groups[group, algorithm])]
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
            submitted = tuple(one for one in handed if one.name in compared)
            found.append(Overall(plain(group), algorithm, group_slug(group, algorithm), comparisons, submitted))
    powers = computed(
        [partial(power_of, [standing.scores for standing in one.headline.standings]) for one in found], "simulating power", "comparisons", 1
    )
    return [replace(one, power=power) for one, power in zip(found, powers, strict=True)]


# For each domain, method and task the mean return of each collector seed.
_Domain = dict[str, dict[str, dict[int, float]]]


def _comparisons(tables: Sequence[Table]) -> list[Callable[[], Comparison | None]]:
    """Functions that make them, where they can be made."""
    found: list[Callable[[], Comparison | None]] = []
    references = {table.domain: table.references for table in tables}
    for milestone in sorted({milestone for table in tables for milestone in table.milestones}, reverse=True):
        domains: dict[str, _Domain] = {}
        notes: list[str] = []
        for table in sorted(tables, key=lambda table: _place(table.domain)):
            results, lines = _known_results(table, milestone)
            notes += lines
            if results:
                domains[table.domain] = results
        for scope, part in _scopes(domains):
            left_out = notes if len(part) == len(domains) else []
            found.append(partial(_compare, scope, milestone, part, left_out, references))
    return found


def _scopes(domains: Mapping[str, _Domain]) -> list[tuple[str, Mapping[str, _Domain]]]:
    """All domains, and then, if there are several, each by itself."""
    single = [(name, {name: results}) for name, results in domains.items()]
    return [(ALL, domains), *single] if len(domains) > 1 else [*single]


def _known_results(table: Table, milestone: int) -> tuple[_Domain, list[str]]:
    """A table's results on the tasks whose largest return is known, and what is not among them."""
    if milestone not in table.milestones:
        return {}, [f"{table.domain}: {short(milestone)} steps is none of its milestones."]
    results = _results(table.records, milestone)
    known = DOMAINS[table.domain].tasks if table.domain in DOMAINS else ()
    unknown = sorted({task for tasks in results.values() for task in tasks} - set(known))
    results = {method: kept for method, tasks in results.items() if (kept := {task: tasks[task] for task in known if task in tasks})}
    if unknown:
        return results, [f"{table.domain}: {', '.join(unknown)}: their largest return is not known."]
    return results, [] if results else [f"{table.domain}: nothing was evaluated there at {short(milestone)} steps."]


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
    scope: str, milestone: int, domains: Mapping[str, _Domain], notes: Sequence[str], references: Mapping[str, References]
) -> Comparison | None:  # fmt: skip
    methods, elsewhere = _in_all_domains(domains)
    tasks, lacking = _common_tasks(methods, domains)
    left_out = [*notes, *elsewhere, *lacking]
    entering: dict[str, _Entering] = {}
    for method in methods:
        seeds, lines = _seeds(method, domains, tasks)
        left_out += lines
        if seeds:
            returns = [
                np.array([[domains[domain][method][task][seed] for one, task in tasks if one == domain] for seed in of], np.float64)
                for domain, of in seeds.items()
            ]
            entering[method] = returns, seeds
    if not entering:
        return None
    return _comparison(scope, milestone, tuple(tasks), entering, [plain(line) for line in left_out], references)


def _in_all_domains(domains: Mapping[str, _Domain]) -> tuple[list[str], list[str]]:
    """Methods with results in each of some domains, and a line for each other one."""
    methods, left_out = [], []
    for method in ordered({method for results in domains.values() for method in results}, METHOD_ORDER):
        lacking = [domain for domain, results in domains.items() if method not in results]
        if lacking:
            left_out.append(f"{method}: it has no results on {', '.join(lacking)}.")
        else:
            methods.append(method)
    return methods, left_out


def _common_tasks(methods: Sequence[str], domains: Mapping[str, _Domain]) -> tuple[list[Task], list[str]]:
    """Tasks that all of some methods have, and a line for each that only some have."""
    tasks: list[Task] = []
    left_out = []
    for domain, results in domains.items():
        for task in DOMAINS[domain].tasks:
            having = [method for method in methods if task in results[method]]
            if having and len(having) == len(methods):
                tasks.append((domain, task))
            elif having:
                left_out.append(f"{domain} {task}: {', '.join(m for m in methods if m not in having)} lacks it.")
    return tasks, left_out


# The returns of a method in each domain, and its collector seeds there.
_Entering = tuple[Scores, dict[str, tuple[int, ...]]]


def _seeds(method: str, domains: Mapping[str, _Domain], tasks: Sequence[Task]) -> tuple[dict[str, tuple[int, ...]], list[str]]:
    """The seeds of a method that enter, for each domain with tasks; none if a domain has none."""
    lines = []
    complete: dict[str, tuple[int, ...]] = {}
    for domain in dict.fromkeys(domain for domain, _ in tasks):
        wanted = [domains[domain][method][task] for one, task in tasks if one == domain]
        having = sorted(set.intersection(*(set(seeds) for seeds in wanted)))
        partial = sorted(set.union(*(set(seeds) for seeds in wanted)) - set(having))
        if partial:
            lines.append(f"{method}, {domain}, {_numbers(partial)}: without all of the tasks.")
        complete[domain] = tuple(having)
    if not all(complete.values()):
        return {}, [*lines, f"{method}: no collector seed has all of a domain's tasks."]
    return complete, lines


def _numbers_text(values: Sequence[float]) -> str:
    """One number, or the least and the largest of several, in two digits."""
    ends = dict.fromkeys(f"{value:.2g}" for value in (values[0], values[-1]))
    return " to ".join(ends)


def _numbers(seeds: Sequence[int]) -> str:
    shown = ", ".join(map(str, seeds[:10]))
    return f"seed{'s' if len(seeds) > 1 else ''} {shown}{', …' if len(seeds) > 10 else ''}"


def _comparison(
    scope: str, milestone: int, tasks: tuple[Task, ...], entering: Mapping[str, _Entering], left_out: Sequence[str],
    references: Mapping[str, References],
) -> Comparison:  # fmt: skip
    having = {(domain, task): references[domain][task] for domain, task in tasks if task in references[domain]}
    by_references = len(having) == len(tasks)
    scales = {
        (domain, task): scale for domain, task in tasks if (scale := scale_of(domain, task, references[domain] if by_references else {}))
    }
    domains = list(dict.fromkeys(domain for domain, _ in tasks))

    def scored(returns: Scores) -> list[Floats]:
        """Returns of all tasks, (n, T) for each domain, as scores."""
        of = [[scale for (one, _), scale in scales.items() if one == domain] for domain in domains]
        return [
            np.stack([scale.score(column) for scale, column in zip(some, block.T, strict=True)], 1)
            for some, block in zip(of, returns, strict=True)
        ]

    scores = {method: scored(returns) for method, (returns, _) in entering.items()}
    lowest, highest = (
        scored([np.array([[end(scale) for (one, _), scale in scales.items() if one == domain]]) for domain in domains])
        for end in (lambda scale: scale.least, lambda scale: scale.largest)
    )
    standings = [
        Standing(
            method=method,
            returns=tuple(returns),
            scores=tuple(scores[method]),
            seeds=seeds,
            estimates=_estimates(method, scores[method], lowest, highest),
            profile=statistics.profile(scores[method], THRESHOLDS),
            band=None if min(map(len, returns)) < 2 else statistics.profile_band(scores[method], THRESHOLDS),
            ranks=None,
        )
        for method, (returns, seeds) in entering.items()
    ]
    found = Comparison(
        scope, milestone, tasks, tuple(standings), tuple(_pairs(scores)), tuple(left_out),
        tuple(having.values()) if by_references else None, tuple(one for one in tasks if one not in having) if having else (),
    )  # fmt: skip
    return found if found.unranked else replace(found, standings=_ranked(standings))


def _estimates(method: str, scores: Scores, lowest: Scores, highest: Scores) -> dict[str, Estimate]:
    alike = len({len(block) for block in scores}) == 1 and len(scores[0]) > 1
    stratified = statistics.stratified(np.concatenate(scores, 1), f"stratified {method}") if alike else {}
    return {
        name: Estimate(aggregate(scores), statistics.aggregate_interval(scores, name, lowest, highest), stratified.get(name))
        for name, aggregate in statistics.AGGREGATES.items()
    }


def _ranked(standings: Sequence[Standing]) -> tuple[Standing, ...]:
    distributions = []
    for standing in standings:
        spread = statistics.aggregate_spread(standing.scores, LEAD)
        assert spread is not None
        distributions.append(spread.draws(standing.estimates[LEAD].value, f"rank {standing.method}"))
    shares = statistics.rank_shares(np.stack(distributions))
    return tuple(replace(standing, ranks=tuple(of.tolist())) for standing, of in zip(standings, shares, strict=True))


def _pairs(scores: Mapping[str, Scores]) -> list[Pair]:
    methods = list(scores)
    found: dict[tuple[str, str], tuple[float, Interval | None, float | None]] = {}
    for index, x in enumerate(methods):
        for y in methods[index + 1 :]:
            probability = statistics.improvement(scores[x], scores[y])
            interval = statistics.improvement_interval(scores[x], scores[y])
            p = None if interval is None else statistics.improvement_p(scores[x], scores[y])
            found[x, y] = probability, interval, p
            # The other way round is this one mirrored at one half.
            found[y, x] = 1 - probability, interval and Interval(1 - interval.high, 1 - interval.low), p
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
