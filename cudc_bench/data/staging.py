"""Crash-safe creation of a dataset's folder: a hidden sibling first, one rename at the end.

Minari skips names that start with a dot, so nothing half-written is ever listed or loaded. One process at a time may build an id.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cudc_bench.errors import RunError
from cudc_bench.ids import DatasetId, dataset_path


@contextmanager
def staging(dataset_id: DatasetId, root: Path | None = None) -> Iterator[Path]:
    """A fresh hidden folder in which to build a dataset; :func:`publish` it before leaving.

    What an earlier, killed process left there is removed. A folder that is not published is removed, too.

    Raises:
        RunError: another living process is building this id, or the root cannot be written.
    """
    final = dataset_path(dataset_id, root)
    folder = final.with_name(f".{final.name}.building")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        with _locked(final.with_name(f".{final.name}.lock"), dataset_id):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            try:
                yield folder
            finally:
                shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or str(error)
        hint = "; free some space and run the same command again" if error.errno == errno.ENOSPC else ""
        raise RunError(f"cannot write '{dataset_id}' below {final.parent}: {reason}{hint}.") from error


@contextmanager
def _locked(path: Path, dataset_id: DatasetId) -> Iterator[None]:
    """Hold a lock that the system itself releases when the process dies."""
    with path.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise RunError(f"process {file.read().strip() or 'unknown'} is writing '{dataset_id}'; wait for it to end.") from None
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def publish(folder: Path, dataset_id: DatasetId, root: Path | None = None) -> Path:
    """Put a finished staging folder in its place by one rename; a dataset that stood there is replaced.

    Returns:
        The dataset's folder.
    """
    final = dataset_path(dataset_id, root)
    sync_tree(folder)
    replaced = final.with_name(f".{final.name}.replaced")
    shutil.rmtree(replaced, ignore_errors=True)
    if final.exists():
        final.rename(replaced)
    folder.rename(final)
    sync(final.parent)
    shutil.rmtree(replaced, ignore_errors=True)
    return final


def sync(path: Path) -> None:
    """Force a file or folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_tree(folder: Path) -> None:
    """Force every file and folder below a folder to the disk."""
    for place, _, files in os.walk(folder):
        for name in files:
            sync(Path(place) / name)
        sync(Path(place))
