"""What every stage function of this folder does with its input and its files."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cudc_bench.files import unwritable, write_atomically

_WRITERS = 8


def _holds(path: Path, content: str | bytes) -> bool:
    expected = content.encode() if isinstance(content, str) else content
    try:
        return path.stat().st_size == len(expected) and path.read_bytes() == expected
    except OSError:
        return False


def write_files(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into a folder, which is made; each is replaced whole, unless it is already the same. Returns their paths.

    Raises:
        RunError: one could not be written.
    """
    changed = [(folder / name, content) for name, content in contents.items() if not _holds(folder / name, content)]
    try:
        # Each waits for the disk, which takes the waits of many together.
        with ThreadPoolExecutor(_WRITERS) as writers:
            deque(writers.map(lambda one: write_atomically(*one), changed), 0)
    except OSError as error:
        raise unwritable(error.filename or folder, error) from None
    return [folder / name for name in contents]
