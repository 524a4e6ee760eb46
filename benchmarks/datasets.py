"""Writing and reading a dataset of a million steps of Walker, with physics states."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.measure import Row, fastest

SIZES = (10_000, 100_000, 1_000_000)
LINEAR = 1.15  # at most so much dearer for each step than in proportion


def run() -> Iterator[Row]:
    """Shards with fsync, consolidation, hashing, metadata and the final rename; then the flat loader and ``load_transitions``."""
    with tempfile.TemporaryDirectory() as root:
        os.environ["MINARI_DATASETS_PATH"] = root
        from cudc_bench import load_transitions
        from cudc_bench.data.reader import load_episodes

        arrays = ("observations", "actions", "rewards")
        write, read, load = [], [], []
        for steps in SIZES:
            dataset_id = f"walker/bench{steps}-v0"
            start = time.perf_counter()
            _write(dataset_id, steps)
            write.append(time.perf_counter() - start)
            read.append(fastest(partial(load_episodes, dataset_id, arrays), repeats=3))
            load.append(fastest(partial(load_transitions, dataset_id), repeats=3))
        size = sum(file.stat().st_size for file in (Path(root) / dataset_id).rglob("*") if file.is_file())
        yield Row("write 1M steps", f"{write[-1]:.1f} s, {size / 1e6:.0f} MB", "", "", "≤ 8 s", write[-1] <= 8)
        yield Row("read 1M steps, as training does", f"{read[-1]:.2f} s", "", "", "≤ 2 s", read[-1] <= 2)
        yield Row("load_transitions, 1M steps", f"{load[-1]:.2f} s", "", "", "≤ 2 s", load[-1] <= 2)
        for what, times in (("writing", write), ("reading", read), ("load_transitions,", load)):
            after = ", ".join(f"{steps:,}" for steps in SIZES)
            shown = ", ".join(f"{seconds:.3f}" for seconds in times)
            growth, most = times[-1] / times[1], LINEAR * SIZES[-1] / SIZES[1]
            yield Row(f"{what} {after} steps", f"{shown} s", "100,000 steps", f"{growth:.1f}x", f"≤ {most:.1f}x", growth <= most)


def _write(dataset: str, steps: int) -> None:
    from cudc_bench.artefacts.ids import parse_id
    from cudc_bench.artefacts.manifest import Manifest, fingerprint
    from cudc_bench.artefacts.provenance import machine, versions
    from cudc_bench.data.metadata import write_metadata
    from cudc_bench.data.staging import publish, staging
    from cudc_bench.data.writer import Episode, EpisodeShards, write_episodes

    random = np.random.default_rng(0)
    observations = random.normal(size=(1001, 24)).astype(np.float32)
    actions = random.uniform(-1, 1, (1000, 6)).astype(np.float32)
    physics = random.normal(size=(1001, 18))
    dataset_id = parse_id(dataset)
    with staging(dataset_id) as folder:
        shards = EpisodeShards(folder / "shards")
        for seed in range(steps // 1000):
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
