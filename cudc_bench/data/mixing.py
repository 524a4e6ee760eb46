"""Which episodes a mixture has of its parts: by its seed and their fingerprints alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cudc_bench.artefacts.ids import DatasetId
from cudc_bench.data.reader import load_episodes
from cudc_bench.envs.domains import Domain
from cudc_bench.settings.seeding import stream_seed


def share_of(steps: int, parts: int, domain: Domain) -> int:
    """Of how many whole episodes each part is, in a mixture of that many steps at most."""
    return steps // (parts * domain.episode_length)


def whole_episodes(dataset_id: DatasetId | str, domain: Domain, root: Path | None = None) -> list[int]:
    """The numbers of a dataset's episodes that last as long as the domain's do; collections end in the middle of one, and imported ones may
    be short.

    Raises:
        UsageError: no such dataset, or not one of ours.
        RunError: it is damaged.
    """
    lengths = load_episodes(dataset_id, (), root).lengths
    return [int(index) for index in np.flatnonzero(lengths == domain.episode_length)]


def draw_episodes(whole: Sequence[int], count: int, seed: int, fingerprint: str) -> list[int]:
    """Draw episodes of one part without replacement, in the order in which the mixture has them.

    A larger count begins with the same episodes. Other parts, and how many there are, change nothing.

    Args:
        whole: the numbers to draw from.
        count: how many, at most all of them.
        seed: of the mixture.
        fingerprint: of the part.
    """
    generator = np.random.default_rng(stream_seed(seed, "mixture", int(fingerprint, 16)))
    return [int(index) for index in generator.permutation(np.asarray(whole, np.int64))[:count]]
