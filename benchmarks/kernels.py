"""Kernels of one update: those that are launched one by one, and those that the compiler leaves, counted on a CPU.

A GPU's limit at these sizes is their number. What counts is what moves numbers: views and empty tensors launch nothing. Of compiled updates
it is what the compiler schedules after fusion, products and other libraries' operations included. Its number for a GPU can only be lower,
since it makes one kernel of a list (Adam, slow copies) where the CPU's code has a loop for each tensor.
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
from cudc_bench.learning.compiled import compile_anew, missing_compiler
from cudc_bench.learning.recording import Recording

TARGETS = {"cudc": 120, "td3": 70}
_PRODUCTS = ("bmm", "baddbmm", "mm", "addmm")


def run() -> Iterator[Row]:
    """Plain DDPG, CUDC and TD3, whose number of members changes nothing about it."""
    from torch._inductor import config

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
        scheduled: list[Any] = []
        # A function that is kept already would not be scheduled.
        with config.patch({"force_disable_caches": True, "_post_fusion_custom_pass": _noting(scheduled)}):
            compile_anew(recording)
        called = [node for node in scheduled if node.is_extern() and type(node.node).__name__ != "MultiOutput"]
        products = sum(str(getattr(node.node, "python_kernel_name", "")).endswith(_PRODUCTS) for node in called)
        loops = [node for node in scheduled if not node.is_extern()]
        lists = sum(_is_of_a_list(node) for node in loops)
        after = len(called) + len(loops) + len(recording.draws)
        target = TARGETS.get(name)
        measured = f"{after}: {products} products, {lists} loops over a tensor of a list"
        yield Row(
            f"{name}: kernels of an update", measured, f"one by one {before}", f"{before / after:.1f}x",
            "" if target is None else f"≤ {target}", target is None or after <= target,
        )  # fmt: skip


def _noting(scheduled: list[Any]) -> Callable[[list[Any]], list[Any]]:
    def note(nodes: list[Any]) -> list[Any]:
        scheduled[:] = nodes
        return nodes

    return note


def _is_of_a_list(node: Any) -> bool:
    """Whether a loop is an optimiser's or a slow copy's, for one tensor, and sums up nothing besides."""
    parts = [one for one in node.get_nodes() if one.node is not None]
    listed = any("_foreach" in str(origin.target) for one in parts for origin in one.node.origins)
    return listed and not any(one.is_reduction() for one in parts)


def _launches(operation: Any) -> bool:
    schema = getattr(operation, "_schema", None)
    if schema is None or schema.name.startswith("aten::empty") or schema.name.startswith("aten::new_empty"):
        return False
    aliases = [one.alias_info for one in schema.returns if one.alias_info is not None]
    return not aliases or any(one.is_write for one in aliases)
