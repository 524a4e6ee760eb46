"""Floors and ceilings: whom they serve, that every table and figure shows them, and when comparisons are by them."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from cudc_bench.artefacts.records import Evaluation, Record
from cudc_bench.artefacts.references import Bounds, Reference, ReferenceRun, reference_path, write_reference
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.numbers.figures import Bars, Curves
from cudc_bench.leaderboard.numbers.grid import Entry, Grid
from cudc_bench.leaderboard.numbers.overall import ALL, Overall, build_overall
from cudc_bench.leaderboard.numbers.published import beside_paper
from cudc_bench.leaderboard.numbers.scale import BETWEEN, OF_LARGEST, scale_of, serving
from cudc_bench.leaderboard.numbers.studies import build_studies
from cudc_bench.leaderboard.numbers.study import SCORE, Study
from cudc_bench.leaderboard.numbers.table import Table, build_blocks, build_tables, tables_of
from cudc_bench.leaderboard.show.csv import of_grid as grid_to_csv
from cudc_bench.leaderboard.show.csv import of_paper as paper_to_csv
from cudc_bench.leaderboard.show.csv import of_scores as scores_to_csv
from cudc_bench.leaderboard.show.csv import of_table as to_csv
from cudc_bench.leaderboard.show.figures.comparisons import draw_domains, draw_intervals, draw_profiles
from cudc_bench.leaderboard.show.figures.draw import draw
from cudc_bench.leaderboard.show.figures.runs import draw_task
from cudc_bench.leaderboard.show.latex import of_paper as paper_to_latex
from cudc_bench.leaderboard.show.latex import of_study as grid_to_latex
from cudc_bench.leaderboard.show.latex import of_table as to_latex
from cudc_bench.leaderboard.show.markdown import of_overall as overall_to_markdown
from cudc_bench.leaderboard.show.markdown import of_paper as paper_to_markdown
from cudc_bench.leaderboard.show.markdown import of_study as grid_to_markdown
from cudc_bench.leaderboard.show.markdown import of_table as to_markdown
from cudc_bench.leaderboard.show.terminal import of_overall as overall_to_rich
from cudc_bench.leaderboard.show.terminal import of_table as to_rich
from cudc_bench.settings.config import as_dict, build, config_hash
from cudc_bench.settings.evaluate_config import OnlineConfig
from cudc_bench.settings.profiles import PROFILES

Served = Mapping[tuple[str, str, str], Bounds]
TASKS = DOMAINS["walker"].tasks
FLOORS, CEILINGS = dict(zip(TASKS, (130.0, 40.0, 25.0, 30.0), strict=True)), dict(zip(TASKS, (980.0, 940.0, 420.0, 610.0), strict=True))
WALKER: Served = {("cpu", "walker", task): Bounds(FLOORS[task], FLOORS[task] + 5, CEILINGS[task], 3) for task in TASKS}
JACO: Served = {("cpu", "jaco", task): Bounds(2.0, 1.0, 200.0, 3) for task in DOMAINS["jaco"].tasks}


@pytest.fixture
def runs(make_record: Callable) -> Callable[..., list[Record]]:
    """Records of a method on all tasks of a domain."""

    def make(method: str, level: float = 0.3, domain: str = "walker", seeds: range = range(1, 6), **changes: object) -> list[Record]:
        return [
            make_record(method, task, seed, final=[DOMAINS[domain].max_return * (level + 0.05 * index + 0.01 * seed)],
                        dataset_domain=domain, dataset_id=f"{domain}/{task}/{method}-seed{seed}-v0", **changes)
            for index, task in enumerate(DOMAINS[domain].tasks)
            for seed in seeds
        ]  # fmt: skip

    return make


def table_of(records: list[Record], references: Served) -> Table:
    (table,), _ = build_tables(records, references)
    return table


def overall_of(records: list[Record], references: Served) -> Overall:
    (overall,) = build_overall(build_tables(records, references)[0])
    return overall


def studies_of(records: list[Record], references: Served) -> dict[str, Study]:
    blocks, _ = build_blocks(records, references)
    return {study.name: study for study in build_studies(blocks, build_overall(tables_of(blocks)))}


def cells(table: Grid) -> dict[tuple[object, ...], Entry | None]:
    return {(part.key, *line.labels, column.name): entry for part, line, column, entry in table.entries()}


def grid(study: Study, name: str) -> Grid:
    return next(one for one in study.tables if one.name == name)


def lines_at(panel: object) -> set[float]:
    """Where a panel has lines across it."""
    return {float(line.get_ydata()[0]) for line in panel.get_lines() if list(line.get_xdata()) == [0, 1]}  # type: ignore[attr-defined]


# Whom they serve


def test_a_scale_is_the_references_or_the_largest_return() -> None:
    bounds = WALKER["cpu", "walker", "run"]
    by_reference, by_largest = scale_of("walker", "run", {"run": bounds}), scale_of("walker", "run", {})
    assert by_reference is not None
    assert by_largest is not None
    assert [by_reference.score(value) for value in (25.0, 420.0, 222.5)] == [0.0, 1.0, 0.5]
    assert by_reference.score(300.0) == bounds.normalise(300.0)
    assert by_reference.width(39.5) == pytest.approx(0.1)
    assert by_largest.score(250.0) == by_largest.width(250.0) == 0.25
    assert scale_of("cheetah", "run", {}) is None
    assert scale_of("cheetah", "run", {"run": bounds}) is not None


@pytest.mark.parametrize(
    "changes",
    [
        {"profile": "paper"}, {"dataset_profile": "paper"}, {"overrides": {"gamma": 0.5}}, {"dataset_overrides": {"steps": 100_000}},
        {"dataset_used": 100_000}, {"dataset_domain": "jaco"},
    ],
    ids=str,
)  # fmt: skip
def test_a_reference_serves_its_own_profile_alone(changes: dict[str, object], make_record: Callable) -> None:
    assert set(serving(WALKER, make_record())) == set(TASKS)
    other = make_record(**changes)
    assert serving(WALKER, other) == {}
    assert table_of([other], WALKER).references == {}
    assert "Floor:" not in table_of([other], WALKER).caption


def test_what_others_made_is_measured_by_what_its_table_is(make_record: Callable) -> None:
    table = table_of(
        [make_record(), make_record("proto", dataset_source="ExORL", dataset_profile="imported", dataset_steps=10_000_000)], WALKER
    )
    assert len(table.methods) == 2
    assert table.references["walk"] == WALKER["cpu", "walker", "walk"]


# Tables


def test_every_rendering_of_a_table_has_floor_ceiling_and_scores(make_record: Callable) -> None:
    records = [make_record(seed=seed, final=[400.0 + 90 * seed]) for seed in (1, 2, 3)]
    records += [make_record(task="juggle", final=[7.0]), make_record(task="flip", final=[7.0])]
    table = table_of(records, {key: bounds for key, bounds in WALKER.items() if key[2] != "flip"})
    text, latex = to_markdown(table), to_latex(table)
    assert "| 20K steps | floor | cudc | ceiling |" in text
    assert "| walk | 40 | 580 ± 90 (3) | 940 |" in text
    assert "| juggle | – | 7 (1) | – |" in text
    assert "stand" not in text.partition("Mean and sample")[0]
    assert "Tasks of walker without any run: stand, run." in text
    assert "| 20K steps, scores | cudc |" in text
    assert "| walk | 0.60 ± 0.10 (3) |" in text
    assert text.count("| juggle |") == text.count("| flip |") == 2  # They have no scores.
    assert "ceiling: of TD3 trained online on the task at this profile (3 seeds each)" in text
    assert "Without a reference: flip, juggle." in text
    assert r"walk & 40 & 580 $\pm$ 90 (3) & 940 \\" in latex
    assert r"walk & 0 & 0.60 $\pm$ 0.10 (3) & 1 \\" in latex
    assert {line.count("&") for line in latex.splitlines() if line.endswith(r"\\")} == {3}
    lines = {(one["milestone"], one["task"]): one for one in csv.DictReader(io.StringIO(to_csv(table)))}
    walk = lines["20000", "walk"]
    assert [float(walk[name]) for name in ("mean", "floor", "untrained", "ceiling", "score", "score_std")] == pytest.approx(
        [580, 40, 45, 940, 0.6, 0.1]
    )
    assert [lines["20000", "juggle"][name] for name in ("floor", "untrained", "ceiling", "score", "score_std")] == [""] * 5
    screen = Console(file=io.StringIO(), width=100)
    screen.print(to_rich(table))
    shown = [line.split() for line in screen.file.getvalue().splitlines()]  # type: ignore[attr-defined]
    assert ["walk", "40", "580±90", "(3)", "940"] in shown
    assert ["walk", "0", "0.60±0.10", "1"] in shown


def test_many_methods_turn_the_terminals_table_with_floor_and_ceiling_as_rows(make_record: Callable) -> None:
    records = [make_record(method, task, final=[300.0]) for method in ("random", "icm", "apt", "proto", "cudc") for task in TASKS]
    screen = Console(file=io.StringIO(), width=80)
    screen.print(to_rich(table_of(records, WALKER)))
    shown = [line.split() for line in screen.file.getvalue().splitlines()]  # type: ignore[attr-defined]
    assert shown.count(["floor", "130", "40", "25", "30"]) == shown.count(["ceiling", "980", "940", "420", "610"]) == 2
    assert ["cudc", "0.20", "0.29", "0.70", "0.47"] in shown


# Comparisons


def test_a_comparison_is_by_references_if_all_of_its_tasks_have_one(runs: Callable) -> None:
    records = [*runs("cudc", 0.5), *runs("random", 0.1), *runs("cudc", 0.5, "jaco"), *runs("random", 0.1, "jaco")]
    overall = overall_of(records, WALKER)
    every, walker, jaco = overall.comparisons[:3]
    assert [one.scope for one in (every, walker, jaco)] == [ALL, "walker", "jaco"]
    assert [one.unit for one in (every, walker, jaco)] == [OF_LARGEST, BETWEEN, OF_LARGEST]
    assert f"{OF_LARGEST}, on all domains, jaco; {BETWEEN}, on walker" in overall.caption
    assert every.remarks[0].startswith("Not by references, which these tasks have not: jaco reach_top_left, jaco reach_top_right,")
    assert not any("references" in line for line in (*walker.remarks, *jaco.remarks))
    assert walker.references == tuple(WALKER.values())
    for standing, plain in zip(walker.standings, overall_of(records, {}).comparisons[1].standings, strict=True):
        (returns,), (scores,) = standing.returns, standing.scores
        expected = np.stack([WALKER["cpu", "walker", task].normalise(returns[:, i]) for i, task in enumerate(TASKS)], 1)  # type: ignore[arg-type]
        assert scores == pytest.approx(expected)
        assert standing.estimates["mean"].value == pytest.approx(expected.mean())
        assert standing.method == plain.method
    # Which of two is better on a task does not depend on the scale.
    assert walker.pairs == overall_of(records, {}).comparisons[1].pairs
    both = overall_of(records, {**WALKER, **JACO})
    assert {one.unit for one in both.comparisons} == {BETWEEN}
    assert f"tasks: {BETWEEN}. Profile" in both.caption
    assert f"tasks: {OF_LARGEST}. Profile" in overall_of(records, {}).caption
    line = next(one for one in csv.DictReader(io.StringIO(scores_to_csv(both))) if (one["scope"], one["task"]) == (ALL, "run"))
    assert float(line["score"]) == pytest.approx((float(line["return"]) - 25) / 395)


def test_a_task_without_a_reference_is_named_where_it_decides(runs: Callable) -> None:
    without_flip = {key: bounds for key, bounds in WALKER.items() if key[2] != "flip"}
    overall = overall_of([*runs("cudc"), *runs("random", 0.1)], without_flip)
    assert overall.headline.unit == OF_LARGEST
    assert "Not by references, which these tasks have not: walker flip." in overall_to_markdown(overall)
    screen = Console(file=io.StringIO(), width=200)
    screen.print(overall_to_rich(overall))
    assert "walker flip" in screen.file.getvalue()  # type: ignore[attr-defined]
    # Nobody has a score on it: then it is no task of the comparison.
    fewer = [one for one in runs("cudc") if one.dataset.task != "flip"]
    assert overall_of(fewer, without_flip).headline.unit == BETWEEN


def test_intervals_by_references_end_where_returns_do(runs: Callable) -> None:
    """At a return of 0, which is below the floor, and at the largest, above the ceiling."""
    wide = [one for seed, level in ((1, 0.0), (2, 0.85)) for one in runs("cudc", level, seeds=range(seed, seed + 1))]
    (standing,) = overall_of(wide, WALKER).headline.standings
    low, high = (np.mean([bounds.normalise(end) for bounds in WALKER.values()]) for end in (0.0, 1000.0))
    interval = standing.estimates["mean"].interval
    assert interval is not None
    assert (interval.low, interval.high) == pytest.approx((low, high))


# Studies


def test_studies_have_rows_of_floors_and_ceilings_and_scores(runs: Callable) -> None:
    records = [*runs("cudc", 0.5), *runs("cudc-no-pe", 0.4)]
    study = studies_of(records, WALKER)["ablation"]
    returns, scores, relative = (cells(grid(study, name)) for name in ("returns", "scores", "relative"))
    assert returns[20_000, "floor (random actions)", "run"] == Entry(25.0)
    assert returns[20_000, "ceiling (TD3 trained online)", "walk"] == Entry(940.0)
    assert returns[20_000, "floor (random actions)", SCORE] is None
    found, score = returns[20_000, "cudc", "run"], scores[20_000, "cudc", "run"]
    assert found is not None
    assert score is not None
    assert score.value == pytest.approx((found.value - 25) / 395)
    assert score.std == pytest.approx((found.std or 0) / 395)
    assert (score.n, score.records) == (found.n, found.records)
    (overall,) = build_overall(build_tables(records, WALKER)[0])
    standing = overall.headline.standings[0]
    mean = returns[20_000, "cudc", SCORE]
    assert mean is not None
    assert (mean.value, mean.interval) == (standing.estimates["mean"].value, standing.estimates["mean"].interval)
    assert BETWEEN in grid(study, "returns").caption
    # A share of CUDC's mean return, as the methods' own are.
    floor = relative[20_000, "floor (random actions)", "run"]
    assert floor is not None
    assert floor.value == pytest.approx(25 / found.value)
    mean_floor = relative[20_000, "floor (random actions)", "mean"]
    assert mean_floor is not None
    cudc = {task: returns[20_000, "cudc", task] for task in TASKS}
    assert mean_floor.value == pytest.approx(np.mean([FLOORS[task] / one.value for task, one in cudc.items() if one]))
    assert "floor (random actions),run,25.0" in grid_to_csv(study, grid(study, "returns"))
    assert "| ceiling (TD3 trained online) | 980 | 940 | 420 | 610 | – |" in grid_to_markdown(study)
    assert OF_LARGEST in grid(studies_of(records, {})["ablation"], "returns").caption
    assert [table.name for table in studies_of(records, {})["ablation"].tables] == ["relative", "returns"]


def test_sizes_are_measured_by_the_whole_datasets_profile_and_say_so(runs: Callable) -> None:
    records = [*runs("cudc", 0.5, dataset_steps=1_000_000), *runs("cudc", 0.3, dataset_steps=1_000_000, dataset_used=100_000)]
    study = studies_of(records, WALKER)["sizes"]
    assert cells(grid(study, "returns"))[100_000, "floor (random actions)", "run"] == Entry(25.0)
    assert "at every size: neither is trained on a part of a dataset" in grid(study, "returns").caption
    area = cells(grid(study, "area"))["100000-1000000", "cudc", SCORE]
    ends = [cells(grid(study, "returns"))[size, "cudc", SCORE] for size in (100_000, 1_000_000)]
    assert area is not None
    assert area.value == pytest.approx(np.mean([end.value for end in ends if end]))
    assert lines_at(draw(study.figures["curves"]).axes[2]) >= {25.0, 420.0}
    # Of parts alone it is not known what the whole would be measured by.
    parts = [one for one in records if one.dataset.used]
    assert "floor (random actions)" not in grid_to_markdown(studies_of(parts, WALKER)["sizes"])


def test_a_score_below_the_floor_is_a_number_in_latex(runs: Callable) -> None:
    records = [*runs("cudc-no-pe", 0.05), *runs("cudc")]
    for text in (grid_to_latex(studies_of(records, WALKER)["ablation"]), to_latex(table_of(runs("cudc", 0.05), WALKER))):
        assert r"& -0.06 $\pm$ 0.02 (5)" in text
        assert "$-0.06 $" not in text


def test_learners_say_what_their_scores_are(runs: Callable) -> None:
    records = [*runs("cudc"), *runs("icm", 0.2), *runs("cudc", algorithm="cql"), *runs("icm", 0.25, algorithm="cql")]
    assert BETWEEN in grid(studies_of(records, WALKER)["learners"], "mean").caption
    assert OF_LARGEST in grid(studies_of(records, {})["learners"], "mean").caption


# Figures


def test_figures_have_lines_at_floor_and_ceiling(runs: Callable) -> None:
    table = table_of([*runs("cudc"), *runs("icm")], {key: bounds for key, bounds in WALKER.items() if key[2] != "flip"})
    for figure in map(draw, (Curves(table.runs), Bars(table.runs))):
        for panel, task in zip(figure.axes, TASKS, strict=True):
            expected = set() if task == "flip" else {FLOORS[task], CEILINGS[task]}
            assert lines_at(panel) == expected
        legend = [text.get_text() for text in figure.legends[0].get_texts()]
        assert legend == ["icm", "cudc", "ceiling: TD3 trained online", "floor: random actions"]
    assert lines_at(draw_task(table.runs, "run").axes[0]) == {25.0, 420.0}
    assert lines_at(draw_task(table.runs, "flip").axes[0]) == set()
    assert len(draw_task(table.runs, "flip").legends[0].get_texts()) == 2
    bound = draw(studies_of(runs("cudc-kmax4"), WALKER)["k-bound"].figures["bound"])
    assert lines_at(bound.axes[2]) >= {25.0, 420.0}


def test_figures_of_comparisons_say_their_scale(runs: Callable) -> None:
    records = [*runs("cudc"), *runs("random", 0.1), *runs("cudc", domain="jaco"), *runs("random", 0.1, "jaco")]
    mixed, both = overall_of(records, WALKER), overall_of(records, {**WALKER, **JACO})
    assert "return / largest possible return" in draw_profiles(mixed).axes[0].get_xlabel()
    assert "0: floor, 1: ceiling" in draw_profiles(both).axes[0].get_xlabel()
    assert "0: floor, 1: ceiling" in draw_intervals(both).get_suptitle().replace("\n", " ")
    assert [panel.get_title() for panel in draw_domains(both).axes] == [ALL, "walker", "jaco"]
    titles = [panel.get_title() for panel in draw_domains(mixed).axes]
    assert titles[1] == "walker\n(0: floor, 1: ceiling)"
    assert titles[2] == "jaco\n(return / largest possible return)"


# Files


def write(results: Path, task: str, floor: float, ceiling: float, **changes: object) -> Path:
    """A reference of profile cpu on walker."""
    profile = PROFILES["cpu"]
    config = build(OnlineConfig, profile.collect, profile.evaluate)
    runs = [
        ReferenceRun(
            seed=seed, random=[floor] * config.final_episodes, untrained=[floor] * config.final_episodes, metrics=[],
            curve=[Evaluation(step=step, returns=[1.0] * config.evaluation_episodes) for step in config.points],
            final=Evaluation(step=config.steps, returns=[ceiling] * config.final_episodes),
        )
        for seed in (1, 2)
    ]  # fmt: skip
    values = as_dict(config)
    facts: dict[str, object] = {
        "domain": "walker", "task": task, "profile": "cpu", "overrides": {}, "hyperparameters": values, "runs": runs, "seconds": 1.0,
        "hyperparameters_hash": config_hash(values), "versions": {}, "machine": {}, "command": "cudc-bench reference",
        "created": "2026-11-20T10:00:00+00:00",
    }  # fmt: skip
    path = reference_path(results, "walker", task, "cpu")
    write_reference(path, Reference(**facts | changes))  # type: ignore[arg-type]
    return path


def below(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_references_beside_records_are_read_and_what_they_change_is_made_again(runs: Callable, save: Callable, tmp_path: Path) -> None:
    methods = [("cudc", "cpu"), ("icm", "cpu"), ("cudc-no-pe", "cpu"), ("cudc", "demo")]
    results = save(*(one for method, profile in methods for one in runs(method, seeds=range(1, 3), profile=profile)))
    out = tmp_path / "out"
    make_leaderboard(results, out)
    before = below(out)
    assert not any(b"ceiling:" in content for name, content in before.items() if name.endswith(".md"))
    paths = [write(results, task, FLOORS[task], CEILINGS[task]) for task in TASKS]
    report = make_leaderboard(results, out)
    after = below(out)
    assert report.problems == []
    assert "| walk | 40 |" in after["cpu.td3.walker/table.md"].decode()
    assert BETWEEN in after["cpu.td3/overall.md"].decode()
    assert BETWEEN in after["cpu.td3.walker/ablation.md"].decode()
    assert b"dashed: ceiling, that of TD3 trained online" in after["cpu.td3.walker/index.html"]
    # What is of another profile is as it was.
    assert {name: after[name] for name in before if name.startswith("demo.td3") and not name.endswith(".html")} == {
        name: content for name, content in before.items() if name.startswith("demo.td3") and not name.endswith(".html")
    }
    make_leaderboard(results, tmp_path / "fresh")
    assert below(tmp_path / "fresh") == after
    page = after["cpu.td3.walker/task-walk.html"].decode()
    assert "Floor: 40.0, the mean return of random actions" in page
    assert "cpu/walker/walk/reference.json below the results" in page
    assert "ceiling (TD3 trained online)" in after["index.html"].decode()
    assert '<span class="raw">940.0</span><span class="scaled"> 1.000</span>' in page
    write(results, "walk", 50.0, 900.0)
    make_leaderboard(results, out)
    assert "| walk | 50 |" in below(out)["cpu.td3.walker/table.md"].decode()
    for path in paths:
        path.unlink()
    make_leaderboard(results, out)
    assert below(out) == before


def test_a_reference_that_cannot_be_used_is_a_problem_and_stops_nothing(runs: Callable, save: Callable, tmp_path: Path) -> None:
    results = save(*runs("cudc", seeds=range(1, 3)))
    write(results, "walk", 40.0, 940.0)
    write(results, "run", 400.0, 300.0)
    reference_path(results, "walker", "flip", "cpu").write_text("{")
    report = make_leaderboard(results, tmp_path / "out")
    assert [any(task in problem for problem in report.problems) for task in ("walk/reference", "run/reference", "flip/reference")] == [
        False, True, True,
    ]  # fmt: skip
    assert all(problem.isprintable() for problem in report.problems)
    assert set(report.tables[0].references) == {"walk"}
    assert report.overall[0].headline.unit == OF_LARGEST
    assert make_leaderboard(next(results.rglob("td3*.json")), None).tables[0].references == {}


def test_the_papers_numbers_have_floor_and_ceiling_beside_them(make_record: Callable) -> None:
    records = [make_record(profile="paper", milestones=[100_000, 500_000], scores=[(0, [0.0]), (100_000, [300.0]), (500_000, [1.0])])]
    references = {("paper", "walker", "walk"): Bounds(40.0, 45.0, 940.0, 3)}
    table = table_of(records, references)
    paper, plain = beside_paper(table), beside_paper(table_of(records, {}))
    assert paper is not None
    assert plain is not None
    (row,) = [line for line in paper_to_markdown(paper).splitlines() if line.startswith("| walk | cudc | 500 (1) |")]
    assert row.endswith(" | 40 | 940 |")
    assert "| difference | floor | ceiling |" in paper_to_markdown(paper)
    assert "& 40 & 940" in paper_to_latex(paper, table.slug)
    assert {line.count("&") for line in paper_to_latex(paper, table.slug).splitlines() if line.endswith(r"\\")} == {6}
    assert [one["ceiling"] for one in csv.DictReader(io.StringIO(paper_to_csv(paper, table)))] == ["940.0"] * 2
    assert "Floor: mean return of random actions" in paper.caption
    assert "ceiling" not in paper_to_markdown(plain)
    assert {line.count("&") for line in paper_to_latex(plain, table.slug).splitlines() if line.endswith(r"\\")} == {4}
