"""The paper's numbers beside ours."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from cudc_bench.errors import RunError
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.numbers import published
from cudc_bench.leaderboard.numbers.published import beside_paper, reported, reported_relative
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.leaderboard.show.csv import of_paper as paper_to_csv
from cudc_bench.leaderboard.show.latex import of_paper as paper_to_latex
from cudc_bench.leaderboard.show.markdown import of_paper as paper_to_markdown

MILESTONES = {"milestones": [100_000, 500_000], "profile": "paper"}
TASKS = ("stand", "walk", "run", "flip")


@pytest.fixture
def paper_record(make_record: Callable) -> Callable:
    def make(method: str, task: str, seed: int, at_100k: float, at_500k: float, **changes: object):
        scores = [(0, [0.0]), (100_000, [at_100k]), (500_000, [1.0])]
        return make_record(method, task, seed, scores, [at_500k], **MILESTONES | changes)

    return make


def beside(records: list):
    (table,) = build_tables(records)[0]
    return beside_paper(table)


def test_what_the_paper_prints_is_there() -> None:
    main = {key: value for key, value in reported().items() if key[3] in {"random", "icm", "apt", "proto", "aps", "cudc"}}
    assert len(main) == 6 * 12 * 2
    # From the paper's Table 1.
    assert reported()["td3", "walker", "stand", "cudc", 500_000] == (971, 7)
    assert reported()["td3", "quadruped", "walk", "cudc", 100_000] == (338, 147)
    assert reported()["td3", "jaco", "reach_bottom_right", "icm", 500_000] == (229, 8)
    assert reported()["td3", "walker", "run", "cudc-vary-icm", 500_000] == (336, 115)
    assert reported_relative()["td3", "walker", "mean", "cudc-no-vary", 500_000] == 0.893


def test_the_papers_means_over_tasks_are_those_of_its_tasks() -> None:
    for (algo, domain, task, method, steps), value in reported_relative().items():
        if task == "mean":
            mean = sum(reported_relative()[algo, domain, one, method, steps] for one in TASKS) / 4
            assert value == pytest.approx(mean, abs=1.1e-3), (method, steps)


def test_ours_stand_beside_the_same_cells_only(paper_record: Callable) -> None:
    records = [paper_record("cudc", "walk", seed, 800.0 + seed, 900.0 + 10 * seed) for seed in (1, 2)]
    records += [paper_record("my_method", "walk", 1, 1.0, 2.0), paper_record("cudc", "juggle", 1, 1.0, 2.0)]
    found = beside(records)
    (first,), (last,) = (part.lines for part in found.parts)
    ours, paper, _ = first.entries
    assert (found.parts[0].key, first.labels, ours.value, paper.value, paper.std) == (100_000, ("walk", "cudc"), 801.5, 827, 64)
    assert last.entries[2].value == pytest.approx((915 - 893) / 34)
    text = paper_to_markdown(found)
    assert "| walk | cudc | 915 ± 7 (2) | 893 ± 34 | +0.6 |" in text
    assert [token.type for token in MarkdownIt().enable("table").parse(text)].count("table_open") == 2
    assert "Profile paper: the paper's sizes, but another implementation." in text
    latex = paper_to_latex(found, "a-table")
    assert r"walk & cudc & 915 $\pm$ 7 (2) & 893 $\pm$ 34 & $+0.6$ \\" in latex
    assert latex.isascii()
    lines = list(csv.DictReader(io.StringIO(paper_to_csv(found, build_tables(records)[0][0]))))
    assert [(line["mean"], line["paper_mean"], line["paper_std"]) for line in lines] == [
        ("801.5", "827.0", "64.0"),
        ("915.0", "893.0", "34.0"),
    ]


@pytest.mark.parametrize(
    "change",
    [{"algorithm": "cql"}, {"dataset_domain": "cheetah"}, {"milestones": [50_000]}, {"dataset_source": "ExORL"}],
    ids=lambda change: next(iter(change)),
)
def test_what_differs_from_the_papers_cell_stands_alone(change: dict, paper_record: Callable) -> None:
    assert beside([paper_record("cudc", "walk", 1, 1.0, 2.0)]) is not None
    assert beside([paper_record("cudc", "walk", 1, 1.0, 2.0, **change)]) is None


@pytest.mark.parametrize("change", [{"profile": "cpu"}, {"dataset_overrides": {"width": 512}}])
def test_another_profile_is_said_to_be_of_another_size(change: dict, paper_record: Callable) -> None:
    found = beside([paper_record("cudc", "walk", 1, 1.0, 2.0, **change)])
    for text in (paper_to_markdown(found), paper_to_latex(found, "a-table")):
        assert "SIZES DIFFER: this is profile" in text
        assert "not to be ranked with our own results" in text


def test_files_are_written_where_there_is_something_to_compare(
    paper_record: Callable, make_record: Callable, save: Callable, tmp_path: Path
) -> None:
    results = save(paper_record("cudc", "walk", 1, 1.0, 2.0), make_record())
    files = make_leaderboard(results, tmp_path / "out").files
    assert {file.parent.name for file in files if file.name.startswith("paper.")} == {"paper.td3.walker"}
    assert {file.suffix for file in files if file.name.startswith("paper.")} == {".md", ".tex", ".csv"}
    assert "893" not in (tmp_path / "out" / "paper.td3.walker" / "table.md").read_text()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace("std", "sd", 1),
        lambda text: text + "main,td3,walker,walk,cudc,500000,1,1\n",
        lambda text: text + "main,td3,walker,walk,new,500000,nan,1\n",
        lambda text: text + "main,td3,walker,swim,new,500000,1,1\n",
        lambda text: text + "main,td3,walker\n",
        lambda text: text + "variants,td3,walker,stand,new,500000,971,7 \\\\*\n",
    ],
)
def test_a_damaged_file_is_one_line(damage: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = Path(published.__file__).with_name("published.csv")
    shutil.copy(original, tmp_path)
    monkeypatch.setattr(published, "__file__", str(tmp_path / "published.py"))
    assert len(reported.__wrapped__()) == len(reported())
    (tmp_path / "published.csv").write_text(damage(original.read_text()))
    with pytest.raises(RunError, match="is damaged") as caught:
        reported.__wrapped__()
    assert "\n" not in str(caught.value)
