from __future__ import annotations

import csv
import io

import pandas as pd
import pytest
from markdown_it import MarkdownIt
from rich.console import Console

from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.csv import of_table as to_csv
from cudc_bench.leaderboard.show.latex import escape as escape_latex
from cudc_bench.leaderboard.show.latex import of_table as to_latex
from cudc_bench.leaderboard.show.markdown import of_table as to_markdown
from cudc_bench.leaderboard.show.terminal import of_table as to_rich
from cudc_bench.text import escape_markdown

HOSTILE = "[bold]x[/bold] | *a* _b_ `c` <script> &amp; $m$ #1 100% {z} ~ ^ \\input{/etc/passwd} -- \x1b[31m\nnew"


@pytest.fixture
def table(make_record):
    records = [
        *(make_record(seed=seed, final=[100.0 * seed]) for seed in (1, 2, 3)),
        make_record(method="random", final=[42.0]),
        make_record(method="my_method", task="run", final=[7.0]),
    ]
    return build_tables(records)[0][0]


@pytest.fixture
def hostile(make_record):
    return build_tables([make_record(overrides={"note": HOSTILE}, command=HOSTILE)])[0][0]


def shown(table, width=200):
    file = io.StringIO()
    Console(file=file, width=width, color_system=None).print(to_rich(table))
    return file.getvalue()


def markdown_tables(text):
    """The cells of each table as a Markdown reader sees them, bold marked by <>."""
    found, cell = [], None
    for token in MarkdownIt().enable("table").parse(text):
        if token.type == "table_open":
            found.append([])
        elif token.type == "tr_open":
            found[-1].append([])
        elif token.type in {"td_open", "th_open"}:
            cell = True
        elif token.type == "inline" and cell:
            marks = {"text": lambda t: t.content, "strong_open": lambda t: "<", "strong_close": lambda t: ">"}
            found[-1][-1].append("".join(marks.get(t.type, lambda t: t.content)(t) for t in token.children))
            cell = None
    return found


def test_markdown_has_a_table_for_each_milestone(table):
    first, last = markdown_tables(to_markdown(table))
    assert first[0] == ["10K steps", "random", "cudc", "my_method"]
    assert last[0][0] == "20K steps"
    assert last[1:] == [
        ["walk", "42 (1)", "<200 ± 100> (3)", "–"],
        ["run", "–", "–", "7 (1)"],
    ]


def test_latex_is_booktabs_with_bold_best_and_explicit_gaps(table):
    text = to_latex(table)
    assert r"walk & 42 (1) & \textbf{200 $\pm$ 100} (3) & -- \\" in text
    assert r"20K steps & random & cudc & my\_method \\" in text
    assert r"\begin{tabular}{lrrr}" in text
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(rows) == 6
    assert {line.count(" & ") for line in rows} == {3}
    assert text.count(r"\midrule") == 3
    assert text.isascii()


def test_terminal_shows_every_cell(table):
    text = shown(table)
    assert "200±100 (3)" in text
    assert "42 (1)" in text
    assert "10K steps" in text
    assert "20K steps" in text
    assert "–" in text


def test_terminal_bold_is_the_best(table):
    cells = styles_of(table)
    assert cells["200±100 (3)"] == "bold"
    assert cells["42 (1)"] == ""


def styles_of(table) -> dict[str, str]:
    """How the terminal shows each cell, by its text."""
    _, grid, _ = to_rich(table).renderables
    return {cell.text: cell.style for line in grid.rows for cell in line.cells[1:]}


def test_every_rendering_marks_all_that_are_not_significantly_worse(make_record):
    finals = {"random": (100.0, 110.0, 120.0), "icm": (480.0, 500.0, 545.0), "cudc": (490.0, 510.0, 530.0)}
    records = [
        make_record(method=method, seed=seed, final=[score]) for method, scores in finals.items() for seed, score in enumerate(scores)
    ]
    (table,), _ = build_tables(records)
    walk = markdown_tables(to_markdown(table))[-1][1]
    assert walk == ["walk", "110 ± 10 (3)", "<508 ± 33> (3)", "<510 ± 20> (3)"]
    assert r"walk & 110 $\pm$ 10 (3) & \textbf{508 $\pm$ 33} (3) & \textbf{510 $\pm$ 20} (3) \\" in to_latex(table)
    frame = pd.read_csv(io.StringIO(to_csv(table)))
    last = frame[(frame.milestone == 20_000) & (frame.task == "walk")]
    assert dict(zip(last.method, last.best, strict=True)) == {"random": False, "icm": True, "cudc": True}
    styles = styles_of(table)
    assert [styles[text] for text in ("110±10 (3)", "508±33 (3)", "510±20 (3)")] == ["", "bold", "bold"]


def test_many_methods_are_the_terminals_rows(make_record):
    methods = [f"method_{letter}" for letter in "abcdefg"]
    records = [make_record(method=method, task=task) for method in methods for task in ("walk", "run")]
    (table,), _ = build_tables(records)
    text = shown(table, width=80)
    assert "…" not in text
    lines = text.splitlines()
    assert lines[1].split() == ["walk", "run"]
    by_name = {line.split()[0]: line for line in lines if line.startswith("method_")}
    assert list(by_name) == methods
    cells = {method: table.cells[table.milestones[-1], "walk", method] for method in methods}
    assert all(f"{round(cells[method].value)} ({cells[method].n})" in line for method, line in by_name.items())


def test_csv_round_trip(table):
    frame = pd.read_csv(io.StringIO(to_csv(table)))
    assert len(frame) == 2 * 2 * 3
    expected = {(part.key, *line.labels, column.name): found for part, line, column, found in table.grid.entries()}
    for line in frame.itertuples():
        found = expected[line.milestone, line.task, line.method]
        if found is None:
            assert line.seeds == 0
            assert pd.isna(line.mean)
        else:
            assert (line.mean, line.seeds, line.best) == (found.value, found.n, found.best)
            assert pd.isna(line.std) if found.std is None else line.std == found.std
    assert set(frame.group) == {"cpu"}


def test_csv_keeps_full_precision(make_record):
    table = build_tables([make_record(final=[0.1 + 0.2]), make_record(seed=2, final=[1 / 3])])[0][0]
    lines = csv.DictReader(io.StringIO(to_csv(table)))
    (last,) = [line for line in lines if (line["milestone"], line["task"]) == ("20000", "walk")]
    found = table.grid.parts[1].lines[0].entries[0]
    assert (float(last["mean"]), float(last["std"])) == (found.value, found.std)


def test_markdown_shows_hostile_text_as_it_is(hostile):
    tokens = MarkdownIt("commonmark").enable("table").parse(to_markdown(hostile))
    kinds = {child.type for token in tokens for child in token.children or []} | {token.type for token in tokens}
    assert not kinds & {"html_inline", "html_block", "link_open", "em_open", "code_inline", "image"}
    caption = next(token for token in tokens if token.type == "inline" and "Profile: " in token.content)
    assert "".join(child.content for child in caption.children).count(hostile.group) == 1
    code = next(token for token in tokens if token.type == "code_block")
    assert code.content.splitlines() == hostile.commands


def test_markdown_of_a_name_is_the_name():
    for text in ("my_method", "a|b", "*x*", "<b>", "`", "\\", "[a](b)", "!", "1 ~ 2"):
        (inline,) = (t for t in MarkdownIt().parse("x " + escape_markdown(text)) if t.type == "inline")
        assert "".join(child.content for child in inline.children) == "x " + text


def test_latex_of_hostile_text_has_no_live_character(hostile):
    text = to_latex(hostile)
    assert r"\input" not in text
    assert r"\textbackslash{}input\{/etc/passwd\}" in text
    assert r"100\% \{z\} \textasciitilde{} \textasciicircum{}" in text
    assert r"\$m\$ \#1" in text
    assert r"\_b\_" in text
    assert r"-{}- \textbackslash{}u001b[31m\textbackslash{}nnew" in text


@pytest.mark.parametrize(
    ("text", "escaped"),
    [("a_b", r"a\_b"), ("50%", r"50\%"), ("--x", "-{}-x"), ("---", "-{}-{}-"), ("é", r"\textbackslash{}xe9"), ("a\nb", "a b")],
)
def test_escape_latex(text, escaped):
    assert escape_latex(text) == escaped


def test_terminal_takes_nothing_for_markup(hostile):
    text = shown(hostile, width=1000)
    assert text.count("[bold]x[/bold]") == 2  # In the title and in the caption.
    assert "\x1b" not in text


def test_csv_of_hostile_text_has_one_line_for_each_cell(hostile):
    text = to_csv(hostile)
    assert len(text.splitlines()) == 1 + 2
    assert set(pd.read_csv(io.StringIO(text)).group) == {hostile.group}
