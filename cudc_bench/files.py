"""Files that are whole or absent, also after a crash."""

from __future__ import annotations

import errno
import os
import platform
import stat
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cudc_bench.errors import RunError, UsageError

# Bytes. A name leaves room for that of the temporary neighbour that a file is first written to, and a path for what goes below a folder.
_LONGEST_NAME, _LONGEST_PATH = 200, 3000
MOST_TEXT = 1 << 24  # bytes of a file of text or JSON; a record of the largest profile has a hundredth
MOST_LINES = 1 << 28  # bytes of a file with a line for each of many steps
MOST_WEIGHTS = 1 << 30  # bytes of a policy; one of the paper's size has a hundredth


def check_path(path: str | Path, what: str) -> Path:
    """Refuse a path that the system could not take, or that could not be shown, before anything looks for it.

    Args:
        path: as the user gave it.
        what: it is, such as ``"the output"``.

    Raises:
        UsageError: it is empty, too long, not UTF-8, has control characters, or cannot be looked at.
    """
    text = str(path)
    if not text:
        raise UsageError(f"{what} cannot be empty; name a path, or '.' for this folder.")
    try:
        encoded = text.encode()
    except UnicodeEncodeError:
        raise UsageError(f"{what} '{text}' is not UTF-8; give it another name.") from None
    if any(ord(c) < 32 or 127 <= ord(c) < 160 for c in text):
        raise UsageError(f"{what} '{text}' has control characters; give it another name.")
    if len(encoded) > _LONGEST_PATH or any(len(part) > _LONGEST_NAME for part in encoded.split(b"/")):
        raise UsageError(f"{what} '{text}' is too long; names may have {_LONGEST_NAME} bytes, paths {_LONGEST_PATH:,}.")
    try:
        Path(text).exists()
    except OSError as error:
        raise UsageError(f"{what} '{text}' cannot be looked at: {error.strerror}.") from None
    return Path(text)


def check_folder(path: str | Path, what: str, writable: bool = True) -> Path:
    """Refuse a folder that cannot be used before any work starts; it is not made yet.

    Args:
        path: as the user gave it.
        what: it is, such as ``"the output"``.
        writable: whether it must be possible to write into it.

    Raises:
        UsageError: it is a file, cannot be written, or is no path at all.
    """
    folder = check_path(path, what)
    nearest = folder
    while not nearest.exists() and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir():
        raise UsageError(f"{what} '{folder}' cannot be a folder: '{nearest}' is a file.")
    if writable and not os.access(nearest, os.W_OK):
        raise UsageError(f"{what} '{folder}' cannot be written.")
    return folder


def check_file(path: str | Path, what: str, writable: bool = True) -> Path:
    """Refuse a file that cannot be used before any work starts; it need not exist.

    Args:
        path: as the user gave it.
        what: it is, such as ``"the output"``.
        writable: whether it must be possible to write it.

    Raises:
        UsageError: it is a folder, cannot be written, or is no path at all.
    """
    file = check_path(path, what)
    if file.is_dir():
        raise UsageError(f"{what} '{file}' is a folder; name a file.")
    check_folder(file.parent, f"{what}'s folder", writable)
    return file


def check_regular(path: Path) -> None:
    """Refuse to read a pipe or a device that somebody put in a file's place: reading it might never end.

    Raises:
        OSError: it is one, or there is nothing.
    """
    mode = path.stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(path))


LeftOut = Callable[[OSError], None]


def walk(folder: Path, left_out: LeftOut | None = None, once: bool = True) -> Iterator[tuple[Path, list[str], list[str]]]:
    """As ``os.walk``, in sorted order, and through symbolic links: people keep what is large on another disk.

    Args:
        folder: where to begin; if there is none, nothing is found.
        left_out: told of each folder that cannot be read.
        once: a folder that several links lead to is entered through the first alone; otherwise through all but those that lead back to
            where one has come from.

    Yields:
        A folder, the names of the folders in it, from which whoever hears of them takes those that shall not be entered, and of the files.
    """
    if not folder.is_dir():
        return
    seen = {_identity(folder)}
    above = {str(folder): frozenset(seen)}
    for place, folders, names in os.walk(folder, onerror=left_out, followlinks=True):
        kept = []
        for name in sorted(folders):
            path = os.path.join(place, name)
            with suppress(OSError):
                one = _identity(path)
                if one not in (seen if once else above[place]):
                    seen.add(one)
                    above[path] = above[place] | {one}
                    kept.append(name)
        folders[:] = kept
        yield Path(place), folders, sorted(names)


def _identity(path: str | Path) -> tuple[int, int]:
    found = os.stat(path)
    return found.st_dev, found.st_ino


def read_limited(path: Path, most: int = MOST_TEXT) -> bytes:
    """What is in a file that may be anybody's; a few bytes of a sparse one can claim to be more than any memory has.

    Args:
        path: the file.
        most: bytes that a file of its kind has reason to have.

    Raises:
        OSError: it cannot be read, has more bytes, or is no file at all.
    """
    check_regular(path)
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        content = b"" if size > most else file.read(most + 1)
    if size > most or len(content) > most:
        raise OSError(errno.EFBIG, f"it has {size:,} bytes, where {most:,} are the most that such a file may have", str(path))
    return content


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


@contextmanager
def environment(name: str, value: str) -> Iterator[None]:
    """Within this context a variable of the environment has a value, for this process and those that it starts."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = before


@contextmanager
def replacing(path: Path, ending: str = "") -> Iterator[Path]:
    """A temporary neighbour of a file, which takes its place when this context ends, and is gone if it fails.

    What a process of this machine left that was killed while it did the same is removed.

    Args:
        path: the file; its folder is made.
        ending: of the neighbour's name, for a library that goes by it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    mine, its = f".{path.name}.{zlib.crc32(platform.node().encode()):08x}.", f".tmp{ending}"
    temporary = path.with_name(f"{mine}{os.getpid()}{its}")
    for other in os.listdir(path.parent):
        number = other.removeprefix(mine).removesuffix(its)
        if other == f"{mine}{number}{its}" and number.isdecimal() and not lives(int(number)):
            path.with_name(other).unlink(missing_ok=True)
    try:
        yield temporary
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file (text as UTF-8) through a temporary neighbour (:func:`replacing`), fsync and one rename."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())


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


def remove_empty_above(path: Path, top: Path) -> None:
    """Remove the folders above a path up to another one as far as there is nothing in them; other processes may be at work beside it."""
    for folder in path.parents:
        if not folder.is_relative_to(top):
            return
        with suppress(OSError):
            folder.rmdir()


def remove_empty(folder: Path) -> None:
    """Remove a folder and those below it as far as there is nothing in them."""
    for place, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):
            os.rmdir(place)


def bytes_below(folder: Path) -> int:
    """Bytes of the files below a folder; links are not followed, and what vanishes meanwhile has none."""
    found = 0
    for place, _, files in os.walk(folder):
        for name in files:
            with suppress(OSError):
                found += os.lstat(os.path.join(place, name)).st_size
    return found
