"""Which measure goes with scores: against scipy's rank correlation of little tables, with what is left out said."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from cudc_bench.artefacts.records import Record
from cudc_bench.data.descriptors import DescriptorCoverage
from cudc_bench.leaderboard.datasets import prediction
from cudc_bench.leaderboard.datasets.prediction import MEASURES, predict
from cudc_bench.leaderboard.datasets.quality import Quality, QualityTable, TaskMeasures, reward_density
from cudc_bench.leaderboard.datasets.visited import Visited
from cudc_bench.leaderboard.numbers.grid import Entry
from cudc_bench.leaderboard.output.report import prediction_files
from cudc_bench.leaderboard.show.documents import of_stats

TASKS = ("stand", "walk", "run", "flip")
METHODS = ("icm", "apt", "rnd", "cic", "smm", "cudc")
CELLS = (40, 10, 30, 20, 60, 60)
SCORES = {"stand": (300.0, 100.0, 200.0, 250.0, 400.0, 500.0), "walk": (50.0, 90.0, 60.0, 70.0, 20.0, 20.0)}
Make = Callable[..., Record]


def quality(number: int, method: str, seed: int = 1, tier: str | None = None) -> Quality:
    rewards = {task: reward_density([np.full(4, (number + 1) / 100)]) for task in TASKS}
    manifest: Any = SimpleNamespace(label=method, seed=seed, tier=tier)
    walk = {"walk": TaskMeasures(None, None, [0.1, 0.2, 0.2, 0.4, 0.5, 0.6][number % 6], None)}
    coverage = DescriptorCoverage(CELLS[number % 6], 1.0)
    return Quality(f"walker/{method}-seed{seed}-v0", manifest, rewards, coverage, None, (0.5, 0.25), 0.125, None, tasks=walk)


def table(*datasets: Quality) -> QualityTable:
    methods = tuple(dict.fromkeys(one.manifest.label for one in datasets))
    return QualityTable("cpu", "walker", TASKS, "cpu.quality.walker", methods, datasets)


def test_measures_are_what_their_names_say() -> None:
    rewards = [np.array([0.0, 0.1, 0.6, 0.95]), np.array([0.2, 0.2, 0.2, 0.2]), np.array([0.0, 0.0, 0.0, 1.0])]
    own = replace(
        quality(3, "icm"), rewards={"walk": reward_density(rewards)}, particle_entropy=7.5, action_correlation=0.25,
        visited=Visited(np.array([1]), np.array([9]), 17, DescriptorCoverage(1, 0.0)), tasks={"walk": TaskMeasures(1.0, 2.0, 0.3, 0.6)},
    )  # fmt: skip
    assert {name: measure(own, "walk") for name, measure in MEASURES.items()} == {
        "visited cells": 20, "entropy of visits": 1.0, "state-action pairs (SACo)": 17, "particle entropy": 7.5,
        "mean reward (TQ)": pytest.approx((1.65 + 0.8 + 1.0) / 12), "95 % of trajectories": pytest.approx(0.25 + 0.9 * 0.1625),
        "best trajectory": pytest.approx(1.65 / 4), "top 1 % of steps": 1.0, "steps > 0.5": 3 / 12, "steps > 0.9": 2 / 12,
        "expert recall": 0.3, "expert precision": 0.6, "std of actions": 0.375, "actions at bounds": 0.125, "consecutive actions": 0.25,
    }  # fmt: skip
    bare = replace(own, coverage=None, particle_entropy=None, action_correlation=None, visited=None, tasks={})
    lacking = {name for name, measure in MEASURES.items() if measure(bare, "walk") is None}
    assert lacking == {
        "visited cells", "entropy of visits", "state-action pairs (SACo)", "particle entropy", "expert recall", "expert precision",
        "consecutive actions",
    }  # fmt: skip


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every dataset of a record is on this machine, and was collected as it is named, but for those with another fingerprint."""
    monkeypatch.setattr(prediction, "_base", lambda one, fingerprint: None if fingerprint[0] == "b" else one)


def records(make: Make, scores: Mapping[str, Sequence[float]], seed: int = 1, **changes: Any) -> list[Record]:
    return [
        make(method, task, seed, final=[score], dataset_id=f"walker/{method}-seed{seed}-v0", **changes)
        for task, of in scores.items() for method, score in zip(METHODS, of, strict=True)
    ]  # fmt: skip


def rows(grid: Any, part: int = 0) -> dict[str, tuple[Entry | None, ...]]:
    return {line.labels[0]: line.entries for line in grid.parts[part].lines}


def test_correlations_are_scipys_mean_over_tasks(make_record: Make) -> None:
    own = table(*(quality(number, method) for number, method in enumerate(METHODS)), quality(5, "expert", tier="expert"))
    extra = [make_record("expert", task, final=[999.0], dataset_id="walker/expert-seed1-v0") for task in SCORES]
    part = make_record("icm", "stand", final=[999.0], dataset_id="walker/icm-seed1-v0", dataset_used=100)
    (found,), remarks = predict([own], [*records(make_record, SCORES), *extra, part])
    assert remarks == []
    mean, tasks = found.study.tables
    assert [part.title for part in mean.parts] == ["cpu"]
    assert [column.name for column in mean.columns] == ["td3"]
    each = {task: stats.spearmanr(CELLS, of).statistic for task, of in SCORES.items()}
    (entry,) = rows(mean)["visited cells"]
    assert entry is not None
    assert (entry.value, entry.n) == (pytest.approx((each["stand"] + each["walk"]) / 2, rel=1e-12), 6)
    assert entry.interval is not None
    assert entry.interval.low <= entry.value <= entry.interval.high
    of_cells = rows(tasks)["visited cells"]
    assert [one and one.value for one in of_cells] == pytest.approx([each["stand"], each["walk"]], rel=1e-12)
    # What only one task has is of that one, and what never varies says nothing.
    (entry,) = rows(mean)["expert recall"]
    assert entry is not None
    assert entry.value == pytest.approx(stats.spearmanr([0.1, 0.2, 0.2, 0.4, 0.5, 0.6], SCORES["walk"]).statistic, rel=1e-12)
    assert rows(tasks)["expert recall"][0] is None
    assert not {"entropy of visits", "particle entropy", "std of actions", "steps > 0.9", "expert precision"} & set(rows(mean))
    assert list(found.figure.measures) == [name for name in MEASURES if name in rows(mean)]
    assert found.figure.panels["td3, 20K steps"]["expert recall"].value == entry.value


def test_several_trainings_on_a_dataset_are_one_score_and_seeds_of_a_collector_one_cluster(make_record: Make) -> None:
    own = table(*(quality(6 * seed + number, method, seed) for seed in (1, 2) for number, method in enumerate(METHODS[:4])))
    once, again = {"walk": SCORES["walk"]}, {"walk": [10.0, 80.0, 200.0, 30.0, 0.0, 0.0]}
    means = [fmean(of) for of in zip(once["walk"], again["walk"], strict=True)]
    trained = [(seed, training, of) for seed in (1, 2) for training, of in ((1, once), (7, again))]
    given = [
        one.model_copy(update={"seed": training})
        for seed, training, of in trained for one in records(make_record, of, seed) if one.dataset.method in METHODS[:4]
    ]  # fmt: skip
    (found,), remarks = predict([own], given)
    assert remarks == []
    (entry,) = rows(found.study.tables[0])["visited cells"]
    assert entry is not None
    assert (entry.n, entry.interval) == (8, None)
    assert entry.value == pytest.approx(stats.spearmanr(CELLS[:4] * 2, means[:4] * 2).statistic, rel=1e-12)
    assert found.study.notes == ("there are no intervals where there are fewer than 5 collectors: td3 has 4.",)


def test_too_few_datasets_have_no_correlation_but_a_line(make_record: Make) -> None:
    own = table(*(quality(number, method) for number, method in enumerate(METHODS)))
    given = records(make_record, SCORES)
    without = [one for one in given if one.dataset.method not in ("icm", "apt") or one.dataset.task == "walk"]
    found, remarks = predict([own], without)
    assert found == []
    line = "cpu.quality.walker: no correlation of measures with scores of td3: it takes 5 datasets that have both on stand, walk, not 4."
    assert remarks == [line]
    # One more is enough. A sixth was not evaluated at the last milestone.
    early = [make_record("icm", task, scores=((0, [0.0]), (10_000, [1.0])), dataset_id="walker/icm-seed1-v0") for task in SCORES]
    (found, *_), remarks = predict([own], [*early, *(one for one in given if one.dataset.method != "icm")])
    assert remarks == ["table cpu.td3.walker: walker/icm-seed1-v0 (seed 1) was not evaluated at milestone 20000."] * 2
    assert [entry and entry.n for entry in rows(found.study.tables[0])["mean reward (TQ)"]] == [5]


def test_learners_are_columns_and_other_settings_parts(make_record: Make) -> None:
    own = table(*(quality(number, method) for number, method in enumerate(METHODS)))
    given = [
        *records(make_record, SCORES), *records(make_record, SCORES, algorithm="bc"),
        *records(make_record, {"walk": SCORES["walk"]}, overrides={"batch_size": 5}),
    ]  # fmt: skip
    (found,), _ = predict([own], given)
    mean, tasks = found.study.tables
    assert [column.name for column in mean.columns] == ["td3", "bc"]
    assert [part.title for part in mean.parts] == ["cpu", "cpu (evaluate: batch_size=5)"]
    assert [entry is None for entry in rows(mean, 1)["visited cells"]] == [False, True]
    assert len(tasks.parts) == len(found.figure.panels) == 3


def test_files_of_one_learner(make_record: Make) -> None:
    own = table(*(quality(number, method) for number, method in enumerate(METHODS)))
    ((found,), _) = predict([own], records(make_record, SCORES))
    files = prediction_files(found)
    assert set(files) == {f"prediction{end}" for end in (".md", ".tex", "-mean.csv", "-tasks.csv", ".svg", ".pdf")}
    assert b"Spearman's" in bytes(files["prediction.svg"])  # type: ignore[arg-type]
    assert "| visited cells |" in str(files["prediction.md"])
    (shown,) = of_stats([own], [found], [], []).predictions
    cells = {(cell.labels[0], cell.column): cell for cell in shown.tables[0].cells}
    entry = rows(found.study.tables[0])["visited cells"][0]
    assert entry is not None
    assert entry.interval is not None
    cell = cells["visited cells", "td3"]
    assert (cell.value, cell.low, cell.high, cell.seeds) == (entry.value, entry.interval.low, entry.interval.high, 6)


def test_scores_on_what_is_not_here_are_named(make_record: Make) -> None:
    own = table(*(quality(number, method) for number, method in enumerate(METHODS[:2])))
    gone = records(make_record, SCORES, dataset_fingerprint="b" * 64)
    elsewhere = make_record("icm", "reach_top_left", dataset_domain="jaco", dataset_fingerprint="b" * 64)
    found, remarks = predict([own], [*gone, elsewhere])
    assert found == []
    (line,) = remarks
    assert line.startswith("scores on 6 labelled datasets, such as walker/icm-seed1-v0, go with no measure: records hold none")
    # Those that nobody asked for are no reason for a line.
    assert predict([own], [one for one in records(make_record, SCORES) if one.dataset.method == "cic"]) == ([], [])
