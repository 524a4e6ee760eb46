"""What a CUDA graph does, on a CPU: for tests of whether an update may become one.

A :class:`RecordedGraph` notes every operation that PyTorch carries out, with the very tensors that it reads and writes, and repeats these
operations on these tensors. Python is not asked again. So whatever an update takes from anywhere else (a Python number that changes, an
attribute that is bound to a new tensor, a branch) makes a replayed run differ from one that goes step by step, here as on a GPU. Operations
for whose results the host would have to wait are refused, except for ``tolist`` and ``numpy``, which on a CPU are no operations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from cudc_bench.learning.cuda_graphs import Graph
from cudc_bench.learning.networks import MemberRandom

T = TypeVar("T")
# The host reads a number, or the size of a result depends on numbers.
_WAITING = frozenset({"aten::_local_scalar_dense", "aten::item", "aten::nonzero", "aten::masked_select", "aten::is_nonzero",
                      "aten::equal", "aten::_unique2", "aten::unique_dim", "aten::repeat_interleave.Tensor"})  # fmt: skip


class WaitsForDeviceError(AssertionError):
    """An update needs a result on the host."""


class _Recorder(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, tuple[Any, ...], dict[str, Any], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None) -> Any:
        name = func._schema.name
        if name in _WAITING or (name == "aten::index" and any(t.dtype == torch.bool for t in tree_flatten(args[1])[0] if t is not None)):
            raise WaitsForDeviceError(f"{name} has the host wait for the device; an update that does so cannot become a graph")
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        self.calls.append((func, args, kwargs, result))
        return result


class RecordedGraph(Graph):
    """Operations on a CPU that can be repeated. Unlike CUDA's, its capture carries them out, and the replay after it does nothing."""

    def capture(self, function: Callable[[], T], random: Iterable[MemberRandom]) -> T:
        recorder = _Recorder()
        with recorder:
            result = function()
        self._calls = recorder.calls
        self._done = True
        return result

    def replay(self) -> None:
        if self._done:
            self._done = False
            return
        with torch.no_grad():
            for func, args, kwargs, before in self._calls:
                after = func(*args, **kwargs)
                # What an operation makes goes where it went the first time; what it changes or looks at is there already.
                if any(returned.alias_info is not None for returned in func._schema.returns):
                    continue
                for old, new in zip(tree_flatten(before)[0], tree_flatten(after)[0], strict=True):
                    if isinstance(old, Tensor):
                        old.copy_(new)
