"""Independent jobs on the cores of one machine, each with its own progress bar; and functions that only compute, with one for all.

A job is a top-level function called as ``function(advance, **arguments)``. On a CPU every member of a stack is a job of its own,
since small matrices gain nothing from being stacked there; on a GPU all members share one job.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

from cudc_bench.errors import RunError, UsageError, finishing
from cudc_bench.execution import interrupts
from cudc_bench.execution.crew import Crew
from cudc_bench.execution.progress import Advance, bar_if_long, bars, warn
from cudc_bench.execution.workers import Died, Ended, Notify, Worker

T = TypeVar("T")
_THREADS = "OMP_NUM_THREADS"  # read by torch when it is imported
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # of mallopt(3)
_FEW = 6  # So many functions are done as fast by one process as others need to start.
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
            return _run_in_processes(lambda: Worker(partial(_work, function, threads)), jobs, advances, workers)
        with interrupts.leaving_gracefully():
            return [_call(function, job, threads, advance) for job, advance in zip(jobs, advances, strict=True)]


def computed(functions: Sequence[Callable[[], T]], description: str, unit: str, few: int = _FEW) -> list[T]:
    """What some functions return, in their order; where there are more than a ``few``, the cores share them.

    The processes are forked: they have everything that this one has, so that functions may be closures and nothing is copied. The first
    Ctrl-C waits for what has begun, and nothing is kept.

    Raises:
        RunError: a process died.
    """
    with bar_if_long(description, len(functions), unit) as advance:
        if len(functions) <= few or not _can_fork():
            results = []
            for function in functions:
                results.append(function())
                advance(1)
            return results

        def do(task: tuple[int, Job], notify: Notify) -> T:
            result = functions[task[0]]()
            notify(1)
            return result

        def make() -> Worker[tuple[int, Job]]:
            return Worker(do, saves=lambda _: False, context=get_context("fork"))

        jobs = [Job(description, 1)] * len(functions)
        # Outside of both, so that a request is not forgotten that comes when the last function ends.
        with warnings.catch_warnings(), interrupts.leaving_gracefully(saves=False):
            # Python warns of every thread; those of NumPy's libraries are made for it.
            warnings.simplefilter("ignore", DeprecationWarning)
            try:
                found = _run_in_processes(make, jobs, [advance] * len(jobs), cores(), saves=False)
            except interrupts.Interrupted:
                found = []
            if interrupts.requested():
                raise KeyboardInterrupt
            return found


def _can_fork() -> bool:
    # A lock that another thread holds at that moment would stay locked for ever in the new process.
    return cores() > 1 and threading.active_count() == 1 and parent_process() is None


def _run_in_processes(
    make: Callable[[], Worker[tuple[int, Job]]], jobs: list[Job], advances: Sequence[Advance], workers: int, saves: bool = True
) -> list[Any]:
    """The jobs' results, in their order.

    Args:
        make: starts a process that does a job, given with its number, and tells how far it is.
        jobs: what to do.
        advances: of each job's bar.
        workers: how many processes at most.
        saves: whether what a job has done is kept when it is asked to leave.
    """
    crew = Crew(make, workers, saves)
    left = list(reversed(list(enumerate(jobs))))
    results: dict[int, Any] = {}
    errors: dict[int, BaseException] = {}

    def next_task() -> tuple[int, Job] | None:
        # After a failure jobs that have not started are dropped, and the running ones are waited for: they lose nothing.
        return left.pop() if left and not errors else None

    def on_news(task: tuple[int, Job], news: Any) -> None:
        index, job = task
        if isinstance(news, Died):
            errors[index] = RunError(f"a worker process died ({news.how}); run the same command again.")
            crew.request_stop()  # what ended it, mostly a want of memory, would end them without a chance to save
        elif not isinstance(news, Ended):
            advances[index](news)
        elif news.error is None:
            results[index] = news.result
        else:
            errors[index] = news.error
            if not isinstance(news.error, interrupts.Interrupted) and crew.is_busy:
                warn(f"{job.description} failed, the others that have begun go on: {news.error}")

    with interrupts.leaving_gracefully():
        crew.work(next_task, on_news)
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


def _work(function: Callable[..., Any], threads: int, task: tuple[int, Job], notify: Callable[[int], None]) -> Any:
    return _call(function, task[1], threads, notify)


def _call(function: Callable[..., Any], job: Job, threads: int, advance: Advance) -> Any:
    if interrupts.requested():
        raise interrupts.interrupted("")  # this job has not even begun
    try:
        with torch_threads(threads), kept_memory(), finishing():
            return function(advance, **job.arguments)
    except interrupts.Interrupted as error:
        raise interrupts.interrupted(f"{job.description} {error.where}") from None


@contextmanager
def kept_memory() -> Iterator[None]:
    """Within this context the C library (glibc) keeps memory that was freed, for what is allocated next.

    It would give blocks of more than 32 MiB back to the system at once, which then fills the next ones with zeros, page by page. An update
    that has such blocks, CQL's at the paper's size, takes a fifth longer so. Afterwards everything that is free is given back.
    """
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    if not hasattr(library, "mallopt") or not hasattr(library, "malloc_trim"):
        yield
        return
    assert library is not None
    library.mallopt(_MMAP_THRESHOLD, 1 << 28)
    library.mallopt(_TRIM_THRESHOLD, (1 << 31) - 1)
    try:
        yield
    finally:
        library.mallopt(_MMAP_THRESHOLD, 1 << 17)  # as at the start of a process
        library.mallopt(_TRIM_THRESHOLD, 1 << 17)
        library.malloc_trim(0)


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
