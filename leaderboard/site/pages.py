"""The static site: pages over tables, comparisons, methods, datasets and runs, beside the files that are made of the same models.

:func:`site_files` is a function of its arguments alone. Pages need no server, ask nothing of the network and can be read without
JavaScript; their policy (``Content-Security-Policy``) allows neither scripts nor styles of anybody else's. Places in the output:

    index.html                              the overview, with the comparison that most people want
    <profile>.<algorithm>/index.html        a comparison of its own for each group and algorithm; they are never mixed
    <profile>.<algorithm>.<domain>/         index.html; task-<task>.html; runs-<task>.<method>.html, the runs behind each cell
    methods/, datasets/                     index.html and a page for each
    <id>.<id>.pair/                         index.html, beside what ``compare`` left there
    site/                                   style, script, and pictures of domains
"""

from __future__ import annotations

import posixpath
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

from markupsafe import Markup, escape

from cudc_bench.execution.parallel import computed
from cudc_bench.text import html_templates, plain

from ..methods import styles
from ..numbers.table import Table
from ..numbers.words import short
from .boards import Boards
from .catalogue import Catalogue
from .models import HtmlTable, Item, Page, Row
from .palette import palette_css
from .parts import ComparisonPage, Site, brief, clip_path, moving_path, picture_path, pictures_of
from .runs import Runs

ASSETS = ("site.css", "site.js")
_FEW = 12  # parts that one process makes sooner than two begin
_PORTION = 40  # pages that a process makes together
T = TypeVar("T")


def site_files(site: Site) -> dict[str, str | bytes]:
    """All files of the site by their path below the output folder."""
    here = Path(__file__).parent
    template = html_templates(here).get_template("page.html.j2")
    files: dict[str, str | bytes] = {f"site/{name}": (here / name).read_bytes() for name in ASSETS}
    files["site/site.css"] = (here / "site.css").read_text("utf-8") + palette_css()

    def rendered(pages: Callable[[], Iterable[Page]]) -> list[tuple[str, str]]:
        return [
            (page.path, template.render(page=page, to=_Links(page.path), style="site/site.css", script="site/site.js",
                                        identify=_Ids(), short=short, cells=_cells))
            for page in pages()
        ]  # fmt: skip

    for path in (one(name) for name in sorted(pictures_of(site)) for one in (picture_path, moving_path)):
        files[path] = (here / "pictures" / posixpath.basename(path)).read_bytes()
    for table in site.tables:
        for task in table.tasks:
            clip = site.clips.get((table.slug, task))
            if clip is not None and clip.shown is not None:
                files[clip_path(table, task, clip)] = clip.content
    parts = _Pages(site).parts()
    for path, text in chain.from_iterable(computed([partial(rendered, part) for part in parts], "making pages", "parts", _FEW)):
        if path in files:
            raise AssertionError(f"two pages want to be {path}")
        files[path] = text
    return files


def _cells(line: Row, grid: HtmlTable, draw: Callable[[Item], Markup]) -> Markup:
    """A row without its head; ``draw`` is the template's way to draw a cell. Most cells are texts, and there are a hundred thousand."""
    parts = []
    for column, item in zip(grid.columns, line.items, strict=True):
        number = ' class="number"' if column.number else ""
        value = f' data-value="{item.value}"' if item.value is not None else " data-missing" if item.missing else ""
        shown = escape(plain(item.text)) if item.simple and item.link is None else draw(item).strip()
        parts.append(f"<td{number}{value}>{shown}</td>")
    return Markup("".join(parts))


class _Pages(Boards, Runs, Catalogue):
    """Builds the pages of a site."""

    def parts(self) -> list[Callable[[], Iterable[Page]]]:
        """Functions that return all pages, those that take the longest first; none needs what another has done."""
        boards, site = self.site.boards, self.site
        tables = [(board, table) for board in boards for table in board.tables]
        found: list[Callable[[], Iterable[Page]]] = [partial(self._of_table, board, table) for board, table in tables]
        found += [partial(self._of_board, board) for board in boards]
        found += [partial(self._plain, self.study_pages, some) for some in _some(site.studies)]
        found += [partial(self._plain, partial(map, self.dataset), some) for some in _some(site.datasets)]
        found += [partial(self._plain, partial(map, self.method), some) for some in _some(site.methods)]
        found += [partial(self._plain, partial(map, self.pair), some) for some in _some(site.pairs)]
        return found

    def _of_table(self, board: ComparisonPage, table: Table) -> Iterable[Page]:
        self._styles = styles(table.methods)
        yield self.domain(board, table)
        for task in table.tasks:
            yield self.task(board, table, task)
        yield from self.runs_of(board, table)

    def _of_board(self, board: ComparisonPage) -> Iterable[Page]:
        """A comparison's page; the first is a part of the overview, too, which comes with lists of everything."""
        self.use_styles(board)
        shown = self.board(board)
        title = f"{board.algorithm}, profile {brief(board.group)}"
        yield Page(board.path, title, (("Overview", "index.html"),), self.summary(board), self.badges(board), shown)
        if board is self.site.boards[0]:
            yield self.overview(self.site.boards, shown)
        for table in board.hidden:
            yield from self.runs_of(board, table)
        if board is self.site.boards[0]:
            self._styles = {}
            yield self.methods_page()
            yield self.datasets_page()

    def _plain(self, pages: Callable[[Sequence[Any]], Iterable[Page]], of: Sequence[Any]) -> Iterable[Page]:
        """Pages without a comparison's colours: those beyond the paper's methods are its own."""
        self._styles = {}
        return pages(of)


def _some(many: Sequence[T]) -> list[Sequence[T]]:
    """Things in portions, which processes share."""
    return [many[first : first + _PORTION] for first in range(0, len(many), _PORTION)]


class _Links:
    """Makes paths from the site's root relative to a page; addresses elsewhere stay, which nothing but readers follows."""

    def __init__(self, page: str) -> None:
        self._folder = posixpath.dirname(page) or "."

    def __call__(self, path: str) -> str:
        if path.startswith("https://"):
            return path
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
