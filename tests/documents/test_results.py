"""What is said of the project's own results is what its records say."""

from collections import defaultdict
from collections.abc import Iterable
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import cudc_bench
from cudc_bench.artefacts.records import read_record
from cudc_bench.leaderboard.api import Report, make_leaderboard
from cudc_bench.leaderboard.numbers.overall import Comparison
from cudc_bench.leaderboard.numbers.published import reported
from cudc_bench.leaderboard.numbers.scale import BETWEEN
from cudc_bench.leaderboard.numbers.statistics import Interval
from cudc_bench.leaderboard.show.markdown import of_table as to_markdown
from tests import ROOT

BLOCK = ROOT / "results" / "cpu" / "walker"
METHODS = ("random", "icm", "apt", "aps", "cudc")
TASKS = ("stand", "walk", "run", "flip")


@pytest.fixture(scope="module")
def report() -> Report:
    return make_leaderboard(BLOCK, output=None, algo="td3")


@pytest.fixture(scope="module")
def section() -> str:
    return (ROOT / "docs" / "results.md").read_text()


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


def test_the_tables_are_those_of_the_records(report: Report, section: str) -> None:
    shown = [line for line in section.splitlines() if line.startswith("|")]
    (table,) = report.tables
    (overall,) = report.overall
    returns = [line.replace(" (5)", "") for line in to_markdown(table).splitlines() if line.startswith("|")]
    assert shown == [*returns, *standings(overall.headline)]
    assert f'"{table.group}"' in section
    assert not report.problems
    assert not report.missing


def test_the_readmes_number_and_table_are_those_of_the_records(report: Report) -> None:
    text = (ROOT / "README.md").read_text()
    headline = report.overall[0].headline
    shown = text.split("\n## Results so far\n")[1].split("\n## ")[0]
    assert [line for line in shown.splitlines() if line.startswith("|")] == standings(headline)
    (cudc,) = [one.estimates["mean"] for one in headline.standings if one.method == "cudc"]
    assert f"**{cudc.value:.3f}** {_ends(cudc.interval)}" in text.split("\n## One number\n")[1].split("\n## ")[0]


def test_the_sentences_are_those_of_the_records(report: Report, section: str) -> None:
    said = " ".join(section.split())
    overall = report.overall[0]
    found = overall.headline
    means = {one.method: one.returns[0].mean(1) for one in found.standings}  # (5,) points a task of each collector seed
    average = {method: of.mean() for method, of in means.items()}
    lead = {method: average["cudc"] - average[method] for method in means}
    error = {method: np.sqrt((means["cudc"].var(ddof=1) + of.var(ddof=1)) / len(of)) for method, of in means.items()}
    leads, errors = (listed(f"{of[method]:.0f}" for method in ("aps", "apt", "icm")) for of in (lead, error))
    assert f"ahead of APS, APT and ICM (by {leads} points a task; standard errors {errors})" in said
    icm = found.pair("cudc", "icm")
    assert f"has p = {icm.p:.3f}, which Holm's correction for four comparisons makes {icm.holm:.3f}" in said
    # The test's second smallest p counted four times then, of five comparisons.
    assert f"ProtoRL's records that were there at first, {4 * icm.p:.3f}" in said
    assert {(pair.method, pair.other) for pair in found.pairs if pair.better} == {
        *((method, "random") for method in METHODS[1:]), ("cudc", "icm"),
    }  # fmt: skip
    ends = {method: f"from {of.min():.0f} to {of.max():.0f}" for method, of in means.items()}
    ranges = f"ICM's five range {ends['icm']}, of APT's {ends['apt']}, of APS's {ends['aps']}, of CUDC's {ends['cudc']}"
    assert ranges in said
    explorers = [average[method] for method in METHODS[1:]]
    assert f"the four methods' own from {min(explorers):.0f} to {max(explorers):.0f}" in said
    paper = {
        milestone: {
            method: np.mean([reported()["td3", "walker", task, method, milestone][0] for task in TASKS]) for method in (*METHODS, "proto")
        }
        for milestone in (100_000, 500_000)
    }
    early, late = ({method: of["cudc"] - one for method, one in of.items()} for of in paper.values())
    assert f"by {early['aps']:.1f} (APS) to {early['icm']:.0f} points (ICM) after 100,000 gradient steps" in said
    assert f"and by {late['proto']:.0f} (ProtoRL) to {late['icm']:.0f} (ICM) after 500,000" in said
    assert min(early.values()) == early["cudc"] == 0
    assert overall.headline.unit == BETWEEN
    assert "on returns between floor and ceiling, with Student's 95 % intervals over datasets" in said
    five, eight, twelve = (f"{design.lead * found.points:.0f}" for design in overall.power.designs if design.lead)
    assert f"a lead of {five} points a task is found in 8 of 10 cases, with 8 seeds one of {eight}, with 12 one of {twelve}." in said


def test_how_far_from_convergence_the_trainings_are(section: str) -> None:
    gains: dict[tuple[str, int], list[float]] = defaultdict(list)
    for path in BLOCK.rglob("td3-seed*.json"):
        record = read_record(path)
        at = {one.step: one.mean for one in record.curve}
        late, early = (np.mean([at[step] for step in steps]) for steps in ((40_000, 45_000, 50_000), (20_000, 25_000, 30_000)))
        if record.dataset.method != "random":
            gains[record.dataset.method, record.dataset.seed].append(late - early)
    rise = np.array([np.mean(of) for of in gains.values()])
    assert len(rise) == 20
    said = " ".join(section.split())
    assert (
        f"rises by {rise.mean():.0f} points a task (standard error {rise.std(ddof=1) / np.sqrt(len(rise)):.0f}, over the 20 datasets"
        in said
    )
    hyper = record.hyperparameters
    seen = hyper["gradient_steps"] * hyper["batch_size"] / record.dataset.steps
    assert (
        f"see each transition {seen:.0f} times on average, the paper's 500,000 with 1,024 see it {500_000 * 1024 / 1e6:.0f} times" in said
    )


def listed(numbers: Iterable[str]) -> str:
    *others, last = numbers
    return f"{', '.join(others)} and {last}"


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
