"""The local scheduler: as many processes as the machine has room for, each with one job at a time."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from cudc_bench.artefacts.ids import parse_id
from cudc_bench.data.deletion import finish_removal
from cudc_bench.errors import RunError
from cudc_bench.execution import interrupts
from cudc_bench.execution.crew import Crew
from cudc_bench.execution.parallel import all_cores
from cudc_bench.text import size

from .display import Display, Running, duration
from .jobs import Job, JobGraph
from .pool import Given, Outcome, Progress, job_worker, understood
from .queue import Failure, Queue
from .work import Common, made_by, remove

_AGAIN = 1.0  # seconds after which a job is tried again that somebody else kept from starting


class Retention:
    """Removes datasets when nothing of a suite needs them any more.

    Args:
        plan: all jobs of the suite.
        left: those to do.
        common: to all of them.
    """

    def __init__(self, plan: JobGraph, left: JobGraph, common: Common) -> None:
        self._users = {one: users & left.needs.keys() for one, users in plan.users().items()}
        self._all = [one for job in plan.of("collect", "relabel") for one in made_by(job)]
        self._common = common
        self.removed: list[str] = []
        self.size = 0

    def job_done(self, job: Job | None, notify: Callable[[str], None]) -> None:
        """Remove what only this job still needed; with None, what nothing needs from the start, and what a killed process left."""
        if job is None:
            for one in self._all:
                finish_removal(parse_id(one))
        for base in list(self._users) if job is None else job.datasets:
            users = self._users.get(base)
            if users is None:
                continue
            users.discard(job)
            if users:
                continue
            del self._users[base]
            with suppress(RunError):  # somebody is at work on it
                removed, count = remove(self._common, base)
                if removed:
                    self.removed += removed
                    self.size += count
                    notify(f"removed {base} and {len(removed) - 1} labelled from it ({size(count)}): all records of it are written")


def run_locally(queue: Queue, common: Common, workers: int, before: int, retention: Retention | None = None) -> list[tuple[Failure, Path]]:
    """Do all jobs of a queue, at most so many at once; a job that fails stops only those that need it.

    Args:
        queue: of the jobs.
        common: to all of them.
        workers: processes; each has an equal share of the cores.
        before: jobs that were done before.
        retention: removes datasets; None keeps them.

    Returns:
        What failed, with its log.

    Raises:
        Interrupted: the process was asked to leave; the jobs have saved what they had done.
    """
    display = Display(queue, workers, before)
    logs = common.folder / "logs"
    running: dict[Job, Running] = {}
    held: dict[Job, float] = {}
    share = max(1, all_cores() // workers)
    left: dict[Job, str] = {}

    def start() -> Given | None:
        not_now = [job for job, when in held.items() if when > time.monotonic()]
        if (job := queue.start(not_now)) is None:
            return None
        left.pop(job, None)
        running[job] = Running(job, time.monotonic(), queue.seconds[job])
        return job, logs / f"{job.slug}.log"

    def on_news(given: Given, news: Any) -> None:
        job, told = given[0], understood(news)
        if isinstance(told, Progress):
            running[job].notify(told.done, told.total)
        else:
            end(job, told)

    def end(job: Job, ended: Outcome) -> None:
        one = running.pop(job)
        passed = time.monotonic() - one.started
        if ended.how == "done":
            held.pop(job, None)
            queue.succeed(job, passed if one.is_whole else None)
            display.line(f"done {job.name} in {duration(passed)}; {display.summary(running)}")
            if retention is not None:
                retention.job_done(job, display.line)
        elif ended.how == "held":
            if job not in held:
                display.line(f"waiting {job.name}: {ended.why}")
            held[job] = time.monotonic() + _AGAIN
            queue.put_back(job)
        elif ended.how == "left":
            queue.put_back(job)
            left[job] = ended.why
            if not interrupts.requested():
                display.line(f"again {job.name}: somebody asked its process to leave; it goes on in another")
        else:
            log = logs / f"{job.slug}.log"
            queue.fail(job, ended.why)
            display.failed(job, f"{ended.why} See {log}")

    if retention is not None:
        retention.job_done(None, display.line)
    crew = Crew(lambda: job_worker(share, common), workers)
    with interrupts.leaving_gracefully(), display.shown():
        crew.work(start, on_news, lambda: queue.is_over, lambda: display.refresh(running))
        if interrupts.requested():
            done = f"{before + len(queue.done)} of {before + len(queue.plan.needs)} jobs done"
            raise interrupts.interrupted("; ".join([done, *dict.fromkeys(filter(None, left.values()))]))
    return [(failure, logs / f"{(failure.because or failure.job).slug}.log") for failure in queue.failures]
