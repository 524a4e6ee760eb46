"""Stacks that are too large for a GPU: how many of their members would fit, in one line instead of an allocator's error.

What a member costs is measured on the card itself: one member, then two, are made as the run makes them and learn a little.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from cudc_bench.errors import RunError

GIB = 2**30


class Rehearsing(Protocol):
    """A stack that can show what its members cost."""

    @property
    def seeds(self) -> Sequence[int]:
        """One for each member."""

    def rehearse(self, members: int) -> None:
        """Make the first so many members, with all that they hold, and have them learn from made-up data; nothing is kept."""


def within_memory(job: Callable[..., Any], advance: Callable[[int], None], *, stack: Rehearsing, **arguments: Any) -> Any:
    """What a job returns, called with the same arguments.

    Raises:
        RunError: the GPU's memory is too small for the stack; the message says how many members would fit.
    """
    try:
        return job(advance, stack=stack, **arguments)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
    # Only here is everything gone that the error's traceback held.
    raise RunError(advice(stack))


def is_out_of_memory(error: BaseException) -> bool:
    """Whether the memory of a GPU was too small."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(error, torch.OutOfMemoryError)


def advice(stack: Rehearsing) -> str:
    """What is too large, how many members would fit, and what to do."""
    members, capacity = len(stack.seeds), free_memory()
    first = cost(stack, 1)
    if members == 1 or first is None:
        what = "one member does not fit" if members == 1 else f"{members} members do not fit, and one alone neither"
        return f"{what} into the GPU's memory, of which {capacity / GIB:.1f} GiB are free; choose a smaller width or batch_size."
    second = cost(stack, 2) if members > 2 else None
    fit = members_that_fit(first, second, capacity, members)
    each = (first if second is None else max(second - first, 1)) / GIB
    return (
        f"{members} members do not fit into the GPU's memory, of which {capacity / GIB:.1f} GiB are free; about {fit} would, at"
        f" {each:.2f} GiB each: give fewer seeds or tasks at a time, or a smaller width or batch_size."
    )


def members_that_fit(first: int, second: int | None, capacity: int, members: int) -> int:
    """How many members fit, by what one and two of them take, fewer than did not.

    Args:
        first, second: bytes; the second is None where two do not fit.
        capacity: bytes that are free.
        members: that do not fit.
    """
    if second is None:
        return 1
    return max(1, min(members - 1, 1 + (capacity - first) // max(second - first, 1)))


def cost(stack: Rehearsing, members: int) -> int | None:
    """Bytes that so many members of a stack take at most; None where they do not fit either."""
    import torch

    free_memory()
    torch.cuda.reset_peak_memory_stats()
    try:
        stack.rehearse(members)
    except torch.OutOfMemoryError:
        return None
    return int(torch.cuda.max_memory_reserved())


def free_memory() -> int:
    """Give back what is held for nothing; bytes that this process could have."""
    import torch

    gc.collect()
    torch.cuda.empty_cache()
    return int(torch.cuda.mem_get_info()[0]) + int(torch.cuda.memory_reserved())
