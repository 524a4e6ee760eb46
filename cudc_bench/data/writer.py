"""Writes datasets in Minari's HDF5 layout, with memory that does not grow with the dataset.

While collecting, finished episodes go to shards (raw NumPy arrays, fsync). At the end they are put together in one HDF5 file with
contiguous storage, which is smaller and faster than Minari's chunked one and reads the same.
"""

from __future__ import annotations

import io
import shutil
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench.artefacts.manifest import FieldHasher
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.storage import odd_values
from cudc_bench.errors import BrokenDownError, UnusableError
from cudc_bench.files import sync

if TYPE_CHECKING:
    pass

Array = NDArray[Any]


@dataclass(frozen=True)
class Episode:
    """One episode of T steps.

    Attributes:
        seed: with which the environment was reset; None where that is not known.
        observations: (T+1, S) float32.
        actions: (T, A) float32.
        infos: name to array (T+1, ...), such as ``physics`` (T+1, P) float64.
        rewards: (T,) float32; zeros when None.
    """

    seed: int | None
    observations: Array
    actions: Array
    infos: Mapping[str, Array] = field(default_factory=dict)
    rewards: Array | None = None

    def fields(self) -> dict[str, Array]:
        """The arrays as they are stored, by their path inside the episode's HDF5 group."""
        steps = len(self.actions)
        truncations = np.zeros(steps, np.bool_)
        truncations[-1] = True
        rewards = np.zeros(steps, np.float32) if self.rewards is None else self.rewards
        return {
            "observations": self.observations,
            "actions": self.actions,
            "rewards": rewards,
            "terminations": np.zeros(steps, np.bool_),
            "truncations": truncations,
        } | {f"infos/{name}": array for name, array in self.infos.items()}


class EpisodeShards:
    """Finished episodes on disk, a few dozen to a file; each file appears whole or not at all.

    Args:
        folder: where the shards go.
        episodes_per_shard: how many episodes are held in memory at most.
    """

    def __init__(self, folder: Path, episodes_per_shard: int = 25) -> None:
        self._folder = folder
        self._limit = episodes_per_shard
        self._pending: list[Episode] = []
        self._sums: list[list[int]] = []  # size and CRC-32 of each shard
        self._info_names: list[str] = []

    def add(self, episode: Episode) -> None:
        """Keep one episode; its arrays are copied.

        Raises:
            BrokenDownError: it holds numbers that no episode can have (see :func:`check_stored`).
        """
        for name, array in episode.fields().items():
            check_stored(name, array, "the episode that has just ended")
        copied = {name: array.copy() for name, array in episode.infos.items()}
        rewards = None if episode.rewards is None else episode.rewards.copy()
        self._pending.append(Episode(episode.seed, episode.observations.copy(), episode.actions.copy(), copied, rewards))
        if len(self._pending) >= self._limit:
            self._flush()

    def state_dict(self) -> dict[str, Any]:
        """What :meth:`load_state_dict` needs to find all episodes added so far, which are on the disk when this returns."""
        self._flush()
        return {"sums": [list(one) for one in self._sums], "infos": list(self._info_names)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go back to the episodes that had been added when ``state_dict`` was called; those added later are forgotten."""
        self._sums, self._info_names, self._pending = [list(one) for one in state["sums"]], list(state["infos"]), []

    def check(self, state: dict[str, Any]) -> None:
        """Whether these episodes are there.

        Raises:
            UnusableError: a shard is missing, or is not as it was.
        """
        for index, expected in enumerate(state["sums"]):
            try:
                found = _checksum(self._path(index))
            except OSError:
                found = []
            if found != expected:
                raise UnusableError

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.npy"

    def _flush(self) -> None:
        if not self._pending:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._path(len(self._sums))
        temporary = path.with_suffix(".tmp")
        with temporary.open("wb") as file:
            for episode in self._pending:
                head = [episode.seed or 0, episode.seed is not None, episode.rewards is not None]
                _save(file, np.array(head, np.uint64))
                infos = [episode.infos[name] for name in sorted(episode.infos)]
                rewards = [] if episode.rewards is None else [episode.rewards]
                for array in (episode.observations, episode.actions, *infos, *rewards):
                    _save(file, array)
        sync(temporary)
        temporary.replace(path)
        sync(self._folder)
        self._sums.append(_checksum(path))
        self._info_names = sorted(self._pending[0].infos)
        self._pending.clear()

    def __iter__(self) -> Iterator[Episode]:
        """All episodes in the order in which they were added, one in memory at a time."""
        self._flush()
        for index in range(len(self._sums)):
            with self._path(index).open("rb") as file:
                while file.peek(1):
                    seed, has_seed, has_rewards = np.load(file, allow_pickle=False)
                    observations = np.load(file, allow_pickle=False)
                    actions = np.load(file, allow_pickle=False)
                    infos = {name: np.load(file, allow_pickle=False) for name in self._info_names}
                    rewards = np.load(file, allow_pickle=False) if has_rewards else None
                    yield Episode(int(seed) if has_seed else None, observations, actions, infos, rewards)

    def episodes(self) -> Iterator[Episode]:
        """See :class:`~cudc_bench.runs.interaction.EpisodeStore`."""
        return iter(self)

    def remove(self) -> None:
        """Delete the shards: the dataset is complete without them."""
        shutil.rmtree(self._folder, ignore_errors=True)


def _save(file: IO[bytes], array: Array) -> None:
    """``np.save``, which writes to a file of the system by itself and, on a full disk, does not say that it is full."""
    content = io.BytesIO()
    np.save(content, array, allow_pickle=False)
    file.write(content.getbuffer())


def _checksum(path: Path) -> list[int]:
    """Size and CRC-32 of a file."""
    size, crc = 0, 0
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            size, crc = size + len(part), zlib.crc32(part, crc)
    return [size, crc]


@dataclass(frozen=True)
class Written:
    """What :func:`write_episodes` wrote: sizes and the hashes of the fields."""

    episodes: int
    steps: int
    fields: dict[str, str]


def write_episodes(data: Path, episodes: Iterator[Episode] | list[Episode]) -> Written:
    """Write Minari's ``main_data.hdf5`` into a dataset's ``data`` folder.

    Args:
        data: the folder, which is made.
        episodes: in order; they become ``episode_0``, ``episode_1``, …

    Raises:
        BrokenDownError: one holds numbers that no episode can have (see :func:`check_stored`).
    """
    data.mkdir(parents=True, exist_ok=True)
    hasher, count, steps = FieldHasher(), 0, 0
    with new_file(data / MAIN_FILE) as file:
        for index, episode in enumerate(episodes):
            group = file.create_group(f"episode_{index}")
            infos = group.create_group("infos") if episode.infos else group
            arrays = episode.fields()
            for name, array in arrays.items():
                check_stored(name, array, f"episode {index}")
                hasher.update(name, array)
                place, _, leaf = name.rpartition("/")
                write_contiguous(infos if place else group, leaf, array)
            write_episode_attributes(group, index, episode.seed, arrays["rewards"])
            count, steps = index + 1, steps + len(episode.actions)
    return Written(count, steps, hasher.digests())


def check_stored(name: str, array: Array, where: str) -> None:
    """Refuse to store what no reader should take: numbers that are not finite, in the type in which they are stored, or wild actions.

    Args:
        name: of the field.
        array: as it is stored.
        where: it belongs, such as ``"episode 3"``.

    Raises:
        BrokenDownError: it holds such numbers.
    """
    for _, what, row in odd_values(name, array):
        raise BrokenDownError(f"{where} cannot be stored: {what} at step {row:,}; mend what made it.")


@contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """A new HDF5 file, whole when this context ends.

    Raises:
        OSError: it cannot be written, with the number that says why.
    """
    with _Disk(path, "w+") as disk:
        try:
            with h5py.File(disk, "w", track_order=True) as file:
                yield file
        except Exception:
            if disk.failed is None:
                raise
        if disk.failed is not None:
            raise disk.failed


class _Disk(io.FileIO):
    """A file of which HDF5 believes that everything could be written.

    HDF5 cannot close a file that it could not write: the process crashes then, or later. Its own errors do not say either that a disk is
    full. So the first failure is kept until the file is closed.
    """

    failed: BaseException | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while len(rest) and self.failed is None:
                rest = rest[super().write(rest) :]
        except BaseException as error:  # an interruption, too, would be lost in HDF5
            self.failed = error
        return size

    def readinto(self, buffer: Any) -> int:
        if self.failed is None:
            return super().readinto(buffer)
        view = memoryview(buffer).cast("B")
        view[:] = bytes(len(view))
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        try:
            if self.failed is None:
                super().truncate(size)
        except BaseException as error:
            self.failed = error
        return size or 0


def write_contiguous(group: h5py.Group, name: str, array: Array) -> None:
    """Write one array by h5py's low-level interface, which costs a third of the high-level one for small arrays."""
    array = np.ascontiguousarray(array)
    kind = h5py.h5t.py_create(array.dtype, logical=True)
    space = h5py.h5s.create_simple(array.shape)
    dataset = h5py.h5d.create(group.id, name.encode(), kind, space, _untimed())
    if array.dtype == np.bool_:
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, array, mtype=h5py.h5t.py_create(array.dtype))
    else:
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, array)


@cache
def _untimed() -> h5py.h5p.PropDCID:
    """HDF5 notes when an array was made unless told otherwise; the same data would then not be the same bytes."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_obj_track_times(False)
    return properties


def write_episode_attributes(group: h5py.Group, index: int, seed: int | None, rewards: Array) -> None:
    """Write :func:`episode_attributes`."""
    for name, value in episode_attributes(index, seed, rewards).items():
        group.attrs[name] = value


def episode_attributes(index: int, seed: int | None, rewards: Array) -> dict[str, int | float]:
    """What Minari keeps of each episode beside its arrays; an unknown seed is left out, as Minari itself does."""
    values = rewards.astype(np.float64)
    attributes = {"id": index, "total_steps": len(rewards)} | {
        f"rewards_{name}": float(getattr(values, name)()) for name in ("sum", "mean", "std", "max", "min")
    }
    if seed is not None:
        attributes["seed"] = seed
    return attributes
