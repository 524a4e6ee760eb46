"""Whether what stands already where a run would write is what that run would make."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from cudc_bench.artefacts.ids import DatasetId
from cudc_bench.artefacts.manifest import Manifest, exists, read_manifest
from cudc_bench.errors import RunError, UsageError

Result = TypeVar("Result")


def dataset_stands(dataset_id: DatasetId, is_same: Callable[[Manifest], bool]) -> bool:
    """Whether a dataset is there already; strangers' and damaged ones are not it.

    Args:
        dataset_id: where it would be.
        is_same: whether a manifest is of the dataset that would be made.
    """
    try:
        return exists(dataset_id) and is_same(read_manifest(dataset_id))
    except (UsageError, RunError):
        return False


def result_stands(path: Path, read: Callable[[Path], Result], is_same: Callable[[Result], bool], other: Callable[[Result], str]) -> bool:
    """Whether a file of results is there already.

    Args:
        path: where it would be.
        read: reads it.
        is_same: whether what was read is what would be made.
        other: what it is if not, as the error says it.

    Raises:
        UsageError: something else stands there.
        RunError: what stands there cannot be read.
    """
    if not path.exists():
        return False
    try:
        there = read(path)
    except RunError as error:
        raise RunError(f"{str(error).rstrip('.')}; use --overwrite or another --output.") from None
    if is_same(there):
        return True
    raise UsageError(f"{path} {other(there)}; use --overwrite or another --output.")
