"""Whether bfloat16 products are the faster ones on this processor: one is timed before a run that asked for them.

Processors differ by more than two to one either way. With AVX512-BF16 or AMX a wide product takes about half of float32's time; where
oneDNN emulates it with other AVX-512 instructions, more than twice as long; without any of them, up to a hundred times. Where products are
small, rounding their factors costs more than is gained.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import Any

import torch

from cudc_bench.execution.progress import echo
from cudc_bench.learning import networks
from cudc_bench.learning.networks import Linear, MemberRandom, bf16_products
from cudc_bench.settings.config import Precision

ROWS = 256  # of a minibatch are enough: with more the ratio is the same
FEW = 8  # rows that are tried first, since what is a hundred times slower would take seconds
SLOW = 0.004  # seconds of these few, after which no more are tried
SPENT = 0.02  # seconds on each, if a few calls do not take longer
NOTICED = 1.05  # what is less could be chance


def echo_if_slower(precision: Precision, config: Any, engine: str, device: str) -> None:
    """Say in one line that bfloat16 is the slower choice for a learner of these hyperparameters, if it was chosen and is; once a process.

    It takes a tenth of a second, and neither draws from a common random stream nor leaves anything behind.

    Args:
        precision: of the run.
        config: of the learner; one without ``batch_size`` and ``width`` is not looked at, nor one too narrow for bfloat16.
        engine: how updates are carried out; compiled ones round while they do other things.
        device: of the run; what GPUs do is known.
    """
    rows, width = getattr(config, "batch_size", 0), getattr(config, "width", 0)
    if precision == "bf16" and device == "cpu" and rows and width >= networks.WIDE:
        _echo_if_slower(rows, width, engine == "compiled")


@cache
def _echo_if_slower(rows: int, width: int, compiled: bool) -> None:
    if (ratio := slowdown(min(rows, ROWS), width, compiled)) >= NOTICED:
        rounding = "" if compiled else ", with the rounding of their factors"
        echo(
            f"bf16 products take {ratio:.1f}x as long as float32's on this processor at batch {rows} and width {width}{rounding};"
            " float32 is the faster choice here"
        )


@torch.no_grad()
def slowdown(rows: int, width: int, rounded: bool = False) -> float:
    """Time of a layer's product in bfloat16 over its time in float32, in one thread.

    Args:
        rows, width: the product is (rows, width) x (width, width).
        rounded: whether its factors are of bfloat16 already, instead of rounded each time.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        few = _slowdown(min(FEW, rows), width, rounded)
        return few[0] if few[1] > SLOW else _slowdown(rows, width, rounded)[0]
    finally:
        torch.set_num_threads(threads)


def _slowdown(rows: int, width: int, rounded: bool) -> tuple[float, float]:
    """The ratio, and the seconds of bfloat16."""
    random = MemberRandom([0], "timing")
    layer, x = Linear(random, width, width, orthogonal=False), random.normal(rows, width)
    exact = _seconds(lambda: layer(x))
    if rounded:
        factors = x.bfloat16(), layer.weight.bfloat16()
        coarse = _seconds(lambda: torch.bmm(*factors))
    else:
        with bf16_products():
            coarse = _seconds(lambda: layer(x))
    return coarse / exact, coarse


def _seconds(function: Callable[[], object]) -> float:
    """Of this thread, the fastest call after a first one."""
    function()
    taken: list[float] = []
    while len(taken) < 2 or sum(taken) < SPENT:
        start = time.thread_time()
        function()
        taken.append(time.thread_time() - start)
    return min(taken)
