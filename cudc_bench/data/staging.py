"""Crash-safe creation of a dataset's folder: a hidden sibling first, one rename at the end.

Minari skips names that start with a dot, so nothing half-written is ever listed or loaded. One process at a time may build an id.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, parse_id
from cudc_bench.errors import BrokenDownError, RunError, UsageError
from cudc_bench.execution.locks import held_by, locked
from cudc_bench.files import sync, sync_tree, unwritable, walk, write_atomically


@contextmanager
def staging(dataset_id: DatasetId, root: Path | None = None, resume: bool = False) -> Iterator[Path]:
    """A hidden folder in which to build a dataset, or the folder that becomes it; :func:`publish` that before leaving.

    What an earlier, killed process left there is removed; a dataset that it was just about to replace comes back. On leaving, the folder
    is removed, too.

    Args:
        dataset_id: what is built.
        root: instead of Minari's.
        resume: what lies there is continued, and stays after an error if there is a checkpoint (see :func:`checkpoints_path`) to continue
            from, except where that would only fail again.

    Raises:
        RunError: another living process is building this id, or the root cannot be written.
    """
    final = dataset_path(dataset_id, root)
    folder = building_path(dataset_id, root)
    try:
        with locked(_lock(final), f"'{dataset_id}'"):
            if not resume:
                shutil.rmtree(folder, ignore_errors=True)
            replaced = _replaced(final)
            if replaced.exists() and not final.exists():
                replaced.rename(final)
            folder.mkdir(exist_ok=resume)
            try:
                yield folder
            except BaseException as error:
                if not (resume and any(checkpoints_path(dataset_id, root).glob("*.pt"))) or isinstance(error, BrokenDownError):
                    shutil.rmtree(folder, ignore_errors=True)
                raise
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        raise unwritable(f"'{dataset_id}' below {final.parent}", error) from error
    finally:
        # A namespace in which nothing came to be.
        for parent in final.parents:
            if parent == (root or datasets_root()):
                break
            with suppress(OSError):
                parent.rmdir()


def building_path(dataset_id: DatasetId, root: Path | None = None) -> Path:
    """The folder of :func:`staging`, whether or not it exists."""
    final = dataset_path(dataset_id, root)
    return final.with_name(f".{final.name}.building")


def checkpoints_path(dataset_id: DatasetId, root: Path | None = None) -> Path:
    """Where the checkpoints of a dataset lie while it is being built."""
    return building_path(dataset_id, root) / "checkpoints"


def publish(folder: Path, dataset_id: DatasetId, root: Path | None = None) -> Path:
    """Put a finished staging folder in its place by one rename; a dataset that stood there is replaced.

    Returns:
        The dataset's folder.
    """
    final = dataset_path(dataset_id, root)
    sync_tree(folder)
    _declare_namespaces(final.parent, root or datasets_root())
    replaced = _replaced(final)
    shutil.rmtree(replaced, ignore_errors=True)
    if final.exists():
        final.rename(replaced)
    folder.rename(final)
    sync(final.parent)
    shutil.rmtree(replaced, ignore_errors=True)
    return final


def unfinished(root: Path | None = None) -> list[tuple[DatasetId, str | None]]:
    """The datasets that are being built, or were when a process ended, each with the process that builds it now, if one does."""
    root = root or datasets_root()
    found = []
    for place, folders, _ in walk(root, once=False):
        for name in (one for one in folders if one.startswith(".") and one.endswith(".building")):
            with suppress(UsageError):
                one = parse_id((place / name[1:].removesuffix(".building")).relative_to(root).as_posix())
                found.append((one, held_by(_lock(dataset_path(one, root)))))
        folders[:] = [name for name in folders if not name.startswith(".")]
    return sorted(found, key=lambda one: str(one[0]))


def writer_of(dataset_id: DatasetId, root: Path | None = None) -> str | None:
    """The process that builds a dataset, or removes it, such as ``"process 123"``; None if none does."""
    return held_by(_lock(dataset_path(dataset_id, root)))


def tidy(dataset_id: DatasetId, root: Path | None = None) -> None:
    """Remove what a process left that was killed just after it had published a dataset; nothing if somebody is writing it again."""
    if is_untidy(dataset_id, root):
        with suppress(RunError), staging(dataset_id, root):
            shutil.rmtree(_replaced(dataset_path(dataset_id, root)), ignore_errors=True)


def is_untidy(dataset_id: DatasetId, root: Path | None = None) -> bool:
    """Whether anything lies beside a dataset that a process left, or needs that is writing it again."""
    final = dataset_path(dataset_id, root)
    return any(path.exists() for path in (building_path(dataset_id, root), _replaced(final), _lock(final)))


def _lock(final: Path) -> Path:
    return final.with_name(f".{final.name}.lock")


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
