"""What people see while work is done: messages and progress bars on standard error, results on standard output.

Who wants to be left alone (``--quiet``) gets neither bars nor notes (:func:`echo`), but what is wrong (:func:`warn`), and all results.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from functools import cache
from typing import TYPE_CHECKING

from cudc_bench.text import visible

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

QUIET = "CUDC_BENCH_QUIET"  # the environment variable of --quiet; processes that are started here hear of it, too
Advance = Callable[[int], None]
Listener = Callable[[int, int], None]
_listener: Listener | None = None  # who else wants to know
_LINE_EVERY = 30.0  # seconds between two lines of a task where there is no terminal to draw a bar on


@cache
def console() -> Console:
    """The console for messages and bars (standard error)."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def is_quiet() -> bool:
    """Whether nobody wants bars and notes: ``CUDC_BENCH_QUIET`` is neither empty nor 0."""
    return os.environ.get(QUIET, "") not in {"", "0"}


def draws_bars() -> bool:
    """Whether there is a terminal for bars, and somebody who wants them."""
    return console().is_terminal and not is_quiet()


def echo(message: str) -> None:
    """Print a note for people on one line, unless they want none; text in it is never taken for markup, nor for what drives a terminal."""
    if not is_quiet():
        warn(message)


def warn(message: str) -> None:
    """Print one line that nobody should miss: what failed, is wrong or was left out; otherwise as :func:`echo`."""
    console().print(visible(message), markup=False, soft_wrap=True)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Within this context, tell somebody of all progress: how much of the present work is done, and how much there is of it.

    Args:
        listener: called with both whenever work advances.
    """
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


def _notifying(advances: list[Advance], total: int) -> list[Advance]:
    if _listener is None:
        return advances
    listener, done = _listener, 0

    def telling(advance: Advance) -> Advance:
        def notify(n: int) -> None:
            nonlocal done
            done += n
            advance(n)
            listener(done, total)

        return notify

    return [telling(one) for one in advances]


@contextmanager
def bars(tasks: list[tuple[str, int]], unit: str) -> Iterator[list[Advance]]:
    """Show one progress bar with its time left for each task; in a log file, a line every half minute.

    Args:
        tasks: description and total of each.
        unit: what is counted, such as ``"steps"``.

    Yields:
        For each task, a function that is told by how much it advanced.
    """
    if not draws_bars():
        yield _notifying([_Lines(description, total, unit).advance for description, total in tasks], sum(total for _, total in tasks))
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    progress = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TextColumn(unit, markup=False),
        TimeElapsedColumn(),
        TextColumn("left", markup=False),
        TimeRemainingColumn(),
        console=console(),
    )
    with progress:
        numbers = [progress.add_task(description, total=total, start=False) for description, total in tasks]

        def advance_of(number: TaskID) -> Advance:
            def advance(n: int) -> None:
                # A task's clock starts with its work: jobs that wait for a core would otherwise spoil their estimate.
                progress.start_task(number)
                progress.advance(number, n)

            return advance

        yield [advance_of(number) for number in numbers]


@contextmanager
def bar_if_long(description: str, total: int, unit: str, after: float = 2.0) -> Iterator[Advance]:
    """One bar as :func:`bars` shows them, but only once the work has taken so many seconds: what is done at once needs none."""
    begun, done = time.monotonic(), 0
    shown: list[Advance] = []
    with ExitStack() as stack:

        def advance(n: int) -> None:
            nonlocal done
            done += n
            if shown:
                shown[0](n)
            elif time.monotonic() - begun >= after and done < total:
                shown.extend(stack.enter_context(bars([(description, total)], unit)))
                shown[0](done)

        yield advance


class _Lines:
    """Reports one task's progress as lines of text."""

    def __init__(self, description: str, total: int, unit: str) -> None:
        self._description, self._total, self._unit = description, total, unit
        self._done = 0
        self._started: float | None = None
        self._said = 0.0

    def advance(self, n: int) -> None:
        """Count, and say how far it is when the last line is old enough or the task is done."""
        now = time.monotonic()
        if self._started is None:
            self._started = self._said = now
        self._done += n
        done = self._done >= self._total
        if now - self._said < _LINE_EVERY and not done:
            return
        self._said = now
        passed = now - self._started
        left = passed / self._done * (self._total - self._done)
        times = [str(timedelta(seconds=round(seconds))) for seconds in (passed, left)]
        echo(f"{self._description}: {self._done:,}/{self._total:,} {self._unit}, {times[0]} passed, {times[1]} left")
