"""From a suite to its jobs: what is made, in which order it can be, and what of it is left to do. Nothing here looks at a disk."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from cudc_bench.artefacts.ids import default_id
from cudc_bench.artefacts.records import LABELS
from cudc_bench.settings.seeds import format_seeds

from .definition import Suite, SuiteStudy

Kind = Literal["pilot", "collect", "relabel", "evaluate", "stats"]
KINDS: tuple[Kind, ...] = ("pilot", "collect", "relabel", "evaluate", "stats")


@dataclass(frozen=True)
class Job:
    """One piece of work of one process.

    Attributes:
        kind: the stage that does it.
        domain: what it is about.
        methods: the collector; several only where datasets are compared.
        seeds: of the collectors; several where one process has a stack of them, or compares them.
        tasks: that it labels, or trains for.
        algo: the offline algorithm.
        used: the transitions to train on, None for all.
        labels: how many of them a learner without rewards is told the rewards of, for each of its records; none for other learners.
        profile: of its suite.
    """

    kind: Kind
    domain: str
    methods: tuple[str, ...]
    seeds: tuple[int, ...] = ()
    tasks: tuple[str, ...] = ()
    algo: str | None = None
    used: int | None = None
    labels: tuple[int, ...] = ()
    profile: str = "paper"

    @property
    def method(self) -> str:
        """The only collector."""
        (method,) = self.methods
        return method

    @property
    def datasets(self) -> tuple[str, ...]:
        """The ids of the task-agnostic datasets that it makes or reads."""
        return tuple(str(default_id(self.domain, method, seed, self.profile)) for method in self.methods for seed in self.seeds)

    @property
    def name(self) -> str:
        """For people; no two jobs of a suite have the same."""
        if self.kind == "stats":
            return f"stats {self.domain}"
        what = [self.kind, *([self.algo] if self.algo else []), self.domain, self.method]
        what += [f"seed {format_seeds(self.seeds)}"] if self.seeds else []
        what += [",".join(self.tasks)] if self.kind == "evaluate" else []
        what += [f"first {self.used:,}"] if self.used is not None else []
        what += [f"labels {'+'.join(map(str, self.labels))}"] if self.labels not in ((), (LABELS,)) else []
        return " ".join(what)

    @property
    def slug(self) -> str:
        """The name as that of a file."""
        return self.name.replace("/", ".").replace(" ", "-").replace(",", "+")


@dataclass(frozen=True)
class JobGraph:
    """All jobs of a suite, and which come before which.

    Attributes:
        needs: of each job the jobs that come before it, in an order in which all could be done.
    """

    needs: Mapping[Job, tuple[Job, ...]]

    def of(self, *kinds: Kind) -> list[Job]:
        """The jobs of some kinds."""
        return [job for job in self.needs if job.kind in kinds]

    def left(self, done: Iterable[Job]) -> JobGraph:
        """What must be made when some of it exists: the jobs that are goals and not done, and what these need and is not there.

        A goal is what no other job of the plan needs: records, comparisons of datasets, and datasets of which nothing is made.
        """
        done = set(done)
        needed = {before for before_it in self.needs.values() for before in before_it}
        wanted: set[Job] = set()
        # Backwards: what needs a job comes after it.
        for job, before in reversed(list(self.needs.items())):
            if job not in done and (job not in needed or job in wanted):
                wanted |= {job, *(one for one in before if one not in done)}
        return JobGraph({job: tuple(one for one in before if one in wanted) for job, before in self.needs.items() if job in wanted})

    def users(self) -> dict[str, set[Job]]:
        """For each dataset the jobs that make or read it."""
        found: dict[str, set[Job]] = {}
        for job in self.needs:
            for one in job.datasets:
                found.setdefault(one, set()).add(job)
        return found


def expand(
    suite: Suite, steps: Mapping[tuple[str, str], int], pilots: Iterable[tuple[str, str]] = (), stacked: bool = False, *,
    profile: str = "paper", zero_shot: Collection[str] = (),
) -> JobGraph:  # fmt: skip
    """The jobs of a suite, each once, whichever of its studies have it.

    Args:
        suite: what is wanted.
        steps: of the datasets, by (domain, method).
        pilots: (domain, method) whose threshold must be measured first.
        stacked: whether one process trains all seeds, and all tasks, together, as is best on a GPU.
        profile: of all jobs.
        zero_shot: the algorithms that train without rewards: once for all tasks, on datasets that nobody labels.
    """
    groups = [suite.seeds] if stacked else [(seed,) for seed in suite.seeds]
    wanted = _Wanted(profile, frozenset(zero_shot))
    for study in suite.studies:
        for domain in study.domains:
            wanted.add(study, domain, steps)
    needs = wanted.datasets(groups, set(pilots))
    needs |= wanted.trainings(groups, stacked, [job for job in needs if job.kind in ("collect", "relabel")])
    needs |= wanted.comparisons(suite.seeds, [job for job in needs if job.kind == "collect"])
    return JobGraph(needs)


_Needs = dict[Job, tuple[Job, ...]]


class _Wanted:
    """What studies ask for, whichever of them; names are kept in the order in which they first came.

    Attributes:
        tasks: that datasets of (domain, method) are labelled for.
        runs: the tasks of each (domain, method, algorithm, transitions, labels).
        compared: the methods of each domain whose datasets are compared.
    """

    def __init__(self, profile: str, zero_shot: frozenset[str]) -> None:
        self.job = partial(Job, profile=profile)
        self.zero_shot = zero_shot
        self.tasks: dict[tuple[str, str], dict[str, None]] = {}
        self.runs: dict[tuple[str, str, str, int | None, tuple[int, ...]], dict[str, None]] = {}
        self.compared: dict[str, dict[str, None]] = {}

    def add(self, study: SuiteStudy, domain: str, steps: Mapping[tuple[str, str], int]) -> None:
        """What a study asks of one of its domains."""
        tasks = dict.fromkeys(study.tasks_of(domain))
        for method in study.methods:
            labels = self.tasks.setdefault((domain, method), {})
            if not self.zero_shot.issuperset(study.algos):
                labels |= tasks
            if study.stats:
                self.compared.setdefault(domain, {})[method] = None
            whole = steps[domain, method]
            for algo in study.algos:
                for size in (round(share * whole) for share in study.shares):
                    used = None if size == whole else max(1, size)
                    asked = study.labels if algo in self.zero_shot else ()
                    self.runs.setdefault((domain, method, algo, used, asked), {}).update(tasks)

    def datasets(self, groups: Sequence[tuple[int, ...]], pilots: set[tuple[str, str]]) -> _Needs:
        """The jobs that measure thresholds, collect and label, for groups of seeds."""
        needs: _Needs = {}
        for (domain, method), tasks in self.tasks.items():
            before: tuple[Job, ...] = ()
            if (domain, method) in pilots:
                pilot = self.job("pilot", domain, (method,))
                needs[pilot], before = (), (pilot,)
            for seeds in groups:
                collect = self.job("collect", domain, (method,), seeds)
                needs[collect] = before
                if tasks:
                    needs[self.job("relabel", domain, (method,), seeds, tuple(tasks))] = (collect,)
        return needs

    def trainings(self, groups: Sequence[tuple[int, ...]], stacked: bool, makers: Iterable[Job]) -> _Needs:
        """The jobs that train, each after the one that makes its datasets."""
        before = {(job.kind, job.domain, job.method, job.seeds): job for job in makers}
        needs: _Needs = {}
        for (domain, method, algo, used, asked), tasks in self.runs.items():
            for seeds in groups:
                for some in [tuple(tasks)] if stacked or asked else [(task,) for task in tasks]:
                    made = before["collect" if asked else "relabel", domain, method, seeds]
                    needs[self.job("evaluate", domain, (method,), seeds, some, algo, used, asked)] = (made,)
        return needs

    def comparisons(self, seeds: tuple[int, ...], collects: Sequence[Job]) -> _Needs:
        """The jobs that compare datasets, each after all that collect them."""
        needs: _Needs = {}
        for domain, methods in self.compared.items():
            makers = tuple(job for job in collects if job.domain == domain and job.method in methods)
            needs[self.job("stats", domain, tuple(methods), seeds)] = makers
        return needs
