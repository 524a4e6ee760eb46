"""The vectorised k-step sampler against a Python loop over the same draws."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from benchmarks.measure import Row, fastest_interleaved
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes

BATCH = 1024


def run() -> Iterator[Row]:
    """1,024 transitions with k=3 from 1M steps of Walker."""
    data = Episodes(1, 1000, 1_000_000, 24, 6, MemberRandom([1], "replay"))
    episode = torch.rand(1001, 24), torch.rand(1000, 6)
    for _ in range(1000):
        data.add(0, *episode)
    k = torch.tensor([3])

    def loop() -> list[torch.Tensor]:
        rows, actions = (index[0].tolist() for index in data.indices(BATCH, k))
        observations = [data.observations[0, row] for row in rows]
        following = [data.observations[0, row + 3] for row in rows]
        taken = [data.actions[0, row] for row in actions]
        return [torch.stack(observations), torch.stack(taken), torch.stack(following)]

    slow, fast = fastest_interleaved([loop, lambda: data.sample(BATCH, k)], rounds=30)
    yield Row(
        "k-step sampler, 1,024 of 1M steps", f"{fast * 1e3:.2f} ms", f"Python loop {slow * 1e3:.1f} ms", f"{slow / fast:.0f}x", "", True
    )
