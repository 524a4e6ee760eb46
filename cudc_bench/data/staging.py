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
from typing import IO

from cudc_bench.errors import RunError
from cudc_bench.files import sync, sync_tree, write_atomically
from cudc_bench.ids import DatasetId, dataset_path, datasets_root


@contextmanager
def staging(dataset_id: DatasetId, root: Path | None = None) -> Iterator[Path]:
    """A fresh hidden folder in which to build a dataset; :func:`publish` it before leaving.

    What an earlier, killed process left there is removed; a dataset that it was just about to replace comes back. A folder that is
    not published is removed, too.

    Raises:
        RunError: another living process is building this id, or the root cannot be written.
    """
    final = dataset_path(dataset_id, root)
    folder = final.with_name(f".{final.name}.building")
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        with _locked(final.with_name(f".{final.name}.lock"), dataset_id):
            shutil.rmtree(folder, ignore_errors=True)
            replaced = _replaced(final)
            if replaced.exists() and not final.exists():
                replaced.rename(final)
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
    while True:
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise RunError(f"process {file.read().strip() or 'unknown'} is writing '{dataset_id}'; wait for it to end.") from None
            if not _is_at(path, file):
                continue  # the holder before us removed it after we had opened it; others lock a new file of that name
            file.truncate(0)
            file.write(str(os.getpid()))
            file.flush()
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _is_at(path: Path, file: IO[str]) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def publish(folder: Path, dataset_id: DatasetId, root: Path | None = None) -> Path:
    """Put a finished staging folder in its place by one rename; a dataset that stood there is replaced.

    Returns:
        The dataset's folder.
    """
    final = dataset_path(dataset_id, root)
    sync_tree(folder)
    replaced = _replaced(final)
    shutil.rmtree(replaced, ignore_errors=True)
    if final.exists():
        final.rename(replaced)
    folder.rename(final)
    sync(final.parent)
    shutil.rmtree(replaced, ignore_errors=True)
    _declare_namespaces(final.parent, root or datasets_root())
    return final


def _replaced(final: Path) -> Path:
    """Where a dataset waits, for an instant, while its successor takes its place."""
    return final.with_name(f".{final.name}.replaced")


def _declare_namespaces(folder: Path, root: Path) -> None:
    """Make Minari list the folders above a dataset as namespaces, as its own functions do."""
    while folder != root:
        file = folder / "namespace_metadata.json"
        if not file.exists():
            write_atomically(file, "{}")
        folder = folder.parent
