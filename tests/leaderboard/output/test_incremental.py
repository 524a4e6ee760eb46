"""A build on top of another gives what a build from nothing gives, and touches nothing of anybody else."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from cudc_bench.leaderboard import api
from cudc_bench.leaderboard.output import report
from cudc_bench.leaderboard.output.incremental import LEDGER, Target, build


def below(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def parts_of(state: dict[str, int], made: list[str]) -> list[Target]:
    """A part for each name, with as many files as its number says and the number in each."""

    def make(name: str, number: int) -> dict[str, str | bytes]:
        made.append(name)
        return {f"{index}.txt": f"{name} {number}" for index in range(number)}

    return [Target(name, lambda name=name, number=number: make(name, number), (str(number),)) for name, number in state.items()]


@pytest.mark.parametrize("seed", range(10))
def test_any_sequence_of_changes_ends_as_a_build_from_nothing(seed: int, tmp_path: Path) -> None:
    draw = random.Random(seed)
    state: dict[str, int] = {}
    for turn in range(12):
        before = dict(state)
        for _ in range(draw.randint(0, 3)):
            name = draw.choice(["a", "b", "c/d", "c", ""])
            if draw.random() < 0.3:
                state.pop(name, None)
            else:
                state[name] = draw.randint(0, 4)
        damaged = set()
        if turn and draw.random() < 0.5 and (there := sorted((tmp_path / "out").rglob("*.txt"))):
            path = draw.choice(there)
            name = path.parent.relative_to(tmp_path / "out").as_posix().removeprefix(".")
            # What was edited and belongs to no part any more is kept, as the next test says.
            if name in state and before.get(name) == state[name]:
                damaged.add(name)
                path.unlink() if draw.random() < 0.5 else path.write_text("edited")
        made: list[str] = []
        files = build(tmp_path / "out", parts_of(state, made))
        assert set(made) == {name for name in state if before.get(name) != state[name] and name not in damaged} | damaged
        fresh = build(tmp_path / "fresh", parts_of(state, []))
        assert below(tmp_path / "out") == below(tmp_path / "fresh") or not state
        assert [path.relative_to(tmp_path / "out") for path in files] == [path.relative_to(tmp_path / "fresh") for path in fresh]
        shutil.rmtree(tmp_path / "fresh", ignore_errors=True)


def test_only_what_was_written_and_not_changed_since_is_removed(tmp_path: Path) -> None:
    build(tmp_path, parts_of({"a": 3, "b": 1}, []))
    (tmp_path / "a" / "1.txt").write_text("mine now")
    (tmp_path / "a" / "own.txt").write_text("mine")
    build(tmp_path, parts_of({"b": 1}, []), whole=False)
    assert (tmp_path / "a" / "0.txt").exists()
    build(tmp_path, parts_of({"b": 1}, []))
    assert below(tmp_path).keys() == {LEDGER, "a/1.txt", "a/own.txt", "b/0.txt"}


def test_parts_of_one_folder_are_made_and_removed_apart(tmp_path: Path) -> None:
    made: list[str] = []

    def part(name: str, value: str) -> Target:
        return Target("a", lambda: made.append(name) or {f"{name}.txt": value}, (value,), name)  # type: ignore[func-returns-value]

    build(tmp_path, [part("x", "1"), part("y", "1")])
    build(tmp_path, [part("x", "1"), part("y", "2")])
    assert made == ["x", "y", "y"]
    build(tmp_path, [part("x", "1")])
    assert below(tmp_path).keys() == {LEDGER, "a/x.txt"}


@pytest.mark.parametrize(
    ("folder", "name"), [("b", "../victim"), ("b", "/{}/victim"), ("b", "x/../../victim"), ("..", "victim"), ("/{}", "victim")]
)
def test_a_ledger_from_anywhere_removes_nothing_outside(folder: str, name: str, tmp_path: Path) -> None:
    build(tmp_path / "out", parts_of({"a": 1}, []))
    victim = tmp_path / "victim"
    victim.write_text("a 1")
    ledger = json.loads((tmp_path / "out" / LEDGER).read_text())
    sums = next(iter(ledger["a:"]["files"].values()))
    ledger["b:"] = {"key": "", "folder": folder.format(tmp_path), "files": {name.format(tmp_path): sums}}
    (tmp_path / "out" / LEDGER).write_text(json.dumps(ledger))
    build(tmp_path / "out", parts_of({"a": 1}, []))
    assert victim.read_text() == "a 1"


def test_a_leaderboard_is_made_again_where_records_changed(
    make_record: Callable, save: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    records = [make_record(profile=profile, method=m, seed=s) for profile in ("cpu", "demo") for m in ("cudc", "icm") for s in (1, 2)]
    results, out = save(*records), tmp_path / "out"
    api.make_leaderboard(results, out)
    first = below(out)
    drawn: list[str] = []
    monkeypatch.setattr(report, "table_files", lambda table, real=report.table_files: drawn.append(table.slug) or real(table))
    api.make_leaderboard(results, out)
    assert (drawn, below(out)) == ([], first)
    save(make_record(profile="demo", final=(1.0, 2.0)))
    api.make_leaderboard(results, out)
    assert drawn == ["demo.td3.walker"]
    api.make_leaderboard(results, tmp_path / "fresh")
    assert below(out) == below(tmp_path / "fresh") != first
    api.make_leaderboard(results, out, profile="cpu")
    assert below(out) == below(tmp_path / "fresh")
    shutil.rmtree(results / "demo")
    api.make_leaderboard(results, out)
    site = {"index.html", "methods", "datasets", "site"}
    assert {path.name for path in out.iterdir()} == {LEDGER, "cpu.td3", "cpu.td3.walker"} | site
    # A filter makes a site where there is none over everything.
    for final in (1.0, 2.0):
        save(make_record(profile="cpu", final=(final,)))
        api.make_leaderboard(results, tmp_path / "some", profile="cpu")
        page = (tmp_path / "some" / "cpu.td3.walker" / "runs-walk.cudc.html").read_text()
        assert f"{final:.1f} after" in page


def test_figures_are_files_only_where_they_were_asked_for_and_stay_as_long_as_they_are_right(
    make_record: Callable, save: Callable, tmp_path: Path
) -> None:
    results, out = save(make_record(), make_record(profile="demo")), tmp_path / "out"

    def figures() -> set[str]:
        return {path.parent.name for path in out.rglob("*.pdf")}

    api.make_leaderboard(results, out, domain="walker")
    assert figures() == set()
    api.make_leaderboard(results, out, figures=True)
    asked = below(out)
    assert figures() == {"cpu.td3", "cpu.td3.walker", "demo.td3", "demo.td3.walker"}
    assert 'href="curves.pdf"' in asked["cpu.td3.walker/index.html"].decode()
    # They need not be asked for again, and pages keep offering them.
    api.make_leaderboard(results, out)
    assert below(out) == asked
    # But nobody may take them for what the records say now.
    save(make_record(profile="demo", final=(1.0, 2.0)))
    api.make_leaderboard(results, out)
    assert figures() == {"cpu.td3", "cpu.td3.walker"}
    assert "curves.pdf" not in (out / "demo.td3.walker" / "index.html").read_text()
