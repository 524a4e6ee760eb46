"""Reads datasets into flat, contiguous arrays in one pass.

Minari decodes every episode into objects and cannot sample transitions; training needs arrays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench.artefacts.ids import DatasetId, dataset_path, parse_id
from cudc_bench.artefacts.manifest import FieldHasher, Manifest, exists, fingerprint, read_manifest
from cudc_bench.data.layout import MAIN_FILE, has_reset_row
from cudc_bench.data.storage import READ_ERRORS, check_links, file_size, odd_values, open_field, row_kinds
from cudc_bench.envs.domains import DOMAINS, Domain
from cudc_bench.errors import RunError
from cudc_bench.files import check_regular

if TYPE_CHECKING:
    pass

Array = NDArray[Any]


@dataclass(frozen=True)
class FlatEpisodes:
    """All episodes of a dataset, one after the other.

    Attributes:
        arrays: field name to array. Fields with a row for the reset (``observations``, ``infos/…``) have T+1 rows an episode, the
            others T.
        lengths: (episodes,) T of each.
        manifest: what the dataset is.
    """

    arrays: dict[str, Array]
    lengths: NDArray[np.int64]
    manifest: Manifest

    def rows(self, name: str) -> NDArray[np.int64]:
        """Rows that each episode has in a field (episodes,)."""
        return self.lengths + 1 if has_reset_row(name) else self.lengths

    def split(self, name: str) -> list[Array]:
        """A field's array cut into its episodes, without copying."""
        return np.split(self.arrays[name], np.cumsum(self.rows(name))[:-1])


def load_episodes(dataset_id: DatasetId | str, fields: tuple[str, ...], root: Path | None = None, verify: bool = False) -> FlatEpisodes:
    """Read some fields of a dataset.

    Args:
        dataset_id: which dataset.
        fields: such as ``("observations", "actions", "infos/physics")``.
        root: Minari's root unless given.
        verify: hash them and compare with the manifest.

    Raises:
        UsageError: no such dataset, or not one of ours.
        RunError: the base of a linked dataset is missing or another one, the file is damaged, or (with ``verify``) a hash does not fit.
    """
    checked = dataset_id if isinstance(dataset_id, DatasetId) else parse_id(dataset_id)
    manifest = read_manifest(checked, root)
    check_base(manifest, checked, root)
    path = dataset_path(checked, root) / "data" / MAIN_FILE
    try:
        check_regular(path)
        with h5py.File(path, "r") as file:
            check_links(file, fields, range(manifest.episodes), base_file(manifest, root))
            groups = [file[f"episode_{index}"] for index in range(manifest.episodes)]
            lengths = np.array([group.attrs["total_steps"] for group in groups], np.int64)
            if not len(lengths) or lengths.min() < 1 or lengths.sum() != manifest.steps:
                raise ValueError(f"its episodes do not have the {manifest.steps:,} steps of the manifest")
            arrays = {name: _read_field(groups, name, lengths) for name in fields}
            _check_rows(arrays, manifest)
    except READ_ERRORS as error:
        raise _unreadable(checked, path, error) from None
    flat = FlatEpisodes(arrays, lengths, manifest)
    if verify:
        hasher = FieldHasher()
        for name in fields:
            for part in flat.split(name):
                hasher.update(name, part)
        _check_hashes(checked, manifest, hasher)
    return flat


def _unreadable(dataset_id: DatasetId, path: Path, error: Exception) -> RunError:
    return RunError(f"the data of '{dataset_id}' cannot be read ({path}): {_words(error)}.")


def _words(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def base_file(manifest: Manifest, root: Path | None = None) -> Path | None:
    """The file that a dataset may link to: its base's, if it is relabelled and has no copy."""
    base = manifest.base
    return dataset_path(base.id, root) / "data" / MAIN_FILE if base is not None and base.linked else None


def _check_rows(arrays: dict[str, Array], manifest: Manifest, domain: Domain | None = None) -> None:
    """Compare with what the domain has, which dm_control's other ones would have to be loaded for, and with what can be."""
    domain = domain or DOMAINS.get(manifest.domain)
    for name, (dtype, shape) in ({} if domain is None else row_kinds(domain)).items():
        if name in arrays and (arrays[name].dtype != dtype or arrays[name].shape[1:] != shape):
            found = arrays[name]
            raise ValueError(f"{name} has rows of {found.dtype} {found.shape[1:]}, not of {np.dtype(dtype)} {shape}")
    for name, array in arrays.items():
        for _, what, row in odd_values(name, array):
            raise ValueError(f"{what}, first in row {row:,}")


def _read_field(groups: list[h5py.Group], name: str, lengths: NDArray[np.int64]) -> Array:
    extra = 1 if has_reset_row(name) else 0
    first = open_field(groups[0], name)
    shape = (int((lengths + extra).sum()), *first.shape[1:])
    # Many names can stand for one array, and make much of little.
    if math.prod(shape) * first.dtype.itemsize > file_size(first):
        raise ValueError(f"{name} claims more bytes than its file has")
    out = np.empty(shape, first.dtype)
    start = 0
    for group, length in zip(groups, lengths, strict=True):
        end = start + int(length) + extra
        _read_into(group, name, out[start:end])
        start = end
    return out


def _read_into(group: h5py.Group, name: str, out: Array) -> None:
    dataset = open_field(group, name)
    if dataset.shape != out.shape or dataset.dtype != out.dtype:
        raise ValueError(f"{group.name}/{name} is {dataset.dtype} {dataset.shape}, expected {out.dtype} {out.shape}")
    dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, out)


def read_field(group: h5py.Group, name: str) -> Array:
    """One field of one episode, in its own shape and type.

    Args:
        group: the episode's HDF5 group.
        name: such as ``"infos/physics"``.

    Raises:
        READ_ERRORS: of ``cudc_bench.data.storage``, when the file is damaged or the field, or the base of a link, is missing.
    """
    dataset = open_field(group, name)
    # What the file says of itself need not be what is there.
    if math.prod(dataset.shape) * dataset.dtype.itemsize > file_size(dataset):
        raise ValueError(f"{group.name}/{name} claims more bytes than its file has")
    out = np.empty(dataset.shape, dataset.dtype)
    dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, out)
    return out


def iterate_episodes(path: Path, names: tuple[str, ...], episodes: int, base: Path | None = None) -> Iterator[dict[str, Array]]:
    """Some fields of one episode after the other, with memory for one.

    Args:
        path: the HDF5 file; also one that is still in its staging folder, from where the links of a linked dataset resolve, too.
        names: of the fields.
        episodes: how many.
        base: the file that it may link to (see :func:`base_file`).

    Raises:
        RunError: it is damaged.
    """
    try:
        yield from _episodes(path, names, range(episodes), base)
    except READ_ERRORS as error:
        raise RunError(f"{path} cannot be read: {_words(error)}.") from None


def _episodes(path: Path, names: tuple[str, ...], episodes: Sequence[int], base: Path | None) -> Iterator[dict[str, Array]]:
    check_regular(path)
    with h5py.File(path, "r") as file:
        check_links(file, names, episodes, base)
        for index in episodes:
            group = file[f"episode_{index}"]
            yield {name: read_field(group, name) for name in names}


def read_episodes(
    dataset_id: DatasetId | str, names: tuple[str, ...], root: Path | None = None, verify: bool = False, domain: Domain | None = None,
    episodes: Sequence[int] | None = None,
) -> Iterator[dict[str, Array]]:  # fmt: skip
    """Some fields of a dataset, one episode in memory after the other.

    Args:
        dataset_id: which dataset.
        names: of the fields.
        root: Minari's root unless given.
        verify: hash them, and compare with the manifest after the last episode; of all episodes only.
        domain: the dataset's, if it is at hand, to check types and shapes by; the benchmark's own are always.
        episodes: their numbers, in the order in which they are read; all unless given.

    Raises:
        UsageError: no such dataset, or not one of ours.
        RunError: as for :func:`load_episodes`.
    """
    checked = dataset_id if isinstance(dataset_id, DatasetId) else parse_id(dataset_id)
    manifest = read_manifest(checked, root)
    check_base(manifest, checked, root)
    path = dataset_path(checked, root) / "data" / MAIN_FILE
    hasher = FieldHasher()
    try:
        numbers = range(manifest.episodes) if episodes is None else episodes
        for index, episode in zip(numbers, _episodes(path, names, numbers, base_file(manifest, root)), strict=True):
            steps = {len(array) - has_reset_row(name) for name, array in episode.items()}
            if len(steps) != 1:
                raise ValueError(f"episode_{index} has fields of different lengths")
            _check_rows(episode, manifest, domain)
            for name, array in episode.items() if verify else ():
                hasher.update(name, array)
            yield episode
    except READ_ERRORS as error:
        raise _unreadable(checked, path, error) from None
    _check_hashes(checked, manifest, hasher)


def _check_hashes(dataset_id: DatasetId | str, manifest: Manifest, hasher: FieldHasher) -> None:
    changed = [name for name, found in hasher.digests().items() if found != manifest.fields.get(name)]
    if changed:
        raise RunError(f"'{dataset_id}' does not fit its fingerprint: {', '.join(changed)} changed after it was made.")


def check_base(manifest: Manifest, dataset_id: DatasetId, root: Path | None = None) -> None:
    """Check that the dataset which a linked one takes its arrays from is there and is the same one.

    Raises:
        RunError: it is missing or has another fingerprint.
    """
    base = manifest.base
    if base is None or not base.linked:
        return
    if not exists(base.id, root):
        raise RunError(f"'{dataset_id}' links to '{base.id}', which is missing; collect it again or relabel with --standalone.")
    there = read_manifest(base.id, root)
    if there.base is not None and there.base.linked:
        raise RunError(f"'{dataset_id}' links to '{base.id}', which holds no data of its own; relabel again with --overwrite.")
    if there.fingerprint != base.fingerprint:
        raise RunError(f"'{dataset_id}' was made from another '{base.id}'; relabel again with --overwrite.")


def verify_fingerprint(dataset_id: DatasetId | str, root: Path | None = None) -> str:
    """Hash a dataset's arrays and compare with its manifest.

    Returns:
        The fingerprint.

    Raises:
        RunError: they differ; the message names the fields.
    """
    manifest = read_manifest(dataset_id, root)
    hasher = FieldHasher()
    for episode in read_episodes(dataset_id, tuple(manifest.fields), root):
        for name, array in episode.items():
            hasher.update(name, array)
    _check_hashes(dataset_id, manifest, hasher)
    if fingerprint(hasher.digests()) != manifest.fingerprint:
        raise RunError(f"'{dataset_id}' does not fit its fingerprint: the manifest changed after it was made.")
    return manifest.fingerprint
