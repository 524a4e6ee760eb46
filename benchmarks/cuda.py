"""Updates on a GPU, as graphs and step by step; nothing is measured where there is no CUDA."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import torch

from benchmarks.measure import Row
from benchmarks.updates import SPACE, PlainDDPG
from cudc_bench import plugins
from cudc_bench.collectors.ddpg import DDPGConfig
from cudc_bench.learning.cuda_graphs import Updater
from cudc_bench.learning.engines import graphs_for
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Batch, Episodes

EPISODES = 100
TARGETS = {("DDPG", 1): 0.8, ("DDPG", 5): 2.5, ("td3", 20): 5.0}  # milliseconds, for an H200


def run() -> Iterator[Row]:
    """Plain DDPG, CUDC and TD3 at the paper's sizes, for stacks of members."""
    if not torch.cuda.is_available():
        return
    cudc, td3 = plugins.load("collectors", "cudc"), plugins.load("evaluators", "td3")
    makers: dict[str, Callable[[list[int]], Any]] = {
        "DDPG": lambda seeds: PlainDDPG(SPACE, DDPGConfig(), seeds, "cuda"),
        "cudc": lambda seeds: cudc(SPACE, cudc.configure("walker"), seeds, "cuda"),
        "td3": lambda seeds: td3(24, 6, td3.configure(), seeds, "cuda"),
    }
    for name, members in (("DDPG", 1), ("DDPG", 5), ("cudc", 1), ("cudc", 5), ("td3", 1), ("td3", 20)):
        eager, graph = (_milliseconds(makers[name](list(range(members))), graphed) for graphed in (False, True))
        limit = TARGETS.get((name, members))
        target = "" if limit is None else f"≤ {limit} ms"
        met = limit is None or graph <= limit
        yield Row(f"{name}, {members} members, {torch.cuda.get_device_name()}", f"{graph:.2f} ms", f"step by step {eager:.2f} ms",
                  f"{eager / graph:.1f}x", target, met)  # fmt: skip


def _milliseconds(learner: Any, graphed: bool, updates: int = 300) -> float:
    seeds = range(len(learner.seeds))
    random = MemberRandom(list(seeds), "replay", "cuda")
    data = Episodes(len(seeds), EPISODES, EPISODES * 1000, 24, 6, random)
    for member in seeds:
        for _ in range(EPISODES):
            data.add(member, torch.randn(1001, 24), torch.rand(1000, 6) * 2 - 1)
    data.rewards = torch.rand(len(seeds), EPISODES * 1000, device="cuda")

    def draw(measure: bool) -> Batch:
        horizon = getattr(learner, "horizon", None)
        if horizon is None:
            horizon = torch.ones(len(seeds), dtype=torch.int64, device="cuda")
        return data.sample(learner.config.batch_size, horizon, measure)

    update = Updater(learner, draw, random, graphs_for(learner, learner.device) if graphed else None)
    for _ in range(20):
        update(False)
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(updates):
        update(False)
    torch.cuda.synchronize()
    return (time.perf_counter() - start) / updates * 1e3
