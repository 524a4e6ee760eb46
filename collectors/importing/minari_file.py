"""A Minari dataset that others made: what it holds, and how it is read without trusting it.

Minari keeps an episode in a group of an HDF5 file: T+1 observations and infos, the first of the reset, and T actions, rewards and ends;
action t leads to observation t+1. Nothing in Minari checks any of it, and Minari's own reading follows links and decodes whatever there
is. Here every array's shape and type is looked at first, and one episode takes at most a few times ``LARGEST`` bytes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench.artefacts.manifest import KEY
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.storage import READ_ERRORS, check_links
from cudc_bench.envs import Domain
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import check_regular

from .exorl import LARGEST, ROUNDING, FileFault, Layout, is_extra, words

Array = NDArray[Any]
MOST_EPISODES = 1_000_000
_ENTRY_POINT = "cudc_bench.envs.gym:SimulatorEnv"
_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_LZF}
_FIELDS = ("observations", "actions", "rewards", "terminations", "truncations")
_FLOATS = (np.dtype(np.float32), np.dtype(np.float64))


@dataclass(frozen=True)
class Described:
    """What a dataset's metadata say of it; nothing of it has been held against the data.

    Attributes:
        folder: which holds ``data``.
        episodes: how many.
        domain, task: of the environment that it was recorded in, if that is one of ours; None where the metadata do not say.
    """

    folder: Path
    episodes: int
    domain: str | None
    task: str | None

    @property
    def file(self) -> Path:
        """The HDF5 file."""
        return self.folder / "data" / MAIN_FILE


@dataclass(frozen=True)
class MinariEpisode:
    """The checked content of an episode of T steps.

    Attributes:
        observations: (T+1, S) float32.
        actions: (T, A) float32 in [-1, 1].
        rewards: (T,) float32.
        infos: those that the layout keeps, (T+1, ...); ``physics`` (T+1, P) float64.
        layout: which they are.
        clipped: how many numbers of actions were beyond [-1, 1] by rounding.
    """

    observations: Array
    actions: Array
    rewards: Array
    infos: dict[str, Array]
    layout: Layout
    clipped: int


def describe(dataset: str, folder: Path) -> Described:
    """Read a dataset's metadata. Nothing that they name is imported.

    Args:
        dataset: its id, for messages.
        folder: where it lies.

    Raises:
        UsageError: there is no such dataset, it is one of ours, or not kept in HDF5.
        RunError: the metadata are damaged.
    """
    path = folder / "data" / "metadata.json"
    try:
        check_regular(path)
        with path.open("rb") as opened:
            content = opened.read(LARGEST + 1)
        if len(content) > LARGEST:
            raise ValueError(f"larger than {LARGEST:,} bytes")
        metadata = json.loads(content)
    except (FileNotFoundError, NotADirectoryError):
        raise UsageError(f"there is no dataset '{dataset}' ({folder}).") from None
    except (OSError, ValueError, RecursionError) as error:
        raise RunError(f"the metadata of '{dataset}' cannot be read ({path}): {words(error)}.") from None
    if not isinstance(metadata, dict):
        raise RunError(f"the metadata of '{dataset}' cannot be read ({path}): they are no object.")
    if KEY in metadata:
        raise UsageError(f"'{dataset}' is a dataset of cudc-bench already; use it as it is.")
    kept = str(metadata.get("data_format", "hdf5"))[:32]
    if kept != "hdf5":
        raise UsageError(f"'{dataset}' is kept as {kept!a}; only hdf5 is read: create it in Minari with data_format='hdf5'.")
    episodes = metadata.get("total_episodes")
    if not isinstance(episodes, int) or not 1 <= episodes <= MOST_EPISODES:
        raise RunError(f"'{dataset}' has {str(episodes)[:32]} episodes by its metadata; 1 to {MOST_EPISODES:,} can be imported.")
    return Described(folder, episodes, *_environment(metadata.get("env_spec")))


def read_minari(described: Described, domain: Domain) -> Iterator[MinariEpisode]:
    """Its episodes, one in memory at a time.

    Raises:
        FileFault: an episode does not fit the domain; all before it were given.
    """
    try:
        check_regular(described.file)
        file = h5py.File(described.file, "r")
    except READ_ERRORS as error:
        raise FileFault(f"cannot be read ({words(error)})") from None
    with file:
        for index in range(described.episodes):
            try:
                yield _episode(file, index, domain)
            except READ_ERRORS as error:
                raise FileFault(f"holds an episode_{index} that cannot be read ({words(error)})") from None
            except FileFault as fault:
                raise FileFault(f"holds an episode_{index} that {fault}") from None


def _environment(spec: object) -> tuple[str | None, str | None]:
    """The domain and the task of a stored specification, if it is of our environments."""
    try:
        found = json.loads(spec) if isinstance(spec, str) else None
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or found.get("entry_point") != _ENTRY_POINT or not isinstance(found.get("kwargs"), dict):
        return None, None
    domain, task = (found["kwargs"].get(name) for name in ("domain", "task"))
    return domain if isinstance(domain, str) else None, task if isinstance(task, str) else None


def _episode(file: h5py.File, index: int, domain: Domain) -> MinariEpisode:
    check_links(file, _FIELDS, [index])
    group = file[f"episode_{index}"]
    arrays = {name: _read(group, name) for name in _FIELDS}
    steps = len(arrays["actions"])
    if not 1 <= steps <= domain.episode_length:
        raise FileFault(f"has {steps:,} steps; one of {domain.name} has 1 to {domain.episode_length:,}")
    _check_shapes(arrays, steps, domain)
    layout, infos = _infos(file, index, steps + 1, domain)
    for name, array in (arrays | {f"infos/{name}": array for name, array in infos.items()}).items():
        if not np.isfinite(array).all():
            raise FileFault(f"has a number in '{name}' that is not finite")
    if arrays["terminations"].any():
        raise FileFault("was terminated; here episodes end by time only, so that values bootstrap through every end")
    actions = arrays["actions"].astype(np.float32)
    largest = float(np.abs(actions).max())
    if largest > 1.0 + ROUNDING:
        raise FileFault(f"has an action of size {largest:g}; all must be within [-1, 1]")
    observations, rewards = _narrow(arrays["observations"], "observations"), _narrow(arrays["rewards"], "rewards")
    return MinariEpisode(observations, np.clip(actions, -1.0, 1.0), rewards, infos, layout, int((np.abs(actions) > 1.0).sum()))


def _check_shapes(arrays: dict[str, Array], steps: int, domain: Domain) -> None:
    expected = {
        "observations": ((steps + 1, domain.observation_size), _FLOATS),
        "actions": ((steps, domain.action_size), _FLOATS),
        "rewards": ((steps,), _FLOATS),
        "terminations": ((steps,), (np.dtype(np.bool_),)),
        "truncations": ((steps,), (np.dtype(np.bool_),)),
    }
    for name, (shape, dtypes) in expected.items():
        found = arrays[name]
        if found.dtype not in dtypes:
            raise FileFault(f"has '{name}' of {found.dtype}, not of {' or '.join(map(str, dtypes))}")
        if found.shape != shape:
            raise FileFault(f"has '{name}' of shape {found.shape}; {steps:,} steps of {domain.name} have {shape}")


def _infos(file: h5py.File, index: int, rows: int, domain: Domain) -> tuple[Layout, dict[str, Array]]:
    group = file[f"episode_{index}"]
    if "infos" not in group:
        return Layout(False, {}, ()), {}
    check_links(file, ["infos"], [index])
    if not isinstance(group["infos"], h5py.Group):
        raise FileFault("has 'infos' that are no group")
    kept: dict[str, Array] = {}
    ignored = []
    for name in sorted(group["infos"]):
        check_links(file, [f"infos/{name}"], [index])
        one = group["infos"][name]
        if name == "physics" and isinstance(one, h5py.Dataset):
            kept[name] = _read(group, "infos/physics")
            if (kept[name].dtype, kept[name].shape) != (np.float64, (rows, domain.physics_size)):
                raise FileFault(
                    f"has 'infos/physics' of {kept[name].dtype} {kept[name].shape}; {rows - 1:,} steps of {domain.name} have float64 "
                    f"{(rows, domain.physics_size)}"
                )
        elif isinstance(one, h5py.Dataset) and is_extra(name, one.shape or (), one.dtype, rows):
            kept[name] = _read(group, f"infos/{name}")
        else:
            ignored.append(f"{name[:80]!a}")
    extras = {name: (array.dtype, array.shape[1:]) for name, array in kept.items() if name != "physics"}
    return Layout("physics" in kept, extras, tuple(ignored)), kept


def _read(group: h5py.Group, name: str) -> Array:
    """An array whose numbers all lie in its own file, whole or in chunks as Minari writes them."""
    try:
        dataset = h5py.h5d.open(group.id, name.encode())
    except KeyError:
        raise FileFault(f"has '{name}' that is no array: {group.get(name, getclass=True).__name__}; flatten it first") from None
    stored, kind = dataset.get_create_plist(), dataset.dtype
    if kind.kind not in "biuf" or not kind.isnative:
        raise FileFault(f"has '{name}' of {str(kind)[:80]}, which are no plain numbers")
    size = math.prod(dataset.shape) * kind.itemsize
    chunked = stored.get_layout() == h5py.h5d.CHUNKED
    filters = {stored.get_filter(i)[0] for i in range(stored.get_nfilters())}
    if stored.get_layout() == h5py.h5d.VIRTUAL or stored.get_external_count() or filters - _FILTERS:
        raise FileFault(f"has '{name}' that does not lie in its file as plain numbers")
    if size > LARGEST or (chunked and math.prod(stored.get_chunk()) * kind.itemsize > LARGEST):
        raise FileFault(f"has '{name}' of {size:,} bytes; the limit for an episode of states is {LARGEST:,}")
    if not filters and dataset.get_storage_size() < size:
        raise FileFault(f"has '{name}' that claims {size:,} bytes, which its file does not have")
    out: Array = np.empty(dataset.shape, kind)
    dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, out)
    return out


def _narrow(array: Array, name: str) -> Array:
    """As float32, in which datasets are kept."""
    with np.errstate(over="ignore"):
        narrow = array.astype(np.float32)
    if not np.isfinite(narrow).all():
        raise FileFault(f"has a number in '{name}' that float32 cannot hold")
    return narrow
