"""Timing by the smallest of several runs, which other load on the machine disturbs least."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: what was measured.
        measured: the figure with its unit.
        against: what it is compared with, measured in the same run; empty if the target is absolute.
        ratio: the comparison.
        target: what the project asks for; empty for none.
        met: whether it was met.
    """

    what: str
    measured: str
    against: str
    ratio: str
    target: str
    met: bool


def fastest(function: Callable[[], object], repeats: int, warm_up: int = 1, clock: Callable[[], float] = time.perf_counter) -> float:
    """Seconds of the fastest call, on the clock on the wall unless another is given."""
    for _ in range(warm_up):
        function()
    best = float("inf")
    for _ in range(repeats):
        start = clock()
        function()
        best = min(best, clock() - start)
    return best


def fastest_interleaved(
    functions: list[Callable[[], object]],
    rounds: int,
    before: list[Callable[[], object]] | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> list[float]:
    """Seconds of the fastest call of each, measured in turns so that all see the same machine.

    Args:
        functions: what to measure; each is called once before.
        rounds: how often.
        before: called before every call of each, and not measured.
        clock: in seconds.
    """
    best = [float("inf")] * len(functions)
    prepare = before or [lambda: None] * len(functions)
    for function, first in zip(functions, prepare, strict=True):
        first()
        function()
    for _ in range(rounds):
        for index, (function, first) in enumerate(zip(functions, prepare, strict=True)):
            first()
            best[index] = min(best[index], fastest(function, repeats=1, warm_up=0, clock=clock))
    return best
