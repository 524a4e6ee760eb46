"""Processes that take one job after another, so that PyTorch is imported once for each and not once for each job.

A worker's output goes to a file of each job's own.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from cudc_bench.errors import CudcBenchError, HeldError
from cudc_bench.execution import interrupts, workers
from cudc_bench.execution.parallel import use_cores
from cudc_bench.text import visible

from .jobs import Job
from .work import Common, do

_NOTIFY_EVERY = 0.25  # seconds between two reports of progress
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Progress:
    """A job is so far."""

    done: int
    total: int


@dataclass(frozen=True)
class Outcome:
    """A job has ended.

    Attributes:
        how: ``done``, ``failed``, ``held`` (somebody else is at work on the same thing) or ``left`` (it was asked to, and has saved).
        why: one line, unless it is done.
    """

    how: str
    why: str = ""


Given = tuple[Job, Path]  # a job, and the file that its output goes to


def job_worker(cores: int, common: Common, context: Any = None) -> workers.Worker[Given]:
    """A process for jobs.

    Args:
        cores: that it may use.
        common: to all its jobs.
        context: how processes start; anew unless given.
    """
    with _threads(cores):
        return workers.Worker(partial(_attempt, common), partial(use_cores, cores), _saves, context)


def understood(news: Any) -> Progress | Outcome:
    """What such a process has said of its job; one that died says that it failed."""
    if isinstance(news, workers.Died):
        return Outcome("failed", f"its process died ({news.how})")
    if not isinstance(news, workers.Ended):
        told: Progress = news
        return told
    if isinstance(news.error, interrupts.Interrupted):
        return Outcome("left", visible(news.error.where))
    if news.error is not None:
        return Outcome("failed", visible(str(news.error)))
    ended: Outcome = news.result
    return ended


def _saves(given: Given) -> bool:
    return given[0].kind != "stats"


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """What processes inherit, since libraries read it when they are loaded; PyTorch is told by itself."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, str(count)))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _attempt(common: Common, given: Given, send: workers.Notify) -> Outcome:
    job, log = given
    last = 0.0

    def notify(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _NOTIFY_EVERY:
            last = time.monotonic()
            send(Progress(done, total))

    try:
        with into(log):
            return attempt(job, common, notify)
    except OSError as error:
        return Outcome("failed", f"its log {log} cannot be written: {error.strerror or error}")


def attempt(job: Job, common: Common, notify: Any) -> Outcome:
    """Do a job in this process, and say how it went; standard error has when, for how long, and in its last line what went wrong."""
    print(f"# {datetime.now(UTC).isoformat(timespec='milliseconds')}, process {os.getpid()}: {job.name}", file=sys.stderr, flush=True)
    started = time.monotonic()
    try:
        do(job, common, notify)
        ended = Outcome("done")
    except interrupts.Interrupted as error:
        ended = Outcome("left", visible(error.where))
    except HeldError as error:
        ended = Outcome("held", visible(str(error)))
    except CudcBenchError as error:
        ended = Outcome("failed", visible(str(error)))
    except BaseException as error:
        traceback.print_exc()
        ended = Outcome("failed", visible(f"{type(error).__name__}: {error}"))
    print(f"# {ended.how} after {time.monotonic() - started:.3f} s", *filter(None, [ended.why]), sep="\n", file=sys.stderr, flush=True)
    return ended


@contextmanager
def into(log: Path) -> Iterator[None]:
    """Send all that this process and its libraries print to the end of a file."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        sys.stdout.flush()
        sys.stderr.flush()
        kept = [os.dup(number) for number in (1, 2)]
        try:
            for number in (1, 2):
                os.dup2(file.fileno(), number)
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, before in zip((1, 2), kept, strict=True):
                os.dup2(before, number)
                os.close(before)
