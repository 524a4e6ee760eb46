"""Which job comes next: what can start, the longest way to the end first. Pure bookkeeping; processes are elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from statistics import fmean

from .jobs import KINDS, Job, JobGraph, Kind

_UNKNOWN = 60.0  # seconds of a job that nothing is known of


@dataclass(frozen=True)
class Failure:
    """A job that failed, or that could not start because another had failed.

    Attributes:
        job: which.
        why: one line.
        because: the job that failed first, for one that could not start.
    """

    job: Job
    why: str
    because: Job | None = None


class Queue:
    """The jobs of a plan, as they go from waiting to done or failed.

    Args:
        plan: what is left to do.
        seconds: that each job may take, None for one of which nothing is known.
        few_datasets: finish what is begun before another dataset is: few of them exist at a time, and the last may keep others waiting.
    """

    def __init__(self, plan: JobGraph, seconds: Mapping[Job, float | None], few_datasets: bool = False) -> None:
        self.plan, self._few = plan, few_datasets
        self.waiting = dict.fromkeys(plan.needs)
        self.running: set[Job] = set()
        self.done: set[Job] = set()
        self.failures: list[Failure] = []
        self._after: dict[Job, list[Job]] = {job: [] for job in plan.needs}
        for job, needs in plan.needs.items():
            for one in needs:
                self._after[one].append(job)
        known = {kind: fmean(some) for kind in KINDS if (some := _known(seconds, kind))}
        self._expected = {job: seconds.get(job) or known.get(job.kind, _UNKNOWN) for job in plan.needs}
        self.seconds = dict(self._expected)
        # Seconds that whole jobs took, and those that were expected of them, by kind and algorithm; and of all.
        self._took: dict[tuple[Kind, str | None] | None, tuple[float, float]] = {}
        self._ways: dict[Job, float] = {}
        for job in reversed(list(plan.needs)):
            self._ways[job] = self.seconds[job] + max((self._ways[one] for one in self._after[job]), default=0.0)

    @property
    def is_over(self) -> bool:
        """Whether nothing runs, and nothing more can."""
        return not self.running and not self.waiting

    def start(self, not_now: Iterable[Job] = ()) -> Job | None:
        """Take the next job, or None if none can start now.

        Args:
            not_now: jobs to leave where they are.
        """
        held = set(not_now)
        ready = [job for job in self.waiting if job not in held and self.done.issuperset(self.plan.needs[job])]
        if not ready:
            return None
        job = min(ready, key=self._rank)
        self.take(job)
        return job

    def take(self, job: Job) -> None:
        """It has started."""
        del self.waiting[job]
        self.running.add(job)

    def _rank(self, job: Job) -> tuple[bool, float]:
        return self._few and job.kind in ("pilot", "collect"), -self._ways[job]

    def put_back(self, job: Job) -> None:
        """It could not start; it waits again."""
        self.running.discard(job)
        self.waiting[job] = None

    def succeed(self, job: Job, seconds: float | None = None) -> None:
        """It is done, in so many seconds: what others take is expected to be off by the same factor, of those like it or, before there are
        any, of all. None says nothing of them, as of a job that went on where it had been interrupted."""
        self.running.discard(job)
        self.done.add(job)
        if seconds is None:
            return
        for like in ((job.kind, job.algo), None):
            took, expected = self._took.get(like, (0.0, 0.0))
            self._took[like] = took + seconds, expected + self._expected[job]
        for one in self.waiting:
            took, expected = self._took.get((one.kind, one.algo), self._took[None])
            self.seconds[one] = self._expected[one] * took / expected

    def fail(self, job: Job, why: str) -> None:
        """It failed, and with it all that needs it."""
        self.running.discard(job)
        self.failures.append(Failure(job, why))
        for one in self._all_after(job):
            if one in self.waiting:
                del self.waiting[one]
                self.failures.append(Failure(one, f"it needs {job.name}, which failed", job))

    def _all_after(self, job: Job) -> list[Job]:
        found: dict[Job, None] = {}
        more = list(self._after[job])
        while more:
            one = more.pop()
            if one not in found:
                found[one] = None
                more += self._after[one]
        return [one for one in self.plan.needs if one in found]

    def seconds_left(self, workers: int, left: Mapping[Job, float]) -> float:
        """Until all is done, at best: neither the work on all workers nor the longest way can take less.

        Args:
            workers: processes.
            left: seconds that each running job still needs.
        """

        @cache
        def way(job: Job) -> float:
            own = left.get(job, self.seconds[job]) if job in self.running else self.seconds[job] if job in self.waiting else 0.0
            return own + max((way(one) for one in self._after[job]), default=0.0)

        work = sum(self.seconds[job] for job in self.waiting) + sum(left.get(job, self.seconds[job]) for job in self.running)
        return max([work / workers, *(way(job) for job in (*self.running, *self.waiting))])


def _known(seconds: Mapping[Job, float | None], kind: Kind) -> list[float]:
    return [found for job, found in seconds.items() if job.kind == kind and found]
