"""Episode files of ExORL and URLB: what they hold, and how they are read without trusting them.

One compressed or plain ``.npz`` archive an episode, called ``<timestamp>_<episode index>_<episode length>.npz`` (ExORL's published buffers:
``episode_<index>_<length>.npz``). Its arrays have one row for the reset and one for each of T steps; the action in row i led to the
observation in row i, and the first action and reward are dummies (Laskin et al. 2021, Yarats et al. 2022).

The files come from others. Every array's declared shape and type is compared with what the domain needs before a byte of it is read,
nothing is ever unpickled, and whatever a file says, reading it takes at most a few times ``LARGEST`` bytes.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from cudc_bench.envs import Domain
from cudc_bench.errors import UsageError
from cudc_bench.files import read_limited

Array = NDArray[Any]

LARGEST = 2**24  # bytes of one file, compressed or not; an episode of the largest domain's states takes a twentieth
MOST_EXTRA = 1024  # numbers a step in an array beyond the known ones
ROUNDING = 1e-5  # how far beyond [-1, 1] float32 arithmetic may have carried an action

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9.:+-]*_(?P<index>[0-9]{1,12})_(?P<length>[0-9]{1,6})\.npz")
_EXTRA_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")
_ALWAYS = ("observation", "action", "reward", "discount")
_FLOAT32, _FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
# Sizes of observations that belong to a look-alike of a domain.
_FOREIGN = {("jaco", 55): "these are URLB's, which observe the pose of a movable target; ExORL's Jaco (42), used here, has fixed targets"}


class FileFault(Exception):
    """What is wrong with an episode file, in words that follow its name."""


@dataclass(frozen=True)
class EpisodeFile:
    """A file as its name describes it: the episode's index in collection order, and its length T in steps."""

    path: Path
    index: int
    length: int


@dataclass(frozen=True)
class Layout:
    """Which optional arrays the files of one collection hold; the same in all of them.

    Attributes:
        physics: whether simulator states are there.
        extras: further numeric arrays with a row for each step, such as a skill: name to type and shape of a row.
        ignored: names of all other arrays.
    """

    physics: bool
    extras: Mapping[str, tuple[np.dtype[Any], tuple[int, ...]]]
    ignored: tuple[str, ...]

    @property
    def kept(self) -> tuple[str, ...]:
        """All arrays that are read."""
        return (*_ALWAYS, *(["physics"] if self.physics else []), *self.extras)

    def __str__(self) -> str:
        names = [*(["physics"] if self.physics else []), *self.extras, *self.ignored]
        return ", ".join(names) or "none"


@dataclass(frozen=True)
class RawEpisode:
    """The checked content of a file, in its own alignment: T+1 rows, the first for the reset.

    Attributes:
        arrays: ``observation`` (T+1, S) and ``action`` (T+1, A) float32 in [-1, 1], ``reward`` (T+1, 1), ``discount`` (T+1, 1), the
            layout's extras and, if there, ``physics`` (T+1, P) float64.
        layout: which of them are optional.
        clipped: (T+1,) how many numbers of each action were beyond [-1, 1] by rounding.
        sha256: of the file's bytes.
    """

    arrays: dict[str, Array]
    layout: Layout
    clipped: NDArray[np.int64]
    sha256: str


def list_files(folder: Path, domain: Domain) -> list[EpisodeFile]:
    """The episode files in a folder, in the order of their episodes' indices; nothing is opened.

    Raises:
        UsageError: there is no such folder or no such file, a name does not fit, or two files have one index.
    """
    try:
        names = sorted(path.name for path in folder.iterdir() if path.suffix == ".npz" and not path.name.startswith("."))
    except OSError as error:
        raise UsageError(f"the episodes in '{folder}' cannot be listed: {error.strerror}.") from None
    if not names:
        below = next((path for path in sorted(folder.iterdir()) if path.is_dir() and any(path.glob("*.npz"))), None)
        hint = f"; did you mean '{below}'?" if below else "; name the folder that holds the episodes of one collection."
        raise UsageError(f"there are no .npz files in '{folder}'{hint}")
    files: dict[int, EpisodeFile] = {}
    for name in names:
        match = _NAME.fullmatch(name)
        if match is None:
            raise UsageError(f"{name!a} in '{folder}' is not called <timestamp>_<episode index>_<episode length>.npz; move it elsewhere.")
        file = EpisodeFile(folder / name, int(match["index"]), int(match["length"]))
        if not 1 <= file.length <= domain.episode_length:
            raise UsageError(
                f"'{file.path}' has {file.length:,} steps by its name; an episode of {domain.name} has 1 to {domain.episode_length:,}."
            )
        if file.index in files:
            raise UsageError(f"'{files[file.index].path.name}' and '{name}' in '{folder}' are both episode {file.index}; keep one.")
        files[file.index] = file
    return [files[index] for index in sorted(files)]


def read_episode(file: EpisodeFile, domain: Domain) -> RawEpisode:
    """Read and check one file.

    Raises:
        FileFault: it is damaged, is not an episode of that domain, or could exhaust the memory.
    """
    try:
        # Read once, so that what is checked, hashed and kept are the same bytes.
        content = read_limited(file.path, LARGEST)
    except OSError as error:
        raise FileFault(f"cannot be read: {error.strerror}") from None
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except Exception as error:  # what parsers of foreign bytes may raise has no end, here and below
        raise FileFault(f"is not a whole .npz archive ({words(error)})") from None
    members = _members(archive)
    headers = {name: _header(archive, name, member) for name, member in members.items()}
    layout = _check_headers(headers, file.length + 1, domain)
    arrays = {name: _array(archive, name, members[name]) for name in layout.kept}
    clipped = _check_values(arrays)
    return RawEpisode(arrays, layout, clipped, hashlib.sha256(content).hexdigest())


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    members: dict[str, zipfile.ZipInfo] = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name == member.filename or name in members:
            raise FileFault(f"holds {member.filename[:80]!a}, which is not an array or there twice")
        # NumPy writes these two only, and the others' decoders may ask for memory before they have seen any data.
        if member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise FileFault(f"holds {name[:80]!a} in a compression that NumPy does not write")
        members[name] = member
    size = sum(member.file_size for member in members.values())
    if size > LARGEST:
        raise FileFault(f"would take {size:,} bytes uncompressed; the limit for an episode of states is {LARGEST:,}")
    return members


def _header(archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """The declared shape and type of an array."""
    try:
        with archive.open(member) as opened:
            read = _HEADERS[npy.read_magic(opened)]
            shape, _, dtype = read(opened)
            start = opened.tell()
    except Exception as error:
        raise FileFault(f"holds {name[:80]!a}, whose header cannot be read ({words(error)})") from None
    if dtype.hasobject:
        raise FileFault(f"holds {name[:80]!a} as Python objects, which are never unpickled")
    if start + math.prod(shape) * dtype.itemsize != member.file_size:
        raise FileFault(f"declares {name[:80]!a} with shape {shape} of {str(dtype)[:80]}, which is not the size of its data")
    return shape, dtype


def _check_headers(headers: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]], rows: int, domain: Domain) -> Layout:
    expected = {
        "observation": ((rows, domain.observation_size), (_FLOAT32,)),
        "action": ((rows, domain.action_size), (_FLOAT32,)),
        "reward": ((rows, 1), (_FLOAT32, _FLOAT64)),
        "discount": ((rows, 1), (_FLOAT32, _FLOAT64)),
        "physics": ((rows, domain.physics_size), (_FLOAT64,)),
    }
    for name, (shape, dtypes) in expected.items():
        if name not in headers:
            if name not in _ALWAYS:
                continue
            raise FileFault(f"has no array '{name}'; it has: {', '.join(f'{one[:80]!a}' for one in sorted(headers)[:9]) or 'none'}")
        found, dtype = headers[name]
        if dtype not in dtypes:
            raise FileFault(f"holds '{name}' as {str(dtype)[:80]}, not as {' or '.join(map(str, dtypes))}")
        if found != shape:
            size = found[1] if len(found) == 2 else None
            hint = _FOREIGN.get((domain.name, size or 0), "") if name == "observation" else ""
            raise FileFault(
                f"holds '{name}' with shape {found}; {rows - 1:,} steps of {domain.name} have {shape}" + (f": {hint}" if hint else "")
            )
    others = sorted(headers.keys() - expected.keys())
    extras = {name: (headers[name][1], headers[name][0][1:]) for name in others if is_extra(name, *headers[name], rows)}
    return Layout("physics" in headers, extras, tuple(f"{name[:80]!a}" for name in others if name not in extras))


def is_extra(name: str, shape: tuple[int, ...], dtype: np.dtype[Any], rows: int) -> bool:
    """Whether an unknown array is worth keeping: plain numbers, and a row for each step."""
    numeric = dtype.kind in "biuf" and dtype.itemsize <= 8 and dtype.isnative
    fits = shape[:1] == (rows,) and 1 <= math.prod(shape[1:]) <= MOST_EXTRA
    return numeric and fits and _EXTRA_NAME.fullmatch(name) is not None


def _array(archive: zipfile.ZipFile, name: str, member: zipfile.ZipInfo) -> Array:
    try:
        with archive.open(member) as opened:
            array: Array = npy.read_array(opened, allow_pickle=False)
    except Exception as error:
        raise FileFault(f"holds damaged data in '{name}' ({words(error)})") from None
    return np.ascontiguousarray(array)


def _check_values(arrays: dict[str, Array]) -> NDArray[np.int64]:
    """Check all numbers, and clip actions that rounding carried beyond [-1, 1]; returns how many in each row."""
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array).reshape(len(array), -1).all(axis=1))[0, 0])
            raise FileFault(f"holds a number that is not finite in row {row} of '{name}'")
    actions, discounts = arrays["action"], arrays["discount"]
    if actions[0].any():
        raise FileFault("has an action in row 0, which must be the reset, with an action of zeros")
    largest = float(np.abs(actions).max())
    if largest > 1.0 + ROUNDING:
        raise FileFault(f"holds an action of size {largest:g}; all must be within [-1, 1]")
    if (discounts != 1.0).any():
        raise FileFault(f"holds the discount {float(discounts[discounts != 1.0][0]):g}; all must be 1, since episodes end by time only")
    clipped = (np.abs(actions) > 1.0).sum(axis=1)
    arrays["action"] = np.clip(actions, -1.0, 1.0)
    return clipped


def words(error: BaseException) -> str:
    """An error's text on one short line of plain characters, whatever a file put into it."""
    text = " ".join(f"{type(error).__name__}: {error}".split()).encode("ascii", "backslashreplace").decode()
    return "".join(c for c in text if c.isprintable())[:120].strip()
