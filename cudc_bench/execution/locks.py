"""One writer at a time: locks that name who holds them and that the system releases when their holder dies."""

from __future__ import annotations

import fcntl
import os
import platform
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO

from cudc_bench.errors import HeldError
from cudc_bench.files import lives, unwritable

_UNNAMED = 20.0  # seconds for which a lock may be held by somebody who has not yet written down who it is: a busy machine lets it wait
_MISSING = 100  # times that its folder may vanish before the lock is given up: those above it may be gone


@contextmanager
def locked(path: Path, what: str, patience: float = 0.0) -> Iterator[None]:
    """Hold a lock file, which is removed in the end; one that a dead process left is taken over.

    Args:
        path: of the lock file; its folder is made.
        what: it protects, for the message.
        patience: seconds to wait for whoever holds it.

    Raises:
        HeldError: a living process holds it.
        RunError: it cannot be written.
    """
    deadline = time.monotonic() + patience
    while True:
        try:
            file = _take(path, what)
            break
        except HeldError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)
        except OSError as error:
            raise unwritable(what, error) from None
    with file:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def held_by(path: Path) -> str | None:
    """Who holds a lock, such as ``"process 123"``; None if nobody does."""
    try:
        with path.open("r+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return None
            except BlockingIOError:
                return _holder(file)
    except OSError:
        return None


def _take(path: Path, what: str) -> IO[str]:
    missing = 0
    while True:
        with ExitStack() as stack:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                file = stack.enter_context(path.open("a+"))
            except FileNotFoundError:
                missing += 1
                if missing > _MISSING:
                    raise
                continue  # somebody removed the folder, which was empty
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if (holder := _holder(file)) is None:
                    continue  # it has just left
                raise HeldError(f"{holder} is writing {what}; wait for it to end.") from None
            if not _is_at(path, file):
                continue  # the holder before us removed it after we had opened it; others lock a new file of that name
            try:
                file.truncate(0)
                file.write(f"{os.getpid()} {platform.node()}")
                file.flush()
            except OSError:
                path.unlink(missing_ok=True)  # on a full disk it could be made, but not be written
                raise
            stack.pop_all()
            return file


def _holder(file: IO[str]) -> str | None:
    """Who holds a lock: ``"process 123"``, with the machine if it is another one; None once nobody does.

    A holder writes its number right after it has taken the lock, so what stands there at first may be nothing, or somebody's who died.
    """
    deadline = time.monotonic() + _UNNAMED
    while time.monotonic() < deadline:
        file.seek(0)
        number, _, machine = file.read(200).partition(" ")
        if machine and machine != platform.node():
            return f"process {number} on {machine}"
        if number.isdecimal() and lives(int(number)):
            return f"process {number}"
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return None
        except BlockingIOError:
            time.sleep(0.005)
    return "another process"


def _is_at(path: Path, file: IO[str]) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
