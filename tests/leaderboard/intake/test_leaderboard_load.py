from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from cudc_bench.artefacts.records import write_record
from cudc_bench.leaderboard.intake.load import load_records, to_frame
from cudc_bench.text import plain


def test_reads_files_and_folders_once_each(make_record, save, tmp_path):
    results = save(make_record(seed=1), make_record(seed=2))
    alone = tmp_path / "alone.json"
    write_record(alone, make_record(seed=3))
    (results / "notes.txt").write_text("not a record")
    loaded = load_records([results, results / "cpu", alone])
    assert sorted(record.dataset.seed for record in loaded.records) == [1, 2, 3]
    assert loaded.problems == ()


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"{}", b"[1]", b"\xff\xfe", b'{"schema_version": 99}', b'{"evil\\u001b[31m\\nfield": 1}'],
)
def test_what_is_not_a_record_is_one_line_and_stops_nothing(content, make_record, save):
    results = save(make_record())
    (results / "broken.json").write_bytes(content)
    loaded = load_records([results])
    assert len(loaded.records) == 1
    (problem,) = loaded.problems
    assert "broken.json" in problem
    assert problem.isprintable()


def test_references_beside_records_are_no_records(make_record, save):
    results = save(make_record())
    (results / "cpu" / "walker" / "walk" / "reference.json").write_text("{}")
    loaded = load_records([results])
    assert len(loaded.records) == 1
    assert loaded.problems == ()


def test_a_dangling_link_is_reported(make_record, save):
    results = save(make_record())
    (results / "gone.json").symlink_to(results / "nowhere")
    loaded = load_records([results])
    assert len(loaded.records) == 1
    assert "gone.json" in loaded.problems[0]


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_an_unreadable_file_is_reported(make_record, save):
    results = save(make_record())
    path = next(results.rglob("*.json"))
    path.chmod(0)
    loaded = load_records([results])
    assert loaded.records == ()
    assert "ermission" in loaded.problems[0]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"final": [1000.1]}, "1000.1"),
        ({"final": [-1000.1]}, "1000.1"),
        ({"final": [1e308, 1e308]}, "1e+308"),
        ({"final": [1e308], "task": "juggle"}, "1e+308"),
        ({"milestones": [-5]}, "gradient steps"),
        ({"milestones": [10**30]}, "gradient steps"),
        ({"created": "yesterday"}, "yesterday"),
    ],
)
def test_impossible_records_are_refused(changes, named, make_record, save):
    loaded = load_records([save(make_record(**changes))])
    assert loaded.records == ()
    (problem,) = loaded.problems
    assert named in problem


def test_the_largest_possible_return_is_accepted(make_record, save):
    assert len(load_records([save(make_record(final=[1000.0]))]).records) == 1


@pytest.mark.parametrize("newer_first", [True, False])
def test_of_duplicates_the_newest_is_kept_and_reported(newer_first, make_record, tmp_path):
    # The later instant has the earlier spelling: times are compared, not strings.
    old = make_record(final=[1.0], created="2026-11-22T11:30:00+02:00")
    new = make_record(final=[2.0], created="2026-11-22T10:00:00")
    for name, record in zip(["a", "b"], [new, old] if newer_first else [old, new], strict=True):
        write_record(tmp_path / f"{name}.json", record)
    loaded = load_records([tmp_path])
    assert [record.final.returns for record in loaded.records] == [[2.0]]
    (problem,) = loaded.problems
    assert problem.startswith(str(tmp_path / ("b.json" if newer_first else "a.json")))


@pytest.mark.parametrize(
    "changes",
    [
        {"seed_": 2},
        {"algorithm": "cql"},
        {"profile": "paper"},
        {"overrides": {"gamma": 0.9}},
        {"dataset_overrides": {"steps": 5}},
        {"dataset_id": "walker/walk/other-v0"},
    ],
)
def test_different_runs_are_not_duplicates(changes, make_record, tmp_path):
    other = make_record(**{name: value for name, value in changes.items() if name != "seed_"})
    if "seed_" in changes:
        other = other.model_copy(update={"seed": changes["seed_"]})
    write_record(tmp_path / "a.json", make_record())
    write_record(tmp_path / "b.json", other)
    loaded = load_records([tmp_path])
    assert (len(loaded.records), loaded.problems) == (2, ())


def test_frame_has_a_row_for_each_milestone(make_record):
    frame = to_frame([make_record(seed=3, milestones=[10_000, 15_000, 20_000])])
    assert frame.milestone.tolist() == [10_000, 15_000, 20_000]
    assert frame.score[0] == 150.0
    assert math.isnan(frame.score[1])
    assert frame.score[2] == 500.0
    assert frame.episodes.tolist() == [2, 0, 3]
    assert set(frame.dataset_seed) == {3}
    assert frame.drop(columns=["milestone", "score", "episodes"]).drop_duplicates().to_dict("records") == [
        {"group": "cpu", "algorithm": "td3", "domain": "walker", "task": "walk", "method": "cudc", "dataset_seed": 3, "seed": 1}
    ]  # fmt: skip


def test_frame_of_nothing_has_the_columns():
    assert {"group", "score", "episodes"} <= set(to_frame([]).columns)


def test_plain_is_one_printable_line():
    assert plain("a\n b\x1b[31m\u202e\tc ") == "a b [31m c"


def test_missing_path_is_a_problem_not_a_crash(tmp_path: Path):
    assert "none.json" in load_records([tmp_path / "none.json"]).problems[0]
