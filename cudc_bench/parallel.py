"""Independent jobs on the cores of one machine, each with its own progress bar.

A job is a top-level function called as ``function(advance, **arguments)``. On a CPU every member of a stack is a job of its own,
since small matrices gain nothing from being stacked there; on a GPU all members share one job.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from cudc_bench.errors import RunError, UsageError
from cudc_bench.progress import bars

_queue: Any = None  # in a worker process: where progress is reported
_leaving = False  # in a worker process: whether it has been told to leave


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
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_jobs(function: Callable[..., Any], jobs: list[Job], *, unit: str, workers: int, threads: int | None) -> list[Any]:
    """Run the jobs, at most ``workers`` at once, and return their results in order.

    Args:
        function: called as ``function(advance, **job.arguments)``.
        jobs: what to do.
        unit: what the bars count.
        workers: number of processes; with 1 the jobs run in this process, one after the other.
        threads: CPU threads of each job; None shares the cores among the workers.

    Raises:
        RunError: a job failed, or its process died.
    """
    threads = threads or max(1, cores() // workers)
    with bars([(job.description, job.total) for job in jobs], unit) as advances:
        if workers == 1:
            with torch_threads(threads):
                return [function(advance, **job.arguments) for job, advance in zip(jobs, advances, strict=True)]
        return _run_in_processes(function, jobs, advances, workers, threads)


def _run_in_processes(function: Callable[..., Any], jobs: list[Job], advances: list[Any], workers: int, threads: int) -> list[Any]:
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    listener = threading.Thread(target=_listen, args=(queue, advances), daemon=True)
    listener.start()
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=(queue, threads))
    try:
        futures = [pool.submit(_call, function, index, job.arguments) for index, job in enumerate(jobs)]
        return [future.result() for future in futures]
    except KeyboardInterrupt:
        # From a terminal the workers were interrupted, too; a signal sent to this process alone has to be passed on.
        for child in multiprocessing.active_children():
            if child.pid is not None:
                os.kill(child.pid, signal.SIGINT)
        raise
    except BrokenProcessPool:
        raise RunError("a worker process died (killed, or out of memory); run the same command again.") from None
    finally:
        # After a failure, jobs that have not started are dropped and the running ones are waited for: they lose nothing.
        pool.shutdown(wait=True, cancel_futures=True)
        queue.put(None)
        listener.join()


def _start_worker(queue: Any, threads: int) -> None:
    global _queue
    _queue = queue
    # Ctrl-C reaches every process of the terminal; a worker leaves quietly, through its own clean-up.
    signal.signal(signal.SIGINT, _leave)
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    import torch

    torch.set_num_threads(threads)


def _leave(*_: object) -> None:
    global _leaving
    _leaving = True
    sys.exit(130)


def _report(index: int, n: int) -> None:
    """What a job in a worker calls to tell how far it is."""
    # Python drops an exception that a signal raises inside a finaliser or a callback; the job would then go on for nobody.
    if _leaving:
        sys.exit(130)
    _queue.put((index, n))


def _leave_with_parent() -> None:
    """End this worker when the process that wants its result was killed; it would compute to the end for nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGINT)


def _call(function: Callable[..., Any], index: int, arguments: dict[str, Any]) -> Any:
    try:
        return function(partial(_report, index), **arguments)
    except SystemExit:
        # The job has cleaned up. The pool would now report this to the parent and wait for the next job, though nobody may be there.
        parent = multiprocessing.parent_process()
        if parent is not None and not parent.is_alive():
            os._exit(130)
        raise


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
