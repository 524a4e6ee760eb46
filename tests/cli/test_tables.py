"""Tables fit whatever terminal they are shown in, with every number whole and every name its own."""

from __future__ import annotations

import re
from io import StringIO

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from cudc_bench.cli.tables import SHORT, Cell, Column, Row, Table, row
from cudc_bench.text import short_names, width_of


def shown(table: Table, width: int) -> str:
    console = Console(file=StringIO(), width=width, highlight=False)
    console.print(table)
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


some_names = st.lists(st.text(st.sampled_from("abc-"), min_size=1, max_size=40), min_size=1, max_size=12, unique=True)


@given(some_names, st.integers(5, 40))
def test_short_names_are_short_and_different(given_names: list[str], most: int) -> None:
    short = short_names(given_names, most)
    assert list(short) == given_names
    assert len(set(short.values())) == len(given_names)
    for name, one in short.items():
        assert one == name or (len(one) < len(name) and "…" in one)
        head, _, tail = one.partition("…")
        assert name.startswith(head)
        assert name.endswith(tail)
    if len(given_names) == 1:
        assert len(short[given_names[0]]) <= most


@settings(max_examples=30)
@given(some_names, st.integers(1, 9), st.integers(40, 120), st.booleans())
def test_no_line_is_too_long_and_no_number_is_cut(rows: list[str], count: int, width: int, stacked: bool) -> None:
    heads = [f"a-long-name-of-method-{index}" for index in range(count)]
    cells = {(name, head): f"{len(name)}{index}.25±0.5 ({index})" for name in rows for index, head in enumerate(heads)}
    columns = (Column(""), *(Column(head, right=True, named=True) for head in heads))
    text = shown(Table(columns, tuple(row(name, *(cells[name, head] for head in heads)) for name in rows), "title", stacked=stacked), width)
    assert all(width_of(line) <= width for line in text.splitlines())
    for one in cells.values():
        assert len(re.findall(rf"(?<![\d.]){re.escape(one)}", text)) >= list(cells.values()).count(one)


def table() -> Table:
    names = ("cudc-vary-icm-longer", "cudc-vary-apt-longer", "icm")
    columns = (Column(""), *(Column(name, right=True, named=True) for name in names))
    best = Row((Cell("run"), Cell("1"), Cell("–"), Cell("2", "bold")))
    rows = (Row(heading="500K steps"), row("walk", "812±11 (5)", "799±31 (5)", "640±9 (5)"), best)
    return Table(columns, rows, "a title", "a caption")


def test_a_table_that_fits_is_shown_as_it_is() -> None:
    assert shown(table(), 60).splitlines() == [
        "a title",
        "      cudc-vary-icm-longer  cudc-vary-apt-longer        icm",
        "───────────────────────────────────────────────────────────",
        "500K steps",
        "walk            812±11 (5)            799±31 (5)  640±9 (5)",
        "run                      1                     –          2",
        "a caption",
    ]


def test_one_that_does_not_has_short_names_and_a_legend() -> None:
    assert shown(table(), 50).splitlines() == [
        "a title",
        "      cudc-va…longer  cudc-v…-longer        icm",
        "───────────────────────────────────────────────",
        "500K steps",
        "walk      812±11 (5)      799±31 (5)  640±9 (5)",
        "run                1               –          2",
        "cudc-va…longer: cudc-vary-icm-longer",
        "cudc-v…-longer: cudc-vary-apt-longer",
        "a caption",
    ]


def test_one_that_still_does_not_is_folded() -> None:
    assert shown(table(), 40).splitlines()[1:11] == [
        "      cudc-va…longer  cudc-v…-longer",
        "────────────────────────────────────",
        "500K steps",
        "walk      812±11 (5)      799±31 (5)",
        "run                1               –",
        "",
        "            icm",
        "───────────────",
        "500K steps",
        "walk  640±9 (5)",
    ]


def test_ids_stay_whole_with_what_is_known_below() -> None:
    columns = (Column("id"), Column("method"), Column("steps", right=True))
    one = Table(columns, (row("walker/walk/cudc-kmax7-seed2-v0", "cudc-kmax7", "1,000,000"),), stacked=True, shortens=False)
    assert shown(one, 40).splitlines() == ["walker/walk/cudc-kmax7-seed2-v0", "  method cudc-kmax7, steps 1,000,000"]


def test_prose_is_broken_between_words() -> None:
    one = Table(
        (Column("name"), Column("what", prose=True)), (row("a-name", "some words that stand in several lines of a narrow terminal"),)
    )
    assert shown(one, 40).splitlines()[2:] == ["a-name  some words that stand in several", "        lines of a narrow terminal"]


@pytest.mark.parametrize("width", [30, 60, 200])
def test_nothing_in_a_cell_drives_a_terminal(width: int) -> None:
    text = shown(Table((Column("id"), Column("b")), (row("\x1b[31mred[bold]", "\u202e1[/]"),), stacked=True), width)
    assert all(character.isprintable() or character == "\n" for character in text)
    assert "[bold]" in text


def test_shortened_names_keep_enough_to_be_known() -> None:
    assert short_names(["cudc-vary-icm-and-more"], SHORT) == {"cudc-vary-icm-and-more": "cudc-va…d-more"}
