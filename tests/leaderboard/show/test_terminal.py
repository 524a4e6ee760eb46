"""Tables in narrow terminals, and the same numbers for scripts: nothing is broken, lost or takes another's name."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from statistics import fmean, stdev
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console, RenderableType

from cudc_bench.cli.tables import Table as Shown
from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.datasets.quality import Quality, QualityTable, RewardDensity, TaskMeasures
from cudc_bench.leaderboard.numbers.table import Table, build_tables
from cudc_bench.leaderboard.output.report import Report
from cudc_bench.leaderboard.show.documents import of_leaderboard, of_stats
from cudc_bench.leaderboard.show.terminal import of_overall, of_quality, of_study, of_table

MakeRecord = Callable[..., Any]
LONG = ("cudc", *(f"wandering-{what}-{which}" for what in ("explorer", "seeker") for which in ("alone", "again", "twice")), "random")
JACO = ("reach_top_left", "reach_top_right", "reach_bottom_left", "reach_bottom_right")


def shown(part: RenderableType, width: int) -> str:
    file = io.StringIO()
    Console(file=file, width=width, highlight=False).print(part)
    return file.getvalue()


def check(part: Any, width: int) -> str:
    """Show it, and see that every cell stands there whole and every row has a name of its own."""
    text = shown(part, width)
    assert max(map(len, text.splitlines())) <= width
    for table in (one for one in part.renderables if isinstance(one, Shown)):
        for line in (line for line in table.rows if line.cells):
            for number in (piece for cell in line.cells[table.keys :] for piece in cell.text.split("\n")):
                assert re.search(rf"(?:^|  ){re.escape(number)}(?:  |$|,)", text, re.MULTILINE), number
        alone = shown(table, width)
        names = {line.cells[0].text for line in table.rows if line.cells}
        legend = dict(re.findall(r"^(.+?): (\S.*)$", alone, re.MULTILINE))
        firsts = {one for line in alone.splitlines() for one in [re.split(r"  +", line)[0]] if one in names or one in legend}
        assert {legend.get(one, one) for one in firsts} == names
    return text


def table_of(make_record: MakeRecord, methods: tuple[str, ...], domain: str, tasks: tuple[str, ...]) -> Table:
    records = [
        make_record(method=method, task=task, seed=seed, dataset_domain=domain, final=[812.3 + 7.1 * seed + 20 * place])
        for place, method in enumerate(methods) for task in tasks for seed in (1, 2, 3)
    ]  # fmt: skip
    (table,), _ = build_tables(records, None)
    return table


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize(("domain", "tasks"), [("walker", ("stand", "walk", "run", "flip")), ("jaco", JACO)])
@pytest.mark.parametrize("count", [1, 4, len(LONG)])
def test_returns_are_whole_and_methods_different(
    count: int, domain: str, tasks: tuple[str, ...], width: int, make_record: MakeRecord
) -> None:
    table = table_of(make_record, LONG[:count], domain, tasks)
    text = check(of_table(table), width)
    assert all(method in text for method in table.methods)  # in a row, a head, or the legend
    assert len(set(table.methods)) == count


@pytest.fixture(scope="module")
def report(make_record: MakeRecord, tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Of methods with three seeds each, which have a comparison and a study."""
    from cudc_bench.artefacts.records import record_path, write_record

    results = tmp_path_factory.mktemp("results")
    for place, method in enumerate(("cudc", "cudc-kmax3", "cudc-kmax4", "cudc-no-inverse", "random", "icm")):
        for task in ("stand", "walk", "run", "flip"):
            for seed in (1, 2, 3):
                record = make_record(method=method, task=task, seed=seed, final=[300.0 + 90 * place + 31 * seed])
                path = record_path(results, record.dataset.id, record.algorithm, seed, record.profile)
                path.parent.mkdir(parents=True, exist_ok=True)
                write_record(path, record)
    return make_leaderboard(results, None, datasets=False)


@pytest.mark.parametrize("width", [60, 80])
def test_comparisons_and_studies_are_whole(width: int, report: Report) -> None:
    assert report.overall
    assert report.studies
    for overall in report.overall:
        check(of_overall(overall), width)
    for study in report.studies:
        check(of_study(study), width)


def test_a_script_gets_the_numbers_of_the_tables(report: Report) -> None:
    found = of_leaderboard(report.tables, report.overall, report.studies, report.missing, report.problems, [Path("a.md")])
    assert found.files == ["a.md"]
    (table,) = found.tables
    assert (table.group, table.profile, table.algorithm, table.domain) == ("cpu", "cpu", "td3", "walker")
    cell = next(one for one in table.cells if (one.milestone, one.task, one.method) == (20_000, "walk", "cudc"))
    returns = [331.0, 362.0, 393.0]
    assert (cell.mean, cell.std, cell.seeds, cell.score) == (fmean(returns), stdev(returns), 3, None)
    best = {(one.milestone, one.task, one.method) for one in table.cells if one.best}
    assert best == {place for place, entry in report.tables[0].cells.items() if entry.best}
    assert (20_000, "walk", "icm") in best
    headline = next(one for one in found.overall[0].comparisons if one.headline)
    shown_one = report.overall[0].headline
    for standing, own in zip(headline.standings, shown_one.standings, strict=True):
        assert (standing.method, standing.mean.value) == (own.method, own.estimates["mean"].value)
        interval = own.estimates["mean"].interval
        assert interval is not None
        assert (standing.mean.low, standing.mean.high) == (interval.low, interval.high)
    assert {(one.method, one.other) for one in headline.pairs if one.better} == {
        (pair.method, pair.other) for pair in shown_one.pairs if pair.better
    }
    for study, own_study in zip(found.studies, report.studies, strict=True):
        cells = [entry.value for grid in own_study.tables for *_, entry in grid.entries() if entry is not None]
        assert [one.value for grid in study.tables for one in grid.cells] == cells
    assert [one.command for one in found.missing] == [one.command for one in report.missing]


def quality(method: str, tasks: tuple[str, ...]) -> Quality:
    density = RewardDensity(0.123, (0.1, 0.2, 0.3, 0.4), 0.9, 0.8, 0.25, 0.125, (1.0,) * 50)
    manifest: Any = SimpleNamespace(label=method, seed=1)
    beside = {tasks[0]: TaskMeasures(0.25, None, 0.75, 1.0)}
    return Quality("jaco/x-v0", manifest, dict.fromkeys(tasks, density), None, float("-inf"), (0.5, 0.25), 0.125, None, tasks=beside)


@pytest.mark.parametrize("width", [60, 80])
def test_what_datasets_are_worth_is_whole(width: int) -> None:
    methods = ("cudc-no-regularize (ExORL)", "cudc-no-inverse (ExORL)", "proto (ExORL)", "random")
    table = QualityTable("cpu", "jaco", JACO, "slug", methods, tuple(quality(method, JACO) for method in methods))
    check(of_quality(table), width)
    (found,) = of_stats([table], [], ["a remark"], [Path("a.md")]).tables
    assert [one.method for one in found.datasets] == list(methods)
    one = found.datasets[0]
    assert one.rewards["reach_top_left"].quantiles == [0.1, 0.2, 0.3, 0.4]
    assert (one.coverage_cells, one.particle_entropy, one.action_saturated, one.state_action_pairs) == (None, None, 0.125, None)
    assert {task: found.model_dump() for task, found in one.tasks.items()} == {
        "reach_top_left": {"trajectory_quality": 0.25, "coverage_ratio": None, "expert_recall": 0.75, "expert_precision": 1.0}
    }
