"""The same update again and again: on CUDA captured once as a graph and then replayed, without Python in between.

An update is some hundred operations on small matrices. Issued one by one they keep the host busy for longer than the GPU; as a graph they
are one call. The price is that Python is not there any more: an update may depend on nothing but tensors that stay where they are, and on
the *plan* that the host makes before it (``prepare``). Each plan has a graph of its own.

What measures itself runs step by step even then: it is one update in a thousand, and may wait for the device.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable
from typing import Any, ClassVar, Generic, TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

from cudc_bench.execution import interrupts
from cudc_bench.execution.progress import echo
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.recording import leaves
from cudc_bench.learning.replay import Batch

WARM_UP = 3  # updates before a capture: optimisers make their state in the first, libraries choose their kernels
T = TypeVar("T")


class CannotCaptureError(Exception):
    """An update cannot become a graph; the message says why."""


class Graph(ABC):
    """Operations that were recorded once and can be repeated on the same tensors.

    Class attributes:
        warm_up: how many updates come before a capture, one by one.
        draws: whether the draw of a minibatch is part of it; else it takes minibatches that were drawn before.
        falls_back: whether updates go on one by one where a capture fails; else its error is raised.
    """

    warm_up: ClassVar[int] = WARM_UP
    draws: ClassVar[bool] = True
    falls_back: ClassVar[bool] = True

    @abstractmethod
    def capture(self, function: Callable[[], T], random: Iterable[MemberRandom]) -> T:
        """Record what ``function`` does; its tensors hold results once :meth:`replay` ran. Streams go on as if it were called each time."""

    @abstractmethod
    def replay(self) -> None:
        """Do it."""

    def warm(self, function: Callable[[], T]) -> T:
        """Call ``function`` as it should be called before a capture."""
        return function()


class CudaGraph(Graph):
    """A CUDA graph; warm-up runs on another stream than the default one, as capturing does."""

    _side: ClassVar[torch.cuda.Stream | None] = None

    def capture(self, function: Callable[[], T], random: Iterable[MemberRandom]) -> T:
        self._graph = torch.cuda.CUDAGraph()
        for stream in random:
            for generator in stream.generators:
                self._graph.register_generator_state(generator)
        with torch.cuda.graph(self._graph):
            return function()

    def replay(self) -> None:
        self._graph.replay()

    def warm(self, function: Callable[[], T]) -> T:
        if CudaGraph._side is None:
            CudaGraph._side = torch.cuda.Stream()
        side = CudaGraph._side
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            result = function()
        torch.cuda.current_stream().wait_stream(side)
        return result


class _Captured(Generic[T]):
    """One function, called, then captured, then replayed.

    Args:
        make: makes its graph.
        random: the streams that it draws from.
        learner: whose state it changes, if it changes any.
    """

    def __init__(self, make: Callable[[], Graph], random: Iterable[MemberRandom], learner: Any = None) -> None:
        self._graph, self._random, self._learner = make(), list(random), learner
        self.draws = self._graph.draws
        self._calls = 0
        self._result: T

    def __call__(self, function: Callable[[], T]) -> T:
        self._calls += 1
        if self._calls <= self._graph.warm_up:
            return self._graph.warm(function)
        if self._calls == self._graph.warm_up + 1:
            self._result = self._capture(function)
        self._graph.replay()
        return self._result

    def _capture(self, function: Callable[[], T]) -> T:
        if not self._graph.falls_back:
            return self._graph.capture(function, self._random)
        standing, common = _standing(self._learner), torch.get_rng_state()
        before = None if self._learner is None else copy.deepcopy(self._learner.state_dict())
        try:
            result = self._graph.capture(function, self._random)
        except (interrupts.Interrupted, torch.OutOfMemoryError):
            # Of the second the update is not to blame, and whoever hears of it says how many members would fit.
            raise
        except Exception as error:  # of whatever kind: done one by one the update works, or says itself what is wrong
            why: tuple[str, Exception | None] = (str(error).splitlines() or [type(error).__name__])[0], error
        else:
            if _standing(self._learner) == standing:
                return result
            why = "it changes something else than tensors in place, which a graph would not do again", None
        if before is not None:
            self._learner.load_state_dict(before)
        torch.set_rng_state(common)
        raise CannotCaptureError(why[0]) from why[1]


def _standing(learner: Any) -> list[Any]:
    """Where a learner's tensors are, and the numbers beside them."""
    if learner is None:
        return []
    own = [*learner.parameters(), *learner.buffers(), *(one.state_dict() for one in learner.optimisers.values())]
    return [*leaves(own), *(leaf for leaf in tree_flatten(learner.state_dict())[0] if not isinstance(leaf, Tensor))]


class Updater:
    """Draws minibatches and has a learner learn from them.

    Args:
        learner: whose ``update`` is called, or with graphs the halves of it that ``Learner`` has; its state is the same however that is
            done, up to the rounding of other kernels.
        draw: a minibatch on the learner's device; told whether it is to be measured. It must keep to what ``learn`` keeps to.
        random: the stream that ``draw`` draws from.
        make: makes graphs, see :func:`.engines.graphs_for`; None for updates one by one, to which it falls back where a capture fails.
    """

    def __init__(self, learner: Any, draw: Callable[[bool], Batch], random: MemberRandom, make: Callable[[], Graph] | None) -> None:
        self._learner, self._draw, self._random, self._make = learner, draw, random, make
        self._captured: dict[Hashable, _Captured[Batch]] = {}
        self._drawn: Batch | None = None

    def __call__(self, measure: bool) -> tuple[dict[str, Tensor], Batch]:
        """One update; its metrics, which are none without ``measure``, and its minibatch, which the next one may write over."""
        if self._make is None or measure:
            batch = self._draw(measure)
            return self._learner.update(batch), batch
        learner, plan = self._learner, self._learner.prepare()
        if plan not in self._captured:
            self._captured[plan] = _Captured(self._make, [*learner.random.values(), self._random], learner)
        captured = self._captured[plan]
        drawn = None if captured.draws else self._in_its_place(self._draw(False))

        def update() -> Batch:
            batch = drawn or self._draw(False)
            with learner.products():
                learner.learn(batch, plan)
            batch.cache = {}
            return batch

        try:
            return {}, captured(update)
        except CannotCaptureError as error:
            echo(f"updates of {type(learner).__name__} go one by one, as {learner.engine} they cannot: {error}")
            self.go_on_with("eager")
            return {}, update()

    def _in_its_place(self, batch: Batch) -> Batch:
        """A minibatch where the first one was, which is where a graph looks for it."""
        if self._drawn is None:
            self._drawn = batch
        for name, value in vars(batch).items():
            if isinstance(value, Tensor):
                getattr(self._drawn, name).copy_(value)
        return self._drawn

    def go_on_with(self, engine: str) -> None:
        """Take updates up as a run did that is continued: one by one if it could not do otherwise."""
        if engine == "eager" and self._make is not None:
            self._learner.engine, self._make = engine, None


def rehearse(update: Updater) -> None:
    """So many updates that all graphs are captured, and one that measures itself: what they take, later ones take again."""
    update(True)
    for _ in range(2 * (WARM_UP + 2)):  # some have two plans, in turns
        update(False)


class ActionRunner:
    """Asks a learner for actions, one observation of each member at a time.

    Args:
        act: (E, S) -> (E, A) on the device.
        random: the streams that it draws from.
        device: where.
        make: makes graphs, see :func:`.engines.graphs_for`.
    """

    def __init__(
        self, act: Callable[[Tensor], Tensor], random: Iterable[MemberRandom], device: torch.device, make: Callable[[], Graph] | None
    ) -> None:
        self._act, self._device = act, device
        self._captured: _Captured[Tensor] | None = None if make is None else _Captured(make, random)
        self._seen: Tensor | None = None

    def __call__(self, observation: Tensor) -> Tensor:
        """Actions on the CPU for observations that are there."""
        if self._captured is None:
            return self._act(observation.to(self._device)).cpu()
        if self._seen is None:
            self._seen = torch.empty_like(observation, device=self._device)
        seen = self._seen
        seen.copy_(observation)
        try:
            return self._captured(lambda: self._act(seen)).cpu()
        except CannotCaptureError as error:
            echo(f"actions are computed step by step, as a graph they cannot be: {error}")
            self._captured = None
            return self._act(seen).cpu()
