"""``run_suite``: from a suite's name to its records and leaderboard."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.ids import datasets_root, rooted_at
from cudc_bench.errors import UsageError, unknown
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.locks import locked
from cudc_bench.execution.parallel import cores, only_cores, worker_count
from cudc_bench.execution.progress import echo
from cudc_bench.files import check_folder
from cudc_bench.learning.engines import check_engine
from cudc_bench.settings.profiles import resolve_device, resolve_profile

from .cluster import Cluster, check_cluster, run_on_ray
from .definition import Suite, load_suite, narrow
from .estimate import Estimates, from_table, measured_here
from .queue import Queue
from .scheduler import Retention, run_locally
from .survey import Survey, survey
from .work import Common

KEEP = ("datasets", "records")


@dataclass(frozen=True)
class Prepared:
    """A suite that could be run.

    Attributes:
        suite: narrowed.
        common: to all its jobs.
        found: its jobs, and what of them is done.
        estimates: what the others may cost.
        workers: how many at once.
    """

    suite: Suite
    common: Common
    found: Survey
    estimates: Estimates
    workers: int

    def queue(self, keep: str = "datasets") -> Queue:
        """Of what is left to do."""
        plan = self.found.plan.left(self.found.done)
        return Queue(plan, {job: self.estimates.seconds(job) for job in plan.needs}, few_datasets=keep == "records")


@dataclass(frozen=True)
class SuiteReport:
    """What became of a suite.

    Attributes:
        jobs: how many it has; ``kept`` of them were done before.
        failed: one line for each job that failed, and one for those that could not start for it; ``lacking`` are not done in all.
        removed: ids of datasets that were removed again.
        leaderboard: what ``make_leaderboard`` returned; None if there is nothing to compare.
    """

    jobs: int
    kept: int
    failed: list[str]
    lacking: int = 0
    removed: list[str] = field(default_factory=list)
    leaderboard: Any = None


def prepare(
    suite: str | Suite, *, methods: Sequence[str] | None = None, domains: Sequence[str] | None = None, tasks: Sequence[str] | None = None,
    algos: Sequence[str] | None = None, seeds: Sequence[int] | None = None, profile: str | None = None, output: str | Path = "results",
    report: str | Path = "report", device: str = "auto", engine: str = "auto",
    workers: int | None = None, checkpoint_every: float = CHECKPOINT_EVERY, cluster: Cluster | None = None,
) -> Prepared:  # fmt: skip
    """Everything that a run of a suite needs to know, checked; nothing is written. The arguments are those of :func:`run_suite`.

    What a cluster's nodes have is not asked: whether they have GPUs is known by what tasks ask for.

    Raises:
        UsageError: wrong input, or other runs stand in the places of the suite's own.
        RunError: something that exists is damaged.
    """
    whole = load_suite(suite) if isinstance(suite, str) else suite
    part = narrow(whole, methods=methods, domains=domains, tasks=tasks, algos=algos, seeds=seeds, profile=profile)
    results, folder = check_folder(output, "the output"), check_folder(report, "the report")
    check_folder(datasets_root(), "the dataset root")
    if cluster is not None:
        check_cluster(cluster)
        wanted = "cuda" if cluster.gpus else "cpu"
        if device not in ("auto", wanted):
            resolve_device(device)
            raise UsageError(f"--device {device} does not go with --ray-gpus {cluster.gpus:g}; tasks take GPUs by --ray-gpus.")
        name, device = part.profile, wanted
        chosen = resolve_profile(({"cuda": "paper", "cpu": "cpu"}[wanted]) if name == "auto" else name)
    else:
        chosen, device = resolve_profile(part.profile), resolve_device(device)
    worker_count(workers, 1)
    check_engine(engine, device)
    common = Common(part.name, chosen.name, part.collect, part.evaluate, device, engine, results, folder, checkpoint_every)
    found = survey(part, common)
    left = found.plan.left(found.done)
    # The threads of each job, and so its result, must not depend on how many are left to do.
    count = (workers or 1) if device == "cuda" else worker_count(workers, max(1, len(found.plan.needs)))
    rates = (measured_here(chosen.name, device, results), from_table(chosen.name, device)) if left.needs else ()
    return Prepared(part, common, found, Estimates(found.totals, rates), count)


def run_suite(
    suite: str | Suite = "main", *, methods: Sequence[str] | None = None, domains: Sequence[str] | None = None,
    tasks: Sequence[str] | None = None, algos: Sequence[str] | None = None, seeds: Sequence[int] | None = None,
    profile: str | None = None, output: str | Path = "results", report: str | Path = "report", device: str = "auto", engine: str = "auto",
    workers: int | None = None, keep: str = "datasets", checkpoint_every: float = CHECKPOINT_EVERY, ray: str | None = None,
    ray_root: str | Path | None = None, ray_cpus: int = 1, ray_gpus: float = 0.0, ray_retries: int = 3,
) -> SuiteReport:  # fmt: skip
    """Make all datasets and records of a suite that do not exist yet, and the leaderboard of them.

    What exists and is of this very run is kept; what was interrupted goes on where it was. One job that fails never stops the others.

    Args:
        suite: one of the package by name, the path of a TOML file, or a suite itself.
        methods, domains, tasks: only these of the suite's.
        algos, seeds, profile: instead of the suite's.
        output: folder of the records.
        report: folder of the leaderboard.
        device: ``cpu``, ``cuda`` or ``auto``.
        engine: how updates are carried out: ``eager``, ``compiled``, or ``auto``, which compiles long runs on a CPU that has a compiler.
        workers: processes on a CPU; None takes one for each core.
        keep: ``"datasets"``, or ``"records"`` to remove each dataset that the suite made as soon as all records of it are written.
        checkpoint_every: seconds between two checkpoints.
        ray: the address of a Ray cluster to run on, ``auto``, or ``local``; ``workers`` then means nothing.
        ray_root: a dataset root on storage that all nodes and this machine share; without one, each node has its own.
        ray_cpus, ray_gpus: that each task takes; a part of a GPU is a fraction.
        ray_retries: of a task whose node is lost.

    Raises:
        UsageError: wrong input, or other runs stand in the places of the suite's own; nothing has been written.
        RunError: another process runs a suite with this output, or something that exists is damaged.
        Interrupted: the process was asked to leave; what it had done is kept.
    """
    check_keep(keep)
    cluster = make_cluster(ray, ray_root, ray_cpus, ray_gpus, ray_retries)
    with shared_root(cluster):
        ready = prepare(
            suite, methods=methods, domains=domains, tasks=tasks, algos=algos, seeds=seeds, profile=profile, output=output, report=report,
            device=device, engine=engine, workers=workers, checkpoint_every=checkpoint_every, cluster=cluster,
        )  # fmt: skip
        return run_prepared(ready, keep, cluster)


def run_prepared(ready: Prepared, keep: str = "datasets", cluster: Cluster | None = None) -> SuiteReport:
    """Run what :func:`prepare` returned, as :func:`run_suite` does.

    Args:
        ready: the suite.
        keep: as for :func:`run_suite`.
        cluster: a Ray cluster to run it on, instead of this machine.
    """
    check_keep(keep)
    common, queue = ready.common, ready.queue(keep)
    jobs, left = len(ready.found.plan.needs), len(queue.plan.needs)
    if cluster is not None and queue.plan.of("stats"):
        raise UsageError("--ray does not measure datasets (stats); run that study without it where the datasets are.")
    with locked(common.folder / "lock", f"a suite into {common.output}"):
        echo(
            f"suite {ready.suite.name}: profile {common.profile}, {common.device},"
            f" {f'{ready.workers} at a time' if cluster is None else f'on Ray ({cluster.address})'}; {jobs} jobs,"
            f" {jobs - left} of them done or not needed any more; logs in {common.folder / 'logs'}"
        )
        if cluster is None:
            retention = Retention(ready.found.plan, queue.plan, common) if keep == "records" else None
            failures = run_locally(queue, common, ready.workers, jobs - left, retention)
            removed = [] if retention is None else retention.removed
        else:
            failures, removed = run_on_ray(queue, common, cluster, jobs - left, keep)
    failed = []
    for failure, log in failures:
        if failure.because is None:
            failed.append(f"{failure.job.name}: {failure.why} See {log}")
    if skipped := len(failures) - len(failed):
        failed.append(f"{skipped} jobs that need these could not start")
    return SuiteReport(jobs, jobs - left, failed, len(failures), removed, _leaderboard(ready))


def _leaderboard(ready: Prepared) -> Any:
    common = ready.common
    if not any(study.algos for study in ready.suite.studies):
        return None
    try:
        # Who asks for one worker has other work for the other cores.
        with only_cores(ready.workers if common.device == "cpu" else cores()):
            return plugins.load("stages", "make_leaderboard")(common.output, common.report, profile=common.profile)
    except UsageError:
        return None  # every training failed: there is no record


def check_keep(keep: str) -> str:
    """Refuse to keep anything else than what can be kept.

    Raises:
        UsageError: names what is allowed.
    """
    if keep not in KEEP:
        raise unknown("--keep", keep, KEEP)
    return keep


def make_cluster(address: str | None, root: str | Path | None, cpus: int, gpus: float, retries: int) -> Cluster | None:
    """What the options of a run say of a cluster; None if there is to be none.

    Raises:
        UsageError: an option that is for clusters was given without one, or cannot be.
    """
    if address is None:
        if root is not None or (cpus, gpus) != (1, 0.0):
            raise UsageError("--ray-root, --ray-cpus and --ray-gpus are for a Ray cluster; give --ray, too, or leave them out.")
        return None
    cluster = Cluster(address, None if root is None else check_folder(root, "the shared root").absolute(), cpus, gpus, retries)
    check_cluster(cluster)
    return cluster


def shared_root(cluster: Cluster | None) -> AbstractContextManager[None]:
    """Within this context, a cluster's shared dataset root is this process's, too."""
    return rooted_at(None if cluster is None else cluster.root)
