"""Writes a relabelled dataset: its own rewards, everything else linked to the base or copied from it."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.storage import LINKED, READ_ERRORS, check_copy
from cudc_bench.data.writer import check_stored, new_file, write_contiguous, write_episode_attributes
from cudc_bench.errors import RunError


def write_linked(base: Path, data: Path, final: Path, rewards: list[NDArray[np.float32]], standalone: bool) -> None:
    """Write ``main_data.hdf5`` of a relabelled dataset.

    Args:
        base: the base's HDF5 file.
        data: the ``data`` folder to write into.
        final: the ``data`` folder after publication, from which the links are relative.
        rewards: (T,) of each episode.
        standalone: copy everything (about 330 MB for a million steps of Walker) instead of linking it (5 MB).

    Raises:
        RunError: the base is damaged.
        BrokenDownError: a reward is not finite in float32, in which it is stored.
    """
    data.mkdir(parents=True, exist_ok=True)
    target = os.path.relpath(base, final)
    with h5py.File(base, "r") as source, new_file(data / MAIN_FILE) as file:
        for index, values in enumerate(rewards):
            name = f"episode_{index}"
            original, group = source[name], file.create_group(name)
            for field in LINKED:
                if standalone:
                    _check(original, field)
                    source.copy(original[field], group, field)
                else:
                    group[field] = h5py.ExternalLink(target, f"/{name}/{field}")
            check_stored("rewards", values, f"episode {index}")
            write_contiguous(group, "rewards", values)
            write_episode_attributes(group, index, _seed(original), values)


def _seed(episode: h5py.Group) -> int | None:
    """The seed that an episode was reset with, if it is known."""
    try:
        seed = episode.attrs.get("seed")
        if seed is None:
            return None
        if np.ndim(seed) == 0 and np.asarray(seed).dtype.kind in "iu" and int(seed) >= 0:
            return int(seed)
    except READ_ERRORS:
        pass
    file = episode.file.filename
    raise RunError(f"the base is damaged ({file}): the seed of {episode.name} is no number; restore it from a copy, or make it again.")


def _check(episode: h5py.Group, field: str) -> None:
    try:
        check_copy(episode, field)
    except READ_ERRORS as error:
        raise RunError(f"the base cannot be copied ({episode.file.filename}): {error}.") from None
