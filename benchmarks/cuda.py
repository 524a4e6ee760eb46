"""Updates on a GPU at the paper's sizes, by every engine and in every precision, against what their arithmetic needs.

Nothing is measured where there is no CUDA. ``make gpu-bundle`` takes it to a machine that has some.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, get_args

import torch

from benchmarks.measure import Row
from benchmarks.updates import SPACE, PlainDDPG, drawing_updates, operations_of
from cudc_bench import plugins
from cudc_bench.collectors.ddpg import DDPGConfig
from cudc_bench.learning.cuda_graphs import WARM_UP, Updater
from cudc_bench.learning.engines import engine_of
from cudc_bench.learning.learner import set_precision
from cudc_bench.settings.config import Precision

EPISODES = 100
CASES = (("DDPG", 1), ("cudc", 1), ("cudc", 5), ("td3", 1), ("td3", 4), ("td3", 20), ("cql", 4))  # learners and how many members
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
ENGINES = ("eager", "graph", "compiled")
# Milliseconds an update in TF32 by the fastest engine, on an H200; bfloat16 is to take a third less.
TARGETS = {("DDPG", 1): 0.35, ("cudc", 1): 0.8, ("cudc", 5): 2.8, ("td3", 4): 1.2, ("td3", 20): 5.0}
BF16 = 2 / 3
SECONDS = 0.2  # of updates that are timed as one


@dataclass(frozen=True)
class Measured:
    """What was found out about a learner with so many members in one precision.

    Attributes:
        name, members, precision: which.
        operations: of an update's matrix products, for all members.
        peak: operations a second of a large product in this precision on this card.
        milliseconds: an update, by engine; of those that work.
        kernels: launched by an update, by engine; of those that were counted.
        failed: why an engine did not work.
    """

    name: str
    members: int
    precision: Precision
    operations: int
    peak: float
    milliseconds: Mapping[str, float]
    kernels: Mapping[str, float]
    failed: Mapping[str, str]


def run() -> Iterator[Row]:
    """Plain DDPG, CUDC, TD3 and CQL for stacks of members, TF32 first, for which there are targets."""
    if not torch.cuda.is_available():
        yield Row("updates on a GPU", "", "not measured: PyTorch finds no CUDA here", "", "", True)
        return
    precisions = sorted(PRECISIONS, key=lambda one: ("tf32", "bf16", "float32").index(one))
    peaks = {precision: peak(precision) for precision in precisions}
    for precision in precisions:
        for name, members in CASES:
            yield row(_measured(name, members, precision, peaks[precision]))


def row(found: Measured) -> Row:
    """A line of the table: times by engine, and the fastest against the limit that its arithmetic sets."""
    what = f"{found.name} x {found.members}, {found.precision}"
    parts = [
        f"{engine} {found.milliseconds[engine]:.3f} ms" + (f" ({found.kernels[engine]:.0f} kernels)" if engine in found.kernels else "")
        for engine in found.milliseconds
    ]
    parts += [f"{engine} failed: {why}" for engine, why in found.failed.items()]
    limit = found.operations / found.peak * 1e3
    against = f"{found.operations / 1e9:.1f} GFLOP, {limit:.3f} ms at {found.peak / 1e12:.0f} TFLOP/s"
    best = min(found.milliseconds.values(), default=float("inf"))
    target = target_of(found.name, found.members, found.precision)
    asked = "" if target is None else f"≤ {target:.2g} ms"
    return Row(what, "; ".join(parts), against, f"{limit / best:.0%}", asked, not found.failed and (target is None or best <= target))


def target_of(name: str, members: int, precision: Precision) -> float | None:
    """Milliseconds that an update may take; None for none."""
    target = TARGETS.get((name, members))
    if target is None or precision == "float32":
        return None
    return target * (BF16 if precision == "bf16" else 1.0)


def peak(precision: Precision, size: int = 8192) -> float:
    """Operations a second of a product of two large square matrices on the card."""
    set_precision(None, precision)
    kind = torch.bfloat16 if precision == "bf16" else torch.float32
    a = torch.randn(size, size, device="cuda").to(kind)
    return 2 * size**3 / (_milliseconds(lambda: a @ a) / 1e3)


def make(name: str, members: int, device: str, values: Mapping[str, Any] | None = None) -> Any:
    """A learner of the paper's size, apart from some values."""
    seeds = list(range(members))
    if name == "DDPG":
        return PlainDDPG(SPACE, DDPGConfig(**(values or {})), seeds, device)
    if name in plugins.names("collectors"):
        collector = plugins.load("collectors", name)
        return collector(SPACE, collector.configure("walker", values), seeds, device)
    evaluator = plugins.load("evaluators", name)
    return evaluator(24, 6, evaluator.configure(values), seeds, device)


@cache
def operations_of_member(name: str, device: str = "cuda") -> int:
    """Of an update with one member; they are the same everywhere, and counted fastest where updates are fast."""
    return operations_of(partial(drawing_updates(make(name, 1, device), "eager", 1), False))


def updates_on_card(name: str, members: int, precision: Precision, engine: str) -> tuple[Any, Updater]:
    """A learner on the card, and its updates by an engine, none of which has been made yet."""
    learner = make(name, members, "cuda")
    set_precision(learner, precision)
    return learner, drawing_updates(learner, engine, EPISODES)


def _measured(name: str, members: int, precision: Precision, peak: float) -> Measured:
    milliseconds: dict[str, float] = {}
    kernels: dict[str, float] = {}
    failed: dict[str, str] = {}
    for engine in ENGINES:
        try:
            milliseconds[engine], count = _by_engine(name, members, precision, engine)
            if count is not None:
                kernels[engine] = count
        except Exception as error:  # whatever it is, the others are measured
            failed[engine] = (str(error).splitlines() or [type(error).__name__])[0][:100]
        torch.cuda.empty_cache()
    return Measured(name, members, precision, operations_of_member(name) * members, peak, milliseconds, kernels, failed)


def _by_engine(name: str, members: int, precision: Precision, engine: str) -> tuple[float, float | None]:
    """Milliseconds of an update, and how many kernels it launches, in TF32: there are as many in other precisions, but for casts."""
    learner, drawing = updates_on_card(name, members, precision, engine)
    update = partial(drawing, False)
    milliseconds = _milliseconds(update)
    if engine_of(learner) != engine:
        raise RuntimeError(f"it went on as {engine_of(learner)}")
    return milliseconds, _kernels(update) if precision == "tf32" else None


def _milliseconds(update: Callable[[], object], rounds: int = 2) -> float:
    """Of one call: of several rounds that take about as long as SECONDS the fastest. The first calls, which capture, are not timed."""
    for _ in range(2 * (WARM_UP + 2)):  # some have two plans, in turns
        update()
    count = 1 + int(SECONDS / _seconds(update, 5) * 5)
    return min(_seconds(update, count) for _ in range(rounds)) / count * 1e3


def _seconds(update: Callable[[], object], count: int) -> float:
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(count):
        update()
    torch.cuda.synchronize()
    return time.perf_counter() - start


def _kernels(update: Callable[[], object], count: int = 4) -> float:
    """How many a call launches, those of a graph among them, as the profiler sees them."""
    from torch.autograd import DeviceType
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CUDA]) as profiler:
        for _ in range(count):
            update()
        torch.cuda.synchronize()
    events: Any = profiler.events()
    copies = ("Memcpy", "Memset")
    return sum(one.device_type == DeviceType.CUDA and not one.name.startswith(copies) for one in events) / count
