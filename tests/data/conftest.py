"""Builds small datasets of any content through the real writer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import Manifest, fingerprint
from cudc_bench.artefacts.provenance import versions
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.staging import publish, staging
from cudc_bench.data.writer import Episode, Written, write_episodes


def random_episodes(lengths: Sequence[int], seed: int = 0, rewards: bool = True) -> list[Episode]:
    """Episodes of Walker's shapes whose every number is different."""
    generator = np.random.default_rng(seed)
    return [
        Episode(
            seed=2**63 - 1 - index,
            observations=generator.normal(size=(length + 1, 24)).astype(np.float32),
            actions=generator.uniform(-1, 1, (length, 6)).astype(np.float32),
            infos={"physics": generator.normal(size=(length + 1, 18))},
            rewards=generator.uniform(size=length).astype(np.float32) if rewards else None,
        )
        for index, length in enumerate(lengths)
    ]


def manifest_for(written: Written, task: str | None = None) -> Manifest:
    """A manifest of something that was written."""
    return Manifest(
        domain="walker", task=task, method="random", seed=1, steps=written.steps, episodes=written.episodes, profile="smoke",
        hyperparameters={}, hyperparameters_hash="0", fields=written.fields, fingerprint=fingerprint(written.fields),
        versions=versions(), machine={}, seconds=0.0, created="2026-01-01T00:00:00+00:00", command="cudc-bench collect",
    )  # fmt: skip


@pytest.fixture
def make_episodes() -> Callable[..., list[Episode]]:
    """Episodes of given lengths."""
    return random_episodes


@pytest.fixture
def make_dataset() -> Callable[..., Manifest]:
    """Writes and publishes a dataset; with a task, one whose rewards count."""

    def make(dataset_id: str, episodes: list[Episode], task: str | None = None) -> Manifest:
        one = parse_id(dataset_id)
        with staging(one) as folder:
            manifest = manifest_for(write_episodes(folder / "data", episodes), task)
            write_metadata(folder / "data", manifest, dataset_id, "made for a test")
            publish(folder, one)
        return manifest

    return make
