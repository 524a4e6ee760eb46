"""What is missing is what would make the comparisons complete, and the command makes it."""

from __future__ import annotations

from cudc_bench.leaderboard.api import make_leaderboard
from cudc_bench.leaderboard.numbers.missing import find_missing
from cudc_bench.leaderboard.numbers.table import build_tables

TASKS = ("stand", "walk", "run", "flip")


def found(*records):
    return [(one.domain, one.method, one.tasks, one.seeds) for one in find_missing(build_tables(records)[0])]


def test_nothing_is_missing_from_what_is_complete(make_record):
    assert found(*(make_record(method=m, task=t, seed=s) for m in ("cudc", "icm") for t in TASKS for s in (1, 2))) == []


def test_holes_are_found_and_tasks_with_the_same_seeds_share_a_command(make_record):
    grid = [(m, t, s) for m in ("cudc", "icm") for t in TASKS for s in (1, 2, 3)]
    holes = {("icm", "walk", 2), ("icm", "run", 2), ("icm", "flip", 1), ("cudc", "stand", 3)}
    records = [make_record(method=m, task=t, seed=s) for m, t, s in grid if (m, t, s) not in holes]
    tables, _ = build_tables(records)
    missing = find_missing(tables)
    assert {(one.method, task, seed) for one in missing for task in one.tasks for seed in one.seeds} == holes
    assert len(missing) == 3
    (line,) = [str(one) for one in missing if one.tasks == ("walk", "run")]
    assert line == (
        "td3 on icm in walker, profile cpu, walk, run, seeds 2: cudc-bench evaluate --algo td3 --domain walker --method icm"
        " --tasks walk,run --seeds 2 --profile cpu"
    )


def test_tasks_that_nobody_asked_for_are_not_missing(make_record):
    """A study of one task, and one of a reward of somebody's own: neither lacks the domain's other tasks."""
    assert found(make_record(task="walk"), make_record(task="walk", seed=2)) == []
    own = {"reference": "mine:hop", "sha256": "a" * 64}
    records = [make_record(task="hop", dataset_reward=own, method=method) for method in ("cudc", "icm")]
    assert found(*records) == []
    (table,), _ = build_tables(records)
    assert table.tasks == ("hop",)
    assert "without any run" not in table.caption


def test_a_method_of_one_domain_is_missing_from_the_others(make_record):
    everywhere = [make_record(task=t, dataset_domain=d) for d, tasks in (("walker", TASKS), ("cheetah", ("run",))) for t in tasks]
    assert found(*everywhere, *(make_record(method="icm", task=t) for t in TASKS)) == [("cheetah", "icm", ("run",), (1,))]


def test_groups_and_algorithms_ask_nothing_of_each_other(make_record):
    full = [make_record(task=t) for t in TASKS]
    other = [make_record(task=t, algorithm="cql", seed=s, overrides={"gamma": 0.5}) for t in TASKS for s in (4, 5)][:-1]
    assert found(*full, *other) == [("walker", "cudc", ("flip",), (5,))]
    (one,) = find_missing(build_tables([*full, *other])[0])
    assert one.command == (
        "cudc-bench evaluate --algo cql --domain walker --method cudc --tasks flip --seeds 5 --profile cpu --set gamma=0.5"
    )


def test_what_lacks_beside_runs_from_before_is_asked_for_as_they_were_made(make_record):
    before = [make_record(task=t, seed=s, hyperparameters={"learning_rate": 1e-3}) for t in TASKS for s in (2, 1)][:-1]
    (one,) = find_missing(build_tables([*before, *(make_record(task=t) for t in TASKS)])[0])
    assert one.command == (
        "cudc-bench evaluate --algo td3 --domain walker --method cudc --tasks flip --seeds 1 --profile cpu --set final_evaluations=1"
    )


def test_imported_datasets_are_not_asked_for(make_record):
    own = [make_record(task=t, seed=s) for t in TASKS for s in (1, 2)]
    assert found(*own, make_record(method="proto", dataset_source="ExORL", dataset_profile="imported")) == []


def test_datasets_with_settings_of_their_own_take_more_than_a_command(make_record):
    records = [make_record(task=t, seed=s, dataset_overrides={"steps": 5}) for t in TASKS for s in (2, 1)][:-1]
    (one,) = find_missing(build_tables(records)[0])
    assert one.command is None
    assert str(one).endswith("flip, seeds 1 (by the commands of its other records)")


def test_the_command_says_them(make_record, save, cli):
    results = save(make_record(), make_record(method="icm", seed=2))
    missing = make_leaderboard(results, None).missing
    assert len(missing) == 2
    done = cli("leaderboard", str(results), "--output", str(results.parent / "out"))
    assert done.code == 0
    assert [line for line in done.err.splitlines() if line.startswith("missing: ")] == [f"missing: {one}" for one in missing]
