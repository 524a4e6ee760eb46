"""The study of learners: whether the ranking of datasets depends on who learns from them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from ..methods import LEARNER_ORDER, METHOD_ORDER
from .columns import column, is_own
from .figures import Intervals
from .grid import Column, Entry, Grid, Line, Part
from .missing import Wanted
from .overall import ALL, LEAD, Comparison, Estimate, Overall, Standing, unit_of
from .statistics import paired_share, paired_share_interval
from .study import Study, known_tasks
from .study_specs import STUDY_METHODS
from .table import Block
from .words import group_slug, ordered, short

_STATISTICS = {"mean": "Mean", "iqm": "IQM"}
_BASIS = "td3"  # that others without rewards are measured by
_FEWEST = 3  # Of two methods every ranking agrees or is turned round.
# By scope and milestone, and then by learner.
_Parts = Mapping[tuple[str, int], Mapping[str, Comparison]]


def build_learners(blocks: Sequence[Block], overall: Sequence[Overall]) -> list[Study]:
    """A study for each group in which several algorithms were evaluated; each number is that of the algorithm's own comparison."""
    together: dict[str, dict[str, Overall]] = defaultdict(dict)
    for one in overall:
        # The slug and not the group, of which different ones may look alike.
        together[one.slug.removesuffix(f".{one.algorithm}")][one.algorithm] = one
    return [
        study for slug, learners in sorted(together.items()) if len(learners) > 1 and (study := _study(slug, learners, blocks)) is not None
    ]


def _study(slug: str, learners: Mapping[str, Overall], blocks: Sequence[Block]) -> Study | None:
    names = ordered(set(learners), LEARNER_ORDER)
    kept = _shared(names, learners)
    if not kept:
        return None
    group = learners[names[0]].group
    own = [block for block in blocks if group_slug(block.group, block.algorithm) == f"{slug}.{block.algorithm}"]
    places = {(block.algorithm, block.domain): block for block in own}
    notes = [
        f"{scope}, {short(milestone)} steps: the learners have different tasks: {_tasks(found)}."
        for (scope, milestone), found in kept.items()
        if len({one.tasks for one in found.values()}) > 1
    ]
    # What was trained on a task and what was told of it afterwards are not compared as columns of one table.
    untold = {block.algorithm for block in own if block.is_zero_shot}
    kinds = [[name for name in names if name not in untold], [name for name in names if name in untold]]
    tables = [
        _values(statistic, title, kind, kept, places, told)
        for kind, told in zip(kinds, ("", "zero-shot-" if kinds[0] else ""), strict=True)
        if kind
        for statistic, title in _STATISTICS.items()
    ]
    if _BASIS in names and untold:
        tables.append(_efficiency(kinds[1], kept, places))
    agreement = _agreement(kept)
    if agreement.parts:
        tables.append(agreement)
    return Study(
        name="learners",
        folder=f"{slug}.learners",
        title="Learners side by side",
        caption=f"Whether the ranking of datasets depends on the learner: {', '.join(names)}. Profile: {group}."
        + (" Preliminary: fewer than five seeds." if any(one.preliminary for found in kept.values() for one in found.values()) else ""),
        group=group,
        algorithm=None,
        domain=None,
        tables=tuple(tables),
        figures={"mean": _means(group, kept)},
        notes=tuple(notes),
        records=tuple(one for block in own for found in block.records.values() for one in found),
        wanted=tuple(_wanted(own)),
    )


def _shared(names: Sequence[str], learners: Mapping[str, Overall]) -> _Parts:
    """The comparisons that several learners have, of the last milestone first, and there those of all domains."""
    parts: dict[tuple[str, int], dict[str, Comparison]] = defaultdict(dict)
    for name in names:
        for comparison in learners[name].comparisons:
            parts[comparison.scope, comparison.milestone][name] = comparison
    scopes = [scope for scope, _ in parts]
    shared = ((key, found) for key, found in parts.items() if len(found) > 1)
    return dict(sorted(shared, key=lambda part: (-part[0][1], part[0][0] != ALL, scopes.index(part[0][0]))))


def _means(group: str, parts: _Parts) -> Intervals:
    """Each learner's mean scores in the first of the comparisons."""
    (scope, milestone), headline = next(iter(parts.items()))
    panels = {name: {standing.method: standing.estimates[LEAD] for standing in one.standings} for name, one in headline.items()}
    methods = ordered({method for panel in panels.values() for method in panel}, METHOD_ORDER)
    title = f"Mean score and 95 % intervals by learner: profile {group}: {scope}, {short(milestone)} steps"
    return Intervals(title, methods, panels, alike=True)


def _tasks(found: Mapping[str, Comparison]) -> str:
    return ", ".join(f"{name} has {len(comparison.tasks)}" for name, comparison in found.items())


def _values(statistic: str, title: str, names: Sequence[str], parts: _Parts, places: Mapping[tuple[str, str], Block], prefix: str) -> Grid:
    shown = []
    for (scope, milestone), every_one in parts.items():
        found = {name: one for name, one in every_one.items() if name in names}
        if not found:
            continue
        methods = ordered({method for one in found.values() for method in one.methods}, METHOD_ORDER)
        standings = {name: {standing.method: standing for standing in one.standings} for name, one in found.items()}
        lines = []
        for method in methods:
            entries = [
                _entry(standing, found[name], places, name, standing.estimates[statistic])
                if name in found and (standing := standings[name].get(method))
                else None
                for name in names
            ]
            lines.append(Line((method,), tuple(entries)))
        shown.append(Part(f"{scope}, {short(milestone)} steps", f"{scope}, {milestone}", tuple(lines)))
    every = [one for found in parts.values() for one in found.values()]
    return Grid(
        name=f"{prefix}{statistic}",
        title=f"{title} by learner{' without rewards' if prefix else ''}",
        caption=f"{title} over tasks and collector seeds of {unit_of(every)}, as in each learner's own comparison over tasks (overall.md"
        " says what enters). In square brackets: 95 % intervals by Student's t over datasets; in brackets the number of seeds.",
        split="scope",
        head=("method",),
        columns=tuple(Column(name, 3) for name in names),
        parts=tuple(shown),
    )


def _efficiency(names: Sequence[str], parts: _Parts, places: Mapping[tuple[str, str], Block]) -> Grid:
    """What learners without rewards reach of what TD3 reaches that was trained on each task."""
    shown = []
    for (scope, milestone), found in parts.items():
        basis = found.get(_BASIS)
        having = [name for name in names if name in found and basis is not None and found[name].tasks == basis.tasks]
        if basis is None or not having:
            continue
        whole = {one.method: one for one in basis.standings}
        own = {name: {one.method: one for one in found[name].standings} for name in having}
        methods = [one for one in ordered(set(whole), METHOD_ORDER) if any(one in standings for standings in own.values())]
        lines = [
            Line((method,), tuple(_share(own[name].get(method), whole[method], found[name], places, name) if name in own else None
                                  for name in names))
            for method in methods
        ]  # fmt: skip
        shown.append(Part(f"{scope}, {short(milestone)} steps", f"{scope}, {milestone}", tuple(lines)))
    return Grid(
        name="efficiency",
        title=f"Share of what {_BASIS} reaches",
        caption=f"The mean over tasks of a learner's mean score, divided by that of {_BASIS}, which was trained on each task, on the same"
        f" datasets. 1: being told of a task afterwards costs nothing. In square brackets: 95 % intervals by Student's t over datasets, the"
        " pairs of whose scores are left out together; in brackets the number of datasets.",
        split="scope",
        head=("method",),
        columns=tuple(Column(name, 2) for name in names),
        parts=tuple(shown),
    )


def _share(
    standing: Standing | None, basis: Standing, comparison: Comparison, places: Mapping[tuple[str, str], Block], learner: str
) -> Entry | None:
    """A method's share, over the datasets that both learners were trained on; None where there is none, or where nothing was reached."""
    if standing is None:
        return None
    groups = []
    for index, (domain, seeds) in enumerate(standing.seeds.items()):
        common = [seed for seed in seeds if seed in basis.seeds[domain]]
        rows = [standing.scores[index][[seeds.index(seed) for seed in common]]]
        rows.append(basis.scores[index][[basis.seeds[domain].index(seed) for seed in common]])
        groups.append(np.hstack(rows))
    if min(map(len, groups)) == 0 or (value := paired_share(groups)) is None:
        return None
    entry = _entry(standing, comparison, places, learner, standing.estimates[LEAD])
    return replace(entry, value=value, interval=paired_share_interval(groups), n=min(map(len, groups)))


def _entry(standing: Standing, comparison: Comparison, places: Mapping[tuple[str, str], Block], learner: str, estimate: Estimate) -> Entry:
    records = tuple(
        one
        for domain, task in comparison.tasks
        for one in places[learner, domain].records.get((standing.method, task), ())
        if one.dataset.seed in standing.seeds[domain]
    )
    return Entry(estimate.value, None, estimate.interval, standing.n, False, records)


def _agreement(parts: _Parts) -> Grid:
    from scipy.stats import kendalltau

    shown = []
    for (scope, milestone), found in parts.items():
        lines = []
        for first, second in combinations(found, 2):
            if found[first].tasks != found[second].tasks:
                continue
            values = [{one.method: one.estimates[LEAD].value for one in found[name].standings} for name in (first, second)]
            common = [method for method in values[0] if method in values[1]]
            pairs = [[one[method] for method in common] for one in values]
            if len(common) < _FEWEST or any(len(set(one)) < 2 for one in pairs):
                continue
            result = kendalltau(*pairs)
            entries = (Entry(float(result.statistic)), Entry(float(result.pvalue)), Entry(len(common)))
            lines.append(Line((first, second), entries))
        if lines:
            shown.append(Part(f"{scope}, {short(milestone)} steps", f"{scope}, {milestone}", tuple(lines)))
    return Grid(
        name="agreement",
        title="Agreement of learners",
        caption="Kendall's tau (b) between two learners' mean scores of the methods that both have, on the same tasks: 1 if both rank the"
        " methods alike, 0 if their rankings have nothing to do with each other, -1 if one is the other turned round. p: two-sided, of no"
        " association. It takes each mean for exact: methods whose intervals overlap may change places.",
        split="scope",
        head=("learner", "other"),
        columns=(Column("tau", 2, signed=True), Column("p", 3), Column("methods")),
        parts=tuple(shown),
    )


def _wanted(blocks: Sequence[Block]) -> list[Wanted]:
    """For each learner the methods that another has on the same domain, with the learner's own seeds there."""
    found = []
    for block in blocks:
        own = [one for records in block.records.values() for one in records if is_own(one)]
        if not own:
            continue
        collected = {
            column(one)
            for other in blocks
            if other.domain == block.domain
            for records in other.records.values()
            for one in records
            if is_own(one)
        }
        tasks = known_tasks(block.domain) if own[0].dataset.reward is None and known_tasks(block.domain) else block.tasks
        for method in ordered(collected - STUDY_METHODS, METHOD_ORDER):
            found.append(
                Wanted(
                    study="learners",
                    group=block.group,
                    algorithm=block.algorithm,
                    domain=block.domain,
                    method=method,
                    tasks=tasks,
                    seeds=tuple(sorted({one.dataset.seed for one in own})),
                    used=own[0].dataset.used,
                    have=frozenset((task, one.dataset.seed) for task in block.tasks for one in block.records.get((method, task), ())),
                    like=own[0],
                )
            )
    return found
