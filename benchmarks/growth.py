"""How cost grows: with members, width and batch, and with the number of episodes that a run has collected so far."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import Row, fastest_interleaved
from benchmarks.updates import SPACE
from cudc_bench import plugins
from cudc_bench.collectors.contract import batch_for
from cudc_bench.collectors.running.dataset_sink import DatasetSink
from cudc_bench.execution.parallel import cores
from cudc_bench.execution.runlog import open_log
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Episodes

COLLECTED = (10_000, 100_000, 1_000_000)
LINEAR = 1.15  # at most so much dearer for each unit than in proportion
FLAT = 1.5  # of what takes less than a millisecond; caches alone may make it dearer


def run() -> Iterator[Row]:
    """Updates of CUDC, then what the loop does beside them, with the replay of a run after so many steps."""
    torch.set_num_threads(cores())
    yield _updates("members", [(members, 512, 512) for members in (1, 2, 4)], LINEAR)
    yield _updates("batches of", [(1, size, 512) for size in (256, 512, 1024)], None)
    yield _updates("width", [(1, 512, width) for width in (256, 512, 1024)], None)
    torch.set_num_threads(1)
    yield from _collected()


def _updates(what: str, sizes: list[tuple[int, int, int]], limit: float | None) -> Row:
    """(members, batch, width) three times, of which one grows."""
    kind = plugins.load("collectors", "cudc")
    updates: list[Callable[[], object]] = []
    for members, batch_size, width in sizes:
        config = kind.configure("walker", {"width": width, "batch_size": batch_size, "feature_dim": width})
        agent = kind(SPACE, config, list(range(members)))
        updates.append(partial(agent.update, batch_for(agent, batch_size)))
    times = fastest_interleaved(updates, rounds=6)
    grows = next(index for index in range(3) if sizes[0][index] != sizes[1][index])
    shown = ", ".join(f"{seconds * 1e3:.0f}" for seconds in times)
    names = ", ".join(str(size[grows]) for size in sizes)
    growth, proportion = times[-1] / times[0], sizes[-1][grows] / sizes[0][grows]
    target = "" if limit is None else f"≤ {limit * proportion:.1f}x"
    met = limit is None or growth <= limit * proportion
    return Row(f"CUDC, {what} {names}", f"{shown} ms an update", f"{proportion:.0f}x the size", f"{growth:.1f}x", target, met)


def _collected() -> Iterator[Row]:
    k = torch.tensor([3])
    observations, actions = torch.rand(1001, 24), torch.rand(1000, 6)
    draws: list[Callable[[], object]] = []
    adds: list[Callable[[], object]] = []
    arrays = observations.numpy(), actions.numpy(), {"physics": np.zeros((1001, 18))}
    with tempfile.TemporaryDirectory() as folder, open_log(None) as log:
        for steps in COLLECTED:
            data = Episodes(1, 1100, 1_100_000, 24, 6, MemberRandom([1], "replay"))
            journal = DatasetSink(_made(Path(folder) / str(steps)), log)
            for seed in range(steps // 1000):
                data.add(0, observations, actions)
                journal.add_episode(seed, *arrays)
            draws.append(lambda data=data: data.sample(1024, k))  # type: ignore[misc]
            adds.append(lambda journal=journal: journal.add_episode(0, *arrays))  # type: ignore[misc]
        for what, calls, rounds in (("drawing 1,024 transitions", draws, 200), ("keeping an episode", adds, 20)):
            times = fastest_interleaved(calls, rounds=rounds)
            shown = ", ".join(f"{seconds * 1e3:.2f}" for seconds in times)
            after = ", ".join(f"{steps:,}" for steps in COLLECTED)
            ratio = times[-1] / times[0]
            yield Row(f"{what} after {after} steps", f"{shown} ms", "the first", f"{ratio:.2f}x", f"≤ {FLAT}x", ratio <= FLAT)


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
