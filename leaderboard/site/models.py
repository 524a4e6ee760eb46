"""What the pages of the static site show, before it is HTML: grids, figures, pictures, downloads, and what has these under one title.

A :class:`Section` is the one way onto a page. Links are paths from the site's root, pages make them relative. All text is plain and is
escaped when it is drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from .palette import colour_class

MISSING = "–"


@dataclass(frozen=True)
class Item:
    """One cell of a grid.

    Attributes:
        text: what it shows.
        value: what it sorts by if that is a number; None sorts by ``text``, and a missing cell last.
        link: where it leads to.
        best: whether it is marked as best.
        scaled: the same divided by the largest possible, which the reader can have shown instead.
        note: less important words behind it.
        beside: the paper's number and our difference from it; ``beside_scaled`` the same divided.
        picture: a small drawing, as inline SVG without styles.
    """

    text: str = MISSING
    value: float | None = None
    link: str | None = None
    best: bool = False
    scaled: str | None = None
    note: str = ""
    beside: str | None = None
    beside_scaled: str | None = None
    picture: Markup | None = None

    @property
    def simple(self) -> bool:
        """Whether it is a text, or a text that leads somewhere, and nothing else; most are."""
        return not self.best and self.scaled is None and not self.note and self.beside is None and self.picture is None

    @property
    def missing(self) -> bool:
        """Whether there is nothing to sort by."""
        return self.text == MISSING and self.value is None and self.picture is None


@dataclass(frozen=True)
class Heading:
    """The head of a column; ``number`` says that its cells are numbers, ``sorts`` that rows can be sorted by it."""

    text: str
    link: str | None = None
    number: bool = True
    sorts: bool = True


@dataclass(frozen=True)
class Row:
    """A row of a grid: its head, which filters look at, and its cells."""

    head: Item
    items: tuple[Item, ...]


@dataclass(frozen=True)
class HtmlTable:
    """A table of a page: of a :class:`~..numbers.grid.Grid`'s numbers, or of texts, links and small pictures, which no other output has.

    Attributes:
        caption: what it is.
        first: head of the column of row heads.
        columns: heads of the others.
        lines: its rows.
        groups: a row above the heads: texts, how many columns each spans, and where it leads to.
        milestone: the gradient steps that it belongs to, for the switch between milestones.
        filters: what its rows are, such as ``"methods"``, if readers may filter them.
        foot: rows below that keep their place whatever the others are sorted by.
        notes: what its marks mean.
        sorted_by: the place among the columns of that by which its rows are sorted, the largest first.
    """

    caption: str
    first: str
    columns: tuple[Heading, ...]
    lines: tuple[Row, ...]
    groups: tuple[tuple[str, int, str | None], ...] = ()
    milestone: int | None = None
    filters: str = ""
    foot: tuple[Row, ...] = ()
    notes: tuple[str, ...] = ()
    sorted_by: int | None = None

    @property
    def items(self) -> list[Item]:
        """All cells."""
        return [item for line in (*self.lines, *self.foot) for item in line.items]


@dataclass(frozen=True)
class Figure:
    """Panels that are drawn in the page, as inline SVG without styles.

    Attributes:
        panels: beside or below one another.
        alt: the words for those who do not see them.
        caption: what they show.
        legend: what the lines are; empty where each has its name.
        milestone: the gradient steps that it belongs to, for the switch between milestones.
    """

    panels: tuple[Markup, ...]
    alt: str
    caption: str = ""
    legend: tuple[Item, ...] = ()
    milestone: int | None = None


@dataclass(frozen=True)
class Picture:
    """An image below the site's root, or a video, the words for those who do not see it, and a caption.

    ``still`` is what those see instead who want nothing on a page to move.
    """

    path: str
    alt: str
    caption: str = ""
    still: str = ""

    @property
    def moves(self) -> bool:
        """Whether it is a video."""
        return self.path.endswith(".mp4")


@dataclass(frozen=True)
class Section:
    """Something to show under a title of its own.

    Attributes:
        title: the heading.
        grids: tables; several if they are of different milestones.
        verdict: sentences above everything else, for each milestone that they belong to.
        figures: drawings; ``pictures``: images and videos.
        downloads: names and paths of files.
        lead: a paragraph above; ``text``: paragraphs below, less important.
        prose: paragraphs of a docstring, whose indented ones are formulas and whose double backticks mean code.
        facts: names and values; a value is a cell, which may lead somewhere.
        lines: a list.
        code: labels and texts to copy, such as commands; a label may be empty.
        parts: what it consists of, a level of headings further down.
        id: the fragment that leads to it; made from the title unless given.
        folded: whether it is closed until somebody opens it.
        milestone: the gradient steps that it belongs to, for the switch between milestones.
    """

    title: str
    grids: tuple[HtmlTable, ...] = ()
    figures: tuple[Figure, ...] = ()
    pictures: tuple[Picture, ...] = ()
    verdict: tuple[tuple[int | None, tuple[str, ...]], ...] = ()
    downloads: tuple[tuple[str, str], ...] = ()
    lead: str = ""
    text: tuple[str, ...] = ()
    prose: tuple[str, ...] = ()
    facts: tuple[tuple[str, Item], ...] = ()
    lines: tuple[Item, ...] = ()
    code: tuple[tuple[str, str], ...] = ()
    parts: tuple[Section, ...] = ()
    id: str = ""
    folded: bool = False
    milestone: int | None = None

    @property
    def every_grid(self) -> list[HtmlTable]:
        """Its tables and those of its parts."""
        return [*self.grids, *(grid for part in self.parts for grid in part.every_grid)]

    @property
    def every_figure(self) -> list[Figure]:
        """Its drawings and those of its parts."""
        return [*self.figures, *(figure for part in self.parts for figure in part.every_figure)]


@dataclass(frozen=True)
class Page:
    """A page of the site.

    Attributes:
        path: from the site's root.
        title: its heading.
        crumbs: names and paths of the pages above it.
        lead: paragraphs below the heading.
        badges: short warnings, such as "preliminary".
        exhibits: what it shows.
    """

    path: str
    title: str
    crumbs: tuple[tuple[str, str], ...] = ()
    lead: tuple[str, ...] = ()
    badges: tuple[str, ...] = ()
    sections: tuple[Section, ...] = ()

    @property
    def figures(self) -> list[Figure]:
        """All of its drawings."""
        return [figure for section in self.sections for figure in section.every_figure]

    @property
    def grids(self) -> list[HtmlTable]:
        """All of its tables."""
        return [grid for section in self.sections for grid in section.every_grid]

    @property
    def milestones(self) -> list[int]:
        """Of its tables, the last first."""
        shown: list[HtmlTable | Figure] = [*self.grids, *self.figures]
        return sorted({one.milestone for one in shown if one.milestone is not None}, reverse=True)

    @property
    def filters(self) -> str:
        """What its rows are that readers may filter."""
        return next((grid.filters for grid in self.grids if grid.filters), "")

    @property
    def has_scaled(self) -> bool:
        """Whether it has numbers that can be shown divided by the largest possible."""
        return any(item.scaled is not None for grid in self.grids for item in grid.items)

    @property
    def has_beside(self) -> bool:
        """Whether it has the paper's numbers beside ours."""
        return any(item.beside is not None for grid in self.grids for item in grid.items)


def bar(low: float, value: float, high: float, largest: float, colour: str) -> Markup:
    """A number in [0, largest] with its interval, as inline SVG."""
    x, a, b = (4 + 112 * min(max(one / largest, 0.0), 1.0) for one in (value, low, high))
    return Markup(
        '<svg class="strip" width="120" height="16" viewBox="0 0 120 16" aria-hidden="true">'
        '<rect class="panel" width="120" height="16" rx="3"/><path class="axis" d="M4 8H116"/>'
        '<g class="{c}"><path d="M{a:.1f} 8H{b:.1f}" stroke="currentColor" stroke-width="5" stroke-opacity="0.55"/>'
        '<circle cx="{x:.1f}" cy="8" r="3.5" fill="currentColor"/></g></svg>'
    ).format(a=a, b=b, x=x, c=colour_class(colour))


def dots(values: Sequence[float], mean: float, largest: float, colour: str) -> Markup:
    """The scores of single seeds in [0, largest] and their mean, as inline SVG."""

    def place(value: float) -> float:
        return 4 + 112 * min(max(value / largest, 0.0), 1.0)

    marks = Markup().join(
        Markup('<circle cx="{x:.1f}" cy="8" r="2.6" fill="currentColor" fill-opacity="0.7"/>').format(x=place(one)) for one in values
    )
    return Markup(
        '<svg class="strip" width="120" height="16" viewBox="0 0 120 16" aria-hidden="true">'
        '<rect class="panel" width="120" height="16" rx="3"/><path class="axis" d="M4 8H116"/><g class="{c}">{marks}'
        '<path d="M{x:.1f} 2V14" stroke="currentColor" stroke-width="2"/></g></svg>'
    ).format(marks=marks, x=place(mean), c=colour_class(colour))


def swatch(colour: str, dashes: str) -> Markup:
    """A line as figures draw a method's, as inline SVG; ``dashes`` as SVG's ``stroke-dasharray``."""
    return Markup(
        '<svg class="swatch {c}" width="22" height="10" viewBox="0 0 22 10" aria-hidden="true">'
        '<path d="M1 5H21" stroke="currentColor" stroke-width="2.5"{d}/></svg>'
    ).format(c=colour_class(colour), d=Markup(' stroke-dasharray="{}"').format(dashes) if dashes else "")
