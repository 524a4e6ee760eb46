"""Independent jobs on the cores of one machine, each with its own progress bar.

A job is a top-level function called as ``function(advance, **arguments)``. On a CPU every member of a stack is a job of its own,
since small matrices gain nothing from being stacked there; on a GPU all members share one job.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from cudc_bench import interrupts
from cudc_bench.errors import RunError, UsageError
from cudc_bench.progress import Advance, bars

# In a worker process:
_queue: Any = None  # where progress is reported
_busy = False  # whether it has a job
_share: int | None = None  # of the machine's cores, where other processes have the rest


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

    The first Ctrl-C, or a SIGTERM, asks the jobs to save their state and leave (see ``cudc_bench.interrupts``).

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
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    listener = threading.Thread(target=_listen, args=(queue, advances), daemon=True)
    listener.start()
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(queue,))
    try:
        # In this order: a second Ctrl-C must not wait for the workers, neither while they work nor while they finish.
        with interrupts.leave_well(pass_on=partial(_signal_workers, signal.SIGTERM)), _or_killed(), _finished(pool), _or_killed():
            with signals_blocked():
                futures = [pool.submit(_work, function, job, index, threads) for index, job in enumerate(jobs)]
            wait(futures, return_when=FIRST_EXCEPTION)
            if interrupts.requested():
                wait(futures)
            return _results(futures)
    except BrokenProcessPool:
        raise RunError("a worker process died (killed, or out of memory); run the same command again.") from None
    finally:
        queue.put(None)
        listener.join()


@contextmanager
def _finished(pool: ProcessPoolExecutor) -> Iterator[None]:
    """After a failure, jobs that have not started are dropped and the running ones are waited for: they lose nothing."""
    try:
        yield
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _or_killed() -> Iterator[None]:
    """Kill the workers if this process is to stop at once."""
    try:
        yield
    except interrupts.Interrupted:
        raise
    except KeyboardInterrupt:
        _signal_workers(signal.SIGKILL)
        raise


def _results(futures: Sequence[Future[Any]]) -> list[Any]:
    """The results of jobs, or the error of the first that failed, or in one the places at which they were interrupted."""
    errors = [error for one in futures if one.done() and (error := one.exception()) is not None]
    stopped = [error for error in errors if isinstance(error, interrupts.Interrupted)]
    if stopped:
        raise interrupts.interrupted(", ".join(filter(None, (one.where for one in stopped))))
    for error in errors:
        raise error
    return [future.result() for future in futures]


def _signal_workers(number: int) -> None:
    for child in multiprocessing.active_children():
        if child.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(child.pid, number)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Processes inherit what is blocked: a worker never hears Ctrl-C, and SIGTERM only once it knows what to do with it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(queue: Any) -> None:
    global _queue
    _queue = queue
    signal.signal(signal.SIGTERM, lambda number, _: interrupts.ask(number))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    leave_with_parent(lambda: _busy)


def leave_with_parent(busy: Callable[[], bool]) -> None:
    """End this worker when the process that wants its results was killed: at once if it is idle, else when its job has saved its state.

    Args:
        busy: whether there is a job that will save its state.
    """
    parent = multiprocessing.parent_process()

    def wait_and_leave() -> None:
        if parent is None:
            return
        parent.join()
        interrupts.ask(signal.SIGTERM)
        while busy():
            time.sleep(0.05)
        os._exit(1)

    threading.Thread(target=wait_and_leave, daemon=True).start()


def _work(function: Callable[..., Any], job: Job, index: int, threads: int) -> Any:
    global _busy
    _busy = True
    try:
        return _call(function, job, threads, lambda n: _queue.put((index, n)))
    finally:
        _busy = False


def _call(function: Callable[..., Any], job: Job, threads: int, advance: Advance) -> Any:
    if interrupts.requested():
        raise interrupts.interrupted("")  # this job has not even begun
    try:
        with torch_threads(threads):
            return function(advance, **job.arguments)
    except interrupts.Interrupted as error:
        raise interrupts.interrupted(f"{job.description} {error.where}") from None


def _listen(queue: Any, advances: list[Any]) -> None:
    while (message := queue.get()) is not None:
        index, n = message
        advances[index](n)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Within this context torch uses the given number of threads."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
