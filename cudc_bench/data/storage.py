"""What is looked at in a dataset's HDF5 file before an array of it is read.

In HDF5 a name can stand for almost anything: an object in another file, the bytes of any file of the machine, more numbers than there is
memory for. Datasets come from others. So only what this project writes is read: arrays that lie whole in their own file, and, in a
relabelled dataset, links to the same episode of its base.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from cudc_bench.envs.domains import Domain
from cudc_bench.files import check_regular

# Fields, and the group of the others, that a relabelled dataset takes from its base.
LINKED = ("observations", "actions", "terminations", "truncations", "infos")
# All that h5py raises on bytes that make no sense to it, and what is raised here.
READ_ERRORS = (OSError, KeyError, IndexError, RuntimeError, ValueError, TypeError, OverflowError)
_LARGEST = 1 << 28  # bytes of one episode's array; states take a thousandth
_WHOLE = (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT)


def check_links(file: h5py.File, fields: Iterable[str], episodes: Sequence[int], base: Path | None = None) -> None:
    """Refuse links that lead anywhere but from a relabelled dataset to the same place in its base; nothing is followed before.

    Args:
        file: the dataset's.
        fields: such as ``("observations", "infos/physics")``.
        episodes: their numbers.
        base: the file of the base that a relabelled dataset links to; None where all must be in the file itself.

    Raises:
        ValueError: there is such a link, or something is missing.
    """
    names = list(fields)
    for index in episodes:
        group = _member(file.id, f"episode_{index}", file.name)
        for name in names:
            first, _, second = name.partition("/")
            if base is not None and first in LINKED:
                _check_target(file, group, index, first, base)
            else:
                inner = _member(group, first, f"/episode_{index}", opened=bool(second))
                if second:
                    _member(inner, second, f"/episode_{index}/{first}", opened=False)
    if base is not None:
        check_regular(base)
        with h5py.File(base, "r") as target:
            check_links(target, [name for name in names if name.partition("/")[0] in LINKED], episodes)


def open_field(group: h5py.Group, name: str) -> Any:
    """Open an array through h5py's low-level interface, whose objects cost a third of the high-level one's.

    Raises:
        ValueError: its numbers are not all in its file.
        KeyError: there is none.
    """
    dataset = h5py.h5d.open(group.id, name.encode())
    kind, stored = dataset.dtype, dataset.get_create_plist()
    if stored.get_layout() not in _WHOLE or stored.get_external_count():
        raise ValueError(f"{group.name}/{name} is not stored whole in its file")
    if kind.kind not in "biuf":
        raise ValueError(f"{group.name}/{name} holds {kind}, which are no numbers")
    if not kind.isnative:
        raise ValueError(f"{group.name}/{name} holds {kind.str}, numbers in another byte order than ours")
    size = math.prod(dataset.shape) * kind.itemsize
    if size > _LARGEST:
        # A file with holes has any number of bytes, and few of them on the disk.
        raise ValueError(f"{group.name}/{name} claims {size:,} bytes; an array of one episode may have {_LARGEST:,}")
    if dataset.get_storage_size() < size:
        raise ValueError(f"{group.name}/{name} claims {size:,} bytes, which its file does not have")
    return dataset


def file_size(dataset: Any) -> int:
    """Bytes of the file that an array lies in."""
    return int(h5py.h5i.get_file_id(dataset).get_filesize())


def check_copy(group: h5py.Group, name: str) -> None:
    """Refuse to copy what is not whole: an array, or a group of arrays.

    Raises:
        ValueError: it is a link, or its numbers are not all in its file.
    """
    _member(group.id, name, group.name, opened=False)
    if isinstance(group[name], h5py.Group):
        for one in group[name]:
            _member(group[name].id, one, group[name].name, opened=False)
            open_field(group, f"{name}/{one}")
    else:
        open_field(group, name)


def row_kinds(domain: Domain) -> dict[str, tuple[type, tuple[int, ...]]]:
    """The type and the shape of a row of each field that a domain fixes."""
    return {
        "observations": (np.float32, (domain.observation_size,)),
        "actions": (np.float32, (domain.action_size,)),
        "rewards": (np.float32, ()),
        "terminations": (np.bool_, ()),
        "truncations": (np.bool_, ()),
        "infos/physics": (np.float64, (domain.physics_size,)),
    }


def odd_values(name: str, array: NDArray[Any]) -> Iterator[tuple[str, str, int]]:
    """What no episode can hold, in the type in which it is stored.

    Args:
        name: of the field, such as ``"actions"``.
        array: of an episode, a row for each step.

    Yields:
        What it is about (``"numbers"`` or ``"actions"``), what is wrong in a few words, and the first row where it is.
    """
    if array.dtype.kind != "f":
        return
    for check, what, good in (
        ("numbers", f"a number of {name} is not finite", np.isfinite(array)),
        ("actions", "an action is out of [-1, 1]", np.abs(array) <= 1.0 if name == "actions" else None),
    ):
        if good is not None and not good.all():
            rows = good.reshape(len(good), -1).all(axis=1)
            yield check, what, int(np.flatnonzero(~rows)[0])


def _member(group: Any, name: str, where: str, opened: bool = True) -> Any:
    """A group in a group of the same file; ``opened=False`` only looks at the link."""
    try:
        kind = group.links.get_info(name.encode()).type
    except RuntimeError:
        raise ValueError(f"there is no {where.rstrip('/')}/{name}") from None
    if kind != h5py.h5l.TYPE_HARD:
        raise ValueError(f"{where.rstrip('/')}/{name} is a link to somewhere else")
    return h5py.h5g.open(group, name.encode()) if opened else None


def _check_target(file: h5py.File, group: Any, index: int, name: str, base: Path) -> None:
    try:
        kind = group.links.get_info(name.encode()).type
    except RuntimeError:
        raise ValueError(f"there is no /episode_{index}/{name}") from None
    if kind != h5py.h5l.TYPE_EXTERNAL:
        raise ValueError(f"/episode_{index}/{name} is no link to its base")
    there, inside = (part.decode("utf-8", "replace") for part in group.links.get_val(name.encode()))
    if inside != f"/episode_{index}/{name}" or not _same(Path(file.filename).parent / there, base):
        if behind := behind_link(Path(file.filename), there, base):
            raise ValueError(behind)
        raise ValueError(f"/episode_{index}/{name} links to '{there[:200]}' ({inside[:200]}), which is not that episode of its base")


def behind_link(path: Path, there: str, base: Path) -> str:
    """What is the matter with a link into a base that would be right if no symbolic link lay on the way; empty if something else is.

    Args:
        path: the file of the labelled dataset.
        there: where its link leads, as it is written.
        base: the file that it should lead to.
    """
    if not _same(Path(os.path.normpath(path.absolute().parent / there)), base):
        return ""
    return (
        f"the labelled dataset lies behind a symbolic link, really in '{path.resolve().parents[1]}', from where its links to its base lead "
        "elsewhere; link the whole root instead, or label it there with relabel --standalone"
    )


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except (OSError, ValueError):
        return False
