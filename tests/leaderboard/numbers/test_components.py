"""Variance between datasets and between trainings on one, and that several trainings on a dataset count once everywhere else."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable

import numpy as np
import pytest
from rich.console import Console

from cudc_bench.artefacts.records import Evaluation, Record
from cudc_bench.leaderboard.numbers.components import ALL_TASKS, BETWEEN, POOLED, WITHIN, components
from cudc_bench.leaderboard.numbers.figures import curve
from cudc_bench.leaderboard.numbers.grid import Entry
from cudc_bench.leaderboard.numbers.overall import build_overall
from cudc_bench.leaderboard.numbers.studies import build_studies
from cudc_bench.leaderboard.numbers.study import Study
from cudc_bench.leaderboard.numbers.table import build_blocks, build_tables, tables_of
from cudc_bench.leaderboard.output.report import study_files
from cudc_bench.leaderboard.show.csv import of_grid as to_csv
from cudc_bench.leaderboard.show.csv import of_overall as overall_to_csv
from cudc_bench.leaderboard.show.csv import of_scores as scores_to_csv
from cudc_bench.leaderboard.show.csv import of_table as table_to_csv
from cudc_bench.leaderboard.show.figures.runs import draw_bars, draw_curves
from cudc_bench.leaderboard.show.latex import of_study as to_latex
from cudc_bench.leaderboard.show.markdown import of_study as to_markdown
from cudc_bench.leaderboard.show.terminal import of_study as to_rich
from cudc_bench.leaderboard.site.pages import site_files
from cudc_bench.leaderboard.site.parts import Site

# Davies and Goldsmith 1972, table 6.1 (lme4's "Dyestuff"): yields of five samples of each of six batches.
DYESTUFF = [
    [1545, 1440, 1440, 1520, 1580], [1540, 1555, 1490, 1560, 1495], [1595, 1550, 1605, 1510, 1560],
    [1445, 1440, 1595, 1465, 1545], [1595, 1630, 1515, 1635, 1625], [1520, 1455, 1450, 1480, 1445],
]  # fmt: skip
TASKS = ("stand", "walk", "run", "flip")


def test_estimates_are_those_that_are_published() -> None:
    found = components([DYESTUFF])
    assert found is not None
    assert (found.between, found.within) == (pytest.approx(1764.05), pytest.approx(2451.25))
    assert (found.datasets, found.trainings) == (6, 30)
    assert found.share == pytest.approx(1764.05 / 4215.3)


def expectation(estimator: Callable[[np.ndarray], float], design: list[list[int]], between: float, within: float) -> float:
    """The expected value of a quadratic form in the returns: the trace of its matrix times their covariance."""
    labels = [(m, i) for m, sizes in enumerate(design) for i, n in enumerate(sizes) for _ in range(n)]
    covariance = within * np.eye(len(labels)) + between * np.array([[a == b for b in labels] for a in labels])
    unit = np.eye(len(labels))
    diagonal = [estimator(one) for one in unit]
    matrix = [[(estimator(unit[i] + unit[j]) - diagonal[i] - diagonal[j]) / 2 if i != j else diagonal[i] for j in range(len(labels))]
              for i in range(len(labels))]  # fmt: skip
    return float(np.trace(np.array(matrix) @ covariance))


def shaped(values: np.ndarray, design: list[list[int]]) -> list[list[list[float]]]:
    rest = iter(values.tolist())
    return [[[next(rest) for _ in range(n)] for n in sizes] for sizes in design]


@pytest.mark.parametrize("design", [[[2, 2, 2]], [[3, 1, 2, 1]], [[2, 1], [1, 1, 4], [3]]])
def test_estimates_are_right_on_average_whatever_is_missing(design: list[list[int]]) -> None:
    """Exactly: of any numbers of trainings on a dataset, and pooled over methods."""

    def between(values: np.ndarray) -> float:
        found = components(shaped(values, design))
        assert found is not None
        assert found.estimate is not None
        return found.estimate

    def within(values: np.ndarray) -> float:
        found = components(shaped(values, design))
        assert found is not None
        return found.within

    assert expectation(between, design, 7.0, 3.0) == pytest.approx(7.0)
    assert expectation(within, design, 7.0, 3.0) == pytest.approx(3.0)


def test_a_negative_estimate_is_shown_as_none() -> None:
    found = components([[[0.0, 10.0], [10.0, 0.0], [1.0, 9.0]]])
    assert found is not None
    assert found.estimate is not None
    assert found.estimate < 0
    assert (found.between, found.share) == (0.0, 0.0)


def test_there_must_be_several_trainings_and_for_the_rest_several_datasets() -> None:
    assert components([]) is None
    assert components([[[1.0], [2.0]]]) is None
    assert components([[[], [1.0]]]) is None
    one = components([[[1.0, 3.0]]])
    assert one is not None
    assert (one.between, one.estimate, one.share, one.within) == (None, None, None, pytest.approx(2.0))
    same = components([[[1.0, 1.0], [1.0, 1.0]]])
    assert same is not None
    assert (same.between, same.within, same.share) == (0.0, 0.0, None)


def test_there_are_intervals_where_there_is_enough() -> None:
    few = components([DYESTUFF[:4]])
    assert few is not None
    assert few.between_interval is None
    assert few.within_interval is not None
    many = components([[one[:2] for one in DYESTUFF[:3]], [one[2:4] for one in DYESTUFF]])
    assert many is not None
    assert many.between_interval is not None
    same = components([[[1.0, 1.0]] * 5])
    assert same is not None
    assert (same.between_interval.low, same.between_interval.high) == (0.0, 0.0)  # type: ignore[union-attr]
    apart = components([[[float(i)] * 2 for i in range(5)]])
    assert apart is not None
    # Trainings that do not differ: the interval of a normal variance, of the datasets' means.
    assert (apart.between_interval.low, apart.between_interval.high) == pytest.approx((10 / 11.14329, 10 / 0.4844186))  # type: ignore[union-attr]


@pytest.mark.parametrize(("between", "design"), [(4.0, [[2] * 5]), (0.5, [[3] * 6]), (4.0, [[1, 2, 3, 1, 2, 4]]), (1.0, [[2, 2, 1]] * 4)])
def test_intervals_hold_the_truth(between: float, design: list[list[int]]) -> None:
    random = np.random.default_rng(5)
    repeats, held = 1000, np.zeros(2)
    for _ in range(repeats):
        data = [[(random.normal(0, between**0.5) + random.normal(0, 1, n)).tolist() for n in sizes] for sizes in design]
        found = components(data)
        assert found is not None
        for index, (interval, truth) in enumerate(((found.between_interval, between), (found.within_interval, 1.0))):
            assert interval is not None
            held[index] += interval.low <= truth <= interval.high
    print(f"coverage, variance {between} between datasets: {100 * held[0] / repeats:.1f}, within: {100 * held[1] / repeats:.1f}")
    assert (held / repeats).min() > 0.95 - 3 * np.sqrt(0.95 * 0.05 / repeats)


# From records


@pytest.fixture
def runs(make_record: Callable) -> Callable[..., list[Record]]:
    """Records on Walker with returns of (dataset seed, training seed, task)."""

    def make(method: str, trainings: dict[int, int], tasks: tuple[str, ...] = TASKS, **changes: object) -> list[Record]:
        """``trainings``: how many on the dataset of each collector seed."""
        return [
            make_record(
                method, task, seed, [(0, [0.0]), (10_000, [0.5 * value]), (20_000, [1.0])], [value],
                dataset_id=f"walker/{task}/{method}-seed{seed}-v0", **changes,
            ).model_copy(update={"seed": training})
            for index, task in enumerate(tasks)
            for seed, count in trainings.items()
            for training in range(1, count + 1)
            for value in [300 + 100 * index + 30 * np.sin(5 * seed + index) + 20 * np.cos(11 * seed * training + 3 * index + len(method))]
        ]  # fmt: skip

    return make


def studies_of(records: list[Record]) -> dict[str, Study]:
    blocks, _ = build_blocks(records)
    return {study.name: study for study in build_studies(blocks, build_overall(tables_of(blocks)))}


def cells(study: Study, table: str) -> dict[tuple[object, ...], Entry | None]:
    grid = next(one for one in study.tables if one.name == table)
    return {(part.key, *line.labels, column.name): entry for part, line, column, entry in grid.entries()}


def value(entry: Entry | None) -> float:
    assert entry is not None
    return entry.value


def test_it_is_shown_only_if_a_dataset_was_trained_on_with_several_seeds(runs: Callable) -> None:
    once = dict.fromkeys(range(1, 6), 1)
    assert "variance" not in studies_of([*runs("cudc", once), *runs("icm", once)])
    study = studies_of([*runs("cudc", once | {3: 2}), *runs("icm", once)])["variance"]
    assert [column.name for column in study.tables[0].columns] == ["cudc"]
    assert study.folder == "cpu.td3.walker"


def test_components_are_those_of_the_records(runs: Callable) -> None:
    records = [*runs("cudc", {1: 2, 2: 2, 3: 3, 4: 1, 5: 2}), *runs("icm", {1: 3, 2: 3}), *runs("apt", {1: 1, 2: 1})]
    study = studies_of(records)["variance"]
    found = cells(study, "components")
    assert [column.name for column in study.tables[0].columns] == ["icm", "cudc", POOLED]

    def returns(method: str, task: str) -> list[list[float]]:
        of = [one for one in records if (one.dataset.method, one.dataset.task) == (method, task)]
        return [[one.final.mean for one in of if one.dataset.seed == seed] for seed in sorted({one.dataset.seed for one in of})]

    for task in TASKS:
        expected = {"icm": components([returns("icm", task)]), "cudc": components([returns("cudc", task)]),
                    POOLED: components([returns("icm", task), returns("cudc", task)])}  # fmt: skip
        for name, parts in expected.items():
            assert parts is not None
            between, within = found[20_000, task, BETWEEN, name], found[20_000, task, WITHIN, name]
            assert (value(between), value(within)) == pytest.approx((parts.between, parts.within))
            assert between is not None
            assert within is not None
            assert (between.interval, within.interval) == (parts.between_interval, parts.within_interval)
            assert (between.n, within.n) == (parts.datasets, parts.trainings)
            assert len(within.records) == parts.trainings
    mean = [
        [float(np.mean([returns("cudc", task)[i][j] for task in TASKS])) for j in range(len(of))]
        for i, of in enumerate(returns("cudc", "walk"))
    ]
    whole = components([mean])
    assert whole is not None
    assert value(found[20_000, ALL_TASKS, WITHIN, "cudc"]) == pytest.approx(whole.within)
    assert value(found[10_000, "walk", WITHIN, "cudc"]) == pytest.approx(value(found[20_000, "walk", WITHIN, "cudc"]) / 4)
    share = cells(study, "share")[20_000, "walk", "cudc"]
    parts = value(found[20_000, "walk", BETWEEN, "cudc"]), value(found[20_000, "walk", WITHIN, "cudc"])
    assert value(share) == pytest.approx(parts[0] / sum(parts))


def test_a_negative_one_has_a_note(make_record: Callable) -> None:
    records = [make_record(seed=seed, final=[score]).model_copy(update={"seed": training})
               for seed, scores in {1: (100.0, 900.0), 2: (900.0, 120.0)}.items() for training, score in enumerate(scores)]  # fmt: skip
    study = studies_of(records)["variance"]
    assert cells(study, "components")[20_000, "walk", BETWEEN, "cudc"] == Entry(0.0, None, None, 2, False, tuple(records))
    assert any(note.startswith("cudc, walk, 20K steps: between datasets the estimate is negative, -") for note in study.notes)
    assert "Preliminary" in study.caption
    assert "the estimate is negative" in to_markdown(study)


def test_training_seeds_without_all_tasks_are_not_in_the_mean_over_tasks(runs: Callable) -> None:
    records = [one for one in runs("cudc", {1: 3, 2: 2}) if (one.dataset.task, one.dataset.seed, one.seed) != ("run", 1, 3)]
    found = cells(studies_of(records)["variance"], "components")
    assert found[20_000, "walk", WITHIN, "cudc"].n == 5  # type: ignore[union-attr]
    assert found[20_000, ALL_TASKS, WITHIN, "cudc"].n == 4  # type: ignore[union-attr]
    alone = cells(studies_of(runs("cudc", {1: 3, 2: 2}, ("walk",)))["variance"], "components")
    assert {key[1] for key in alone} == {"walk"}


def test_every_format_and_the_site_have_it(runs: Callable) -> None:
    records = [*runs("cudc", dict.fromkeys(range(1, 7), 2)), *runs("icm", dict.fromkeys(range(1, 7), 2))]
    study = studies_of(records)["variance"]
    entry = cells(study, "components")[20_000, "walk", BETWEEN, "cudc"]
    assert entry is not None
    assert entry.interval is not None
    shown = f"{entry.value:.0f} [{entry.interval.low:.0f}, {entry.interval.high:.0f}] (6)"
    assert shown in to_markdown(study).replace("\\", "")
    assert shown in to_latex(study)
    line = next(one for one in csv.DictReader(io.StringIO(to_csv(study, study.tables[0])))
                if (one["milestone"], one["task"], one["variance"], one["column"]) == ("20000", "walk", BETWEEN, "cudc"))  # fmt: skip
    assert [float(line[name]) for name in ("value", "low", "high")] == [entry.value, entry.interval.low, entry.interval.high]
    screen = Console(file=io.StringIO(), width=120)
    screen.print(to_rich(study))
    assert BETWEEN in screen.file.getvalue()  # type: ignore[attr-defined]
    assert to_markdown(study) == to_markdown(studies_of(records[::-1])["variance"])
    assert set(study_files(study)) == {"variance.md", "variance.tex", "variance-components.csv", "variance-share.csv"}
    pages = pages_of(records)
    assert shown in pages["cpu.td3.walker/variance.html"]
    assert "variance.html" in pages["cpu.td3.walker/index.html"]


def pages_of(records: list[Record]) -> dict[str, str]:
    blocks, problems = build_blocks(records)
    tables = tables_of(blocks)
    overall = build_overall(tables)
    site = Site(tables, overall, problems, studies=build_studies(blocks, overall), hidden=tables_of(blocks, studies=True))
    return {path: str(content) for path, content in site_files(site).items() if path.endswith(".html")}


# The dataset is the unit of replication


def averaged(records: list[Record]) -> list[Record]:
    """One training on each dataset, with the mean of what all trainings on it have."""
    together: dict[tuple[str, str, int, str, int | None], list[Record]] = {}
    for one in records:
        together.setdefault((one.dataset.method, one.dataset.task, one.dataset.seed, one.algorithm, one.dataset.used), []).append(one)
    return [
        same[0].model_copy(update={
            "curve": [Evaluation(step=evaluation.step, returns=[float(np.mean([one.curve[i].mean for one in same]))])
                      for i, evaluation in enumerate(same[0].curve)],
            "final": Evaluation(step=same[0].final.step, returns=[float(np.mean([one.final.mean for one in same]))]),
        })
        for same in together.values()
    ]  # fmt: skip


def same(text: str, other: str) -> bool:
    """Whether two CSV files are the same up to the rounding of numbers."""

    def read(cell: str) -> float | str:
        try:
            return float(cell)
        except ValueError:
            return cell

    rows, others = ([[read(cell) for cell in row] for row in csv.reader(io.StringIO(one))] for one in (text, other))
    return len(rows) == len(others) > 1 and all(
        a == (pytest.approx(b, rel=1e-9, abs=1e-9) if isinstance(b, float) else b)
        for row, expected in zip(rows, others, strict=True)
        for a, b in zip(row, expected, strict=True)
    )


def test_trainings_on_one_dataset_count_once_as_their_mean(runs: Callable) -> None:
    """In tables, comparisons, studies and figures."""
    trainings = {1: 2, 2: 1, 3: 3, 4: 1, 5: 2}
    records = [one for method in ("cudc", "icm", "cudc-no-pe") for one in runs(method, trainings)]
    records += [*runs("cudc", trainings, algorithm="cql"), *runs("icm", trainings, algorithm="cql")]
    records += runs("cudc", trainings, dataset_used=100_000)
    once = averaged(records)
    assert len(once) < len(records)
    tables, plain = (build_tables(some)[0] for some in (records, once))
    for table, other in zip(tables, plain, strict=True):
        assert same(table_to_csv(table), table_to_csv(other))
        for key, found in table.runs.records.items():
            for part, expected in zip(curve(found), curve(other.runs.records[key]), strict=True):
                assert part == pytest.approx(expected)
        for draw in (draw_curves, draw_bars):
            for panel, beside in zip(draw(table.runs).axes, draw(other.runs).axes, strict=True):
                assert [bar.get_height() for bar in panel.patches] == pytest.approx([bar.get_height() for bar in beside.patches])
    for overall, other in zip(build_overall(tables), build_overall(plain), strict=True):
        assert same(overall_to_csv(overall), overall_to_csv(other))
        assert same(scores_to_csv(overall), scores_to_csv(other))
    studies, others = studies_of(records), studies_of(once)
    assert set(studies) == {*others, "variance"} == {"ablation", "sizes", "learners", "variance"}
    for name, study in others.items():
        for grid, other in zip(study.tables, studies[name].tables, strict=True):
            assert same(to_csv(studies[name], other), to_csv(study, grid))


def test_pages_count_them_once_too(runs: Callable) -> None:
    trainings = {1: 2, 2: 1, 3: 3}
    records = [*runs("cudc", trainings, ("walk",)), *runs("icm", trainings, ("walk",))]
    pages = [pages_of(some)["cpu.td3.walker/task-walk.html"] for some in (records, averaged(records))]
    # A row has a dot and a number for each dataset.
    assert [page.count('r="2.6"') for page in pages] == [2 * 2 * 3] * 2
    tables = [page[page.index("<tbody>") : page.rindex("</tbody>")] for page in pages]
    assert tables[0] == tables[1]
