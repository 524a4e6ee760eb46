"""What is said of the project's own results is what its records say."""

import csv
import importlib
from collections import defaultdict
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.records import read_record
from cudc_bench.collectors.cudc import CUDC
from cudc_bench.leaderboard.api import Report, make_leaderboard
from cudc_bench.leaderboard.numbers.overall import Comparison
from cudc_bench.leaderboard.numbers.published import reported
from cudc_bench.leaderboard.numbers.scale import BETWEEN
from cudc_bench.leaderboard.numbers.statistics import Interval
from cudc_bench.leaderboard.show.markdown import of_table as to_markdown
from tests import ROOT

BLOCK = ROOT / "results" / "cpu" / "walker"
OLD, NEW = ("random", "icm", "apt", "aps"), ("cudc-stopgrad", "cudc-momentum")
TASKS = ("stand", "walk", "run", "flip")


@pytest.fixture(scope="module")
def report() -> Report:
    return make_leaderboard(BLOCK, output=None, algo="td3")


@pytest.fixture(scope="module")
def section() -> str:
    return (ROOT / "docs" / "results.md").read_text()


@pytest.mark.parametrize("methods", [OLD, NEW], ids=["one evaluation", "three evaluations"])
def test_each_block_is_whole_and_its_records_keep_the_rules_for_those_of_others(methods: tuple[str, ...], tmp_path: Path) -> None:
    every = {path: read_record(path) for path in sorted(BLOCK.rglob("td3-seed?.json"))}
    assert {record.dataset.method for record in every.values()} == {*OLD, *NEW}
    found = {path: record for path, record in every.items() if record.dataset.method in methods}
    records = list(found.values())
    runs = [(record.dataset.method, record.seed, record.dataset.task) for record in records]
    assert sorted(runs) == sorted(product(methods, range(1, 6), TASKS))
    assert all(record.dataset.seed == record.seed for record in records)
    assert {(record.profile, record.algorithm, record.dirty) for record in records} == {("cpu", "td3", False)}
    assert len({(record.commit, record.hyperparameters_hash, str(record.versions)) for record in records}) == 1
    assert len({record.dataset.fingerprint for record in records}) == len(records)
    assert len(cudc_bench.submit(list(found), by="us", output=tmp_path).files) == len(records)


def test_the_tables_are_those_of_the_records(report: Report, section: str) -> None:
    shown = [line for line in section.splitlines() if line.startswith("|")]
    expected = []
    for table, overall in zip(report.tables, report.overall, strict=True):
        expected += [line.replace(" (5)", "") for line in to_markdown(table).splitlines() if line.startswith("|")]
        expected += standings(overall.headline)
    assert shown == expected
    assert f'"{report.tables[1].group}"' in section
    assert {overall.headline.unit for overall in report.overall} == {BETWEEN}
    assert not report.problems
    # The reading that the study ruled out before it came to returns.
    assert report.missing
    assert {(one.study, one.method) for one in report.missing} == {("readings", "cudc-live")}


def test_the_readmes_number_and_tables_are_those_of_the_records(report: Report) -> None:
    text = (ROOT / "README.md").read_text()
    shown = text.split("\n## Results so far\n")[1].split("\n## ")[0]
    assert [line for line in shown.splitlines() if line.startswith("|")] == [
        line for overall in report.overall for line in standings(overall.headline)
    ]
    (cudc,) = [one.estimates["mean"] for one in report.overall[0].headline.standings]
    assert f"**{cudc.value:.3f}** {_ends(cudc.interval)}" in text.split("\n## One number\n")[1].split("\n## ")[0]


def test_the_sentences_are_those_of_the_records(report: Report, section: str) -> None:
    said = " ".join(section.split())
    new, old = report.overall
    means = {one.method: one.returns[0].mean(1) for of in (new, old) for one in of.headline.standings}  # (5,) points a task of each seed
    ends = {method: f"from {of.min():.0f} to {of.max():.0f}" for method, of in means.items()}
    assert f"The means of the five seeds range {ends['cudc']} points a task" in said
    assert f"ICM's five range {ends['icm']}, of APT's {ends['apt']}, of APS's {ends['aps']}" in said
    runs = [record for path in BLOCK.rglob("td3-seed?.json") if (record := read_record(path)).dataset.method in NEW]
    last = np.mean([record.final.mean for record in runs if record.dataset.method == "cudc-stopgrad"])
    of_three, aps, apt, icm = (f"{means[method].mean():.0f}" for method in ("cudc", "aps", "apt", "icm"))
    assert f"CUDC's mean is {last:.0f} points a task (it is {of_three} as the mean of three)" in said
    assert f"where APS, APT and ICM have {aps}, {apt} and {icm}" in said
    readings = np.array(
        [
            [np.mean([one.score(50_000) for one in runs if (one.dataset.method, one.seed) == (method, seed)]) for seed in range(1, 6)]
            for method in NEW
        ]
    )
    difference, error = abs(np.subtract(*readings.mean(1))), np.sqrt(readings.var(1, ddof=1).sum() / 5)
    assert f"show no difference: {difference:.1f} points a task, standard error {error:.0f}." in said
    explorers = [means[method].mean() for method in OLD[1:]]
    assert f"the three methods' own from {min(explorers):.0f} to {max(explorers):.0f}" in said
    found = old.headline
    assert {(pair.method, pair.other) for pair in found.pairs if pair.better} == {(method, "random") for method in OLD[1:]}
    least = min(pair.holm for pair in found.pairs if "random" not in (pair.method, pair.other))
    assert f"the smallest p is {least:.2f} after Holm's correction" in said
    paper = {
        milestone: {
            method: np.mean([reported()["td3", "walker", task, method, milestone][0] for task in TASKS])
            for method in (*OLD, "cudc", "proto")
        }
        for milestone in (100_000, 500_000)
    }
    early, late = ({method: of["cudc"] - one for method, one in of.items()} for of in paper.values())
    assert f"by {early['aps']:.1f} (APS) to {early['icm']:.0f} points (ICM) after 100,000 gradient steps" in said
    assert f"and by {late['proto']:.0f} (ProtoRL) to {late['icm']:.0f} (ICM) after 500,000" in said
    assert min(early.values()) == early["cudc"] == 0
    assert "on returns between floor and ceiling, with Student's 95 % intervals over datasets" in said
    five, eight, twelve = (f"{design.lead * found.points:.0f}" for design in old.power.designs if design.lead)
    assert f"a lead of {five} points a task is found in 8 of 10 cases, with 8 seeds one of {eight}, with 12 one of {twelve}." in said


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., list[str]]:
    """The lines that a script of ``studies/`` prints."""
    monkeypatch.syspath_prepend(ROOT / "studies")

    def run(script: str, argument: Any) -> list[str]:
        importlib.import_module(script).main(argument)
        return capsys.readouterr().out.splitlines()

    return run


def tables(lines: Iterable[str]) -> list[str]:
    return [line for line in lines if line.startswith("|")]


def test_the_study_of_the_state_target_says_what_its_script_finds(section: str, printed: Callable[..., list[str]]) -> None:
    """Its tables, the means of returns, and when k grew."""
    found = printed("cudc_state_target", ["--from-csv", str(ROOT / "results")])
    came_out = (ROOT / "studies" / "cudc-state-target.md").read_text().split("## What came out")[1]
    assert tables(came_out.splitlines()) == tables(found)
    assert found[-1].startswith("ahead by (c): none, so that the order decides: cudc-stopgrad")
    assert found[-2] == "cudc-stopgrad - cudc-momentum: -0.2 points, p = 1.000, after Holm 1.000"
    assert "a difference of 0.2 points, p = 1.0 (exact, over the 252 ways" in " ".join(came_out.split())
    with (ROOT / "studies" / "cudc-state-target.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["method"] == "cudc-stopgrad"]
    shares = {k: listed(f"{100 * float(row[f'k{k}']):.0f}" for row in rows) for k in (4, 5, 6)}
    said = " ".join(section.split())
    assert f"k grew to 4 after {shares[4]} % of the five collections, to 5 after {shares[5]} % and to 6 after {shares[6]} %" in said


def test_the_study_of_representations_says_what_its_script_finds(printed: Callable[..., list[str]]) -> None:
    came_out = (ROOT / "studies" / "cudc-representations.md").read_text().split("## What came out")[1]
    found = tables(printed("cudc_representations", ["--from-csv"]))
    assert tables(came_out.splitlines()) == found
    suspect = {line.split("`")[1] for line in found if line.endswith("| suspect |")}
    assert suspect == {"cudc-live", "cudc-literal", "cudc-vary-apt"}
    related = {plugins.load("collectors", name) for name in plugins.names("collectors")}
    assert len(found) - 2 == len({kind for kind in related if issubclass(kind, CUDC) and kind.__module__.startswith("cudc_bench.")})


def test_what_trainings_on_one_dataset_differ_by_is_what_their_records_say() -> None:
    found = make_leaderboard(ROOT / "studies" / "training-seeds", output=None, algo="td3")
    assert len(list((ROOT / "studies" / "training-seeds").rglob("td3-*.json"))) == 2 * 2 * 4 * 2
    (study,) = [one for one in found.studies if one.name == "variance"]
    components, shares = study.tables
    pooled = {
        (part.key, *line.labels): entry
        for part, line, column, entry in [*components.entries(), *shares.entries()]
        if column.name == "pooled" and entry is not None
    }
    said = " ".join((ROOT / "docs" / "explanation" / "statistics.md").read_text().split())
    within = pooled[50_000, "mean over tasks", "within a dataset"]
    ends = _ends(within.interval, 0)
    assert f"is {within.value:.0f} points² {ends} between trainings on one dataset" in said
    assert f"a standard deviation of {np.sqrt(within.value):.0f} points" in said
    assert all(pooled[50_000, task, "between datasets"].value == 0 for task in ("mean over tasks", "stand", "walk", "flip"))
    assert f"of run, {pooled[50_000, 'run'].value:.2f} of it is between datasets" in said


def test_what_three_evaluations_gain_is_what_the_records_say(printed: Callable[..., list[str]]) -> None:
    (line,) = printed("final_score", ROOT / "results")
    said = " ".join((ROOT / "docs" / "reference" / "profiles.md").read_text().split())
    _, found, numbers = line.partition("between datasets ")
    assert found
    assert f"last evaluation alone by {numbers.replace('-', '−').replace('%', ' %')}" in said


def test_how_far_from_convergence_the_trainings_are(section: str) -> None:
    gains: dict[tuple[str, int], list[float]] = defaultdict(list)
    for path in BLOCK.rglob("td3-seed?.json"):
        record = read_record(path)
        at = {one.step: one.mean for one in record.curve}
        late, early = (np.mean([at[step] for step in steps]) for steps in ((40_000, 45_000, 50_000), (20_000, 25_000, 30_000)))
        if record.dataset.method not in {"random", "cudc-momentum"}:
            gains[record.dataset.method, record.dataset.seed].append(late - early)
    rise = np.array([np.mean(of) for of in gains.values()])
    assert len(rise) == 20
    said = " ".join(section.split())
    error = rise.std(ddof=1) / np.sqrt(len(rise))
    assert f"rises by {rise.mean():.0f} points a task (standard error {error:.0f}, over the 20 datasets" in said
    hyper = record.hyperparameters
    seen = hyper["gradient_steps"] * hyper["batch_size"] / record.dataset.steps
    assert (
        f"see each transition {seen:.0f} times on average, the paper's 500,000 with 1,024 see it {500_000 * 1024 / 1e6:.0f} times" in said
    )


@pytest.mark.parametrize(
    ("page", "heading", "method"),
    [("docs/how-to/zero-shot.md", "## What to expect of small runs", "rnd"), ("studies/zero-shot.md", "### CUDC's first dataset", "cudc")],
)
def test_what_learners_without_rewards_reach_is_what_the_records_say(page: str, heading: str, method: str) -> None:
    found = make_leaderboard(ROOT / "studies" / "zero-shot", output=None)
    assert not found.problems
    rows: dict[str, list[Any]] = {}
    for table in found.tables:
        bounds = [table.references[task] for task in TASKS]
        rows["random actions"] = [one.floor for one in bounds]
        name = "`td3`, trained on each task" if table.algorithm == "td3" else f"`{table.algorithm}`"
        scores = {(one.dataset.method, one.dataset.seed, one.dataset.task): one.score(50_000) for one in table.records}
        rows[name] = [scores[method, 1, task] for task in TASKS]
    shown = (ROOT / page).read_text().split(heading)[1].split("(`cudc-bench")[0]
    lines = {line for line in shown.splitlines() if line.startswith("|")}
    assert len(rows) == len(lines) - 2 == 7
    assert {f"| {name} | {' | '.join(f'{value:.0f}' for value in row)} |" for name, row in rows.items()} < lines


def listed(numbers: Iterable[str]) -> str:
    *others, last = numbers
    return f"{', '.join(others)} and {last}"


def standings(comparison: Comparison) -> list[str]:
    """Means and, where there is ``random``, the probability of being better than that."""
    with_random = any(one.method == "random" for one in comparison.standings)
    last = " better than random |" if with_random else ""
    lines = [f"| | mean | IQM |{last}", f"|:---|---:|---:|{'---:|' * with_random}"]
    for one in comparison.standings:
        cells = [one.method, *(f"{found.value:.3f} {_ends(found.interval)}" for found in (one.estimates["mean"], one.estimates["iqm"]))]
        if with_random:
            pair = None if one.method == "random" else comparison.pair(one.method, "random")
            cells.append("–" if pair is None else f"{pair.probability:.2f} {_ends(pair.interval, 2)}{'*' * pair.better}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _ends(interval: Interval | None, digits: int = 3) -> str:
    assert interval is not None
    return f"[{interval.low:.{digits}f}, {interval.high:.{digits}f}]"
