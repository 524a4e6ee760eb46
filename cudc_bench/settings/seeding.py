"""Random streams: one for each purpose of each seed, so that no two draws of a run depend on each other.

A member of a stack draws only from the streams of its own seed. Seeds 1 to 5 collected together are therefore the same experiment
as five separate runs.
"""

from __future__ import annotations

import zlib

import numpy as np


def stream_seed(seed: int, purpose: str, *numbers: int) -> int:
    """A 63-bit seed for one purpose of one run.

    Args:
        seed: the run's seed, as the user gives it.
        purpose: what is drawn, such as ``"weights"`` or ``"environment"``.
        numbers: further distinctions, such as the index of an episode.
    """
    sequence = np.random.SeedSequence(entropy=seed, spawn_key=(zlib.crc32(purpose.encode()), *numbers))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))


def episode_seed(seed: int, purpose: str, *numbers: int) -> int:
    """A 32-bit seed for resetting an environment, which ``numpy.random.RandomState`` and dm_control accept as it is."""
    return stream_seed(seed, purpose, *numbers) >> 31
