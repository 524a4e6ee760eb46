"""What a CUDA graph does, on a CPU: for tests of whether an update may become one.

A :class:`RecordedGraph` notes every operation that PyTorch carries out, with the very tensors that it reads and writes, and repeats these
operations on these tensors. Python is not asked again. So whatever an update takes from anywhere else (a Python number that changes, an
attribute that is bound to a new tensor, a branch) makes a replayed run differ from one that goes step by step, here as on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

from cudc_bench.learning.cuda_graphs import Graph
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.recording import Recorder

T = TypeVar("T")


class RecordedGraph(Graph):
    """Operations on a CPU that can be repeated. Unlike CUDA's, its capture carries them out, and the replay after it does nothing."""

    falls_back = False

    def capture(self, function: Callable[[], T], random: Iterable[MemberRandom]) -> T:
        recorder = Recorder()
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
            for call in self._calls:
                after = call.function(*call.args, **call.kwargs)
                # What an operation makes goes where it went the first time; what it changes or looks at is there already.
                if any(returned.alias_info is not None for returned in call.function._schema.returns):
                    continue
                for old, new in zip(tree_flatten(call.result)[0], tree_flatten(after)[0], strict=True):
                    if isinstance(old, Tensor):
                        old.copy_(new)
