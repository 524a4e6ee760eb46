"""What is said of the project's own results is what its records say."""

from itertools import product
from pathlib import Path

import pytest

import cudc_bench
from cudc_bench.leaderboard.api import Report, make_leaderboard
from cudc_bench.leaderboard.overall import Comparison
from cudc_bench.leaderboard.render import to_markdown
from cudc_bench.leaderboard.statistics import Interval
from cudc_bench.records import read_record

ROOT = Path(__file__).resolve().parent.parent
BLOCK = ROOT / "results" / "cpu" / "walker"
METHODS = ("random", "icm", "apt", "proto", "aps", "cudc")


@pytest.fixture(scope="module")
def report() -> Report:
    return make_leaderboard(BLOCK, output=None)


@pytest.fixture(scope="module")
def section() -> str:
    return (ROOT / "README.md").read_text().split("\n## Results so far\n")[1].split("\n## ")[0]


def test_the_walker_block_is_whole_and_each_record_keeps_the_rules_for_those_of_others(tmp_path: Path) -> None:
    paths = sorted(BLOCK.rglob("*.json"))
    records = [read_record(path) for path in paths]
    runs = [(record.dataset.method, record.seed, record.dataset.task) for record in records]
    assert sorted(runs) == sorted(product(METHODS, range(1, 6), ("stand", "walk", "run", "flip")))
    assert {record.dataset.seed == record.seed for record in records} == {True}
    assert {(record.profile, record.algorithm, record.dirty) for record in records} == {("cpu", "td3", False)}
    assert len({(record.commit, record.hyperparameters_hash, str(record.versions)) for record in records}) == 1
    assert len({record.dataset.fingerprint for record in records}) == len(records)
    assert len(cudc_bench.submit(BLOCK, by="us", output=tmp_path).files) == len(paths)


def test_the_readmes_tables_are_those_of_the_records(report: Report, section: str) -> None:
    shown = [line for line in section.splitlines() if line.startswith("|")]
    (table,) = report.tables
    (overall,) = report.overall
    returns = [line.replace(" (5)", "") for line in to_markdown(table).splitlines() if line.startswith("|")]
    assert shown == [*returns, *standings(overall.headline)]
    assert not report.problems
    assert not report.missing


def standings(comparison: Comparison) -> list[str]:
    lines = ["| | IQM | mean | better than random | CUDC better than it |", "|:---|---:|---:|---:|---:|"]
    for one in comparison.standings:
        scores = [f"{found.value:.3f} {_ends(found.cluster)}" for found in (one.estimates["iqm"], one.estimates["mean"])]
        pairs = [comparison.pair(*names) if len(set(names)) == 2 else None for names in ((one.method, "random"), ("cudc", one.method))]
        chances = [f"{pair.probability:.2f} {_ends(pair.interval, 2)}{'*' * pair.better}" if pair else "–" for pair in pairs]
        lines.append(f"| {' | '.join([one.method, *scores, *chances])} |")
    return lines


def _ends(interval: Interval | None, digits: int = 3) -> str:
    assert interval is not None
    return f"[{interval.low:.{digits}f}, {interval.high:.{digits}f}]"
