"""What people see while a suite runs: a table of the running jobs in a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING

from cudc_bench.execution.progress import console, draws_bars, echo, warn
from cudc_bench.text import short_names

from .jobs import Job
from .queue import Queue

if TYPE_CHECKING:
    from rich.console import Group
    from rich.live import Live
    from rich.table import Table

_REFRESH = 0.5  # seconds
_LINE_EVERY = 60.0
_BAR, _LEAST_BAR = 20, 6  # letters
_MARGINS = 8  # letters between five columns
_LEAST = 16  # letters of a name


@dataclass
class Running:
    """A job that is being done.

    Attributes:
        job: which.
        started: when, by ``time.monotonic``.
        expected: seconds that it was thought to take.
        done, total: units of work; 0 before it has told.
        first: what it had done when it first told, and when: a run that goes on has done much at once.
    """

    job: Job
    started: float
    expected: float
    done: int = 0
    total: int = 0
    first: tuple[int, float] | None = None

    def notify(self, done: int, total: int) -> None:
        """It is so far."""
        self.done, self.total = done, total
        if self.first is None:
            self.first = (done, time.monotonic())

    @property
    def is_whole(self) -> bool:
        """Whether it was begun here, and not gone on with: then what it took says what others like it take."""
        return self.first is None or self.first[0] <= 0.1 * self.total

    @property
    def left(self) -> float:
        """Seconds, from its own rate as soon as it has one."""
        now = time.monotonic()
        if self.first is not None and self.done > self.first[0] and now > self.first[1]:
            return (now - self.first[1]) / (self.done - self.first[0]) * (self.total - self.done)
        share = 1 - self.done / self.total if self.total else 1.0
        return max(0.0, self.expected * share - (now - self.started if self.first is None else 0.0))


class Display:
    """Of one suite's run.

    Args:
        queue: of its jobs.
        workers: how many at once.
        before: jobs that were done before.
    """

    def __init__(self, queue: Queue, workers: int, before: int) -> None:
        self._queue, self._workers, self._before = queue, workers, before
        self._all = before + len(queue.waiting)
        self._live: Live | None = None
        self._last = self._said = time.monotonic()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the table for the time of this context, where there is a terminal for it."""
        if not draws_bars():
            yield
            return
        from rich.live import Live

        # Refreshed by the scheduler's own loop: a thread for it could hold a lock when processes start.
        with Live(console=console(), auto_refresh=False, transient=True) as self._live:
            yield
        self._live = None

    def refresh(self, running: Mapping[Job, Running], now: bool = False) -> None:
        """Bring the table up to date; where there is none, say a line from time to time."""
        moment = time.monotonic()
        if self._live is not None:
            if now or moment - self._last >= _REFRESH:
                self._last = moment
                self._live.update(self._table(running), refresh=True)
        elif moment - self._said >= _LINE_EVERY:
            self._said = moment
            echo(self.summary(running))

    def line(self, message: str) -> None:
        """Say a line above the table."""
        self._said = time.monotonic()
        echo(message)

    def failed(self, job: Job, why: str) -> None:
        """Say above the table that a job failed."""
        self._said = time.monotonic()
        warn(f"failed {job.name}: {why}")

    def summary(self, running: Mapping[Job, Running]) -> str:
        """How far it is, on one line."""
        queue = self._queue
        failed = f", {len(queue.failures)} failed" if queue.failures else ""
        left = queue.seconds_left(self._workers, {job: one.left for job, one in running.items()})
        done = f"{self._before + len(queue.done)} of {self._all} jobs done{failed}"
        return f"{done}, {len(queue.running)} running, {len(queue.waiting)} waiting; about {duration(left)} left"

    def _table(self, running: Mapping[Job, Running]) -> Group:
        from rich.console import Group
        from rich.text import Text

        return Group(running_jobs(running, console().width), Text(self.summary(running)))


def running_jobs(running: Mapping[Job, Running], width: int) -> Table:
    """A line for each job: its name, how far it is, and for how long; names that are too long lose their middle.

    Args:
        running: the jobs.
        width: letters of a line of the terminal.
    """
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("job", "", "", "passed", "left"):
        table.add_column(column, no_wrap=True)
    times = {job: (duration(time.monotonic() - one.started), duration(one.left)) for job, one in running.items()}
    room = width - _MARGINS - len("100%") - sum(max(map(len, (*column, "passed"))) for column in zip(*times.values(), strict=True))
    size = min(_BAR, max(_LEAST_BAR, room - _LEAST))
    names = short_names([job.name for job in running], max(_LEAST, room - size))
    for job, one in running.items():
        share = f"{one.done / one.total:.0%}" if one.total else "–"
        bar = ProgressBar(total=one.total or 1, completed=one.done, width=size)
        table.add_row(Text(names[job.name]), bar, share, *times[job])
    return table


def duration(seconds: float) -> str:
    """``"1:02:03"``, or with days before it."""
    return str(timedelta(seconds=round(seconds)))
