"""Time of one update at the paper's size, as a share of the machine's own float32 matrix-product peak."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.measure import Row, fastest, fastest_interleaved
from cudc_bench import plugins
from cudc_bench.collectors.base import Space
from cudc_bench.collectors.ddpg import DDPG, DDPGConfig
from cudc_bench.evaluators.td3 import TD3, TD3Config
from cudc_bench.parallel import cores
from cudc_bench.replay import Batch

SPACE = Space("walker", 24, 6, 1000, 4000, 2)
SIZE = 1024


class PlainDDPG(DDPG):
    """The backbone alone, with a reward that costs nothing."""

    family = citation = "benchmark"

    def reward(self, batch: Batch) -> torch.Tensor:
        return batch.observation[..., 0]


def peak(size: int = 1024) -> float:
    """Floating-point operations a second of the best matrix product of the paper's width."""
    a, b, out = torch.randn(size, size), torch.randn(size, size), torch.empty(size, size)
    return 2 * size**3 / fastest(lambda: torch.mm(a, b, out=out), repeats=40, warm_up=5)


# At most so many times plain DDPG's time. By operations alone: 1.03, 1.4, 1.3, 1.45, 1.1, 1.05 and 1.9.
RATIOS = {"icm": 1.2, "rnd": 1.6, "aps": 1.4, "apt": 1.7, "proto": 1.4, "disagreement": 1.4, "cudc": 2.2}
SHARES = {"DDPG": 0.70, "cudc": 0.60}


def batch_for(agent: Any) -> Batch:
    """Random transitions of Walker's sizes, with skills for a method that has some."""
    observation, action, following = (torch.rand(1, SIZE, size) * 2 - 1 for size in (24, 6, 24))
    skill = None
    if getattr(agent, "skill_size", 0):
        skill = agent.next_skill(0)[:, None].expand(-1, SIZE, -1).contiguous()
    horizon = torch.tensor([1 if isinstance(agent, TD3) else 3])
    return Batch(observation, action, following, horizon, torch.rand(1, SIZE), skill=skill)


def run() -> Iterator[Row]:
    """Every collector that learns, plain DDPG and TD3 at E=1; the operations of matrix products are counted by torch."""
    torch.set_num_threads(cores())
    kinds = {name: plugins.load("collectors", name) for name in plugins.names("collectors")}
    agents: dict[str, Any] = {
        "DDPG": PlainDDPG(SPACE, DDPGConfig(), [1]),
        "TD3": TD3(24, 6, TD3Config(), [1]),
        **{name: kind(SPACE, kind.config_class(), [1]) for name, kind in kinds.items() if kind.learns},
    }
    updates: dict[str, Callable[[], object]] = {}
    operations: dict[str, int] = {}
    for name, agent in agents.items():
        updates[name] = partial(agent.update, batch_for(agent))
        updates[name]()
        with FlopCounterMode(display=False) as counter:
            updates[name]()
        operations[name] = counter.get_total_flops()
    best_peak = peak()
    times = dict(zip(updates, fastest_interleaved(list(updates.values()), rounds=12), strict=True))
    best_peak = max(best_peak, peak())
    for name, seconds in times.items():
        share, ratio = operations[name] / seconds / best_peak, seconds / times["DDPG"]
        limit, least = RATIOS.get(name), SHARES.get(name)
        targets = [*([] if limit is None else [f"≤ {limit}x"]), *([] if least is None else [f"≥ {least:.0%}"])]
        yield Row(
            f"{name} update, paper size, {cores()} threads",
            f"{seconds * 1e3:.0f} ms, {operations[name] / 1e9:.1f} GFLOP",
            f"DDPG; peak {best_peak / 1e9:.0f} GFLOP/s",
            f"{ratio:.2f}x; {share:.0%}",
            " ".join(targets),
            (limit is None or ratio <= limit) and (least is None or share >= least),
        )
