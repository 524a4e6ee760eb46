"""Writes a relabelled dataset: its own rewards, everything else linked to the base or copied from it."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.storage import LINKED, READ_ERRORS, check_copy
from cudc_bench.data.writer import new_file, write_contiguous, write_episode_attributes
from cudc_bench.errors import RunError


def write_linked(base: Path, data: Path, final: Path, rewards: list[NDArray[np.float32]], standalone: bool) -> None:
    """Write ``main_data.hdf5`` of a relabelled dataset.

    Args:
        base: the base's HDF5 file.
        data: the ``data`` folder to write into.
        final: the ``data`` folder after publication, from which the links are relative.
        rewards: (T,) of each episode.
        standalone: copy everything (about 330 MB for a million steps of Walker) instead of linking it (5 MB).
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
            write_contiguous(group, "rewards", values)
            seed = original.attrs.get("seed")
            write_episode_attributes(group, index, None if seed is None else int(seed), values)


def _check(episode: h5py.Group, field: str) -> None:
    try:
        check_copy(episode, field)
    except READ_ERRORS as error:
        raise RunError(f"the base cannot be copied ({episode.file.filename}): {error}.") from None
