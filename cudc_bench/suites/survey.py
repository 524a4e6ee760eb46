"""What of a suite exists. The stages say so themselves: what they would keep is done."""

from __future__ import annotations

from dataclasses import dataclass

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import exists
from cudc_bench.data.staging import is_untidy
from cudc_bench.errors import UsageError
from cudc_bench.stages import Planned, check_relabelled

from .definition import Suite
from .jobs import Job, Plan, expand
from .work import Common, is_measured


@dataclass(frozen=True)
class Survey:
    """A suite and what exists of it.

    Attributes:
        plan: all its jobs.
        done: those whose output is there.
        totals: units of work of each job: environment steps, states or gradient steps, for one member.
    """

    plan: Plan
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
    plan_collect, plan_evaluate = plugins.load("stages", "plan_collect"), plugins.load("stages", "plan_evaluate")
    datasets: dict[tuple[str, str], list[Planned]] = {
        (domain, method): plan_collect(method, domain, suite.seeds, profile=common.profile, settings=common.collect)
        for domain, method in pairs
    }
    steps = {pair: found[0].total for pair, found in datasets.items()}
    pilots = [pair for pair, found in datasets.items() if found[0].needs_pilot]
    plan = expand(suite, steps, pilots, stacked=common.device == "cuda")
    done, totals = set(), {}
    collected = {(pair, one.seed) for pair, found in datasets.items() for one in found if one.done}
    for job in plan.needs:
        pairs_of_job = [(job.domain, method) for method in job.methods]
        totals[job] = steps[pairs_of_job[0]]
        has_datasets = all((pair, seed) in collected for pair in pairs_of_job for seed in job.seeds)
        if job.kind == "collect":
            is_done = has_datasets
        elif job.kind == "relabel":
            labelled = [one for base in job.datasets for one in check_relabelled(base, job.tasks).values()] if has_datasets else []
            is_done = has_datasets and all(exists(one) and not is_untidy(one) for one in labelled)
        elif job.kind == "evaluate":
            records = plan_evaluate(
                job.algo, job.domain, job.tasks, job.method, job.seeds, profile=common.profile, settings=common.evaluate, used=job.used,
                output=common.output, collected=datasets[pairs_of_job[0]][0].overrides,
            )  # fmt: skip
            is_done, totals[job] = all(one.done for one in records), records[0].total
        else:
            is_done = job.kind == "stats" and is_measured(job, common)
        if job.kind == "stats":
            totals[job] *= len(job.datasets)
        if is_done:
            done.add(job)
    return Survey(plan, frozenset(done), totals)
