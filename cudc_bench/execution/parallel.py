"""Independent jobs on the cores of one machine, each with its own progress bar.

A job is a top-level function called as ``function(advance, **arguments)``. On a CPU every member of a stack is a job of its own,
since small matrices gain nothing from being stacked there; on a GPU all members share one job.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.crew import Crew
from cudc_bench.execution.progress import Advance, bars, say
from cudc_bench.execution.workers import Died, Ended, Worker

_THREADS = "OMP_NUM_THREADS"  # read by torch when it is imported
_share: int | None = None  # in a worker process: of the machine's cores, where other processes have the rest


@dataclass(frozen=True)
class Job:
    """One piece of work.

    Attributes:
        description: for its progress bar.
        total: what it counts up to.
        arguments: keyword arguments of the job function; they must be picklable.
    """

    description: str
    total: int
    arguments: dict[str, Any] = field(default_factory=dict)


def worker_count(asked: int | None, jobs: int) -> int:
    """How many processes to use: what was asked, by default one for each core, never more than there are jobs.

    Raises:
        UsageError: less than one was asked for.
    """
    if asked is not None and asked < 1:
        raise UsageError(f"--workers takes 1 or more, not {asked}.")
    return max(1, min(asked or cores(), jobs))


def cores() -> int:
    """Cores that this process may use."""
    return _share or all_cores()


def all_cores() -> int:
    """Cores that the system lets this process use, whatever was agreed with others."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_cores(count: int) -> None:
    """Let what this process runs take only so many cores."""
    global _share
    _share = count


@contextmanager
def only_cores(count: int) -> Iterator[None]:
    """Within this context :func:`use_cores` holds."""
    global _share
    before, _share = _share, count
    try:
        yield
    finally:
        _share = before


def run_jobs(function: Callable[..., Any], jobs: list[Job], *, unit: str, workers: int, threads: int | None) -> list[Any]:
    """Run the jobs, at most ``workers`` at once, and return their results in order.

    The first Ctrl-C, or a SIGTERM, asks the jobs to save their state and leave (see ``cudc_bench.execution.interrupts``).

    Args:
        function: called as ``function(advance, **job.arguments)``.
        jobs: what to do.
        unit: what the bars count.
        workers: number of processes; with 1 the jobs run in this process, one after the other.
        threads: CPU threads of each job; None shares the cores among the workers, though there may be fewer jobs. Results depend on it.

    Raises:
        RunError: a job failed, or its process died.
        Interrupted: the jobs were asked to leave.
    """
    threads = threads or max(1, cores() // workers)
    with bars([(job.description, job.total) for job in jobs], unit) as advances:
        if min(workers, len(jobs)) > 1:
            return _run_in_processes(function, jobs, advances, workers, threads)
        with interrupts.leave_well():
            return [_call(function, job, threads, advance) for job, advance in zip(jobs, advances, strict=True)]


def _run_in_processes(function: Callable[..., Any], jobs: list[Job], advances: list[Any], workers: int, threads: int) -> list[Any]:
    crew: Crew[tuple[int, Job]] = Crew(lambda: Worker(partial(_work, function, threads)), workers)
    left = list(reversed(list(enumerate(jobs))))
    results: dict[int, Any] = {}
    errors: dict[int, BaseException] = {}

    def next_task() -> tuple[int, Job] | None:
        # After a failure jobs that have not started are dropped, and the running ones are waited for: they lose nothing.
        return left.pop() if left and not errors else None

    def hear(task: tuple[int, Job], news: Any) -> None:
        index, job = task
        if isinstance(news, Died):
            errors[index] = RunError(f"a worker process died ({news.how}); run the same command again.")
            crew.ask()  # what ended it, mostly a want of memory, would end them without a chance to save
        elif not isinstance(news, Ended):
            advances[index](news)
        elif news.error is None:
            results[index] = news.result
        else:
            errors[index] = news.error
            if not isinstance(news.error, interrupts.Interrupted) and crew.is_busy:
                say(f"{job.description} failed, the others that have begun go on: {news.error}")

    with interrupts.leave_well():
        crew.work(next_task, hear)
        return _results([results.get(index) for index in range(len(jobs))], [errors[index] for index in sorted(errors)], bool(left))


def _results(results: list[Any], errors: list[BaseException], left: bool) -> list[Any]:
    """The results of jobs, or the error of the first that failed, or in one the places at which they were interrupted."""
    stopped = [error for error in errors if isinstance(error, interrupts.Interrupted)]
    failed = [error for error in errors if not isinstance(error, interrupts.Interrupted)]
    # Where a worker died, the others were asked to leave by nobody but this process.
    if (stopped or left) and (interrupts.requested() or not failed):
        raise interrupts.interrupted(", ".join(filter(None, (one.where for one in stopped)))) from next(iter(failed), None)
    for error in failed:
        raise error
    return results


def _work(function: Callable[..., Any], threads: int, task: tuple[int, Job], tell: Callable[[int], None]) -> Any:
    return _call(function, task[1], threads, tell)


def _call(function: Callable[..., Any], job: Job, threads: int, advance: Advance) -> Any:
    if interrupts.requested():
        raise interrupts.interrupted("")  # this job has not even begun
    try:
        with torch_threads(threads):
            return function(advance, **job.arguments)
    except interrupts.Interrupted as error:
        raise interrupts.interrupted(f"{job.description} {error.where}") from None


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Within this context torch uses the given number of threads; if it is first imported there, that or as many as there are cores."""
    if (torch := sys.modules.get("torch")) is None:
        before = os.environ.get(_THREADS)
        os.environ[_THREADS] = str(count)
    else:
        before = torch.get_num_threads()
        torch.set_num_threads(count)
    try:
        yield
    finally:
        if torch is not None:
            torch.set_num_threads(before)
        elif before is None:
            del os.environ[_THREADS]
        else:
            os.environ[_THREADS] = before
