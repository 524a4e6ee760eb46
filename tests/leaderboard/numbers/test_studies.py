"""The paper's other tables and figures: which records enter, what their numbers are, and what they lack."""

from __future__ import annotations

import csv
import io
import itertools
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from markdown_it import MarkdownIt
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from rich.console import Console
from scipy import stats

from cudc_bench import plugins
from cudc_bench.artefacts.records import Record
from cudc_bench.leaderboard.api import Report, make_leaderboard
from cudc_bench.leaderboard.methods import ALIASES, canonical, styles
from cudc_bench.leaderboard.numbers import statistics
from cudc_bench.leaderboard.numbers.grid import Column, Entry, Grid, number
from cudc_bench.leaderboard.numbers.overall import ALL, build_overall
from cudc_bench.leaderboard.numbers.published import reported, reported_relative
from cudc_bench.leaderboard.numbers.sizes import area_weights
from cudc_bench.leaderboard.numbers.studies import build_studies
from cudc_bench.leaderboard.numbers.study import SCORE, Study
from cudc_bench.leaderboard.numbers.study_specs import ABLATION, K_BOUND, SPECS, STUDY_METHODS, VARIANTS
from cudc_bench.leaderboard.numbers.table import build_blocks, build_tables, tables_of
from cudc_bench.leaderboard.show.csv import of_grid as to_csv
from cudc_bench.leaderboard.show.figures.draw import draw
from cudc_bench.leaderboard.show.figures.drawing import _STYLE, figure_files, filled, legend
from cudc_bench.leaderboard.show.figures.runs import draw_bars
from cudc_bench.leaderboard.show.latex import of_study as to_latex
from cudc_bench.leaderboard.show.markdown import of_study as to_markdown
from cudc_bench.leaderboard.show.terminal import of_study as to_rich

TASKS = ("stand", "walk", "run", "flip")
PAPER = {"milestones": [100_000, 500_000], "profile": "paper", "dataset_steps": 1_000_000}


@pytest.fixture(autouse=True)
def fewer_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = statistics.draw
    monkeypatch.setattr(statistics, "draw", lambda n, tasks, name: draw(n, tasks, name, 500))


def studies_of(records: list[Record]) -> list[Study]:
    blocks, _ = build_blocks(records)
    return build_studies(blocks, build_overall(tables_of(blocks)))


def only(records: list[Record], name: str) -> Study:
    (study,) = [one for one in studies_of(records) if one.name == name]
    return study


def grid(study: Study, name: str) -> Grid:
    return next(one for one in study.tables if one.name == name)


def cells(table: Grid) -> dict[tuple[object, ...], Entry | None]:
    """By part, labels and column."""
    return {(part.key, *line.labels, column.name): entry for part, line, column, entry in table.entries()}


@pytest.fixture
def runs(make_record: Callable) -> Callable[..., list[Record]]:
    """Records of a method on Walker's tasks, whose last scores are ``level`` of the largest return and different everywhere."""

    def make(method: str, level: float = 0.5, seeds: range = range(1, 6), tasks: tuple[str, ...] = TASKS, **changes: object):
        return [
            make_record(
                method, task, seed,
                scores=[(0, [0.0]), (10_000, [400 * score]), (20_000, [1.0])], final=[1000 * score],
                **({"dataset_id": f"walker/{task}/{method}-seed{seed}-v0"} | changes),
            )
            for task in tasks
            for seed in seeds
            for index in [TASKS.index(task) if task in TASKS else 0]
            for score in [level + 0.02 * index + 0.01 * seed + 0.003 * (seed * index % 3)]
        ]  # fmt: skip

    return make


# Which names there are


def test_the_studies_methods_are_those_of_the_collectors_variants() -> None:
    points = {point.name: point.value for point in plugins.entry_points(group="cudc_bench.collectors")}
    variants = {name for name, value in points.items() if value.startswith("cudc_bench.collectors.variants:")}
    assert variants | {"cudc-kmax6", "cudc-stopgrad"} == STUDY_METHODS
    # Two names are compared as one where they are one class, and nowhere else.
    for first, second in itertools.combinations(points, 2):
        assert (canonical(first) == canonical(second)) == (points[first] == points[second])
    assert ALIASES.keys() <= points.keys()
    assert {method for spec in SPECS for method in spec.methods} <= points.keys()


def test_the_papers_own_studies_have_all_methods_that_it_reports() -> None:
    assert {key[3] for key in reported()} - {"random", "proto", "aps"} == set(VARIANTS.methods)
    assert {key[3] for key in reported_relative()} == set(ABLATION.methods)


def test_main_tables_and_comparisons_hold_no_method_of_a_study(runs: Callable) -> None:
    records = [*runs("cudc"), *runs("random", 0.1), *runs("cudc-no-pe"), *runs("apt-k6"), *runs("my-method")]
    tables, problems = build_tables(records)
    assert problems == []
    assert [table.methods for table in tables] == [("random", "cudc", "my-method")]
    assert {method for one in build_overall(tables)[0].comparisons for method in one.methods} == {"random", "cudc", "my-method"}
    assert len(tables[0].records) == 60
    # An imported dataset of such a name is a column of its own, as any other.
    imported = runs("cudc-no-pe", dataset_source="ExORL", dataset_profile="imported")
    assert build_tables([*runs("cudc"), *imported])[0][0].methods == ("cudc", "cudc-no-pe (ExORL, 400K)")
    assert studies_of([*runs("cudc"), *imported]) == []


def test_records_of_studies_alone_make_no_main_table(runs: Callable, save: Callable) -> None:
    report = make_leaderboard(save(*runs("cudc-no-pe")), None)
    assert (report.tables, report.overall) == ([], [])
    assert [study.name for study in report.studies] == ["ablation"]
    assert [table.name for table in report.studies[0].tables] == ["returns"]  # There is no share of CUDC's without CUDC.


def test_studies_exist_once_they_have_begun(runs: Callable) -> None:
    assert studies_of([*runs("cudc"), *runs("icm"), *runs("apt")]) == []
    for method, names in {
        "cudc-reach": ["variants"], "cudc-no-regularize": ["ablation"], "cudc-no-vary": ["ablation"], "cudc-kmax3": ["k-bound"],
        "cudc-kmax6": ["k-bound"], "cudc-normal-k": ["schedule"], "apt-ksched": ["controls"], "cudc-kmix": ["controls"],
    }.items():  # fmt: skip
        assert [study.name for study in studies_of(runs(method))] == names, method


# Names for one setting


def test_either_name_of_a_setting_serves_every_study(runs: Callable) -> None:
    own = [*runs("cudc", 0.6), *runs("cudc-no-vary", 0.4), *runs("cudc-reach", 0.5), *runs("cudc-no-pe"), *runs("cudc-kmax8")]
    other = [*runs("cudc-kmax6", 0.6), *runs("cudc-kmax3", 0.4), *runs("cudc-no-regularize", 0.5), *runs("cudc-no-pe"), *runs("cudc-kmax8")]
    for records in (own, other):
        bound, ablation = only(records, "k-bound"), only(records, "ablation")
        found = cells(grid(bound, "returns"))
        assert found[20_000, "cudc-kmax3", "walk"].value == pytest.approx(
            1000 * np.mean([0.42 + 0.01 * s + 0.003 * (s % 3) for s in range(1, 6)])
        )
        assert found[20_000, "cudc-kmax6", "walk"].n == 5
        assert cells(grid(ablation, "relative"))[20_000, "cudc-no-regularize", "mean"].value < 1
        assert [line.labels[0] for line in grid(bound, "returns").parts[0].lines] == ["cudc-kmax3", "cudc-kmax6", "cudc-kmax8"]
    assert "cudc-kmax6: seeds 1-5 are runs of cudc, another name of the same setting." in only(own, "k-bound").notes
    assert "cudc-no-vary: seeds 1-5 are runs of cudc-kmax3, another name of the same setting." in only(other, "ablation").notes
    table = build_tables(other)[0][0]
    assert table.methods == ("cudc",)
    assert "Another name of the same setting: cudc-kmax6 under cudc." in table.caption


def test_two_runs_of_one_setting_and_seed_are_never_mixed(runs: Callable) -> None:
    records = [*runs("cudc", 0.6), *runs("cudc-kmax6", 0.2, range(4, 8)), *runs("cudc-kmax8")]
    blocks, problems = build_blocks(records)
    assert problems == [
        f"table cpu.td3.walker: cudc-kmax6, seed {seed}, is left out: it is the same setting as cudc, which has that seed, too."
        for seed in (4, 5)
    ]
    (entry,) = [one for key, one in cells(grid(only(records, "k-bound"), "returns")).items() if key == (20_000, "cudc-kmax6", "stand")]
    wanted = [1000 * (0.6 + 0.01 * seed) for seed in range(1, 6)] + [1000 * (0.2 + 0.01 * seed) for seed in (6, 7)]
    assert (entry.n, entry.value) == (7, pytest.approx(np.mean(wanted)))
    assert entry.std == pytest.approx(np.std(wanted, ddof=1))
    assert {one.dataset.id for one in entry.records} == {f"walker/stand/{name}-seed{seed}-v0" for name, seeds in
                                                         (("cudc", range(1, 6)), ("cudc-kmax6", (6, 7))) for seed in seeds}  # fmt: skip
    # The one with more runs of a seed is kept, whatever its name.
    partial = [*runs("cudc", 0.6, range(1, 2), ("walk",)), *runs("cudc-kmax6", 0.2, range(1, 2))]
    assert "cudc, seed 1, is left out" in build_blocks(partial)[1][0]
    assert len(blocks) == 1


# Numbers


def test_returns_are_those_of_the_main_table_and_mean_scores_those_of_the_overall_comparison(runs: Callable) -> None:
    records = [*runs("cudc", 0.6), *runs("icm", 0.3), *runs("cudc-vary-icm", 0.4)]
    study = only(records, "variants")
    assert [line.labels for line in grid(study, "returns").parts[0].lines] == [("icm",), ("cudc-vary-icm",), ("cudc",)]
    found = cells(grid(study, "returns"))
    (table,) = build_tables(records)[0]
    overall = build_overall([table])[0]
    for part in table.grid.parts:
        for line in part.lines:
            for method, cell in zip(table.methods, line.entries, strict=True):
                entry = found[part.key, method, *line.labels]
                assert (entry.value, entry.std, entry.n) == (cell.value, cell.std, cell.n)
                assert len(entry.records) == 5
    for comparison in overall.comparisons:
        for standing in comparison.standings:
            entry = found[comparison.milestone, standing.method, SCORE]
            assert (entry.value, entry.interval) == (standing.estimates["mean"].value, standing.estimates["mean"].interval)
    assert [found[20_000, method, "walk"].best for method in ("icm", "cudc-vary-icm", "cudc")] == [False, False, True]


def test_a_mean_score_needs_all_tasks_and_one_seed_has_no_interval(runs: Callable) -> None:
    study = only([*runs("cudc-kmax4", tasks=TASKS[:3]), *runs("cudc-kmax5", seeds=range(1, 2))], "k-bound")
    found = cells(grid(study, "returns"))
    assert found[20_000, "cudc-kmax4", SCORE] is None
    entry = found[20_000, "cudc-kmax5", SCORE]
    assert (entry.n, entry.interval, len(entry.records)) == (1, None, 4)
    assert "Preliminary" in study.caption


def test_relative_scores_and_their_intervals(runs: Callable) -> None:
    cudc, other = runs("cudc", 0.6), runs("cudc-no-entropy", 0.4, range(1, 5))
    found = cells(grid(only([*cudc, *other], "ablation"), "relative"))

    def matrix(records: list[Record], n: int) -> np.ndarray:
        return np.array([[one.final.mean for one in records if one.dataset.task == task] for task in TASKS]).T.reshape(n, 4)

    x, y = matrix(other, 4), matrix(cudc, 5)
    assert found[20_000, "cudc-no-entropy", "run"].value == pytest.approx(x[:, 2].mean() / y[:, 2].mean())
    mean = found[20_000, "cudc-no-entropy", "mean"]
    assert mean.value == pytest.approx(np.mean(x.mean(0) / y.mean(0)))
    assert (mean.n, len(mean.records)) == (4, 36)
    # One dataset left out at a time.
    without = [
        [np.mean(np.delete(x, i, 0).mean(0) / y.mean(0)) for i in range(4)],
        [np.mean(x.mean(0) / np.delete(y, i, 0).mean(0)) for i in range(5)],
    ]
    a, b = (np.var(one) * (len(one) - 1) for one in without)
    reach = stats.t.ppf(0.975, (a + b) ** 2 / (a**2 / 3 + b**2 / 4)) * np.sqrt(a + b)
    assert (mean.interval.low, mean.interval.high) == pytest.approx((mean.value - reach, mean.value + reach))


@pytest.mark.parametrize("seeds", [3, 5, 8])
def test_relative_intervals_hold_the_truth(seeds: int) -> None:
    random = np.random.default_rng(1)
    held, repeats = 0, 1000
    for _ in range(repeats):
        x, y = (level + 0.05 * random.normal(size=(seeds, 1)) + 0.02 * random.normal(size=(seeds, 4)) for level in (0.4, 0.5))
        interval = statistics.relative_interval(x, y)
        held += interval.low <= 0.8 <= interval.high
    print(f"coverage, relative scores, {seeds} seeds: {100 * held / repeats:.1f}")
    assert held / repeats == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / repeats))


@pytest.mark.parametrize("zero", [0.0, -1.0])
def test_there_is_no_share_of_nothing(zero: float, make_record: Callable) -> None:
    def records(last: float) -> list[Record]:
        cudc = [make_record("cudc", task, seed, final=[last if seed == 5 else zero]) for task in TASKS for seed in range(1, 6)]
        return [*cudc, *(make_record("cudc-no-pe", task, seed) for task in TASKS for seed in range(1, 6))]

    entry = cells(grid(only(records(900.0), "ablation"), "relative"))[20_000, "cudc-no-pe", "mean"]
    assert (entry.value > 1, entry.interval) == (True, None)  # Without the one seed there is no share.
    assert cells(grid(only(records(zero), "ablation"), "relative"))[20_000, "cudc-no-pe", "mean"] is None


def test_the_mean_over_tasks_is_of_seeds_that_have_all_of_them(runs: Callable) -> None:
    records = [*runs("cudc", 0.6), *runs("cudc-no-pe", 0.5, range(1, 4)), *runs("cudc-no-pe", 0.1, range(4, 6), ("stand",))]
    found = cells(grid(only(records, "ablation"), "relative"))
    complete = cells(grid(only([*runs("cudc", 0.6), *runs("cudc-no-pe", 0.5, range(1, 4))], "ablation"), "relative"))
    assert found[20_000, "cudc-no-pe", "mean"] == complete[20_000, "cudc-no-pe", "mean"]
    assert (found[20_000, "cudc-no-pe", "mean"].n, found[20_000, "cudc-no-pe", "stand"].n) == (3, 5)
    lacking = [*runs("cudc", 0.6), *runs("cudc-no-pe", tasks=TASKS[:3])]
    assert cells(grid(only(lacking, "ablation"), "relative"))[20_000, "cudc-no-pe", "mean"] is None


# The paper's numbers


def paper_records(make_record: Callable, method: str, task: str, at: dict[int, tuple[float, float]], **changes: object) -> list[Record]:
    """Five seeds with a given mean and sample standard deviation at both milestones."""
    shape = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) / np.sqrt(2.5)
    return [
        make_record(
            method, task, seed + 1, [(0, [0.0]), (100_000, [at[100_000][0] + at[100_000][1] * z]), (500_000, [0.0])],
            [at[500_000][0] + at[500_000][1] * z], **PAPER | changes,
        )
        for seed, z in enumerate(shape.tolist())
    ]  # fmt: skip


def test_the_papers_table_2_comes_out_where_records_have_its_numbers(make_record: Callable) -> None:
    records = []
    for method, task in itertools.product(VARIANTS.methods, TASKS):
        at = {step: reported()["td3", "walker", task, method, step] for step in (100_000, 500_000)}
        # No return is beyond what is possible: the spread is left out of the records where it would be.
        records += paper_records(make_record, method, task, at)
    study = only(records, "variants")
    returns, paper = cells(grid(study, "returns")), cells(grid(study, "paper"))
    count = 0
    for (algo, domain, task, method, step), (mean, std) in reported().items():
        if (algo, domain) != ("td3", "walker") or method not in VARIANTS.methods:
            continue
        count += 1
        assert (returns[step, method, task].value, returns[step, method, task].std) == (pytest.approx(mean), pytest.approx(std))
        assert paper[step, task, method, "here"].value == pytest.approx(mean)
        assert (paper[step, task, method, "reported in the paper"].value, paper[step, task, method, "reported in the paper"].std) == (
            mean,
            std,
        )
        assert paper[step, task, method, "difference"].value == pytest.approx(0, abs=1e-9)
        assert paper[step, task, method, "reported in the paper"].records == ()
    assert count == len(VARIANTS.methods) * 8
    text = to_markdown(study)
    assert "| 893 ± 34 (5) |" in text.replace("**", "")
    assert r"893 $\pm$ 34 (5)" in to_latex(study)
    assert "Profile paper: the paper's sizes, but another implementation." in text


def test_the_papers_table_3_comes_out_where_records_have_its_shares(make_record: Callable) -> None:
    records = []
    for method, task in itertools.product(ABLATION.methods, TASKS):
        share = {step: reported_relative()["td3", "walker", task, method, step] for step in (100_000, 500_000)}
        records += paper_records(make_record, method, task, {step: (800 * value, 5.0) for step, value in share.items()})
    study = only(records, "ablation")
    relative, paper = cells(grid(study, "relative")), cells(grid(study, "paper"))
    count = 0
    for (_, _, task, method, step), value in reported_relative().items():
        if method == "cudc":
            continue
        count += 1
        # Its means over tasks are rounded, and of rounded shares.
        assert relative[step, method, task].value == pytest.approx(value, abs=1.1e-3 if task == "mean" else 1e-9)
        assert paper[step, task, method, "reported in the paper"].value == value
        assert relative[step, method, task].interval.low < relative[step, method, task].value < relative[step, method, task].interval.high
    assert count == 6 * 5 * 2
    (line,) = [one for one in csv.DictReader(io.StringIO(to_csv(study, grid(study, "relative"))))
               if (one["milestone"], one["method"], one["column"]) == ("500000", "cudc-no-vary", "flip")]  # fmt: skip
    assert float(line["value"]) == pytest.approx(0.809)
    assert "| flip | cudc-no-vary | 0.809 [" in to_markdown(study)


def test_another_profile_is_said_to_be_of_another_size(make_record: Callable) -> None:
    at = dict.fromkeys((100_000, 500_000), (500.0, 10.0))
    study = only(paper_records(make_record, "cudc-reach", "walk", at, profile="cpu"), "variants")
    assert "SIZES DIFFER: this is profile cpu" in grid(study, "paper").caption
    # The baselines' numbers are beside the main table.
    controls = only([one for m in ("apt", "apt-k6") for one in paper_records(make_record, m, "walk", at)], "controls")
    assert [table.name for table in controls.tables] == ["returns"]


# Sizes


def sized(runs: Callable, method: str, levels: dict[int | None, float], **changes: object) -> list[Record]:
    return [one for used, level in levels.items() for one in runs(method, level, dataset_used=used, dataset_steps=1_000_000, **changes)]


LEVELS = {100_000: 0.2, 200_000: 0.3, 500_000: 0.5, None: 0.6}


def test_sizes_are_joined_and_their_area_is_the_mean_over_the_logarithm(runs: Callable) -> None:
    records = [*sized(runs, "cudc", LEVELS), *sized(runs, "icm", {used: level / 2 for used, level in LEVELS.items()}), *runs("apt")]
    study = only(records, "sizes")
    assert (study.group, study.folder, study.algorithm, study.domain) == ("cpu", "cpu.td3.walker", "td3", "walker")
    returns = grid(study, "returns")
    assert [(part.key, part.title) for part in returns.parts] == [
        (100_000, "100K transitions"), (200_000, "200K transitions"), (500_000, "500K transitions"), (1_000_000, "1M transitions"),
    ]  # fmt: skip
    # APT was never trained on a part.
    assert [line.labels for line in returns.parts[0].lines] == [("icm",), ("cudc",)]
    found = cells(returns)
    for used, level in LEVELS.items():
        assert found[used or 1_000_000, "cudc", "stand"].value == pytest.approx(1000 * (level + 0.03))
    area = cells(grid(study, "area"))
    # Of scores that differ by a constant between seeds, tasks and sizes, all areas are the level's plus that constant.
    level = float(np.trapezoid(list(LEVELS.values()), np.log10([1e5, 2e5, 5e5, 1e6])))
    assert area["100000-1000000", "cudc", "stand"].value == pytest.approx(level + 0.03)
    own = [level + 0.02 * i + 0.01 * s + 0.003 * (s * i % 3) for s in range(1, 6) for i in range(4)]
    entry = area["100000-1000000", "cudc", SCORE]
    assert entry.value == pytest.approx(np.mean(own))
    assert (entry.n, len(entry.records)) == (5, 5 * 4 * 4)
    assert entry.interval.low < entry.value < entry.interval.high
    text = to_markdown(study)
    assert "log10 of the number of transitions" in text
    assert "trapezoidal rule" in text


def test_area_weights() -> None:
    assert area_weights((100_000, 1_000_000)) == pytest.approx([0.5, 0.5])
    sizes = (100_000, 200_000, 500_000, 1_000_000)
    scores = np.array([0.1, 0.7, 0.4, 0.9])
    assert area_weights(sizes).sum() == pytest.approx(1)
    assert area_weights(sizes) @ scores == pytest.approx(np.trapezoid(scores, np.log10(sizes)) / (np.log10(sizes[-1]) - np.log10(sizes[0])))


def test_only_the_size_may_differ(runs: Callable) -> None:
    records = [
        *sized(runs, "cudc", LEVELS),
        *runs("cudc", 0.9, dataset_used=50_000, overrides={"gamma": 0.5}, dataset_steps=1_000_000),
        *runs("cudc", 0.9, dataset_used=60_000, profile="smoke", dataset_steps=1_000_000),
        *runs("cudc", 0.9, dataset_used=70_000, algorithm="cql", dataset_steps=1_000_000),
    ]
    found = {
        (one.group, one.algorithm): [part.key for part in grid(one, "returns").parts] for one in studies_of(records) if one.name == "sizes"
    }
    assert found == {
        ("cpu", "td3"): [100_000, 200_000, 500_000, 1_000_000], ("cpu (evaluate: gamma=0.5)", "td3"): [50_000],
        ("smoke", "td3"): [60_000], ("cpu", "cql"): [70_000],
    }  # fmt: skip
    (single,) = [one for one in studies_of(records) if (one.name, one.group) == ("sizes", "smoke")]
    assert [table.name for table in single.tables] == ["returns"]  # One size has no area.


def test_a_method_that_lacks_a_size_takes_nothing_from_the_others(runs: Callable) -> None:
    lacking = {used: level for used, level in LEVELS.items() if used != 200_000}
    records = [*sized(runs, "cudc", LEVELS), *sized(runs, "icm", LEVELS), *sized(runs, "apt", lacking)]
    study = only(records, "sizes")
    assert [line.labels for line in grid(study, "area").parts[0].lines] == [("icm",), ("cudc",)]
    assert study.notes == ("apt has no area under the curve: it lacks 200K transitions.",)
    assert cells(grid(study, "returns"))[200_000, "apt", "walk"] is None
    # A seed without one of the sizes has no area; it has its returns.
    fewer = [one for one in records if (one.dataset.method, one.dataset.seed, one.dataset.used) != ("icm", 3, 500_000)]
    study = only(fewer, "sizes")
    assert cells(grid(study, "area"))["100000-1000000", "icm", "walk"].n == 4
    assert cells(grid(study, "returns"))[100_000, "icm", "walk"].n == 5


# Learners


def test_learners_stand_side_by_side_with_their_rank_correlation(runs: Callable) -> None:
    td3 = {"random": 0.1, "icm": 0.3, "apt": 0.4, "proto": 0.35, "cudc": 0.5}
    cql = {"random": 0.2, "icm": 0.25, "apt": 0.22, "proto": 0.4, "cudc": 0.3, "aps": 0.1}
    records = [
        one for algo, levels in (("cql", cql), ("td3", td3)) for m, level in levels.items() for one in runs(m, level, algorithm=algo)
    ]
    study = only(records, "learners")
    assert (study.folder, study.slug, study.algorithm, study.domain) == ("cpu.learners", "cpu.learners.learners", None, None)
    for name, statistic in (("iqm", lambda s: stats.trim_mean(s, 0.25, axis=None)), ("mean", np.mean)):
        table = grid(study, name)
        assert [column.name for column in table.columns] == ["td3", "cql"]
        assert [part.key for part in table.parts] == ["walker, 20000", "walker, 10000"]
        found = cells(table)
        for algo, levels in (("cql", cql), ("td3", td3)):
            for method in levels:
                scores = [one.final.mean / 1000 for one in records if (one.algorithm, one.dataset.method) == (algo, method)]
                entry = found["walker, 20000", method, algo]
                assert entry.value == pytest.approx(statistic(scores))
                assert {one.algorithm for one in entry.records} == {algo}
                assert (entry.n, len(entry.records)) == (5, 20)
        assert found["walker, 20000", "aps", "td3"] is None
    agreement = cells(grid(study, "agreement"))
    # Of ten pairs of methods, seven are in the same order: (icm, apt), (proto, apt) and (proto, cudc) are not.
    assert agreement["walker, 20000", "td3", "cql", "tau"].value == pytest.approx((7 - 3) / 10)
    assert agreement["walker, 20000", "td3", "cql", "methods"].value == 5
    wanted = stats.kendalltau(list(td3.values()), [cql[method] for method in td3])
    assert agreement["walker, 20000", "td3", "cql", "p"].value == pytest.approx(wanted.pvalue)


def test_learners_of_other_groups_or_tasks_are_not_ranked_together(runs: Callable) -> None:
    methods = {"random": 0.1, "icm": 0.3, "cudc": 0.5}
    td3 = [one for method, level in methods.items() for one in runs(method, level)]
    assert studies_of([*td3, *(one for m, v in methods.items() for one in runs(m, v, algorithm="cql", profile="smoke"))]) == []
    study = only([*td3, *(one for m, v in methods.items() for one in runs(m, v, algorithm="cql", tasks=TASKS[:2]))], "learners")
    assert [table.name for table in study.tables] == ["mean", "iqm"]
    assert "walker, 20K steps: the learners have different tasks: td3 has 4, cql has 2." in study.notes
    two = [one for method, level in list(methods.items())[:2] for algo in ("td3", "cql") for one in runs(method, level, algorithm=algo)]
    assert [table.name for table in only(two, "learners").tables] == ["mean", "iqm"]  # Two methods always agree, or never.


def test_learners_over_several_domains_come_first(runs: Callable) -> None:
    records = []
    for algo, method in itertools.product(("td3", "cql"), ("random", "icm", "cudc")):
        records += runs(method, algorithm=algo)
        records += runs(method, 0.1, tasks=("stand", "walk", "run", "jump"), dataset_domain="quadruped", algorithm=algo,
                        dataset_id=f"quadruped/{method}")  # fmt: skip
    study = only(records, "learners")
    assert [part.key for part in grid(study, "iqm").parts][:3] == [f"{ALL}, 20000", "walker, 20000", "quadruped, 20000"]
    assert len(cells(grid(study, "iqm"))[f"{ALL}, 20000", "cudc", "cql"].records) == 40


# What is missing


def missing(report: Report) -> list[tuple[object, ...]]:
    return [(one.study, one.method, one.tasks, one.seeds) for one in report.missing]


def test_main_tables_do_not_ask_for_studies(runs: Callable, save: Callable) -> None:
    jaco = runs("cudc", 0.1, tasks=("reach_top_left",), dataset_domain="jaco", dataset_id="jaco/reach_top_left/cudc-v0", seeds=range(1, 2))
    report = make_leaderboard(save(*runs("cudc"), *runs("cudc-no-pe", seeds=range(1, 3)), *jaco), None)
    assert [one[:2] for one in missing(report)] == [
        (None, "cudc"), *(("ablation", method) for method in ABLATION.methods if method not in ("cudc", "cudc-no-pe")),
    ]  # fmt: skip
    assert {one.domain for one in report.missing if one.study} == {"walker"}
    assert all((one.tasks, one.seeds) == (TASKS, (1, 2)) for one in report.missing if one.study)
    assert str(report.missing[1]) == (
        "ablation: td3 on cudc-no-entropy in walker, profile cpu, stand, walk, run, flip, seeds 1,2: cudc-bench evaluate --algo td3"
        " --domain walker --method cudc-no-entropy --tasks stand,walk,run,flip --seeds 1,2 --profile cpu"
    )


def test_what_is_there_under_another_name_is_not_missing(runs: Callable, save: Callable) -> None:
    report = make_leaderboard(save(*(one for method in K_BOUND.methods[1:] for one in runs(method)), *runs("cudc-no-vary")), None)
    assert [one for one in missing(report) if one[0] == "k-bound"] == []


def test_of_two_studies_one_asks_for_what_both_lack(runs: Callable, save: Callable) -> None:
    report = make_leaderboard(save(*runs("cudc-kmax4"), *runs("cudc-no-pe"), *runs("cudc-reach")), None)
    asked = [one for one in missing(report) if one[1] in ("cudc-no-vary", "cudc-kmax3")]
    assert len(asked) == 1
    assert sum(one[1] in ("cudc", "cudc-kmax6") for one in missing(report)) == 1


def test_sizes_lack_what_others_have(runs: Callable, save: Callable) -> None:
    records = [*sized(runs, "cudc", {100_000: 0.2, None: 0.6}, seeds=range(1, 3)), *sized(runs, "icm", {100_000: 0.1}, seeds=range(1, 3))]
    gone = [one for one in records if (one.dataset.used, one.dataset.seed, one.dataset.task) != (100_000, 2, "run")]
    for index, record in enumerate(gone):
        (save() / f"{index}.json").write_text(record.model_dump_json())
    report = make_leaderboard(save(), None)
    lines = [str(one) for one in report.missing]
    assert len(lines) == 3
    assert sum("--method icm --tasks run --seeds 2 --profile cpu --dataset-size 100000" in line for line in lines) == 1
    assert sum("--method cudc --tasks run --seeds 2 --profile cpu --dataset-size 100000" in line for line in lines) == 1
    (full,) = [line for line in lines if "--dataset-size" not in line]
    assert full.startswith("sizes: td3 on icm in walker, profile cpu, stand, walk, run, flip, seeds 1,2: cudc-bench evaluate")


def test_learners_lack_what_others_have(runs: Callable, save: Callable) -> None:
    report = make_leaderboard(save(*runs("cudc"), *runs("icm"), *runs("cudc", algorithm="cql", seeds=range(1, 3))), None)
    assert missing(report) == [("learners", "icm", TASKS, (1, 2))]
    assert "--algo cql" in str(report.missing[0])


# Files and figures


@pytest.fixture
def everything(runs: Callable) -> list[Record]:
    records = [one for method in STUDY_METHODS | {"icm", "apt", "cudc"} for one in runs(method, seeds=range(1, 3))]
    records += [one for method in ("random", "icm", "cudc") for one in runs(method, seeds=range(1, 3), algorithm="cql")]
    return [*records, *sized(runs, "cudc", {100_000: 0.2, 300_000: 0.4}, seeds=range(1, 3))]


def test_every_study_is_shown_in_every_format_and_repeatable(everything: list[Record]) -> None:
    studies, again = (studies_of(records) for records in (everything, everything[::-1]))
    assert [study.slug.rpartition(".")[2] for study in studies] == [
        "variants", "schedule", "ablation", "k-bound", "controls", "readings", "sizes", "learners",
    ]  # fmt: skip
    assert len({study.slug for study in studies}) == len(studies)
    for study, other in zip(studies, again, strict=True):
        assert (to_markdown(study), to_latex(study)) == (to_markdown(other), to_latex(other))
        assert to_latex(study).isascii()
        for table, same in zip(study.tables, other.tables, strict=True):
            assert to_csv(study, table) == to_csv(other, same)
            rows = list(csv.reader(io.StringIO(to_csv(study, table))))
            assert {len(row) for row in rows} == {len(rows[0])}
            assert len(rows) == 1 + sum(len(part.lines) for part in table.parts) * len(table.columns)
            for _, _, column, entry in table.entries():
                if entry is not None and column.name not in ("reported in the paper", "difference", "tau", "p", "methods"):
                    assert entry.records
        screen = Console(file=io.StringIO(), width=100, force_terminal=False)
        screen.print(to_rich(study))
        assert study.heading in screen.file.getvalue()  # type: ignore[attr-defined]
        assert study.commands == sorted({one.command for one in study.records})


def test_files_and_terminal_show_the_same_cells(runs: Callable) -> None:
    study = only([*runs("cudc", 0.6), *runs("cudc-no-pe", 0.3)], "ablation")
    markdown = [token for token in MarkdownIt().enable("table").parse(to_markdown(study)) if token.type == "inline"]
    latex = to_latex(study)
    screen = Console(file=io.StringIO(), width=150, force_terminal=False)
    screen.print(to_rich(study))
    terminal = screen.file.getvalue()  # type: ignore[attr-defined]
    texts = [token.content for token in markdown]
    for _, _, column, entry in grid(study, "returns").entries():
        if column.name != SCORE:
            shown = (f"{entry.value:.0f}", f"{entry.std:.0f}")
            assert any(text.replace("**", "") == f"{shown[0]} ± {shown[1]} (5)" for text in texts)
            assert f"{shown[0]} $\\pm$ {shown[1]} (5)" in latex
            assert f"{shown[0]}±{shown[1]} (5)" in terminal
    ratio = cells(grid(study, "relative"))[20_000, "cudc-no-pe", "mean"]
    text = f"{ratio.value:.3f} [{ratio.interval.low:.3f}, {ratio.interval.high:.3f}] (5)"
    assert text in texts
    assert text in latex
    assert f"{ratio.interval.low:.2f} to {ratio.interval.high:.2f}" in terminal
    assert r"\textbf{" in latex


def test_numbers_are_rounded_without_a_minus_for_zero() -> None:
    assert number(-0.3, Column("")) == "0"
    assert number(-0.04, Column("", 1, signed=True)) == "+0.0"
    assert number(-1.25, Column("", 1, signed=True)) == "-1.2"


@pytest.mark.parametrize("name", ["k-bound", "sizes", "learners"])
def test_figures_are_repeatable_xml_with_their_methods_as_text(name: str, everything: list[Record]) -> None:
    first, again = (only(records, name) for records in (everything, everything[::-1]))
    figure = {"k-bound": "bound", "sizes": "curves", "learners": "mean"}[name]
    files = figure_files(f"{name}-{figure}", lambda: draw(first.figures[figure]))
    assert files == figure_files(f"{name}-{figure}", lambda: draw(again.figures[figure]))
    texts = {element.text for element in ElementTree.fromstring(files[f"{name}-{figure}.svg"]).iter("{http://www.w3.org/2000/svg}text")}
    assert {"k-bound": {"10K steps", "20K steps", "largest k", "8"}, "sizes": {"cudc", "100K", "400K", "transitions"},
            "learners": {"td3", "cql", "random", "cudc"}}[name] <= texts  # fmt: skip


def test_what_figures_draw(everything: list[Record], runs: Callable) -> None:
    bound = only(everything, "k-bound")
    values = cells(grid(bound, "returns"))
    panel = draw(bound.figures["bound"]).axes[1]
    lines = [line for line in panel.lines if len(line.get_xdata()) == 6]
    assert panel.get_title() == "walk"
    for line, milestone in zip(lines, (10_000, 20_000), strict=True):
        assert line.get_ydata() == pytest.approx([values[milestone, f"cudc-kmax{k}", "walk"].value for k in range(3, 9)])
        assert np.round(line.get_xdata()).tolist() == [3, 4, 5, 6, 7, 8]
    sizes = only([*sized(runs, "cudc", LEVELS), *sized(runs, "icm", LEVELS)], "sizes")
    *tasks, last = draw(sizes.figures["curves"]).axes[:5]
    assert [panel.get_title() for panel in tasks] == list(TASKS)
    values = cells(grid(sizes, "returns"))
    assert last.lines[1].get_xdata().tolist() == [100_000, 200_000, 500_000, 1_000_000]
    assert last.lines[1].get_ydata() == pytest.approx([values[size, "cudc", SCORE].value for size in last.lines[1].get_xdata()])
    assert tasks[2].lines[1].get_ydata() == pytest.approx([values[size, "cudc", "run"].value for size in last.lines[1].get_xdata()])
    bars = draw(only(everything, "variants").figures["bars"]).axes[1]
    values = cells(grid(only(everything, "variants"), "returns"))
    assert [bar.get_height() for bar in bars.patches] == pytest.approx(
        [values[step, method, "walk"].value for method in VARIANTS.methods for step in (10_000, 20_000)]
    )


@pytest.mark.parametrize("width", ["short", "long"])
@pytest.mark.parametrize("count", [6, 12])
def test_no_labels_of_bars_overlap(count: int, width: str, runs: Callable) -> None:
    names = [f"m{'ethod' * 11 if width == 'long' else ''}{i}" for i in range(count)]
    table = build_tables([one for name in names for one in runs(name, seeds=range(1, 3))])[0][0]
    with style.context(_STYLE, after_reset=True):
        figure = draw_bars(table.runs)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        texts = [one for one in figure.findobj(Text) if one.get_visible() and one.get_text()]
        boxes = [one.get_window_extent(canvas.get_renderer()) for one in texts]
    assert not [(a, b) for a, b in itertools.combinations(range(len(boxes)), 2) if boxes[a].overlaps(boxes[b])]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.width and box.y0 >= 0 and box.y1 <= figure.bbox.height for box in boxes)
    assert len(figure.legends[0].get_texts()) == count


def test_methods_of_a_study_can_be_told_apart_and_legends_never_merge_them() -> None:
    for spec in SPECS:
        shown = styles(spec.methods)
        assert len({(style["color"], style["linestyle"]) for style in shown.values()}) == len(spec.methods)
        assert len({(area["facecolor"], area["hatch"]) for area in map(filled, shown.values())}) == len(spec.methods)
    alike = [f"{'a' * 60}{i}" for i in range(3)]
    names = legend(styles(alike))
    assert len(names) == 3
    assert max(map(len, names)) == 28


def test_hostile_texts_are_shown_plainly(make_record: Callable) -> None:
    hostile = "<script>alert(1)</script> | `x` \\input{/etc/passwd} $m$ \x1b[31m \u202e =cmd"
    changes = {"overrides": {hostile: hostile}, "dataset_overrides": {hostile: hostile}, "command": "cudc-bench evaluate"}
    grid_of = itertools.product(("cudc", "cudc-kmax4", "icm"), TASKS, (1, 2), (None, 100_000), ("td3", "cql"))
    records = [make_record(m, task, s, dataset_used=used, algorithm=algo, **changes) for m, task, s, used, algo in grid_of]
    studies = studies_of(records)
    assert {study.name for study in studies} == {"k-bound", "sizes", "learners"}
    for study in studies:
        assert Path(study.slug).name == study.slug
        texts = [to_markdown(study), to_latex(study), *(to_csv(study, table) for table in study.tables)]
        screen = Console(file=io.StringIO(), width=150, force_terminal=False)
        screen.print(to_rich(study))
        for text in (*texts, screen.file.getvalue()):  # type: ignore[attr-defined]
            assert all(character.isprintable() or character == "\n" for character in text)
        assert "<script" not in texts[0].replace("\\<script", "")
        assert "\\input" not in texts[1]
        for text in texts[2:]:
            assert not any(cell[:1] in "=+@" for row in csv.reader(io.StringIO(text)) for cell in row if cell)


def test_the_command_prints_and_writes_studies(runs: Callable, save: Callable, cli: Callable, tmp_path: Path) -> None:
    results = save(*(one for m in ("cudc", "cudc-kmax4") for one in runs(m, seeds=range(1, 3), tasks=("walk",))))
    done = cli("leaderboard", str(results), "--output", str(tmp_path / "out"), "--figures")
    assert done.code == 0, done.err
    assert "The upper bound of k: walker, td3, profile cpu" in done.out
    written = {path.name for path in (tmp_path / "out" / "cpu.td3.walker").iterdir() if path.name.startswith("k-bound")}
    figures = {f"k-bound-{name}.{kind}" for name in ("bars", "curves", "bound") for kind in ("svg", "pdf")}
    assert written == {"k-bound.md", "k-bound.tex", "k-bound-returns.csv", "k-bound.html", *figures}
    assert "missing: k-bound: td3 on cudc-kmax5 in walker" in done.err
    assert "cudc-kmax4" not in (tmp_path / "out" / "cpu.td3.walker" / "table.md").read_text()
