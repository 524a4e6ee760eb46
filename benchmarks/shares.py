"""Where an update's time goes beside its matrix products, for each learner that stays below 70 % of the machine's peak, and some above."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from benchmarks.measure import Row
from benchmarks.updates import SPACE, PlainDDPG, batch_for
from cudc_bench import plugins
from cudc_bench.collectors.ddpg import DDPGConfig
from cudc_bench.execution.parallel import cores

UPDATES = 4
PRODUCTS, OPTIMISER, REST = "products", "optimiser and targets", "PyTorch's own work"
KINDS = {
    PRODUCTS: ("aten::bmm", "aten::mm", "aten::addmm", "aten::baddbmm", "aten::linear", "aten::matmul"),
    OPTIMISER: ("aten::_fused_adam_", "aten::_foreach", "aten::lerp"),
    "random numbers": ("aten::normal_", "aten::uniform_"),
    "sorting": ("aten::topk", "aten::sort", "aten::searchsorted"),
    "gathering and joining": ("aten::cat", "aten::index", "aten::gather", "aten::copy_", "aten::repeat", "aten::fill_", "aten::zero_"),
    "tanh, ReLU, norms": ("aten::tanh", "aten::relu", "aten::native_layer_norm", "aten::threshold", "aten::clamp"),
    "sums and other arithmetic": ("aten::",),
}


def run() -> Iterator[Row]:
    """Shares of the time inside PyTorch's operations; the rest is Python, autograd's bookkeeping and launching."""
    torch.set_num_threads(cores())
    agents: dict[str, Any] = {"DDPG": PlainDDPG(SPACE, DDPGConfig(), [1])}
    for kind, names in (("collectors", ("cudc",)), ("evaluators", ("td3", "crr", "cql", "iql", "rebrac"))):
        for name in names:
            made = plugins.load(kind, name)
            agents[name] = made(SPACE, made.configure("walker"), [1]) if kind == "collectors" else made(24, 6, made.configure(), [1])
    for name, agent in agents.items():
        batch = batch_for(agent, agent.config.batch_size)
        agent.update(batch)
        agent.update(batch)
        with profile(activities=[ProfilerActivity.CPU], acc_events=True) as found:
            for _ in range(UPDATES):
                agent.update(batch)
        shares: dict[str, float] = defaultdict(float)
        for event in found.key_averages():
            shares[_kind(event.key)] += event.self_cpu_time_total
        total = sum(shares.values())
        ordered = sorted(((share / total, kind) for kind, share in shares.items()), reverse=True)
        text = ", ".join(f"{kind} {share:.0%}" for share, kind in ordered if share >= 0.01 and kind != PRODUCTS)
        yield Row(f"{name}: share of products in its time", f"{shares[PRODUCTS] / total:.0%}", text, "", "", True)


def _kind(name: str) -> str:
    return next((kind for kind, starts in KINDS.items() if name.startswith(starts)), REST)
