"""Writing and reading a dataset of a million steps of Walker, with physics states."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measure import Row, fastest

STEPS = 1_000_000


def run() -> Iterator[Row]:
    """Shards with fsync, consolidation, hashing, metadata and the final rename; then the flat loader and ``load_transitions``."""
    with tempfile.TemporaryDirectory() as root:
        os.environ["MINARI_DATASETS_PATH"] = root
        start = time.perf_counter()
        _write()
        seconds = time.perf_counter() - start
        size = sum(file.stat().st_size for file in Path(root).rglob("*") if file.is_file())
        yield Row("write 1M steps", f"{seconds:.1f} s, {size / 1e6:.0f} MB", "", "", "≤ 8 s", seconds <= 8)

        from cudc_bench import load_transitions
        from cudc_bench.data.reader import load_episodes

        arrays = ("observations", "actions", "rewards")
        seconds = fastest(lambda: load_episodes("walker/bench-v0", arrays), repeats=3)
        yield Row("read 1M steps, as training does", f"{seconds:.2f} s", "", "", "≤ 2 s", seconds <= 2)
        seconds = fastest(lambda: load_transitions("walker/bench-v0"), repeats=3)
        yield Row("load_transitions, 1M steps", f"{seconds:.2f} s", "", "", "≤ 2 s", seconds <= 2)


def _write() -> None:
    from cudc_bench.data.staging import publish, staging
    from cudc_bench.data.writer import Episode, EpisodeShards, write_episodes, write_metadata
    from cudc_bench.ids import parse_id
    from cudc_bench.manifest import Manifest, fingerprint
    from cudc_bench.provenance import machine, versions

    random = np.random.default_rng(0)
    observations = random.normal(size=(1001, 24)).astype(np.float32)
    actions = random.uniform(-1, 1, (1000, 6)).astype(np.float32)
    physics = random.normal(size=(1001, 18))
    dataset_id = parse_id("walker/bench-v0")
    with staging(dataset_id) as folder:
        shards = EpisodeShards(folder / "shards")
        for seed in range(STEPS // 1000):
            shards.add(Episode(seed, observations, actions, {"physics": physics}))
        written = write_episodes(folder / "data", iter(shards))
        manifest = Manifest(
            domain="walker", method="bench", seed=1, steps=written.steps, episodes=written.episodes, profile="paper",
            hyperparameters={}, hyperparameters_hash="", fields=written.fields, fingerprint=fingerprint(written.fields),
            versions=versions(), machine=machine("cpu", 1), seconds=0.0, created="", command="",
        )  # fmt: skip
        write_metadata(folder / "data", manifest, str(dataset_id), "benchmark")
        shards.remove()
        publish(folder, dataset_id)
