"""Processes that take one job after another, so that PyTorch is imported once for each and not once for each job.

A worker's output goes to a file of each job's own. It hears nothing of Ctrl-C, which is the scheduler's to pass on; SIGTERM makes it save
and leave, and so does the death of the scheduler.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from cudc_bench import interrupts
from cudc_bench.errors import CudcBenchError, HeldError
from cudc_bench.markup import visible
from cudc_bench.parallel import leave_with_parent, signals_blocked, use_cores

from .jobs import Job
from .work import Common, do

_TELL_EVERY = 0.25  # seconds between two reports of progress
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_busy = False  # in a worker, whether it has a job that keeps its state


@dataclass(frozen=True)
class Progress:
    """A job is so far."""

    done: int
    total: int


@dataclass(frozen=True)
class Ended:
    """A job has ended.

    Attributes:
        how: ``done``, ``failed``, ``held`` (somebody else is at work on the same thing) or ``left`` (it was asked to, and has saved).
        why: one line, unless it is done.
    """

    how: str
    why: str = ""


class Worker:
    """One process.

    Args:
        cores: that it may use.
        common: to all its jobs.
        context: how processes start; anew unless given.
    """

    def __init__(self, cores: int, common: Common, context: Any = None) -> None:
        context = context or multiprocessing.get_context("spawn")
        self._mine, its = context.Pipe()
        self._process = context.Process(target=_serve, args=(its, cores, common), daemon=False)
        with signals_blocked(), _threads(cores):
            self._process.start()
        its.close()
        self.job: Job | None = None
        self.log: Path | None = None

    def give(self, job: Job, log: Path) -> None:
        """Start a job, whose output goes to a file."""
        self.job, self.log = job, log
        # A process that has died says so when it is listened to.
        with suppress(OSError):
            self._mine.send((job, log))

    def news(self) -> Iterator[Progress | Ended]:
        """What it has said since it was last asked; a process that died says that its job failed."""
        try:
            while self.job is not None and self._mine.poll():
                message = self._mine.recv()
                if isinstance(message, Ended):
                    self.job = None
                yield message
        except (EOFError, OSError):
            self._process.join()
            self.job = None
            yield Ended("failed", f"its process died ({_death(self._process.exitcode)})")

    @property
    def lives(self) -> bool:
        """Whether it can take a job."""
        return self._process.is_alive()

    @property
    def connection(self) -> Connection:
        """For :func:`listen`."""
        return self._mine

    def signal(self, number: int) -> None:
        """Send its process a signal."""
        if self._process.pid is not None and self._process.is_alive():
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def close(self) -> None:
        """Let it go when its job has ended."""
        with suppress(OSError):
            self._mine.send(None)
        self._mine.close()
        self._process.join()


def listen(workers: list[Worker], seconds: float) -> None:
    """Wait until a worker that has a job says something, but no longer than so many seconds."""
    busy = [worker.connection for worker in workers if worker.job is not None]
    if busy:
        wait(busy, seconds)
    else:
        time.sleep(seconds)


def _death(code: int | None) -> str:
    if code is None or code >= 0:
        return f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = str(-code)
    return f"{name}{', perhaps out of memory' if name == 'SIGKILL' else ''}"


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


def _serve(pipe: Connection, cores: int, common: Common) -> None:
    """A worker's life."""
    global _busy
    signal.signal(signal.SIGTERM, lambda number, _: interrupts.ask(number))
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    use_cores(cores)
    leave_with_parent(lambda: _busy)
    while True:
        try:
            given = pipe.recv()
        except (EOFError, OSError):
            return
        if given is None:
            return
        job, log = given
        _busy = job.kind != "stats"
        try:
            ended = _attempt(job, log, common, pipe)
        finally:
            _busy = False
        try:
            pipe.send(ended)
        except OSError:
            return


def _attempt(job: Job, log: Path, common: Common, pipe: Connection) -> Ended:
    last = 0.0

    def tell(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _TELL_EVERY:
            last = time.monotonic()
            with suppress(OSError):
                pipe.send(Progress(done, total))

    try:
        with into(log):
            return attempt(job, common, tell)
    except OSError as error:
        return Ended("failed", f"its log {log} cannot be written: {error.strerror or error}")


def attempt(job: Job, common: Common, tell: Any) -> Ended:
    """Do a job in this process, and say how it went; standard error has when, for how long, and in its last line what went wrong."""
    print(f"# {datetime.now(UTC).isoformat(timespec='milliseconds')}, process {os.getpid()}: {job.name}", file=sys.stderr, flush=True)
    started = time.monotonic()
    try:
        do(job, common, tell)
        ended = Ended("done")
    except interrupts.Interrupted as error:
        ended = Ended("left", visible(error.where))
    except HeldError as error:
        ended = Ended("held", visible(str(error)))
    except CudcBenchError as error:
        ended = Ended("failed", visible(str(error)))
    except BaseException as error:
        traceback.print_exc()
        ended = Ended("failed", visible(f"{type(error).__name__}: {error}"))
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
