"""What of a suite exists. The stages say so themselves: what they would keep is done."""

from __future__ import annotations

from dataclasses import dataclass

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import exists
from cudc_bench.data.staging import is_untidy
from cudc_bench.errors import UsageError
from cudc_bench.stages import Planned, check_relabelled

from .definition import Suite
from .jobs import Job, JobGraph, expand
from .work import Common, is_measured


@dataclass(frozen=True)
class Survey:
    """A suite and what exists of it.

    Attributes:
        plan: all its jobs.
        done: those whose output is there.
        totals: units of work of each job: environment steps, states or gradient steps, for one member.
    """

    plan: JobGraph
    done: frozenset[Job]
    totals: dict[Job, int]


def survey(suite: Suite, common: Common) -> Survey:
    """Look at what exists; nothing is written.

    Raises:
        UsageError: something in the suite is wrong, or other runs stand in the places of its own.
        RunError: something that exists is damaged.
    """
    pairs = dict.fromkeys((domain, method) for study in suite.studies for domain in study.domains for method in study.methods)
    if not pairs:
        raise UsageError(f"nothing is left of the suite '{suite.name}'; narrow it less.")
    plan_collect = plugins.load("stages", "plan_collect")
    looked = _Looked(
        common,
        {
            (domain, method): plan_collect(method, domain, suite.seeds, profile=common.profile, settings=common.collect)
            for domain, method in pairs
        },
    )
    steps = {pair: found[0].total for pair, found in looked.datasets.items()}
    pilots = [pair for pair, found in looked.datasets.items() if found[0].needs_pilot]
    algos = dict.fromkeys(algo for study in suite.studies for algo in study.algos)
    zero_shot = [algo for algo in algos if not getattr(plugins.load("evaluators", algo), "learns_from_rewards", True)]
    plan = expand(suite, steps, pilots, stacked=common.device == "cuda", profile=common.profile, zero_shot=zero_shot)
    states = {job: looked.state(job) for job in plan.needs}
    return Survey(plan, frozenset(job for job, (done, _) in states.items() if done), {job: total for job, (_, total) in states.items()})


class _Looked:
    """What exists of a suite's jobs.

    Args:
        common: to all of them.
        datasets: of each (domain, method) what ``collect`` would do, by seed.
    """

    def __init__(self, common: Common, datasets: dict[tuple[str, str], list[Planned]]) -> None:
        self._common, self.datasets = common, datasets
        self._plan_evaluate = plugins.load("stages", "plan_evaluate")
        self._collected = {(pair, one.seed) for pair, found in datasets.items() for one in found if one.done}

    def state(self, job: Job) -> tuple[bool, int]:
        """Whether a job is done, and its units of work."""
        steps = self.datasets[job.domain, job.methods[0]][0].total
        if job.kind == "collect":
            return self._has_datasets(job), steps
        if job.kind == "relabel":
            return self._has_datasets(job) and self._has_labels(job), steps
        if job.kind == "evaluate":
            return self._evaluated(job)
        if job.kind == "stats":
            return is_measured(job, self._common), steps * len(job.datasets)
        return False, steps  # a threshold that was measured needs no pilot

    def _has_datasets(self, job: Job) -> bool:
        return all(((job.domain, method), seed) in self._collected for method in job.methods for seed in job.seeds)

    def _has_labels(self, job: Job) -> bool:
        labelled = [one for base in job.datasets for one in check_relabelled(base, job.tasks).values()]
        return all(exists(one) and not is_untidy(one) for one in labelled)

    def _evaluated(self, job: Job) -> tuple[bool, int]:
        common = self._common
        records = self._plan_evaluate(
            job.algo, job.domain, job.tasks, job.method, job.seeds, profile=common.profile, settings=common.evaluate, used=job.used,
            output=common.output, collected=self.datasets[job.domain, job.method][0].overrides, labels=job.labels or None,
        )  # fmt: skip
        return all(one.done for one in records), records[0].total
