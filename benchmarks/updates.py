"""Time of one update at the paper's size, as a share of the machine's own float32 matrix-product peak."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.measure import Row, fastest, fastest_interleaved
from cudc_bench.collectors.base import Space
from cudc_bench.collectors.cudc import CUDC, CUDCConfig
from cudc_bench.collectors.ddpg import DDPG, DDPGConfig
from cudc_bench.evaluators.td3 import TD3, TD3Config
from cudc_bench.parallel import cores
from cudc_bench.replay import Batch

SPACE = Space("walker", 24, 6, 1000, 4000, 2)


class PlainDDPG(DDPG):
    """The backbone alone, with a reward that costs nothing."""

    family = citation = "benchmark"

    def reward(self, batch: Batch) -> torch.Tensor:
        return batch.observation[..., 0]


def peak(size: int = 1024) -> float:
    """Floating-point operations a second of the best matrix product of the paper's width."""
    a, b, out = torch.randn(size, size), torch.randn(size, size), torch.empty(size, size)
    return 2 * size**3 / fastest(lambda: torch.mm(a, b, out=out), repeats=40, warm_up=5)


def run() -> Iterator[Row]:
    """DDPG, CUDC and TD3 at E=1; the operations of matrix products are counted by torch."""
    torch.set_num_threads(cores())
    targets = {"DDPG": 0.70, "CUDC": 0.60, "TD3": None}
    agents: dict[str, Any] = {
        "DDPG": PlainDDPG(SPACE, DDPGConfig(), [1]),
        "CUDC": CUDC(SPACE, CUDCConfig(), [1]),
        "TD3": TD3(24, 6, TD3Config(), [1]),
    }
    updates: list[Callable[[], object]] = []
    operations: dict[str, int] = {}
    for name, agent in agents.items():
        observation, action, following = (torch.rand(1, 1024, size) * 2 - 1 for size in (24, 6, 24))
        horizon = torch.tensor([1 if name == "TD3" else 3])
        update = partial(agent.update, Batch(observation, action, following, horizon, torch.rand(1, 1024)))
        update()
        with FlopCounterMode(display=False) as counter:
            update()
        operations[name] = counter.get_total_flops()
        updates.append(update)
    best_peak = peak()
    times = fastest_interleaved(updates, rounds=12)
    best_peak = max(best_peak, peak())
    for (name, count), seconds in zip(operations.items(), times, strict=True):
        share, target = count / seconds / best_peak, targets[name]
        yield Row(
            f"{name} update, paper size, {cores()} threads",
            f"{seconds * 1e3:.0f} ms, {count / 1e9:.1f} GFLOP, {count / seconds / 1e9:.0f} GFLOP/s",
            f"matmul peak {best_peak / 1e9:.0f} GFLOP/s",
            f"{share:.0%}",
            "" if target is None else f"≥ {target:.0%}",
            target is None or share >= target,
        )
