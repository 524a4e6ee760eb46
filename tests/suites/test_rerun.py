"""Runs made again from their records alone come out the same to the last bit, or it is said what does not."""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import cudc_bench
from cudc_bench.artefacts.again import commands_from_nothing
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.cli.app import main
from cudc_bench.errors import UsageError
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.leaderboard.numbers.table import build_tables
from cudc_bench.suites.rerun import rerun

from .test_run import timeless

SHORT = {"gradient_steps": 4, "evaluate_every": 2, "milestones": [2, 4], "final_episodes": 1, "final_evaluations": 1}


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with a dataset whose collection has a setting of its own, labelled, and in ``results`` beside it one training on it."""
    place = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(place / "datasets"))
        cudc_bench.collect("cudc", profile="smoke", settings={"steps": 1200})
        cudc_bench.relabel("walker/cudc-smoke-v0", ["walk"])
        cudc_bench.evaluate(
            "bc", dataset_id="walker/walk/cudc-smoke-v0", profile="smoke", settings=SHORT, output=place / "results", policies=False
        )
    return place


@pytest.fixture
def record(made_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Its record, and no dataset anywhere."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(made_once / "results", tmp_path / "results")
    (found,) = tmp_path.rglob("bc-seed1.json")
    return found


def change(path: Path, **changes: Any) -> Path:
    """A copy of a record in which some parts are others; a path of names is joined by two underscores."""
    content = json.loads(path.read_text())
    for name, value in changes.items():
        *where, last = name.split("__")
        part = content
        for one in where:
            part = part[one]
        part[last] = value
    other = path.with_name("changed.json")
    other.write_text(json.dumps(content))
    return other


def test_a_record_is_all_that_it_takes(record: Path, datasets: Path, tmp_path: Path) -> None:
    before = record.read_bytes()
    (found,) = rerun(record, keep=True)
    assert (found.path, found.collected, found.differences, found.causes) == (record, True, (), ())
    assert found.made is not None
    assert not datasets.exists()  # all of it happened in a folder of its own
    assert record.read_bytes() == before
    old, new = read_record(record), read_record(found.made)
    assert timeless(json.loads(new.model_dump_json())["curve"]) == timeless(json.loads(old.model_dump_json())["curve"])
    assert (new.finals, new.metrics, new.dataset.fingerprint) == (old.finals, old.metrics, old.dataset.fingerprint)
    # What is there already is not made again, and goes once nobody wants to see it.
    made = found.made.stat().st_mtime_ns
    (again,) = rerun(record, keep=True)
    assert again.made == found.made
    assert found.made.stat().st_mtime_ns == made
    rerun(record)
    assert not (tmp_path / "rerun").exists()


def test_defaults_may_have_changed_since(record: Path) -> None:
    """As if the setting of the collection had been the default at its time: the record says it nevertheless."""
    assert read_record(record).dataset.overrides == {"steps": 1200}
    (found,) = rerun(change(record, dataset__overrides={}))
    assert found.differences == ()
    # A record from before it was written down is made with today's, and that is said.
    content = json.loads(record.read_text())
    del content["dataset"]["collection"]
    content["dataset"]["overrides"] = {"steps": 1100}
    record.write_text(json.dumps(content))
    (found,) = rerun(record, scratch="other")
    assert "other data" in found.differences[0]
    assert any("does not say with which hyperparameters" in cause for cause in found.causes)


def test_a_dataset_that_is_here_is_trained_on(record: Path, made_once: Path, datasets: Path, tmp_path: Path) -> None:
    shutil.copytree(made_once / "datasets", datasets)
    (found,) = rerun(record)
    assert (found.collected, found.differences) == (False, ())
    assert not (tmp_path / "rerun").exists()
    # Another one under its name is not.
    cudc_bench.relabel("walker/cudc-smoke-v0", ["run"])
    shutil.rmtree(datasets / "walker" / "walk")
    (datasets / "walker" / "run").rename(datasets / "walker" / "walk")
    (found,) = rerun(record)
    assert (found.collected, found.differences) == (True, ())


def test_what_differs_is_named(record: Path, made_once: Path, datasets: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    shutil.copytree(made_once / "datasets", datasets)
    content = json.loads(record.read_text())
    content["curve"][1]["returns"][0] *= 1 + 1e-15
    content["metrics"][-1]["values"] = {name: value + 1.0 for name, value in content["metrics"][-1]["values"].items()}
    content["versions"]["torch"] = "1.0"
    content["machine"]["processor"] = "abacus"
    record.write_text(json.dumps(content))
    with pytest.raises(SystemExit) as ended:
        main(["rerun", str(record)])
    said = capsys.readouterr()
    assert ended.value.code == 1
    assert "not the same: returns from gradient step 2 on (1 of 3 lines); losses from gradient step 4 on" in said.out
    assert "torch 1.0 (here " in said.err
    assert "processor abacus (here " in said.err
    assert "1 of 1 records came out with other numbers" in said.err
    assert next((tmp_path / "rerun").rglob("bc-seed1.json")).is_file()  # to be looked at


def test_other_data_are_not_trained_on(record: Path, tmp_path: Path) -> None:
    (found,) = rerun(change(record, dataset__fingerprint="0" * 64))
    assert found.made is None
    assert found.differences[0].startswith("the dataset came out with other data")
    for command in commands_from_nothing(read_record(record)):
        assert command in found.differences[0]


def test_the_commands_of_a_record_work_in_an_empty_root(record: Path, cli: Callable, datasets: Path) -> None:
    commands = commands_from_nothing(read_record(record))
    assert [command.split()[1] for command in commands] == ["collect", "relabel", "evaluate"]
    before = timeless(json.loads(record.read_text()))
    shutil.rmtree(record.parents[4])
    for command in commands:
        done = cli(*shlex.split(command)[1:])
        assert done.code == 0, done.err
    after = timeless(json.loads(record.read_text()))
    for name in ("curve", "final", "metrics", "hyperparameters", "overrides", "command"):
        assert after[name] == before[name]
    assert after["dataset"]["fingerprint"] == before["dataset"]["fingerprint"] == read_manifest("walker/walk/cudc-smoke-v0").fingerprint


def test_what_others_handed_in_says_that_it_was_made_again(record: Path, made_once: Path, datasets: Path) -> None:
    (kept,) = cudc_bench.submit(record, "ann", output="ours").files

    def captions() -> list[str]:
        tables, _ = build_tables(load_records([Path("ours")]).records)
        return [table.caption for table in tables]

    assert "Submitted by others, and not run again here: cudc (by ann)." in captions()[0]
    shutil.copytree(made_once / "datasets", datasets)
    rerun(kept)
    there = read_record(kept).submission
    assert there is not None
    assert there.reran is not None
    assert not there.reran.collected
    assert "Submitted by others, and run again here with the same numbers: cudc (by ann)." in captions()[0]
    # Nobody can hand in a claim of that kind.
    with pytest.raises(UsageError, match="handed in before"):
        cudc_bench.submit(kept, "bob", output="ours")


def test_a_claim_that_does_not_hold_stays_one(record: Path, made_once: Path, datasets: Path) -> None:
    (kept,) = cudc_bench.submit(record, "ann", output="ours").files
    shutil.copytree(made_once / "datasets", datasets)
    content = json.loads(kept.read_text())
    content["final"]["returns"][0] += 1.0
    kept.write_text(json.dumps(content))
    before = kept.read_bytes()
    assert rerun(kept)[0].differences
    assert kept.read_bytes() == before


def test_nobodys_folder_and_nobodys_code(record: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds other things"):
        rerun(record, scratch=record.parents[1])
    with pytest.raises(UsageError, match="there is no record at 'missing'"):
        rerun("missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="there is no record in"):
        rerun("empty")
    with pytest.raises(UsageError, match="no dataset of these records is labelled by mine:reward"):
        rerun(record, reward="mine:reward")
    own = change(record, dataset__reward={"reference": "mine:reward", "sha256": "0" * 64})
    with pytest.raises(UsageError, match="to run it here, give --reward mine:reward"):
        rerun(own)
    with pytest.raises(UsageError, match="was imported from ExORL, and no command can collect it"):
        rerun(change(record, dataset__source="ExORL", dataset__profile="imported", dataset__overrides={}))
    assert not (tmp_path / "rerun").exists()


def test_nothing_but_what_was_made_is_ever_removed(record: Path, made_once: Path, datasets: Path, tmp_path: Path) -> None:
    shutil.copytree(made_once / "datasets", datasets)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "rerun.lock").write_text("")  # of a process that was killed at once
    rerun(record, scratch="mine", keep=True)
    note, folder = tmp_path / "mine" / "note.txt", tmp_path / "mine" / "notes"
    note.write_text("mine")
    folder.mkdir()
    stamp = tmp_path / "mine" / "rerun.json"
    stamp.write_text(stamp.read_text().replace("source", "sauce"))  # of other code, so that what was made goes first
    rerun(record, scratch="mine")
    assert sorted(path.name for path in (tmp_path / "mine").iterdir()) == ["note.txt", "notes"]


def test_what_other_code_made_is_made_again(record: Path, made_once: Path, datasets: Path, tmp_path: Path) -> None:
    shutil.copytree(made_once / "datasets", datasets)
    (found,) = rerun(record, keep=True)
    assert found.made is not None
    # As if another version had left it there: a file that says what the record says, though nobody ran anything.
    stamp = tmp_path / "rerun" / "rerun.json"
    stamp.write_text(stamp.read_text().replace("source", "sauce"))
    content = json.loads(record.read_text())
    content["final"]["returns"][0] += 1.0
    for path in (record, found.made):
        path.write_text(json.dumps(content))
    assert rerun(record)[0].differences
