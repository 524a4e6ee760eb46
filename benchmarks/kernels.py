"""Kernels of one update: those that are launched one by one, and those that the compiler leaves, counted on a CPU.

A GPU's limit at these sizes is their number. What counts is what moves numbers: views and empty tensors launch nothing. The compiler's own
count for a GPU can only be lower, since it makes one kernel of a list (Adam, slow copies) where the CPU's code has a loop for each tensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from benchmarks.measure import Row
from benchmarks.updates import SPACE, PlainDDPG, batch_for
from cudc_bench import plugins
from cudc_bench.collectors.ddpg import DDPGConfig
from cudc_bench.learning.compiled import compile_anew, functional, missing_compiler
from cudc_bench.learning.recording import Recording

TARGETS = {"cudc": 120, "td3": 70}
_PRODUCTS = ("bmm", "baddbmm", "mm", "addmm")


def run() -> Iterator[Row]:
    """Plain DDPG, CUDC and TD3, whose number of members changes nothing about it."""
    from torch._inductor import config, metrics
    from torch._subclasses.fake_tensor import FakeTensorMode

    if missing := missing_compiler():
        yield Row("kernels", "", missing, "", "", False)
        return
    torch.set_num_threads(1)
    cudc, td3 = plugins.load("collectors", "cudc"), plugins.load("evaluators", "td3")
    small = {"width": 128, "batch_size": 128}
    makers: dict[str, Callable[[], Any]] = {
        "DDPG": lambda: PlainDDPG(SPACE, DDPGConfig(**small), [1]),
        "cudc": lambda: cudc(SPACE, cudc.configure("walker", {**small, "feature_dim": 128}), [1]),
        "td3": lambda: td3(24, 6, td3.configure(small), [1]),
    }
    for name, make in makers.items():
        learner = make()
        batch = batch_for(learner, learner.config.batch_size)
        plan = learner.prepare()
        recording = Recording.of(partial(learner.learn, batch, plan), learner.random.values())[0]
        before = sum(_launches(node.target) for node in recording.graph.graph.nodes if node.op == "call_function") + len(recording.draws)
        metrics.reset()
        # A function that is kept already would not be counted.
        with config.patch({"force_disable_caches": True}):
            compile_anew(recording)
        graph = functional(recording, FakeTensorMode())[0]
        called = [str(node.target).split(".") for node in graph.graph.nodes if node.op == "call_function"]
        products = sum(parts[0] == "aten" and parts[1] in _PRODUCTS for parts in called)
        after = metrics.generated_kernel_count + len(recording.draws)
        target = TARGETS.get(name)
        yield Row(
            f"{name}: kernels of an update", f"{after}, {products} of them products", f"one by one {before}", f"{before / after:.1f}x",
            "" if target is None else f"≤ {target}", target is None or after <= target,
        )  # fmt: skip


def _launches(operation: Any) -> bool:
    schema = getattr(operation, "_schema", None)
    if schema is None or schema.name.startswith("aten::empty") or schema.name.startswith("aten::new_empty"):
        return False
    aliases = [one.alias_info for one in schema.returns if one.alias_info is not None]
    return not aliases or any(one.is_write for one in aliases)
