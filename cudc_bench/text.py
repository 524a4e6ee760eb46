"""Text for terminals, Markdown and templates: nothing that comes from a dataset, a record or a user is taken for markup."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment

_HEAD, _TAIL = 1500, 500  # characters of a message that are shown, where it has more


def plain(text: str) -> str:
    """One line without control characters, which could drive a terminal or break a file's syntax."""
    # Most texts are; looking at each character of all texts of a leaderboard takes seconds.
    shown = text if text.isprintable() else "".join(c if c.isprintable() else " " for c in text)
    return " ".join(shown.split())


def visible(text: str) -> str:
    """One line for a terminal, in which a character that could drive it or turn text around is shown by its number: ``\\x1b``."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))


def shortened(text: str) -> str:
    """A text without its middle, where that is so long that it would bury the rest; a value that was given can have megabytes."""
    return text if len(text) <= _HEAD + _TAIL else f"{text[:_HEAD]} … {text[-_TAIL:]}"


def width_of(text: str) -> int:
    """How many columns of a terminal a line takes."""
    from rich.cells import cell_len

    return cell_len(text)


def short_names(names: Sequence[str], most: int) -> dict[str, str]:
    """Names of at most so many letters, the longer ones without their middle; no two are the same.

    Args:
        names: of any length.
        most: letters of each, at least 5; more where names would else look the same.

    Returns:
        What stands for each name.
    """
    found: dict[str, str] = {}
    for name in dict.fromkeys(names):
        taken = {*found.values(), *(other for other in names if other != name)}
        found[name] = name if width_of(name) <= most else next(one for one in _shorter(name, most) if one not in taken)
    return found


def _shorter(name: str, most: int) -> Iterator[str]:
    """Ways to leave out the middle of a name, the nicest first."""
    for size in range(most - 1, len(name)):
        middle = (size + 1) // 2
        for head in sorted(range(1, size), key=lambda head: abs(head - middle)):
            yield f"{name[:head]}…{name[len(name) - (size - head) :]}"
    yield name


def size(count: float) -> str:
    """Bytes for people."""
    for unit, large in (("GB", 1e9), ("MB", 1e6)):
        if count >= large:
            return f"{count / large:,.1f} {unit}"
    return f"{count / 1e3:,.0f} kB"


def escape_markdown(text: str) -> str:
    """Text that Markdown shows as it is, inside table cells too."""
    return re.sub(r"([\\`*_{}\[\]<>&#|~$!@])", r"\\\1", plain(text))


@cache
def templates(folder: Path, escape: Callable[[str], str]) -> Environment:
    """Templates whose every value is escaped unless it passes the ``safe`` filter; braces mean nothing, for LaTeX's sake.

    Args:
        folder: where they are.
        escape: makes text safe for the language that they are written in.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def finish(value: Any) -> Any:
        return value if isinstance(value, Markup) else escape(str(value))

    return Environment(
        loader=FileSystemLoader(folder), undefined=StrictUndefined, finalize=finish,
        variable_start_string="<<", variable_end_string=">>", block_start_string="<%", block_end_string="%>",
        comment_start_string="<#", comment_end_string="#>", trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip


@cache
def html_templates(folder: Path) -> Environment:
    """Templates of HTML pages: every value is one line without control characters, and escaped unless it is ``Markup``.

    Args:
        folder: where they are.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def finish(value: Any) -> Any:
        return value if isinstance(value, Markup) else plain(str(value))

    return Environment(
        loader=FileSystemLoader(folder), undefined=StrictUndefined, finalize=finish, autoescape=True, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
