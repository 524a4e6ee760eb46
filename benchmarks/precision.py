"""``--precision bf16`` against float32: updates at the paper's size, on all cores, and of what they consist, one layer's product, in one
thread, with the rounding of its factors to bfloat16 and without."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.measure import Row, fastest_interleaved
from benchmarks.updates import SPACE, PlainDDPG, batch_for
from cudc_bench import plugins
from cudc_bench.collectors.ddpg import DDPGConfig
from cudc_bench.execution.parallel import cores
from cudc_bench.learning.bf16 import ROWS, slowdown
from cudc_bench.learning.learner import set_precision

TARGET = 1.7


def run() -> Iterator[Row]:
    """Plain DDPG, CUDC and TD3; the target is for processors that multiply bfloat16 themselves."""
    torch.set_num_threads(cores())
    native = _multiplies_bf16()
    cudc, td3 = plugins.load("collectors", "cudc"), plugins.load("evaluators", "td3")
    makers: dict[str, Callable[[], Any]] = {
        "DDPG": lambda: PlainDDPG(SPACE, DDPGConfig(), [1]),
        "cudc": lambda: cudc(SPACE, cudc.configure("walker"), [1]),
        "td3": lambda: td3(24, 6, td3.configure(), [1]),
    }
    for name, make in makers.items():
        updates: list[Callable[[], object]] = []
        for precision in ("float32", "bf16"):
            agent = make()
            set_precision(agent, precision)
            updates.append(partial(agent.update, batch_for(agent)))
        exact, coarse = fastest_interleaved(updates, rounds=10)
        target = f"≥ {TARGET}x" if native else ""
        ratio = exact / coarse
        what = f"{name} update, 1024 x 1024, bf16"
        yield Row(what, f"{coarse * 1e3:.0f} ms", f"float32 {exact * 1e3:.0f} ms", f"{ratio:.2f}x", target, not target or ratio >= TARGET)
    for width in (128, 256, 1024):
        rows = min(width, ROWS)
        whole, product = (1 / slowdown(rows, width, rounded) for rounded in (False, True))
        what = f"a product, {rows} x {width} and {width} x {width}, bf16"
        yield Row(what, "rounding included", "float32", f"{whole:.2f}x", "", False)
        yield Row(what, "factors rounded before", "float32", f"{product:.2f}x", "", False)


def _multiplies_bf16() -> bool:
    flags = Path("/proc/cpuinfo").read_text().split()
    return "avx512_bf16" in flags or "amx_bf16" in flags
