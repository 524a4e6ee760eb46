"""From suites to jobs, by known answers: nothing here touches a disk or starts a process."""

from __future__ import annotations

import re
import time
from collections import Counter
from io import StringIO

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from cudc_bench import plugins
from cudc_bench.errors import UsageError
from cudc_bench.suites.definition import Suite, SuiteStudy, load_suite, narrow, suite_names
from cudc_bench.suites.display import Running, running_jobs
from cudc_bench.suites.estimate import Estimates, Rates, from_table
from cudc_bench.suites.jobs import Job, JobGraph, expand
from cudc_bench.suites.queue import Queue

MAIN = ("random", "icm", "apt", "proto", "aps", "cudc")


class Anything(dict):
    """Every dataset has a thousand steps."""

    def __missing__(self, key):
        return 1000


def plan(name, **narrower):
    return expand(narrow(load_suite(name), **narrower), Anything())


def count(found: JobGraph):
    return Counter(job.kind for job in found.needs)


# The experiments of the paper: methods x domains x seeds, tasks of each domain, algorithms, sizes.
@pytest.mark.parametrize(
    ("name", "datasets", "records"),
    [
        ("main", 6 * 3 * 5, 6 * 12 * 5),
        ("variants", 7 * 5, 7 * 4 * 5),
        ("ablation", 7 * 5, 7 * 4 * 5),
        ("schedule", 3 * 5, 3 * 4 * 5),
        ("k-bound", 6 * 5, 6 * 4 * 5),
        ("dataset-size", 6 * 5, 6 * 4 * 5 * 4),
        ("cql", 6 * 5, 6 * 4 * 5),
        ("controls", 7 * 5, 7 * 4 * 5),
        ("density", 6 * 5, 0),
    ],
)
def test_the_papers_studies_have_as_many_runs_as_the_paper(name: str, datasets: int, records: int) -> None:
    found = count(plan(name))
    assert found["collect"] == datasets
    assert found["evaluate"] == records
    assert found["relabel"] == (datasets if records else 0)
    assert found["stats"] == (name == "density")


def test_all_shares_what_its_studies_share() -> None:
    found = plan("all")
    studies = ("variants", "ablation", "schedule", "k-bound")
    walker = set(MAIN) | {method for name in studies for method in load_suite(name).studies[0].methods}
    assert len(walker) == 6 + 4 + 6 + 2 + 6
    kinds = count(found)
    assert kinds["collect"] == 5 * (len(walker) + 2 * 6)
    # Whole datasets with TD3 for all of these, three parts of main's, and CQL on main's.
    assert kinds["evaluate"] == 5 * (4 * len(walker) + 8 * 6 + 3 * 4 * 6 + 4 * 6)
    assert kinds["stats"] == 1
    assert len({job.name for job in found.needs}) == len({job.slug for job in found.needs}) == len(found.needs)
    assert set(suite_names()) == {
        "all", "controls", "readings", "main", "dataset-size", "cql", "density", "zero-shot", "labels", "field", *studies,
    }  # fmt: skip


def test_the_field_is_every_collector_but_variants() -> None:
    (study,) = load_suite("field").studies
    ours = [name for name in plugins.names("collectors") if "cudc-bench" in plugins.package("collectors", name)]
    kinds = {name: plugins.load("collectors", name) for name in ours}
    own = {kind: name for name, kind in reversed(kinds.items()) if kind.__module__ != "cudc_bench.collectors.variants"}
    assert sorted(study.methods) == sorted(own.values())
    assert (study.domains, study.algos) == (("walker",), ("td3",))
    assert count(plan("field"))["evaluate"] == 15 * 5 * 4


def test_a_plan_is_in_an_order_in_which_it_can_be_done() -> None:
    seen: set[Job] = set()
    for job, needs in plan("all").needs.items():
        assert seen.issuperset(needs)
        seen.add(job)


def test_parts_of_a_dataset_are_counted_in_transitions() -> None:
    found = expand(narrow(load_suite("dataset-size"), methods=["cudc"], seeds=[3], tasks=["walk"]), {("walker", "cudc"): 400_000})
    assert [job.used for job in found.of("evaluate")] == [40_000, 80_000, 200_000, None]
    assert {job.name for job in found.of("evaluate")} >= {"evaluate td3 walker cudc seed 3 walk first 40,000"}


def test_a_pilot_comes_before_every_dataset_that_needs_it() -> None:
    found = expand(narrow(load_suite("variants"), seeds=[1, 2]), Anything(), [("walker", "cudc-reward")])
    (pilot,) = found.of("pilot")
    assert pilot.methods == ("cudc-reward",)
    assert [job for job, needs in found.needs.items() if pilot in needs] == [
        Job("collect", "walker", ("cudc-reward",), (seed,)) for seed in (1, 2)
    ]


def test_on_a_gpu_one_job_has_all_seeds_and_tasks() -> None:
    suite = narrow(load_suite("main"), methods=["cudc"], domains=["walker"])
    assert [(job.kind, job.seeds, job.tasks) for job in expand(suite, Anything(), stacked=True).needs] == [
        ("collect", (1, 2, 3, 4, 5), ()),
        ("relabel", (1, 2, 3, 4, 5), ("stand", "walk", "run", "flip")),
        ("evaluate", (1, 2, 3, 4, 5), ("stand", "walk", "run", "flip")),
    ]


def test_only_what_is_still_needed_is_left() -> None:
    found = plan("main", methods=["cudc"], domains=["walker"], seeds=[1], tasks=["walk", "run"])
    collect, relabel, walk, run = found.needs
    assert (walk.tasks, run.tasks) == (("walk",), ("run",))

    def left(*done: Job) -> list[Job]:
        return list(found.left(done).needs)

    assert left() == [collect, relabel, walk, run]
    assert left(collect) == [relabel, walk, run]
    # The dataset was removed when all was recorded, and nobody needs it.
    assert left(walk, run) == []
    # It was removed, and one record is missing: it is made again.
    assert left(walk) == [collect, relabel, run]
    assert found.left([walk]).needs[run] == (relabel,)
    assert found.left([collect, relabel, walk]).needs == {run: ()}
    # Datasets of which nothing is made are a goal themselves, those that are only compared are not.
    alone = expand(Suite("x", "", (SuiteStudy(("random",), ("walker",)),), (1,)), Anything())
    assert list(alone.left([]).needs) == list(alone.needs) == [Job("collect", "walker", ("random",), (1,))]
    density = plan("density", methods=["random"], seeds=[1])
    assert list(density.left(density.of("stats")).needs) == []


def test_narrowing_keeps_what_is_named_and_refuses_what_is_not_there() -> None:
    main = load_suite("main")
    part = narrow(main, methods=["cudc", "icm"], domains=["jaco"], tasks=["reach_top_left"], algos=["bc", "iql"], seeds=[7], profile="cpu")
    assert part.studies == (SuiteStudy(("icm", "cudc"), ("jaco",), ("reach_top_left",), ("bc", "iql")),)
    assert (part.seeds, part.profile) == ((7,), "cpu")
    # One task of each domain: whoever has none of them is left out.
    assert [(one.domains, one.tasks) for one in narrow(main, tasks=["walk"]).studies] == [
        (("walker",), ("walk",)),
        (("quadruped",), ("walk",)),
    ]
    assert not narrow(load_suite("density"), algos=["bc"]).studies[0].algos
    for wrong, says in (
        ({"methods": ["rnd"]}, "has no method 'rnd'; it has: random, icm, apt, proto, aps, cudc"),
        ({"methods": []}, "--methods is empty"),
        ({"domains": ["jacko"]}, "has no domain 'jacko'; it has: walker, quadruped, jaco. Did you mean 'jaco'?"),
        ({"domains": ["jaco"], "tasks": ["walk"]}, "has no task 'walk'"),
        ({"algos": ["td4"]}, "unknown algo 'td4'"),
        ({"algos": []}, "--algos is empty"),
        ({"seeds": [1, 1]}, "the seed 1 was given twice"),
        ({"profile": "large"}, "unknown profile 'large'"),
    ):
        with pytest.raises(UsageError) as refusal:
            narrow(main, **wrong)  # type: ignore[arg-type]
        assert says in str(refusal.value)


# ---------------------------------------------------------------------------------------------------------------------------- queue

A, B = (Job("collect", "walker", (name,), (1,)) for name in ("random", "cudc"))
A1, A2, B1 = (
    Job("evaluate", "walker", (name,), (1,), (task,), "td3") for name, task in (("random", "walk"), ("random", "run"), ("cudc", "walk"))
)
SMALL = JobGraph({A: (), B: (), A1: (A,), A2: (A,), B1: (B,)})
SECONDS = {A: 10.0, B: 50.0, A1: 30.0, A2: 20.0, B1: 30.0}


def test_the_longest_way_to_the_end_goes_first() -> None:
    queue = Queue(SMALL, SECONDS)
    assert queue.start() == B  # 50 + 30
    assert queue.start() == A  # 10 + 30
    assert queue.start() is None  # the others wait for these
    queue.succeed(A)
    assert queue.start() == A1
    queue.succeed(B)
    assert [queue.start(), queue.start(), queue.start()] == [B1, A2, None]
    for job in (A1, A2, B1):
        assert not queue.is_over
        queue.succeed(job)
    assert queue.is_over


def test_with_few_datasets_what_is_begun_ends_before_more_begins() -> None:
    queue = Queue(SMALL, SECONDS, few_datasets=True)
    assert queue.start() == B
    queue.succeed(B)
    assert [queue.start(), queue.start()] == [B1, A]


def test_a_failure_takes_with_it_what_needs_it_and_nothing_else() -> None:
    queue = Queue(SMALL, SECONDS)
    queue.start(), queue.start()
    queue.fail(A, "no reason")
    assert [(one.job, one.because) for one in queue.failures] == [(A, None), (A1, A), (A2, A)]
    queue.succeed(B)
    assert queue.start() == B1
    queue.succeed(B1)
    assert queue.is_over


def test_who_is_kept_from_starting_waits_and_others_go_on() -> None:
    queue = Queue(SMALL, SECONDS)
    assert queue.start() == B
    queue.put_back(B)
    assert queue.start(not_now=[B]) == A
    assert queue.start() == B


def test_time_left_is_that_of_the_work_or_of_the_longest_way() -> None:
    queue = Queue(SMALL, SECONDS)
    assert queue.seconds_left(1, {}) == 140
    assert queue.seconds_left(2, {}) == 80  # B and B1 one after the other
    assert queue.start() == B
    assert queue.seconds_left(2, {B: 5.0}) == (90 + 5) / 2
    # What nobody measured is taken to be as what was measured of its kind.
    unknown = Queue(SMALL, SECONDS | {A2: None})
    assert unknown.seconds[A2] == 30


def test_what_jobs_took_says_what_others_will_take() -> None:
    queue = Queue(SMALL, SECONDS)
    assert queue.start() == B
    queue.succeed(B, 2 * SECONDS[B])
    assert {job: queue.seconds[job] / SECONDS[job] for job in queue.waiting} == dict.fromkeys(queue.waiting, 2.0)
    queue.start([A])
    queue.succeed(B1, 3 * SECONDS[B1])  # Trainings are known by now, collections as before.
    assert {job: queue.seconds[job] / SECONDS[job] for job in queue.waiting} == pytest.approx({A: 2.0, A1: 3.0, A2: 3.0})
    queue.start()
    queue.succeed(A)  # It went on where it had been, which says nothing.
    assert queue.seconds_left(1, {}) == pytest.approx(3 * (SECONDS[A1] + SECONDS[A2]))


@given(st.data())
def test_any_order_of_ends_does_every_job_once(data: st.DataObject) -> None:
    found = plan("all", methods=["cudc", "random", "icm"], seeds=[1])
    workers = data.draw(st.integers(1, 6))
    queue = Queue(found, dict.fromkeys(found.needs, 1.0), data.draw(st.booleans()))
    running: list[Job] = []
    ended: list[Job] = []
    while not queue.is_over:
        while len(running) < workers and (job := queue.start()) is not None:
            assert set(found.needs[job]) <= set(ended)
            running.append(job)
        assert running
        job = running.pop(data.draw(st.integers(0, len(running) - 1)))
        queue.succeed(job)
        ended.append(job)
    assert sorted(job.name for job in ended) == sorted(job.name for job in found.needs)


# ------------------------------------------------------------------------------------------------------------------------- estimates


def test_estimates_are_from_what_is_most_like_the_job() -> None:
    here, table = Rates("measured here"), Rates("table")
    here.add("collect", "walker", "random", seconds=10.0, units=1000)
    here.add("collect", "walker", "random", seconds=30.0, units=1000)
    table.add("collect", "jaco", "cudc", 5.0, 1000)
    table.add("evaluate", "walker", "td3", 3.0, 1000)
    found = Estimates({A: 2000, B: 2000, A1: 500, B1: 500}, (here, table))
    assert found.seconds(A) == pytest.approx(2000 * 0.02)
    # Another collector on the same domain, measured here, is nearer than the same one on another machine.
    assert (found.seconds(B), found.source(B)) == (pytest.approx(40.0), "measured here")
    assert Estimates({B: 2000}, (table,)).seconds(B) == pytest.approx(10.0)
    assert (found.seconds(A1), found.source(A1)) == (pytest.approx(1.5), "table")
    # Offline algorithms are not alike: nobody knows.
    other = Job("evaluate", "walker", ("cudc",), (1,), ("walk",), "cql")
    assert Estimates({other: 500}, (here, table)).seconds(other) is None
    # 24 observations and 6 actions as float32, 18 numbers of physics as float64, rewards and two flags.
    assert found.size(A) == 2000 * (30 * 4 + 18 * 8 + 4 + 2)


def test_the_table_of_the_package_has_the_small_profiles() -> None:
    for profile in ("cpu", "demo", "smoke"):
        rates = from_table(profile, "cpu")
        assert re.fullmatch(r"measured on .+, \d{4}-\d\d-\d\d", rates.source)
        for domain in ("walker", "quadruped", "jaco"):
            assert 0 < (rates.of("collect", domain, "cudc") or 0) < 0.01
            assert 0 < (rates.of("evaluate", domain, "td3") or 0) < 0.1
    assert from_table("cpu", "cuda").of("collect", "walker", "cudc") is None


@pytest.mark.parametrize("width", [60, 80, 200])
def test_the_table_of_running_jobs_names_each_of_them(width: int) -> None:
    jobs = [job for job in plan("variants").needs if job.kind == "evaluate"][:12]
    running = {job: Running(job, time.monotonic() - 3700, 9000, done=index, total=12) for index, job in enumerate(jobs)}
    screen = Console(file=StringIO(), width=width, force_terminal=True, color_system=None)
    screen.print(running_jobs(running, width))
    assert isinstance(screen.file, StringIO)
    lines = screen.file.getvalue().splitlines()
    assert all(len(line) <= width for line in lines)
    rows = [line for line in lines if "%" in line]
    assert len({line.split("━")[0] for line in rows}) == len(jobs)
    for line in rows:
        assert re.search(r" \d+% +1:01:4\d +\d+:\d\d:\d\d", line), line
