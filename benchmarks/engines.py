"""Compiled updates against updates one by one: each learner at the ``cpu`` profile's sizes, in one thread, minibatches drawn with them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

from benchmarks.measure import Row, fastest_interleaved
from benchmarks.updates import SPACE, drawing_updates
from cudc_bench import plugins
from cudc_bench.collectors import variants
from cudc_bench.learning.compiled import missing_compiler
from cudc_bench.settings.profiles import resolve_profile

EPISODES, TOGETHER = 50, 40  # of the data, and updates that are timed as one
TARGETS = {"td3": 2.2}
LEAST = 1.7


def run() -> Iterator[Row]:
    """Every collector and learner that learns; of several names for one class the first, and no variants."""
    if missing := missing_compiler():
        yield Row("compiled updates", "", missing, "", "", False)
        return
    torch.set_num_threads(1)
    profile = resolve_profile("cpu")
    for kind in ("evaluators", "collectors"):
        classes = {plugins.load(kind, name): name for name in reversed(plugins.names(kind))}
        for made, name in reversed(classes.items()):
            if not getattr(made, "learns", True) or made.__module__ == variants.__name__:
                continue

            def make(made: Any = made, kind: str = kind) -> Any:
                if kind == "evaluators":
                    return made(24, 6, made.configure(profile.evaluate), [1])
                return made(SPACE, made.configure("walker", profile.collect), [1])

            yield _row(name, make)


def _row(name: str, make: Callable[[], Any]) -> Row:
    runs: list[Callable[[], object]] = [updates(make(), engine) for engine in ("eager", "compiled")]
    start = time.perf_counter()
    runs[1]()
    first = time.perf_counter() - start
    eager, compiled = (seconds / TOGETHER * 1e3 for seconds in fastest_interleaved(runs, rounds=12))
    target = TARGETS.get(name, LEAST)
    what = f"{name}, 128 x 128"
    measured = f"{compiled:.2f} ms, the first {TOGETHER} in {first:.0f} s"
    return Row(what, measured, f"one by one {eager:.2f} ms", f"{eager / compiled:.2f}x", f"≥ {target}x", eager / compiled >= target)


def updates(learner: Any, engine: str, count: int = TOGETHER) -> Callable[[], None]:
    """So many updates of a learner, with the drawing of their minibatches."""
    update = drawing_updates(learner, engine, EPISODES)

    def together() -> None:
        for _ in range(count):
            update(False)

    return together
