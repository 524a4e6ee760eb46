"""How updates are carried out: one by one, as a CUDA graph, or compiled.

Results depend on it up to rounding, as on the device; records say which it was.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from cudc_bench.errors import unknown
from cudc_bench.execution.progress import echo
from cudc_bench.learning.compiled import CompiledCudaGraph, CompiledGraph, missing_compiler
from cudc_bench.learning.cuda_graphs import CudaGraph, Graph
from cudc_bench.learning.learner import Learner

ENGINES = ("auto", "eager", "compiled")  # what can be asked for
WORTH_COMPILING = 20_000  # updates: compiling takes as long as it saves in about so many of the ``cpu`` profile's


def check_engine(engine: str, device: str) -> None:
    """Refuse what is no engine, and say where what was asked for cannot be had.

    Raises:
        UsageError: the message says which there are.
    """
    if engine not in ENGINES:
        raise unknown("--engine", engine, ENGINES)
    if engine == "compiled" and device == "cpu" and (missing := missing_compiler()):
        echo(f"updates go one by one: {missing}; install g++, or name another compiler in CXX")


def resolve_engine(asked: str, kind: type, device: str, updates: int) -> str:
    """What a run of so many updates is to be carried out with: ``eager``, ``graph`` (CUDA) or ``compiled``.

    Args:
        asked: ``auto`` compiles on a CPU where there is a compiler and enough to do, and takes graphs on CUDA.
        kind: the class of what learns.
        device: ``cpu`` or ``cuda``.
        updates: of each member.
    """
    if not (issubclass(kind, Learner) and kind.replayable) or asked == "eager":
        return "eager"
    if device == "cuda":
        return "compiled" if asked == "compiled" else "graph"
    if asked == "auto" and updates < WORTH_COMPILING:
        return "eager"
    return "eager" if missing_compiler() else "compiled"


def set_engine(learner: object, engine: str) -> None:
    """Say how a learner's updates are to be carried out, before its first one."""
    if isinstance(learner, Learner):
        learner.engine = engine


def engine_of(learner: object) -> str:
    """How its updates were carried out."""
    return learner.engine if isinstance(learner, Learner) else "eager"


def graphs_for(learner: object, device: torch.device) -> Callable[[], Graph] | None:
    """What makes graphs for a learner; None where its updates are to run one by one."""
    if not getattr(learner, "replayable", False):
        return None
    engine = engine_of(learner)
    if device.type == "cuda":
        return {"eager": None, "compiled": CompiledCudaGraph}.get(engine, CudaGraph)
    return CompiledGraph if engine == "compiled" else None
