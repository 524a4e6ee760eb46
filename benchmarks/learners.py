"""Time of one gradient step of every offline algorithm at the size of its own defaults, as a share of the matrix-product peak."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.measure import Row
from benchmarks.updates import compare
from cudc_bench import plugins


def run() -> Iterator[Row]:
    """TD3 first, against which the others are compared; IQL and ReBRAC have smaller networks of their own."""
    names = ["td3", *(name for name in plugins.names("evaluators") if name != "td3")]
    kinds = {name: plugins.load("evaluators", name) for name in names}
    yield from compare({name: kind(24, 6, kind.configure(), [1]) for name, kind in kinds.items()}, "gradient step")
