"""A suite on a Ray cluster: one task for each (domain, method, group of seeds), which does all that is to be done of it on one node.

Ray decides where tasks run, and starts those of a lost node again elsewhere. Where the nodes share a dataset root, such a task goes on from
the last checkpoint; where each has its own, it starts over, with the same result. Records come back to the driver as they are finished.
"""

from __future__ import annotations

import os
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cudc_bench.artefacts.ids import datasets_root, default_id, rooted_at
from cudc_bench.artefacts.records import SUITE_FOLDER, Record, record_path
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.parallel import use_cores
from cudc_bench.files import environment, read_limited, unwritable, write_atomically
from cudc_bench.settings.config import config_hash

from .display import Display
from .jobs import Job
from .pool import Outcome, attempt, into
from .queue import Failure, Queue
from .work import Common, note_path, remove

_HOST = re.compile(r"([A-Za-z0-9._-]{1,253}):(\d{1,5})")
_CONNECT = 10.0  # seconds
_PATIENCE = 600.0  # seconds to wait for a lock: that of a node that was lost lives until its file server notices
_LEAVING = 120.0  # seconds that tasks have to save what they have done
_LOG = 20_000  # characters of a failed job's log that come back
RETRIES = 3  # of a task whose node was lost
THRESHOLDS = "CUDC_BENCH_THRESHOLDS"


@dataclass(frozen=True)
class Cluster:
    """Where and with what tasks run.

    Attributes:
        address: of a running cluster, ``auto``, or ``local`` for one on this machine that ends with the suite.
        root: dataset root on storage that all nodes and this machine share; None if each node has its own.
        cpus, gpus: of each task; a part of a GPU is a fraction.
        retries: of a task whose node or process was lost.
    """

    address: str
    root: Path | None = None
    cpus: int = 1
    gpus: float = 0.0
    retries: int = RETRIES


@dataclass(frozen=True)
class News:
    """What a task says of one of its jobs.

    Attributes:
        job: which; None for datasets that were removed.
        ended: how it went.
        files: contents by place below the folder of the records: records, policies, notes of datasets.
        log: its end, where it failed.
        removed: datasets.
    """

    job: Job | None
    ended: Outcome
    files: dict[str, bytes]
    log: str = ""
    removed: tuple[str, ...] = ()


def check_cluster(cluster: Cluster) -> None:
    """Refuse what cannot work before anything is started.

    Raises:
        UsageError: Ray is not installed, or an option makes no sense.
    """
    if find_spec("ray") is None:
        raise UsageError("--ray needs a package that is not installed; pip install 'cudc-bench[ray]', or leave out --ray.")
    if cluster.address not in ("auto", "local") and not _HOST.fullmatch(cluster.address):
        raise UsageError(f"--ray cannot be '{cluster.address}'; give auto, local, or host:port.")
    if cluster.cpus < 1:
        raise UsageError(f"--ray-cpus takes 1 or more, not {cluster.cpus}.")
    if not 0 <= cluster.gpus <= 1024:
        raise UsageError(f"--ray-gpus takes 0, a fraction or a number of GPUs, not {cluster.gpus:g}.")


def run_on_ray(
    queue: Queue, common: Common, cluster: Cluster, before: int, keep: str = "datasets"
) -> tuple[list[tuple[Failure, Path]], list[str]]:
    """Do all jobs of a queue on a cluster; the arguments are those of :func:`cudc_bench.suites.scheduler.run_locally`.

    Returns:
        What failed with its log, and the datasets that were removed.

    Raises:
        RunError: there is no such cluster, or none of its nodes has what a task needs.
        Interrupted: the process was asked to leave; on shared storage the tasks have kept what they had done.
    """
    import ray

    ours = not ray.is_initialized()
    if ours:
        try:
            if host := _HOST.fullmatch(cluster.address):
                # Ray itself would try for two minutes.
                socket.create_connection((host[1], int(host[2])), _CONNECT).close()
            ray.init(address=cluster.address, log_to_driver=False, logging_level="ERROR")
        except (OSError, OverflowError, ValueError, RuntimeError) as error:
            raise RunError(f"there is no Ray cluster at '{cluster.address}': {' '.join(str(error).split())}") from None
    try:
        return _drive(ray, queue, common, cluster, before, keep)
    finally:
        if ours:
            ray.shutdown()


def _drive(
    ray: Any, queue: Queue, common: Common, cluster: Cluster, before: int, keep: str
) -> tuple[list[tuple[Failure, Path]], list[str]]:
    needed = {"CPU": cluster.cpus, "GPU": cluster.gpus}
    if not any(node["Alive"] and all(node["Resources"].get(name, 0) >= count for name, count in needed.items()) for node in ray.nodes()):
        wanted = f"{cluster.cpus} CPUs and {cluster.gpus:g} GPUs"
        raise RunError(f"no node of the cluster has {wanted}; ask for less with --ray-cpus and --ray-gpus.")
    at_once = max(1, int(ray.cluster_resources().get("CPU", 1)) // cluster.cpus)
    display, logs, removed = Display(queue, at_once, before), common.folder / "logs", list[str]()
    options = {"num_cpus": cluster.cpus, "num_gpus": cluster.gpus, "max_retries": cluster.retries}
    measure, work = ray.remote(**options)(_measure), ray.remote(num_returns="streaming", **options)(_work)
    known = _thresholds()
    pilots = {job: measure.remote(job, common, cluster, known) for job in queue.plan.of("pilot")}
    groups = _groups(queue)
    tasks = {
        work.remote(jobs, common, cluster, _threshold_of(pilots, jobs[0], known), keep, dict(queue.plan.needs)): jobs
        for jobs in groups
    }  # fmt: skip
    asked: float | None = None

    def take(news: News) -> None:
        removed.extend(news.removed)
        for place, content in sorted(news.files.items(), key=lambda file: file[0].endswith(".json")):
            _put(common.output / place, content)
        job = news.job
        if job is None or job not in queue.waiting:
            return  # known already: it needs a job that failed
        queue.take(job)
        if news.ended.how == "done":
            queue.succeed(job)
            display.line(f"done {job.name}; {display.summary({})}")
        elif news.ended.how == "left" and asked is not None:
            queue.put_back(job)
        else:
            log = logs / f"{job.slug}.log"
            with suppress(OSError):
                write_atomically(log, news.log)
            why = news.ended.why or "somebody asked its process to leave."
            queue.fail(job, why)
            display.failed(job, f"{why} See {log}")

    with interrupts.leaving_gracefully():
        while tasks or pilots:
            if interrupts.requested() and asked is None:
                asked = time.monotonic()
                for one in (*tasks, *pilots.values()):
                    ray.cancel(one)
            if asked is not None and time.monotonic() - asked > _LEAVING:
                break
            ready, _ = ray.wait([*pilots.values(), *tasks], num_returns=1, timeout=0.5, fetch_local=False)
            for one in ready:
                lost = _hear(ray, one, pilots, tasks, take)
                for job, why in lost:
                    take(News(job, Outcome("left" if asked is not None else "failed", why), {}, why))
            display.refresh({})
        if interrupts.requested():
            raise interrupts.interrupted(f"{before + len(queue.done)} of {before + len(queue.plan.needs)} jobs done")
    return [(failure, logs / f"{(failure.because or failure.job).slug}.log") for failure in queue.failures], removed


def _hear(ray: Any, one: Any, pilots: dict[Job, Any], tasks: dict[Any, list[Job]], take: Callable[[News], None]) -> list[tuple[Job, str]]:
    """Take what a task has to say; the jobs of one that ended badly, with the reason."""
    mine = tasks.get(one) if one in tasks else [job for job, ref in pilots.items() if ref == one]
    assert mine is not None
    try:
        if one in tasks:
            take(ray.get(next(one)))
        else:
            del pilots[mine[0]]
            take(ray.get(one)[1])
    except StopIteration:
        del tasks[one]
    except ray.exceptions.RayError as error:
        tasks.pop(one, None)
        first = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
        return [(job, f"its task was lost: {first.strip()}") for job in mine]
    return []


def _groups(queue: Queue) -> list[list[Job]]:
    """The jobs that one task does, each list in an order in which they can be done; those that take longest first."""
    found: dict[tuple[str, str, tuple[int, ...]], list[Job]] = {}
    for job in queue.plan.of("collect", "relabel", "evaluate"):
        found.setdefault((job.domain, job.method, job.seeds), []).append(job)
    return sorted(found.values(), key=lambda jobs: -sum(queue.seconds[job] for job in jobs))


def _threshold_of(pilots: dict[Job, Any], job: Job, known: bytes) -> Any:
    """What a task's thresholds will be: Ray waits for the pilot's result."""
    return next((ref for pilot, ref in pilots.items() if (pilot.domain, pilot.methods) == (job.domain, job.methods)), known)


def _thresholds() -> bytes:
    with suppress(OSError):
        return read_limited(Path(os.environ.get(THRESHOLDS) or "thresholds.json"))
    return b""


def _put(path: Path, content: bytes) -> None:
    try:
        if path.suffix == ".json" and SUITE_FOLDER not in path.parts:
            Record.model_validate_json(content)
        write_atomically(path, content)
    except ValidationError as error:
        raise RunError(f"a node sent what is no record for {path}: {error.errors()[0]['msg']}; install the same version there.") from None
    except OSError as error:
        raise unwritable(str(path), error) from None


# ------------------------------------------------------------------------------------------------------------------------ on the nodes


def _measure(job: Job, common: Common, cluster: Cluster, known: bytes) -> tuple[bytes, News]:
    """A pilot, as a Ray task: the thresholds with its own among them, and how it went."""
    with _place(common, cluster, known) as (here, thresholds):
        news = _attempt(job, here)
        return (thresholds.read_bytes() if thresholds.exists() else known), news


def _work(
    jobs: list[Job], common: Common, cluster: Cluster, threshold: bytes | tuple[bytes, News], keep: str, needs: dict[Job, tuple[Job, ...]]
) -> Iterator[News]:
    """All that is to be done of some datasets, as a Ray task: one piece of news for each job, in their order, and one for what was removed.

    A task that Ray starts again after its node was lost says the same again, of which the driver takes what it had not heard.
    """
    with _place(common, cluster, threshold if isinstance(threshold, bytes) else threshold[0]) as (here, _):
        bad: set[Job] = set()
        for job in jobs:
            if bad.intersection(needs[job]):
                bad.add(job)
                yield News(job, Outcome("failed", "it needs a job that failed"), {})
                continue
            news = _attempt(job, here)
            if news.ended.how != "done":
                bad.add(job)
            yield news
        removed: list[str] = []
        if keep == "records" and not bad:
            for base in jobs[0].datasets:
                with suppress(RunError):
                    removed += remove(here, base)[0]
        if not bad:
            # The driver has the records; whoever removes one there wants it to be made again.
            for job in jobs:
                for place in _made(job, here) if job.kind == "evaluate" else ():
                    (here.output / place).unlink(missing_ok=True)
        yield News(None, Outcome("done"), {}, removed=tuple(removed))


@contextmanager
def _place(common: Common, cluster: Cluster, thresholds: bytes) -> Iterator[tuple[Common, Path]]:
    """The environment of a task: its dataset root, its own file of thresholds, and a folder for records and what goes on from there.

    That folder lies in the dataset root, where it outlives a node if the nodes share it.
    """
    use_cores(cluster.cpus)
    key = config_hash({"profile": common.profile, "collect": dict(common.collect), "evaluate": dict(common.evaluate)})
    with rooted_at(cluster.root):
        folder = datasets_root().absolute() / ".suites" / f"{common.suite}-{key}"
        own = folder / "thresholds" / f"{os.getpid()}.json"
        try:
            if thresholds:
                write_atomically(own, thresholds)
            with environment(THRESHOLDS, str(own)):
                yield replace(common, output=folder / "results", report=folder / "report"), own
        finally:
            own.unlink(missing_ok=True)


def _attempt(job: Job, here: Common) -> News:
    log = here.folder / "logs" / f"{job.slug}.log"
    started = time.monotonic()
    with into(log):
        ended = attempt(job, here, lambda *_: None)
        while ended.how == "held" and time.monotonic() - started < _PATIENCE:
            time.sleep(1.0)
            ended = attempt(job, here, lambda *_: None)
    files = {place: (here.output / place).read_bytes() for place in _made(job, here)} if ended.how == "done" else {}
    how = "failed" if ended.how == "held" else ended.how
    return News(job, Outcome(how, ended.why), files, log.read_text(errors="replace")[-_LOG:] if how == "failed" else "")


def _made(job: Job, here: Common) -> list[str]:
    """The files that a job leaves for the driver, below the folder of the records."""
    found = []
    for seed, base in zip(job.seeds, job.datasets, strict=True):
        one = default_id(job.domain, job.method, seed, job.profile)
        if job.kind == "evaluate":
            places = [(one.for_task(task), labels) for task in job.tasks for labels in job.labels or (None,)]
            where = partial(record_path, here.output, algorithm=str(job.algo), seed=seed, profile=here.profile, used=job.used)
            records = [where(dataset_id=str(place), labels=labels) for place, labels in places]
            found += [path for record in records for path in (record, record.with_suffix(".policy.pt"))]
            found += [where(dataset_id=base).with_suffix(".learner.pt")] if job.labels else []
        else:
            ids = [base] if job.kind == "collect" else [str(one.for_task(task)) for task in job.tasks]
            found += [note_path(here, each) for each in ids]
    return [path.relative_to(here.output).as_posix() for path in found if path.exists()]
