"""Files that are only made again where something changed, by as many processes as there are cores.

A leaderboard's files are made in parts: the files of a table, of a comparison, of a site. What a part holds follows from its inputs and
from this package's own source; a hash of both is the part's key. A ledger in the output folder says which key each part had and what was
written of it. A part with the same key whose files are all as they were written is left alone, so that what comes out is always what a
build into an empty folder gives. What the ledger says was written, and no part holds any more, is removed unless somebody changed it since.
"""

from __future__ import annotations

import errno
import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from cudc_bench.artefacts.provenance import source
from cudc_bench.execution.parallel import computed
from cudc_bench.files import read_limited, remove_empty_above, unwritable, write_atomically

from .files import write_files

LEDGER = ".ledger.json"
_KINDS = frozenset({".py", ".j2", ".csv", ".css", ".js", ".webp"})  # of this package's files that decide what is written
_MOST = 1 << 28  # bytes of a file that is written here; the ledger of ten thousand records has a tenth
_LIBRARIES = ("jinja2", "matplotlib", "numpy", "pandas", "scipy")
Contents = Mapping[str, str | bytes]


@dataclass(frozen=True)
class Target:
    """Files that are made together.

    Attributes:
        folder: where they go, below the output; ``""`` is the output itself.
        make: returns what is in each file, by its path below the folder; the same whenever the inputs are.
        inputs: all that ``make`` depends on, apart from this package's source.
        name: tells parts with one folder apart.
        asked: whether it is wanted; otherwise its files stay as long as they are what they would be now, and are not made again.
    """

    folder: str
    make: Callable[[], Contents]
    inputs: tuple[str, ...]
    name: str = ""
    asked: bool = True

    @property
    def place(self) -> str:
        """What stands for the part in a ledger: no folder's name begins like that of another's part."""
        return f"{self.folder}:{self.name}"

    @property
    def key(self) -> str:
        """Tells whether the part has to be made again."""
        return digest([_source(), self.place, *self.inputs])


def digest(texts: Iterable[str]) -> str:
    """A hash of some texts in their order."""
    found = hashlib.sha256()
    for text in texts:
        encoded = text.encode("utf-8", "backslashreplace")
        found.update(b"%d:" % len(encoded) + encoded)
    return found.hexdigest()


def build(
    output: Path, parts: Sequence[Target], whole: bool = True, last: Callable[[Mapping[str, Sequence[str]]], Target] | None = None
) -> list[Path]:
    """Bring the files of an output folder up to date.

    Args:
        output: the folder, which is made.
        parts: all that belongs into it; no two may have a file in common.
        whole: whether these are all parts; otherwise those that were built before stay.
        last: makes a further part from the names of the files that lie in each folder then.

    Returns:
        The files of these parts.

    Raises:
        RunError: a file could not be read or written.
    """
    ledger = _read(output)
    try:
        parts = [part for part in parts if part.asked or _is_current(output, part, part.key, ledger)]
        made = _bring(output, parts, ledger)
        if last is not None:
            there: dict[str, list[str]] = defaultdict(list)
            for entry in made.values():
                there[entry["folder"]] += entry["files"]
            final = last({folder: sorted(there[folder]) for folder in sorted(there)})
            parts = [*parts, final]
            made |= _bring(output, [final], ledger)
        entries = made if whole else ledger | made
        _remove(output, ledger, entries)
        if entries != ledger:
            write_atomically(output / LEDGER, json.dumps(entries, indent=1, sort_keys=True) + "\n")
    except OSError as error:
        raise unwritable(error.filename or output, error) from None
    return [output / part.folder / name for part in parts for name in entries[part.place]["files"]]


def holds(output: Path, folder: str, name: str) -> bool:
    """Whether an earlier build left a part there."""
    return f"{folder}:{name}" in _read(output)


def _bring(output: Path, parts: Sequence[Target], ledger: Mapping[str, Any]) -> dict[str, Any]:
    """Make the files of those parts that are not as they should be; the ledger's entries of all of them."""
    keys = {part.place: part.key for part in parts}
    stale = [part for part in parts if not _is_current(output, part, keys[part.place], ledger)]
    entries = {part.place: ledger[part.place] for part in parts if part not in stale}
    for part, contents in zip(stale, computed([part.make for part in stale], "making files", "parts"), strict=True):
        sums = {name: _hash(content) for name, content in contents.items()}
        write_files(output / part.folder, contents)
        entries[part.place] = {"key": keys[part.place], "folder": part.folder, "files": sums}
    return entries


@cache
def _source() -> str:
    """A hash of all that decides what files look like but is no input: this package, and the libraries that it draws with."""
    versions = []
    for library in _LIBRARIES:
        with suppress(PackageNotFoundError):
            versions.append(f"{library} {version(library)}")
    return digest([*versions, source(_KINDS)])


def _hash(content: str | bytes) -> str:
    return hashlib.sha256(content.encode() if isinstance(content, str) else content).hexdigest()


def _sum(path: Path) -> str | None:
    try:
        return _hash(read_limited(path, _MOST))
    except OSError as error:
        if error.errno not in (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EFBIG, errno.EINVAL):
            raise
        return None  # nothing, or not what was written here


def _is_current(output: Path, part: Target, key: str, ledger: Mapping[str, Any]) -> bool:
    entry = ledger.get(part.place)
    if entry is None or (entry["key"], entry["folder"]) != (key, part.folder):
        return False
    return all(_sum(output / part.folder / name) == sum for name, sum in entry["files"].items())


def _remove(output: Path, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Remove what was written once, belongs to no part any more, and is as it was written."""
    kept = {output / entry["folder"] / name for entry in after.values() for name in entry["files"]}
    for entry in before.values():
        for name, sum in entry["files"].items():
            path = output / entry["folder"] / name
            if path not in kept and _sum(path) == sum:
                path.unlink()
                remove_empty_above(path, output)


def _read(output: Path) -> dict[str, Any]:
    """The ledger; empty where there is none, or none that could have been written here."""
    try:
        found = json.loads(read_limited(output / LEDGER, _MOST))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) and all(map(_is_entry, found.values())) else {}


def _is_entry(entry: Any) -> bool:
    if not (isinstance(entry, dict) and entry.keys() == {"key", "folder", "files"} and isinstance(entry["files"], dict)):
        return False
    if not isinstance(entry["folder"], str):
        return False
    # Files are removed by what stands here, which may have come from anywhere.
    paths = [PurePosixPath(entry["folder"]), *map(PurePosixPath, entry["files"])]
    return not any(path.is_absolute() or ".." in path.parts for path in paths) and "" not in entry["files"]
