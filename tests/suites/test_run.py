"""Suites as people run them: real processes, real stages, small runs."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.ids import dataset_path, parse_id
from cudc_bench.artefacts.manifest import exists, read_manifest
from cudc_bench.artefacts.records import Record, read_record, write_record
from cudc_bench.cli.app import main
from cudc_bench.data.staging import staging
from cudc_bench.errors import HeldError, RunError, UsageError
from cudc_bench.files import lives
from cudc_bench.suites.api import prepare
from cudc_bench.suites.definition import load_suite
from cudc_bench.suites.jobs import expand
from cudc_bench.suites.work import Common, check_same, do, is_ours, remove

from ..waiting import PATIENCE, wait_for

TINY = """
methods = ["random"]
domains = ["jaco"]
tasks = ["reach_top_left"]
algos = ["bc"]
seeds = 1
profile = "smoke"
collect = { steps = 1000 }
evaluate = { gradient_steps = 2, evaluate_every = 2, milestones = [2], final_episodes = 1 }
"""


def timeless(value: Any) -> Any:
    """A record without what may differ between two runs: when, how long, and who was beside it."""
    if isinstance(value, dict):
        return {name: timeless(one) for name, one in value.items() if name not in {"seconds", "created", "beside"}}
    return [timeless(one) for one in value] if isinstance(value, list) else value


def records(folder: Path) -> dict[str, Any]:
    found = {}
    for path in sorted(folder.rglob("*.json")):
        if not any(part.startswith(".") for part in path.relative_to(folder).parts):
            found[path.relative_to(folder).as_posix()] = timeless(json.loads(path.read_text()))
    return found


@pytest.mark.longest
def test_the_papers_main_study_at_the_smoke_profile(
    cli: Callable, datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All domains, one task each and one seed, two at a time; all methods are planned, and two of them run."""
    whole = ["run", "main", "--profile", "smoke", "--seeds", "1", "--tasks", "stand,reach_top_left"]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([*whole, "--dry-run"])
    dry = capsys.readouterr()
    assert (ended.value.code, dry.err) == (0, "")
    assert list(tmp_path.iterdir()) == []
    assert not datasets.exists()
    assert "54 jobs to do, 0 done" in dry.out
    assert re.search(r"time: about \d:\d\d:\d\d with \d+ at a time \(measured on ", dry.out)
    assert re.search(r"disk: about \d", dry.out)

    methods = ("random", "icm")
    done = cli(*whole, "--methods", ",".join(methods), "--workers", "2")
    assert done.code == 0, done.err
    assert "suite main is complete" in done.err
    # It ends with the tables and where the site is, and names no other file.
    assert all(f"{domain}, td3, profile smoke" in done.out for domain in ("walker", "quadruped", "jaco"))
    assert done.out.splitlines()[-1] == "report/index.html"
    assert [line for line in done.out.splitlines() if line.startswith("report/")] == ["report/index.html"]
    found = records(tmp_path / "results")
    tasks = {"walker": "stand", "quadruped": "stand", "jaco": "reach_top_left"}
    assert set(found) == {f"smoke/{domain}/{task}/{method}-smoke-v0/td3-seed1.json" for domain, task in tasks.items() for method in methods}
    for domain in tasks:
        table = (tmp_path / "report" / f"smoke.td3.{domain}" / "table.md").read_text()
        assert all(name in table for name in methods)
    # Its records are those of the plain command.
    cudc_bench.evaluate("td3", "walker", ["stand"], ["icm"], profile="smoke", output=tmp_path / "plain")
    (name,) = records(tmp_path / "plain")
    plain, ours = records(tmp_path / "plain")[name], found[name]
    assert plain == ours

    again = prepare("main", profile="smoke", methods=list(methods), seeds=[1], tasks=["stand", "reach_top_left"])
    assert not again.queue().plan.needs
    # Ten records of seeds 1 to 5 and two domains, of which two are there, and the eight datasets of seeds 2 to 5, labelled.
    wider = prepare("main", profile="smoke", methods=["icm"], tasks=["stand"])
    assert Counter(job.kind for job in wider.queue().plan.needs) == {"collect": 8, "relabel": 8, "evaluate": 8}
    assert {wider.estimates.source(job) for job in wider.queue().plan.of("collect", "evaluate")} == {"measured here"}


BROKEN = """
from dataclasses import dataclass
from cudc_bench.collectors.random import Random

class Broken(Random):
    citation = "nobody"
    def act(self, observation, explore=True):
        raise ValueError("a bug of somebody's own")
"""


def test_a_job_that_fails_stops_no_other_and_datasets_leave_when_their_records_are_written(
    datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package = tmp_path / "package" / "broken-1.0.dist-info"
    package.mkdir(parents=True)
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text("[cudc_bench.collectors]\nbroken = broken_method:Broken\n")
    (package.parent / "broken_method.py").write_text(BROKEN)
    suite = tmp_path / "my.toml"
    suite.write_text(TINY.replace('["random"]', '["broken", "random", "proto"]'))
    # A dataset of somebody's own stays, whatever becomes of the others; so does what is labelled from it.
    cudc_bench.collect("proto", "jaco", profile="smoke", settings={"steps": 1000})
    # Entry points are looked up once in a process; workers get its path.
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.setattr(plugins, "_points", cache(plugins._points.__wrapped__))
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["run", "my.toml", "--keep", "records", "--workers", "1"])
    err = capsys.readouterr().err
    assert ended.value.code == 1, err
    log = "results/.suite/logs/collect-jaco-broken-seed-1.log"
    assert f"failed: collect jaco broken seed 1: ValueError: a bug of somebody's own See {log}" in " ".join(err.split())
    assert "2 jobs that need these could not start" in err
    assert err.splitlines()[-1] == "cudc-bench: error: 3 of 9 jobs are not done, see above; the same command tries them again."
    assert "Traceback" not in err
    said = (tmp_path / log).read_text()
    assert "Traceback" in said
    assert said.splitlines()[-1] == "ValueError: a bug of somebody's own"
    first = records(tmp_path / "results")
    assert set(first) == {f"smoke/jaco/reach_top_left/{name}-smoke-v0/bc-seed1.json" for name in ("random", "proto")}
    assert not exists("jaco/random-smoke-v0")
    assert not exists("jaco/reach_top_left/random-smoke-v0")
    assert exists("jaco/proto-smoke-v0")
    assert exists("jaco/reach_top_left/proto-smoke-v0")
    assert "removed jaco/random-smoke-v0 and 1 labelled from it" in err
    assert list((tmp_path / "report").rglob("table.md"))

    # Another algorithm needs the dataset again: it is the same, and nothing that was recorded is made again.
    suite.write_text(TINY)
    again = cudc_bench.run_suite(
        str(suite), algos=["bc", "td3-bc"], workers=1, output=tmp_path / "results", report=tmp_path / "report"
    )  # fmt: skip
    assert (again.jobs, again.kept, again.failed) == (4, 1, [])
    second = records(tmp_path / "results")
    name = "smoke/jaco/reach_top_left/random-smoke-v0/td3-bc-seed1.json"
    assert set(second) == {*first, name}
    for path in first:
        assert second[path] == first[path]
    assert second[name]["dataset"] == second[name.replace("td3-bc", "bc")]["dataset"]
    note = json.loads((tmp_path / "results/.suite/datasets/jaco/random-smoke-v0.json").read_text())
    assert note["manifest"]["fingerprint"] == read_manifest("jaco/random-smoke-v0").fingerprint
    assert note["manifest"]["command"].startswith("cudc-bench collect --domain jaco --method random --seed 1 --profile smoke")


def started(cli_environment: dict[str, str], folder: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cudc_bench.cli", "run", "my.toml", "--workers", "1", "--checkpoint-every", "0", *options]
    return subprocess.Popen(command, cwd=folder, env=cli_environment, stderr=subprocess.PIPE, text=True, start_new_session=True)


def test_a_killed_scheduler_leaves_no_orphan_and_ctrl_c_leaves_what_goes_on(
    environment: dict[str, str], datasets: Path, tmp_path: Path
) -> None:
    (tmp_path / "my.toml").write_text(TINY.replace("steps = 1000", "steps = 6000000, seed_steps = 500").replace("jaco", "walker").replace(
        "reach_top_left", "walk"
    ))  # fmt: skip
    kept = datasets / "walker" / ".random-smoke-v0.building" / "checkpoints"
    log = tmp_path / "results" / ".suite" / "logs" / "collect-walker-random-seed-1.log"

    def newest() -> int:
        return max((int(path.stem) for path in kept.glob("*.pt")), default=0)

    first = started(environment, tmp_path)
    wait_for(newest, first)
    worker = int(re.search(r"process (\d+):", log.read_text())[1])  # type: ignore[index]
    first.kill()
    first.communicate()
    wait_for(lambda: not lives(worker))
    reached = newest()

    second = started(environment, tmp_path)
    wait_for(lambda: newest() > reached, second)
    # Two schedulers into one folder: the second says who is there.
    with pytest.raises(HeldError, match=f"process {second.pid} is writing a suite into "):
        cudc_bench.run_suite(str(tmp_path / "my.toml"), output=tmp_path / "results", report=tmp_path / "report")
    os.killpg(second.pid, signal.SIGINT)
    _, said = second.communicate(timeout=PATIENCE)
    assert second.returncode == 130, said
    assert re.search(r"error: interrupted: 0 of 3 jobs done; .*random seed 1 at step [\d,]+ of 6,000,000; the same command continues", said)
    assert newest() > reached
    assert not exists("walker/random-smoke-v0")
    worker = int(re.findall(r"process (\d+):", log.read_text())[-1])
    assert not lives(worker)


def test_what_stands_in_the_way_is_refused_before_any_work(datasets: Path, tmp_path: Path) -> None:
    suite = tmp_path / "my.toml"
    suite.write_text(TINY)
    output = tmp_path / "results"
    cudc_bench.collect("random", "jaco", profile="smoke", settings={"steps": 1250})
    with pytest.raises(UsageError, match=r"'jaco/random-smoke-v0' exists \(.*steps=1250.*is of another run; take another root"):
        cudc_bench.run_suite(str(suite), output=output)
    suite.write_text(TINY.replace("steps = 1000", "steps = 1250"))
    cudc_bench.evaluate(
        "bc", "jaco", ["reach_top_left"], ["random"], profile="smoke", steps=2, settings={"final_episodes": 1}, output=output
    )
    with pytest.raises(UsageError, match="records another run"):
        cudc_bench.run_suite(str(suite), output=output)
    suite.write_text(TINY.replace('["random"]', '["rnd"]').replace("steps = 1000", "stesp = 1000"))
    with pytest.raises(UsageError, match=r"nothing here is called 'stesp'\. Did you mean 'steps'"):
        cudc_bench.run_suite(str(suite), output=output)
    suite.write_text(TINY.replace('["random"]', '["rnd"]').replace("final_episodes = 1", "final_episodes = 0"))
    with pytest.raises(UsageError, match="'final_episodes' cannot be 0"):
        cudc_bench.run_suite(str(suite), output=output)
    assert not (output / ".suite").exists()


def test_a_stack_of_seeds_makes_the_same_records(datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU, where one job has them all."""
    suite = replace(load_suite(str(write(tmp_path, TINY))), seeds=(1, 2))
    found = {}
    for stacked in (False, True):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(datasets / str(stacked)))
        ready = prepare(suite, output=tmp_path / str(stacked), report=tmp_path / "report")
        for job in expand(suite, {("jaco", "random"): 1000}, stacked=stacked, profile="smoke").needs:
            do(job, ready.common, lambda done, total: None)
        found[stacked] = records(tmp_path / str(stacked))
        assert not prepare(suite, output=tmp_path / str(stacked), report=tmp_path / "report").queue().plan.needs
    assert len(found[True]) == 2
    assert found[True] == found[False]


def write(folder: Path, text: str) -> Path:
    path = folder / "my.toml"
    path.write_text(text)
    return path


@pytest.fixture
def collected(datasets: Path, tmp_path: Path) -> tuple[Common, Record, Path]:
    """A dataset that a suite made, labelled, with a record of it."""
    (tmp_path / "my.toml").write_text(TINY)
    ready = prepare(str(tmp_path / "my.toml"), output=tmp_path / "results", report=tmp_path / "report")
    for kind in ("collect", "relabel", "evaluate"):
        (job,) = ready.found.plan.of(kind)
        do(job, ready.common, lambda done, total: None)
    (path,) = (tmp_path / "results" / "smoke").rglob("*.json")
    return ready.common, read_record(path), path


def test_only_what_the_suite_made_is_removed(collected: tuple[Common, Record, Path], datasets: Path) -> None:
    common, _, _ = collected
    base, labelled = "jaco/random-smoke-v0", "jaco/reach_top_left/random-smoke-v0"
    assert is_ours(common, base)
    assert is_ours(common, labelled)
    # What somebody else labelled from it needs it.
    (theirs,) = cudc_bench.relabel(base, ["reach_top_right"])
    assert remove(common, base) == ([], 0)
    shutil.rmtree(dataset_path(theirs))
    # Another suite made it, though into the same folder.
    other = replace(common, suite="other")
    assert not is_ours(other, base)
    assert remove(other, base) == ([], 0)
    # It is not the dataset that the suite made, but one that was made since.
    note = common.folder / "datasets" / f"{base}.json"
    ours = note.read_text()
    note.write_text(ours.replace(read_manifest(base).created, "2020-01-01T00:00:00+00:00"))
    assert remove(common, base) == ([], 0)
    # Nobody knows who made it.
    note.unlink()
    assert remove(common, base) == ([], 0)
    assert exists(base)
    note.write_text(ours)
    # Somebody reads or writes it.
    with staging(parse_id(labelled)), pytest.raises(HeldError):
        remove(common, base)
    removed, size = remove(common, base)
    assert removed == [labelled, base]
    assert size > 1000 * 4 * (42 + 9)
    assert not [path for path in datasets.rglob("*") if path.is_file() and path.name != "namespace_metadata.json"]


def test_a_dataset_that_comes_out_different_is_not_trained_on(collected: tuple[Common, Record, Path]) -> None:
    common, record, path = collected
    base = parse_id("jaco/random-smoke-v0")
    check_same(base, common)
    changed = record.model_copy(update={"dataset": record.dataset.model_copy(update={"fingerprint": "0" * 64})})
    write_record(path, changed)
    with pytest.raises(
        RunError, match=r"'jaco/reach_top_left/random-smoke-v0' has other data now \(fingerprint .*\) than when .* \(000000000000\)"
    ):
        check_same(base, common)
