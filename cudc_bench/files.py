"""Files that are whole or absent, also after a crash."""

from __future__ import annotations

import errno
import os
import platform
from contextlib import suppress
from pathlib import Path

from cudc_bench.errors import RunError


def unwritable(what: object, error: OSError) -> RunError:
    """The one failure for something that the system does not let us write."""
    hint = "; free some space and run the same command again" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
    return RunError(f"cannot write {what}: {error.strerror or error}{hint}.")


def lives(process: int) -> bool:
    """Whether a process of this machine is running."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file (text as UTF-8) through a temporary neighbour, fsync and one rename.

    What a process of this machine left that was killed while it did the same is removed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    mine = f".{path.name}.{platform.node()}."
    temporary = path.with_name(f"{mine}{os.getpid()}.tmp")
    for other in os.listdir(path.parent):
        number = other.removeprefix(mine).removesuffix(".tmp")
        if other == f"{mine}{number}.tmp" and number.isdecimal() and not lives(int(number)):
            path.with_name(other).unlink(missing_ok=True)
    try:
        with temporary.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


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


def remove_empty(folder: Path) -> None:
    """Remove a folder and those below it as far as there is nothing in them."""
    for place, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):
            os.rmdir(place)
