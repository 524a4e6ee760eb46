"""How numbers, counts and names are written and ordered, in words and in names of files."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Sequence

from cudc_bench.artefacts.ids import domain_slug

_NAME = re.compile(r"[a-z0-9_-]{1,200}")
_DOMAIN = re.compile(r"[A-Za-z0-9_.-]{1,200}")


def span(counts: Iterable[int], what: str) -> str:
    """Some numbers of things: ``"5 seeds"``, ``"1 to 3 seeds"``."""
    low, high = min(counts := list(counts)), max(counts)
    return f"{extent(low, high)} {what if high == 1 else f'{what}s'}"


def ordered(names: set[str], first: Sequence[str]) -> tuple[str, ...]:
    """Names in the order of ``first``, then those that are not in it by the alphabet."""
    return tuple(sorted(names, key=lambda name: (first.index(name) if name in first else len(first), name)))


def slug(group: str, algorithm: str, domain: str) -> str:
    """A safe and unique name for the files of a group on a domain; ``algorithm`` is a name without a dot."""
    # Neither group nor algorithm has a dot, so different triples cannot give one slug.
    return f"{group_slug(group, algorithm)}.{_slug(domain_slug(domain), _DOMAIN)}"


def group_slug(group: str, algorithm: str) -> str:
    """The same for the files of all of its domains; its one dot keeps it apart from any single domain's, whatever that is called."""
    return f"{_slug(group, _NAME)}.{algorithm}"


def file_slug(text: str) -> str:
    """A safe and unique part of file names, without a dot, for any text; a name of letters, digits, ``_`` and ``-`` is its own."""
    return _slug(text, _NAME)


def _slug(text: str, allowed: re.Pattern[str]) -> str:
    if allowed.fullmatch(text):
        return text
    # Different texts may look alike once their punctuation is gone; the digest keeps them apart.
    readable = re.sub(r"[^a-z0-9]+", "-", text.lower())[:60].strip("-")
    return f"{readable}-{hashlib.sha256(text.encode('utf-8', 'backslashreplace')).hexdigest()[:8]}"


def short(steps: float) -> str:
    """``20000`` -> ``"20K"``, ``1500000`` -> ``"1.5M"``."""
    for size, letter in ((1e6, "M"), (1e3, "K")):
        if steps >= size:
            return f"{steps / size:.6g}{letter}"
    return f"{steps:.6g}"


def extent(low: int, high: int) -> str:
    """Two numbers as one text: ``"5"``, ``"1 to 3"``."""
    return str(low) if low == high else f"{low} to {high}"
