"""What is said of the project's own results is what its records say."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

import cudc_bench
from cudc_bench.leaderboard.api import Report, make_leaderboard
from cudc_bench.leaderboard.overall import Comparison
from cudc_bench.leaderboard.published import reported
from cudc_bench.leaderboard.render import to_markdown
from cudc_bench.leaderboard.scale import OF_LARGEST
from cudc_bench.leaderboard.statistics import Interval
from cudc_bench.records import read_record

ROOT = Path(__file__).resolve().parent.parent
BLOCK = ROOT / "results" / "cpu" / "walker"
METHODS = ("random", "icm", "apt", "proto", "aps", "cudc")
TASKS = ("stand", "walk", "run", "flip")


@pytest.fixture(scope="module")
def report() -> Report:
    return make_leaderboard(BLOCK, output=None, algo="td3")


@pytest.fixture(scope="module")
def section() -> str:
    return (ROOT / "README.md").read_text().split("\n## Results so far\n")[1].split("\n## ")[0]


def test_the_walker_block_is_whole_and_each_record_keeps_the_rules_for_those_of_others(tmp_path: Path) -> None:
    paths = sorted(BLOCK.rglob("td3-seed*.json"))
    records = [read_record(path) for path in paths]
    runs = [(record.dataset.method, record.seed, record.dataset.task) for record in records]
    assert sorted(runs) == sorted(product(METHODS, range(1, 6), TASKS))
    assert all(record.dataset.seed == record.seed for record in records)
    assert {(record.profile, record.algorithm, record.dirty) for record in records} == {("cpu", "td3", False)}
    assert len({(record.commit, record.hyperparameters_hash, str(record.versions)) for record in records}) == 1
    assert len({record.dataset.fingerprint for record in records}) == len(records)
    assert len(cudc_bench.submit(paths, by="us", output=tmp_path).files) == len(paths)


def test_the_readmes_tables_are_those_of_the_records(report: Report, section: str) -> None:
    shown = [line for line in section.splitlines() if line.startswith("|")]
    (table,) = report.tables
    (overall,) = report.overall
    returns = [line.replace(" (5)", "") for line in to_markdown(table).splitlines() if line.startswith("|")]
    assert shown == [*returns, *standings(overall.headline)]
    assert not report.problems
    assert not report.missing


def test_the_readmes_sentences_are_those_of_the_records(report: Report, section: str) -> None:
    said = " ".join(section.split())
    (overall,) = report.overall
    found = overall.headline
    means = {one.method: one.returns[0].mean(1) for one in found.standings}  # (5,) points a task of each collector seed
    average = {method: of.mean() for method, of in means.items()}
    lead = {method: average["cudc"] - average[method] for method in means}
    error = {method: np.sqrt((means["cudc"].var(ddof=1) + of.var(ddof=1)) / len(of)) for method, of in means.items()}
    assert (
        f"({average['cudc']:.0f} and {average['proto']:.0f} points a task: {lead['proto']:.0f}, standard error {error['proto']:.0f})"
        in said
    )
    leads, errors = (", ".join(f"{of[method]:.0f}" for method in ("aps", "apt", "icm")) for of in (lead, error))
    assert f"(by {' and '.join(leads.rsplit(', ', 1))}; {' and '.join(errors.rsplit(', ', 1))})" in said
    icm = found.pair("cudc", "icm")
    assert f"has p = {icm.p:.3f}, after Holm's correction {icm.holm:.3f}" in said
    assert [pair.other for pair in found.pairs if pair.better] == ["random"] * 5
    ends = {method: f"from {of.min():.0f} to {of.max():.0f}" for method, of in means.items()}
    assert (
        f"ICM's five range {ends['icm']}, of APT's {ends['apt']}, of APS's {ends['aps']}; of CUDC's {ends['cudc']} and of ProtoRL's" in said
    )
    explorers = [average[method] for method in METHODS[1:]]
    assert f"ProtoRL's {ends['proto']}; the five methods' own from {min(explorers):.0f} to {max(explorers):.0f}" in said
    paper = {method: np.mean([reported()["td3", "walker", task, method, 100_000][0] for task in TASKS]) for method in METHODS}
    assert f"by {paper['cudc'] - paper['aps']:.1f} (APS) to {paper['cudc'] - paper['icm']:.0f} points (ICM)" in said
    assert overall.headline.unit == OF_LARGEST
    assert "on returns divided by the largest possible ones, with 95 % intervals by Student's t over datasets" in said
    five, *more = [1000 * design.lead for design in overall.power.designs if design.lead]
    assert f"with five seeds a lead must be {five:.0f} points a task to be found in 8 of 10 cases (with eight {more[0]:.0f}," in said
    assert f"with twelve {more[1]:.0f})" in said
    hours = sum(record.seconds for record in report.tables[0].records) / 3600
    assert f"{hours:.1f} of training" in said


def standings(comparison: Comparison) -> list[str]:
    lines = ["| | mean | IQM | better than random | CUDC better than it |", "|:---|---:|---:|---:|---:|"]
    for one in comparison.standings:
        scores = [f"{found.value:.3f} {_ends(found.interval)}" for found in (one.estimates["mean"], one.estimates["iqm"])]
        pairs = [comparison.pair(*names) if len(set(names)) == 2 else None for names in ((one.method, "random"), ("cudc", one.method))]
        chances = [f"{pair.probability:.2f} {_ends(pair.interval, 2)}{'*' * pair.better}" if pair else "–" for pair in pairs]
        lines.append(f"| {' | '.join([one.method, *scores, *chances])} |")
    return lines


def _ends(interval: Interval | None, digits: int = 3) -> str:
    assert interval is not None
    return f"[{interval.low:.{digits}f}, {interval.high:.{digits}f}]"
