"""Small stacks for tests."""

from cudc_bench.collectors.contract import SMALL, batch_for, make

__all__ = ["SMALL", "batch_for", "make"]
