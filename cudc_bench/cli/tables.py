"""Tables that fit a terminal: nothing wraps within a number or a name, and no two names look the same.

What is too wide is, in this order: broken between words, where a column holds prose; shortened in the middle, where names are long, with a
legend below; and folded, columns below one another. Nothing in a dataset or a record is taken for markup.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from cudc_bench.text import short_names, visible, width_of

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult
    from rich.text import Text

GAP = 2  # between columns
LEAST_PROSE = 24  # letters that a column of prose keeps
SHORT = 14  # letters of a shortened name, at least
_INDENT = "  "  # of what stands below a name


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        name: its head; a name of several lines is a head of several lines.
        right: whether its cells are aligned to the right, as numbers are.
        prose: whether its cells may be broken between words.
        named: whether its head is a name that may be shortened, as that of a method is.
        least: letters of its width, at least.
    """

    name: str
    right: bool = False
    prose: bool = False
    named: bool = False
    least: int = 0


@dataclass(frozen=True)
class Cell:
    """What stands in a row below a column: one line or several, in a style of ``rich``."""

    text: str
    style: str = ""

    @property
    def lines(self) -> list[str]:
        """Without what could drive a terminal."""
        return [visible(line) for line in self.text.split("\n")]

    @property
    def width(self) -> int:
        """Of its longest line, as a terminal counts."""
        return max(map(width_of, self.lines))


@dataclass(frozen=True)
class Row:
    """A line of a table: the cells of its columns. One without cells is a heading."""

    cells: tuple[Cell, ...] = ()
    heading: str = ""


@dataclass(frozen=True)
class Table:
    """A table that any console shows in its own width.

    Attributes:
        columns: the first ``keys`` of them hold names, which are repeated wherever the others are folded.
        rows: each with a cell for each column, or a heading over those that follow.
        title: above it; empty for none.
        caption: below it; empty for none.
        stacked: if it is too wide, a row's name stands on a line of its own and all else below it, rather than columns below one another.
        shortens: whether the names in its first column may be shortened; ids that people copy may not.
        keys: how many columns say what a row is of.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...] = field(repr=False)
    title: str = ""
    caption: str = ""
    stacked: bool = False
    shortens: bool = True
    keys: int = 1

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich.text import Text

        if self.title:
            yield Text(visible(self.title), style="bold")
        yield from _laid_out(self, options.max_width)
        if self.caption:
            yield Text(visible(self.caption), style="dim")


def row(*texts: str) -> Row:
    """A row of plain cells."""
    return Row(tuple(map(Cell, texts)))


def _laid_out(table: Table, width: int) -> Iterator[Text]:
    if _width(table) <= width:
        yield from _drawn(table, _widths(table))
        return
    table = _broken(table, width)
    if _width(table) > width:
        table, legend = _shortened(table, width)
        table = _broken(table, width)
    else:
        legend = {}
    if _width(table) <= width:
        yield from _drawn(table, _widths(table))
    elif table.stacked:
        yield from _drawn_stacked(table, width)
    else:
        yield from _folded(table, width)
    if legend:
        from rich.text import Text

        for short, name in legend.items():
            yield Text(f"{short}: {name}", style="dim", overflow="fold")


def _widths(table: Table) -> list[int]:
    widths = []
    for index, column in enumerate(table.columns):
        cells = [one.cells[index].width for one in table.rows if one.cells]
        widths.append(max([column.least, Cell(column.name).width, *cells]))
    return widths


def _width(table: Table) -> int:
    widths = _widths(table)
    return sum(widths) + GAP * (len(widths) - 1)


def _broken(table: Table, width: int) -> Table:
    """With its columns of prose as narrow as they must be, and may be."""
    prose = [index for index, column in enumerate(table.columns) if column.prose]
    if not prose:
        return table
    widths = _widths(table)
    fixed = sum(size for index, size in enumerate(widths) if index not in prose) + GAP * (len(widths) - 1)
    left = width - fixed
    room = {}
    # The narrowest first: what it does not need is the others'.
    for place, index in enumerate(sorted(prose, key=lambda index: widths[index])):
        room[index] = max(LEAST_PROSE, min(widths[index], left // (len(prose) - place)))
        left -= min(widths[index], room[index])

    def broken(one: Row) -> Row:
        cells = [replace(cell, text=_wrapped(cell, room[index])) if index in room else cell for index, cell in enumerate(one.cells)]
        return replace(one, cells=tuple(cells))

    return replace(table, rows=tuple(map(broken, table.rows)))


def _wrapped(cell: Cell, width: int) -> str:
    return "\n".join("\n".join(textwrap.wrap(line, width, break_on_hyphens=False)) for line in cell.lines)


def _shortened(table: Table, width: int) -> tuple[Table, dict[str, str]]:
    """With short names, and the long ones by the short ones."""
    most = max(SHORT, width // 5)
    heads = [column.name for column in table.columns if column.named]
    firsts = [one.cells[0].text for one in table.rows if one.cells] if table.shortens else []
    short = short_names([*heads, *firsts], most)
    rows = table.rows
    if table.shortens:
        rows = tuple(replace(one, cells=(replace(one.cells[0], text=short[one.cells[0].text]), *one.cells[1:])) if one.cells else one
                     for one in rows)  # fmt: skip
    columns = tuple(replace(column, name=short[column.name]) if column.named else column for column in table.columns)
    return replace(table, columns=columns, rows=rows), {one: visible(name) for name, one in short.items() if one != name}


def _folded(table: Table, width: int) -> Iterator[Text]:
    """As many columns as there is room for, then the names again with the next ones."""
    from rich.text import Text

    widths, keys = _widths(table), table.keys
    first = sum(widths[:keys]) + GAP * (keys - 1)
    if first + GAP + max(widths[keys:], default=0) > width:
        yield from _drawn_stacked(table, width)
        return
    index = keys
    while index < len(widths):
        end, used = index, first
        while end < len(widths) and used + GAP + widths[end] <= width:
            used += GAP + widths[end]
            end += 1
        if index > keys:
            yield Text("")
        rows = tuple(replace(one, cells=(*one.cells[:keys], *one.cells[index:end])) if one.cells else one for one in table.rows)
        part = replace(table, columns=(*table.columns[:keys], *table.columns[index:end]), rows=rows)
        yield from _drawn(part, [*widths[:keys], *widths[index:end]])
        index = end


def _drawn(table: Table, widths: Sequence[int]) -> Iterator[Text]:
    if any(column.name for column in table.columns):
        yield from _lines([Cell(column.name, "bold") for column in table.columns], table.columns, widths)
        yield _rule(widths)
    for index, one in enumerate(table.rows):
        if one.cells:
            yield from _lines(one.cells, table.columns, widths)
        else:
            yield from _heading(one, widths, first=index == 0)


def _drawn_stacked(table: Table, width: int) -> Iterator[Text]:
    """The name of a row, and below it what its columns say, with their heads where they have room for each."""
    from rich.text import Text

    for index, one in enumerate(table.rows):
        if not one.cells:
            yield from _heading(one, [width], first=index == 0)
            continue
        yield Text(" ".join(one.cells[0].lines), style="bold", overflow="fold")
        facts = [
            f"{' '.join(Cell(column.name).lines)} {' '.join(cell.lines)}".strip()
            for column, cell in zip(table.columns[1:], one.cells[1:], strict=True)
            if cell.text
        ]
        line = ""
        for fact in facts:
            if line and width_of(f"{_INDENT}{line}, {fact},") > width:
                yield Text(f"{_INDENT}{line},", overflow="fold")
                line = ""
            line = f"{line}, {fact}" if line else fact
        if line:
            yield Text("\n".join(textwrap.wrap(line, width, initial_indent=_INDENT, subsequent_indent=_INDENT * 2, break_on_hyphens=False)))


def _heading(one: Row, widths: Sequence[int], first: bool) -> Iterator[Text]:
    from rich.text import Text

    if not first:
        yield _rule(widths)
    if one.heading:
        yield Text(visible(one.heading), style="bold")


def _rule(widths: Sequence[int]) -> Text:
    from rich.text import Text

    return Text("─" * (sum(widths) + GAP * (len(widths) - 1)), style="dim")


def _lines(cells: Sequence[Cell], columns: Sequence[Column], widths: Sequence[int]) -> Iterator[Text]:
    """The lines of a row."""
    from rich.text import Text

    lines = [cell.lines for cell in cells]
    for number in range(max(map(len, lines))):
        line = Text(no_wrap=True, overflow="fold")
        for index, (cell, own) in enumerate(zip(cells, lines, strict=True)):
            text = own[number] if number < len(own) else ""
            room = " " * (widths[index] - width_of(text))
            gap = " " * GAP if index else ""
            line.append(gap + (room if columns[index].right else ""))
            line.append(text, style=cell.style)
            line.append("" if columns[index].right else room)
        line.rstrip()
        yield line
