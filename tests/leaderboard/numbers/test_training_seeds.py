"""The dataset is the unit of replication: several trainings on one count once, as their mean, in everything that is made of records."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from cudc_bench.artefacts.records import Record, record_path, write_record
from cudc_bench.leaderboard.api import Report, make_leaderboard
from cudc_bench.leaderboard.intake.load import load_records, to_frame
from cudc_bench.leaderboard.show.csv import of_grid as study_to_csv
from cudc_bench.leaderboard.show.csv import of_overall as overall_to_csv
from cudc_bench.leaderboard.show.csv import of_scores as scores_to_csv
from cudc_bench.leaderboard.show.csv import of_table as to_csv

TASKS = ("stand", "walk", "run", "flip")
# Of the main tables and of each study.
METHODS = ("cudc", "icm", "random", "cudc-no-pe", "cudc-kmax5", "cudc-uniform-k", "cudc-vary-icm", "apt-k6")
PARTS = (("td3", None), ("td3", 100_000), ("td3", 200_000), ("iql", None))
TRAININGS = {1: -16.0, 2: 4.0, 9: 12.0}  # by how much each is off their mean


@pytest.fixture
def saved(make_record: Callable[..., Record], tmp_path: Path) -> Callable[[str, Mapping[int, float]], Path]:
    """Writes records of several datasets, trained on with some seeds whose returns are off the dataset's by so much."""

    def save(name: str, trainings: Mapping[int, float]) -> Path:
        for place, method in enumerate(METHODS):
            for algorithm, used in PARTS:
                for column, task in enumerate(TASKS):
                    for seed in (1, 2, 3):
                        level = 100 + 64 * place + 8 * seed**2 + 2 * column + (used or 400_000) // 10_000
                        for training, off in trainings.items():
                            scores = [(0, [0.0]), (10_000, [level / 2 + off]), (20_000, [0.0])]
                            record = make_record(
                                method, task, seed, scores, [level + off], algorithm=algorithm, dataset_used=used
                            ).model_copy(update={"seed": training})  # fmt: skip
                            path = record_path(tmp_path / name, record.dataset.id, algorithm, seed, "cpu", used, training)
                            write_record(path, record)
        return tmp_path / name

    return save


def numbers(report: Report) -> dict[str, str]:
    """Every number of a report, by where it stands."""
    found = {f"table {table.slug}": to_csv(table) for table in report.tables}
    for overall in report.overall:
        found |= {f"overall {overall.slug}": overall_to_csv(overall), f"scores {overall.slug}": scores_to_csv(overall)}
    for study in report.studies:
        found |= {f"{study.name} {study.algorithm} {study.group} {grid.name}": study_to_csv(study, grid) for grid in study.tables}
    return found


def test_every_number_is_that_of_the_trainings_means(saved: Callable[[str, Mapping[int, float]], Path]) -> None:
    several, one = saved("several", TRAININGS), saved("one", {1: 0.0})
    loaded = load_records([several])
    assert loaded.problems == ()
    assert len(loaded.records) == 3 * len(load_records([one]).records)
    assert set(to_frame(loaded.records).seed) == set(TRAININGS)
    reports = [make_leaderboard(results, None) for results in (several, one)]
    assert reports[0].problems == reports[1].problems
    assert [str(missing) for missing in reports[0].missing] == [str(missing) for missing in reports[1].missing]
    first, second = map(numbers, reports)
    assert {name.partition(" ")[0] for name in first} >= {
        "table", "overall", "scores", "variants", "ablation", "k-bound", "controls", "schedule", "sizes", "learners"
    }  # fmt: skip
    # What several trainings alone can tell is how much they differ.
    apart = {name for name in first if name.startswith("variance ")}
    assert apart
    assert first.keys() - apart == second.keys()
    assert [name for name in second if first[name] != second[name]] == []
