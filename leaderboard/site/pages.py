"""The static site: pages over tables, comparisons, methods, datasets and runs, beside the files that are made of the same models.

:func:`site_files` is a function of its arguments alone. Pages need no server, ask nothing of the network and can be read without
JavaScript; their policy (``Content-Security-Policy``) allows neither scripts nor styles of anybody else's. Places in the output:

    index.html                              the overview, with the comparison that most people want
    <profile>.<algorithm>/index.html        a comparison of its own for each group and algorithm; they are never mixed
    <profile>.<algorithm>.<domain>/         index.html; task-<task>.html; runs-<task>.<method>.html, the runs behind each cell
    methods/, datasets/                     index.html and a page for each
    site/                                   style and script
"""

from __future__ import annotations

import posixpath
import re
from collections import Counter
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from cudc_bench.text import html_templates

from ..methods import styles
from ..numbers.words import short
from .boards import Boards
from .catalogue import Catalogue
from .models import Page
from .palette import palette_css
from .parts import Site, brief
from .runs import Runs

ASSETS = ("site.css", "site.js")


def site_files(site: Site) -> dict[str, str | bytes]:
    """All files of the site by their path below the output folder."""
    here = Path(__file__).parent
    template = html_templates(here).get_template("page.html.j2")
    files: dict[str, str | bytes] = {f"site/{name}": (here / name).read_bytes() for name in ASSETS}
    files["site/site.css"] = (here / "site.css").read_text("utf-8") + palette_css()
    for page in _Pages(site).every():
        if page.path in files:
            raise AssertionError(f"two pages want to be {page.path}")
        files[page.path] = template.render(page=page, to=_Links(page.path), style="site/site.css", script="site/site.js",
                                            identify=_Ids(), short=short)  # fmt: skip
    return files


class _Pages(Boards, Runs, Catalogue):
    """Builds the pages of a site."""

    def every(self) -> Iterable[Page]:
        """All pages."""
        boards = self.site.boards
        yield self.overview(boards)
        for board in boards:
            crumbs = (("Overview", "index.html"),)
            self.use_styles(board)
            title = f"{board.algorithm}, profile {brief(board.group)}"
            yield Page(board.path, title, crumbs, self.summary(board), self.badges(board), self.board(board))
            for table in board.tables:
                self._styles = styles(table.methods)
                yield self.domain(board, table)
                for task in table.tasks:
                    yield self.task(board, table, task)
                yield from self.runs_of(board, table)
            for table in board.hidden:
                yield from self.runs_of(board, table)
        self._styles = {}  # Colours beyond the paper's methods are those of one comparison.
        yield from self.study_pages()
        yield self.methods_page()
        yield from map(self.method, self.site.methods)
        yield self.datasets_page()
        yield from map(self.dataset, self.site.datasets)


class _Links:
    """Makes paths from the site's root relative to a page."""

    def __init__(self, page: str) -> None:
        self._folder = posixpath.dirname(page) or "."

    def __call__(self, path: str) -> str:
        target, mark, fragment = path.partition("#")
        return f"{_relative(target, self._folder) if target else ''}{mark}{fragment}"


@lru_cache(maxsize=65536)
def _relative(target: str, folder: str) -> str:
    return posixpath.relpath(target, folder)


class _Ids:
    """Ids that are unique on a page, made from titles."""

    def __init__(self) -> None:
        self._seen = Counter(["main", "theme", "switches", "filter", "found", "said"])  # those of the template

    def __call__(self, text: str) -> str:
        slug = re.sub(r"[^a-z0-9]+", "-", text.lower())[:60].strip("-") or "part"
        if not slug[0].isalpha():
            slug = f"p-{slug}"
        self._seen[slug] += 1
        # No slug has a full stop.
        return slug if self._seen[slug] == 1 else f"{slug}.{self._seen[slug]}"
