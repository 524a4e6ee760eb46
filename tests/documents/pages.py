"""What the documents contain: their pages, and the code and commands in them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import NamedTuple

from tests import ROOT

PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "benchmarks/README.md",
    *(p.relative_to(ROOT).as_posix() for p in sorted(ROOT.glob("docs/**/*.md"))),
]
# A block without a language is one of commands; what is drawn or listed is ``text``.
SHELL = ("", "bash")


class Block(NamedTuple):
    """A fenced block of a page.

    Attributes:
        page: its path from the repository's root.
        line: of its first line.
        language: as it is named.
        code: without the block's own indentation.
    """

    page: str
    line: int
    language: str
    code: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(page: str, *languages: str) -> list[Block]:
    """The blocks of a page in some languages, or all of them; MyST's directives are none."""
    found, lines = [], iter(enumerate((ROOT / page).read_text().split("\n"), 1))
    for number, line in lines:
        if opening := re.fullmatch(r"( *)(```+)([^`]*)", line):
            indent, fence, language = opening.groups()
            inside = []
            for _, one in lines:
                if one.strip() == fence:
                    break
                inside.append(one.removeprefix(indent))
            else:
                raise AssertionError(f"{page}:{number}: the block is never closed")
            if not language.startswith("{") and (not languages or language.strip() in languages):
                found.append(Block(page, number + 1, language.strip(), "".join(f"{one}\n" for one in inside)))
    return found


def block(page: str, contains: str) -> str:
    """The code of the one block of a page that contains a text."""
    (found,) = [one.code for one in blocks(page) if contains in one.code]
    return found


def commands(page: str) -> Iterator[tuple[int, list[str]]]:
    """The commands in a page's blocks, each with its line and its words; comments and line continuations are resolved.

    In blocks of ``text`` it is those that begin with ``cudc-bench``, up to an arrow.
    """
    for one in blocks(page):
        lines = iter(enumerate(one.code.split("\n"), one.line))
        for number, line in lines:
            if one.language == "text" and not line.startswith("cudc-bench "):
                continue
            if one.language not in ("text", *SHELL):
                break
            while line.endswith("\\"):
                line = line[:-1] + next(lines)[1]
            for words in _parts(line.split(" -> ")[0]):
                yield number, words


def _parts(line: str) -> Iterator[list[str]]:
    """The words of each command of a line: of several after each other, and of ours after the ``--`` of one that starts it."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=";&|")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ";"]:
        if not set(word) <= set(";&|") and not (word == "cudc-bench" and words[-1:] == ["--"]):
            words.append(word)
        elif words:
            yield words
            words = [] if set(word) <= set(";&|") else [word]


def spans(page: str) -> Iterator[list[str]]:
    """The words of each command of ours that stands between backticks in a page's text."""
    text = (ROOT / page).read_text()
    for one in blocks(page):
        text = text.replace(one.code, "")
    for found in re.findall(r"`(cudc-bench\s[^`]+)`", text):
        yield shlex.split(found)
