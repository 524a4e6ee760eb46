"""How the work of a command is carried out: the same choices, checks and steps for every stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

from cudc_bench.errors import UsageError
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.parallel import Job, run_jobs, worker_count
from cudc_bench.execution.runlog import check_log
from cudc_bench.runs.memory import Rehearsing, within_memory
from cudc_bench.settings.profiles import resolve_device


@dataclass(frozen=True)
class Execution:
    """How a command works. Results depend on the device, on the engine up to rounding, and on ``workers`` where a profile shares the cores
    among them; on nothing else.

    Attributes:
        device: ``cpu`` or ``cuda``.
        engine: how updates are carried out, as it was asked for: ``auto``, ``eager`` or ``compiled``.
        workers: processes on a CPU; 1 works in this process, None takes one for each core.
        checkpoint_every: seconds between two checkpoints at least.
        fresh: start over where a run was interrupted.
        overwrite: make again what exists.
        log: where numbers are sent while they are measured; None for nowhere.
        log_dir: the folder of these logs.
    """

    device: str = "cpu"
    engine: str = "auto"
    workers: int | None = 1
    checkpoint_every: float = CHECKPOINT_EVERY
    fresh: bool = False
    overwrite: bool = False
    log: str | None = None
    log_dir: Path = field(default_factory=lambda: Path(LOG_DIR))

    @classmethod
    def checked(
        cls, device: str, workers: int | None, checkpoint_every: float, *, engine: str = "auto", fresh: bool = False,
        overwrite: bool = False, log: str | None = None, log_dir: str | Path = LOG_DIR,
    ) -> Self:  # fmt: skip
        """The same as a user gives it.

        Raises:
            UsageError: one of them is not possible.
        """
        if not (math.isfinite(checkpoint_every) and checkpoint_every >= 0):
            raise UsageError(f"--checkpoint-every takes a number of seconds, 0 or more, not {checkpoint_every:g}.")
        worker_count(workers, 1)
        folder = check_log(log, log_dir)
        from cudc_bench.learning.engines import check_engine

        device = resolve_device(device)
        check_engine(engine, device)
        return cls(device, engine, workers, checkpoint_every, fresh, overwrite, log, folder)

    @property
    def options(self) -> dict[str, str]:
        """Of a command that carries its work out like this again: those on which its results depend, where they were asked for."""
        return {} if self.engine == "auto" else {"--engine": self.engine}

    def engine_for(self, kind: type, updates: int) -> str:
        """What a run of so many updates of such a learner is carried out with: ``eager``, ``graph`` (CUDA) or ``compiled``."""
        from cudc_bench.learning.engines import resolve_engine

        return resolve_engine(self.engine, kind, self.device, updates)


class Stack(Rehearsing, Protocol):
    """Members that one process learns with side by side."""

    @property
    def name(self) -> str:
        """What they make, as messages say it."""

    @property
    def label(self) -> str:
        """What stands beside their progress bar."""

    def checkpoints(self, every: float = CHECKPOINT_EVERY) -> Checkpoints:
        """Where their state is kept."""

    def is_interrupted(self) -> bool:
        """Whether these very members have been begun and not ended."""


Member = TypeVar("Member")
AnyStack = TypeVar("AnyStack", bound=Stack)


@dataclass(frozen=True)
class Work(Generic[AnyStack]):
    """What a command has left to do, checked.

    Attributes:
        execution: how it is done.
        stacks: in the order in which they are begun.
        processes: at once.
    """

    execution: Execution
    stacks: list[AnyStack]
    processes: int

    @classmethod
    def plan(
        cls, execution: Execution, command: str, groups: Iterable[Sequence[Member]], left: Collection[Member],
        stack: Callable[[list[Member]], AnyStack], beside: Callable[[Member], int] = lambda _: 1,
    ) -> Work[AnyStack]:  # fmt: skip
        """Cut members into stacks: all of a group together on CUDA; on a CPU so few that all processes have work.

        Args:
            execution: how they will work.
            command: whose work it is, for messages.
            groups: all members, those together that one stack can hold.
            left: those that there is something to do for.
            stack: makes one of members.
            beside: with how many at most a member may be in one stack on a CPU, itself included: 1 where that would change its result.

        Raises:
            UsageError: as :meth:`check`.
        """
        members = [list(group) for group in groups]
        if execution.device == "cuda":
            # A stack that was interrupted while its results were being written goes on as a whole.
            parts = [(group, part) for group in members if (part := [member for member in group if member in left])]
            stacks = [whole if (whole := stack(group)).is_interrupted() else stack(part) for group, part in parts]
            processes = 1
        else:
            # The threads of each, and so its result, must not depend on how many are left to do.
            processes = worker_count(execution.workers, sum(map(len, members)))
            stacks = [stack(part) for part in _parts(members, left, stack, beside, processes)]
        work = cls(execution, stacks, processes)
        work.check(command)
        return work

    def check(self, command: str) -> None:
        """Refuse to go on where a run with other settings was interrupted, unless it shall start over.

        Args:
            command: whose work it is, for messages.

        Raises:
            UsageError: there is such a run.
        """
        for one in () if self.execution.fresh else self.stacks:
            one.checkpoints().check(one.name, command)

    def carry_out(self, job: Callable[..., Any], *, unit: str, total: int, threads: int | None, **arguments: Any) -> list[Any]:
        """Do it, and return what the jobs return, in the order of the stacks.

        Args:
            job: a top-level function, called as ``job(advance, stack=…, execution=…, **arguments)``.
            unit, total: what a stack's progress bar counts, and how far.
            threads: CPU threads of each; None shares the cores.
            arguments: the same for all.

        Raises:
            RunError: one failed, or its process died, or a GPU has too little memory for a stack.
            Interrupted: they were asked to leave.
        """
        if not self.stacks:
            return []
        jobs = [Job(one.label, total, {"stack": one, "execution": self.execution, **arguments}) for one in self.stacks]
        return run_jobs(partial(within_memory, job), jobs, unit=unit, workers=self.processes, threads=threads)


def begun_together(group: Sequence[Member], stack: Callable[[list[Member]], AnyStack], most: int) -> Iterator[list[Member]]:
    """Neighbours, up to so many, that were begun in one stack which is not ended."""
    for size in range(min(most, len(group)), 1, -1):
        for start in range(len(group) - size + 1):
            part = list(group[start : start + size])
            if stack(part).is_interrupted():
                yield part


def _parts(
    groups: Sequence[list[Member]], left: Collection[Member], stack: Callable[[list[Member]], AnyStack], beside: Callable[[Member], int],
    processes: int,
) -> Iterator[list[Member]]:  # fmt: skip
    """What is left of groups, cut into parts: those that were begun together, and of the rest such that all processes have equal work."""
    count = sum(member in left for group in groups for member in group)
    for group in groups:
        most, waiting = beside(group[0]), [member for member in group if member in left]
        for begun in begun_together(group, stack, most):
            if any(member in waiting for member in begun):
                yield begun
                waiting = [member for member in waiting if member not in begun]
        rounds = math.ceil(count / (most * processes))
        parts = math.ceil(len(waiting) / min(most, math.ceil(count / (rounds * processes)))) if waiting else 0
        ends = [round(len(waiting) * (part + 1) / parts) for part in range(parts)]
        yield from (waiting[start:end] for start, end in zip([0, *ends], ends, strict=False))
