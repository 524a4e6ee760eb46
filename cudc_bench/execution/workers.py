"""Processes that do one task after another.

Each has a pipe of its own and shares no lock with the others, unlike ``concurrent.futures`` and ``multiprocessing.Queue``, where a process
that is killed while it holds one, by the system when memory runs out, keeps all others waiting for ever.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from cudc_bench.errors import CudcBenchError, RunError, traceback_of, wants_traceback
from cudc_bench.execution import interrupts
from cudc_bench.execution.streams import open_streams

T = TypeVar("T")
Notify = Callable[[Any], None]

_PR_SET_PDEATHSIG = 1  # of prctl(2)
_PATIENCE = 300.0  # seconds that a task has to save its state once nobody wants its result any more

_saving = False  # in a worker, whether it has a task that keeps its state


@dataclass(frozen=True)
class Ended:
    """A task has ended.

    Attributes:
        result: what came out, None if there is an error.
        error: what it raised.
        leaves: whether its process was asked to leave and ends with it: another must do what is left.
    """

    result: Any = None
    error: BaseException | None = None
    leaves: bool = False


@dataclass(frozen=True)
class Died:
    """The process has died.

    Attributes:
        how: for people.
    """

    how: str


class Worker(Generic[T]):
    """One process. It hears nothing of Ctrl-C, which is for the one who has it to pass on; SIGTERM asks its task to save and leave, and so
    does the death of the process that started it.

    Args:
        do: does a task; called as ``do(task, notify)``, where ``notify`` sends anything home. Picklable, as tasks and results.
        begin: called first in the process.
        saves: whether a task keeps its state when it is asked to leave, else the process ends with its parent without waiting for it; by
            default all do.
        context: how processes start; anew unless given.
    """

    def __init__(
        self,
        do: Callable[[T, Notify], Any],
        begin: Callable[[], Any] | None = None,
        saves: Callable[[T], bool] | None = None,
        context: Any = None,
    ) -> None:
        context = context or multiprocessing.get_context("spawn")
        self._mine, its = context.Pipe()
        self._process = context.Process(target=_serve, args=(its, do, begin, saves), daemon=False)
        with _signals_blocked():
            self._process.start()
        its.close()
        self._asked = self._leaves = False
        self.task: T | None = None

    def give(self, task: T) -> None:
        """Start a task."""
        self.task = task
        # A process that has died says so when it is listened to.
        with suppress(OSError):
            self._mine.send(task)

    def news(self) -> Iterator[Any]:
        """What its task has told since this was last called, and :class:`Ended` or :class:`Died` in the end."""
        try:
            while self.task is not None and self._mine.poll():
                message = self._mine.recv()
                if isinstance(message, Ended):
                    self.task, self._leaves = None, message.leaves
                yield message
        except (EOFError, OSError):
            self._mine.close()  # also where a message could not be read: it goes when it finds nobody
            self._process.join()
            self.task = None
            yield Died(_death(self._process.exitcode))

    @property
    def lives(self) -> bool:
        """Whether it takes a task if it has none."""
        return not self._leaves and self._process.is_alive()

    def request_stop(self) -> None:
        """Ask its task to save and leave; asked again, nothing happens. (A signal handler may not see a worker that is just being started,
        so that whoever waits for them must ask once more.)"""
        if not self._asked:
            self._asked = True
            self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """End its process at once."""
        self._signal(signal.SIGKILL)

    def _signal(self, number: int) -> None:
        if self._process.pid is not None and self._process.is_alive():
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, number)

    def release(self) -> None:
        """Let it go when its task has ended, without waiting for that."""
        with suppress(OSError):
            self._mine.send(None)
        self._mine.close()

    def join(self) -> None:
        """Wait until its process has ended."""
        self._process.join()

    def fileno(self) -> int:
        """Of its pipe, to wait for news."""
        return self._mine.fileno()


def listen(workers: Sequence[Worker[Any]], seconds: float | None = None) -> None:
    """Wait until a worker that has a task says something, but no longer than so many seconds."""
    busy = [worker for worker in workers if worker.task is not None]
    if busy:
        wait([worker.fileno() for worker in busy], seconds)
    elif seconds is not None:
        time.sleep(seconds)


def close(workers: Iterable[Worker[Any]]) -> None:
    """Let workers go when their tasks have ended, and wait for that; kill them if the waiting is interrupted."""
    workers = list(workers)
    for worker in workers:  # all before any is waited for: one with an open pipe would stay, and Python waits for it at its own end
        worker.release()
    try:
        for worker in workers:
            worker.join()
    except BaseException:
        for worker in workers:
            worker.kill()
        raise


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Processes inherit what is blocked: a worker never hears Ctrl-C, and SIGTERM only once it knows what to do with it."""
    # Python starts this before the first process, and ends with unblocking both.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _death(code: int | None) -> str:
    if code is None or code >= 0:
        return f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = str(-code)
    return f"{name}{', perhaps out of memory' if name == 'SIGKILL' else ''}"


def _serve(pipe: Connection, do: Callable[[T, Notify], Any], begin: Callable[[], Any] | None, saves: Callable[[T], bool] | None) -> None:
    """A worker's life."""
    global _saving
    interrupts.on_sigterm()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    open_streams()
    _leave_with_parent()
    _end_with_parent(True)
    if begin is not None:
        begin()

    def notify(message: Any) -> None:
        with suppress(OSError):
            pipe.send(message)

    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        if task is None:
            return
        _saving = saves is None or saves(task)
        _end_with_parent(not _saving)
        try:
            ended = Ended(do(task, notify))
        except BaseException as error:
            ended = Ended(error=_travelling(error))
        finally:
            _saving = False
            _end_with_parent(True)
        # Whoever was asked to leave, by the one that started it or by somebody else, is never of use again: each task would leave at once.
        ended = replace(ended, leaves=interrupts.requested())
        try:
            try:
                pipe.send(ended)
            except OSError:
                raise
            except Exception as error:  # such a result cannot be sent, and nothing of it has been
                pipe.send(Ended(error=_travelling(error), leaves=ended.leaves))
        except OSError:
            return
        if ended.leaves:
            return


def _travelling(error: BaseException) -> BaseException:
    """An error as it can be sent: as another where it cannot be made again over there, and with its traceback in words if it is a bug or
    somebody asked for it."""
    expected = isinstance(error, CudcBenchError | interrupts.Interrupted)
    told = None if expected and not wants_traceback() else traceback_of(error)
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RunError(str(error)) if isinstance(error, CudcBenchError) else RuntimeError(f"{type(error).__name__}: {error}")
    if told is not None:
        error.add_note(told)
    return error


def _leave_with_parent() -> None:
    """End this process when the one that wants its results was killed: at once, or when its task has saved its state."""
    parent, number = multiprocessing.parent_process(), os.getppid()

    def wait_and_leave() -> None:
        if parent is None:
            return
        # Forked siblings hold each other's end of the pipe that says it: whether there is still a parent, the system knows itself.
        while os.getppid() == number and parent.is_alive():
            parent.join(1.0)
        interrupts.request_stop(signal.SIGTERM)
        deadline = time.monotonic() + _PATIENCE
        while _saving and time.monotonic() < deadline:
            time.sleep(0.05)
        os._exit(1)

    threading.Thread(target=wait_and_leave, daemon=True).start()


def _end_with_parent(ends: bool) -> None:
    """Whether the system kills this process when its parent's is: no thread can end it while a library computes."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL if ends else 0, 0, 0, 0)
