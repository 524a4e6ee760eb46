"""The loop that keeps worker processes at work: whoever has tasks says which is next, and hears what becomes of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from cudc_bench.execution import interrupts
from cudc_bench.execution.workers import Worker, close, listen

T = TypeVar("T")


class Crew(Generic[T]):
    """Worker processes, each with one task at a time. They start when there is a task for them.

    Args:
        make: starts one.
        most: how many there are at once.
        saves: whether what tasks have done is kept when they are asked to leave.
    """

    def __init__(self, make: Callable[[], Worker[T]], most: int, saves: bool = True) -> None:
        self._make, self._most, self._saves = make, most, saves
        self._workers: list[Worker[T]] = []

    @property
    def is_busy(self) -> bool:
        """Whether a task is under way."""
        return any(worker.task is not None for worker in self._workers)

    def request_stop(self) -> None:
        """Ask the tasks that are under way to save and leave."""
        for worker in self._workers:
            worker.request_stop()

    def work(
        self,
        next_task: Callable[[], T | None],
        on_news: Callable[[T, Any], None],
        is_over: Callable[[], bool] = lambda: True,
        each_round: Callable[[], None] = lambda: None,
    ) -> None:
        """Do tasks until there are no more or, once this process was asked to leave, until those under way have left.

        The first Ctrl-C, or a SIGTERM, is passed on to the workers (see ``cudc_bench.execution.interrupts``). Whoever wants to know
        afterwards whether there was one has a context of its own around this call.

        Args:
            next_task: the task to begin now; None if there is none, or none yet.
            on_news: called with a task and whatever it sends; at last with ``Ended``, or with ``Died`` if its process did.
            is_over: asked while nothing is under way: whether no task will come any more.
            each_round: called five times a second, or more often.
        """
        with interrupts.leaving_gracefully(self.request_stop, self._saves):
            try:
                while True:
                    if interrupts.requested():
                        self.request_stop()  # also of a worker that was just being started when the signal came
                    else:
                        self._give_out(next_task)
                    if not self.is_busy and (interrupts.requested() or is_over()):
                        return
                    each_round()
                    listen(self._workers, 0.2)
                    for worker in self._workers:
                        if (task := worker.task) is not None:
                            for news in worker.news():
                                on_news(task, news)
            except BaseException as error:
                for worker in self._workers:
                    # Whoever asks twice does not want to wait; after an error here nobody wants the results.
                    if isinstance(error, Exception | interrupts.Interrupted):
                        worker.request_stop()
                    else:
                        worker.kill()
                raise
            finally:
                close(self._workers)

    def _give_out(self, next_task: Callable[[], T | None]) -> None:
        """Give each worker that is idle a task, as far as there are any; one that died is replaced."""
        while not interrupts.requested() and sum(worker.task is not None for worker in self._workers) < self._most:
            if (task := next_task()) is None:
                return
            for dead in [worker for worker in self._workers if worker.task is None and not worker.lives]:
                self._workers.remove(dead)
                close([dead])
            idle = next((worker for worker in self._workers if worker.task is None), None)
            if idle is None:
                idle = self._make()
                self._workers.append(idle)
            idle.give(task)
