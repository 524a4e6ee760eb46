"""What every stage function of this folder does with its input and its files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from cudc_bench.errors import UsageError, nearest
from cudc_bench.files import unwritable, write_atomically

T = TypeVar("T")


def only(found: Sequence[T], kind: str, what: str, wanted: str | None, key: Callable[[T], str]) -> tuple[T, ...]:
    """Those of some things of a kind whose ``key`` is wanted; all of them if None is.

    Raises:
        UsageError: there is none; the message lists what there is.
    """
    kept = tuple(one for one in found if wanted is None or key(one) == wanted)
    if wanted is not None and not kept:
        exist = sorted({key(one) for one in found})
        raise UsageError(f"no {kind} has the {what} '{wanted}'; there are: {', '.join(exist)}.{nearest(wanted, exist)}")
    return kept


def write_files(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into a folder, which is made; each is replaced whole. Returns their paths.

    Raises:
        RunError: one could not be written.
    """
    try:
        for name, content in contents.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise unwritable(error.filename or folder, error) from None
    return [folder / name for name in contents]
