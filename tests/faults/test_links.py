"""Folders that are links to another disk, that cannot be read, or that lead back to where they are."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import cudc_bench
from cudc_bench.artefacts.ids import stored_ids
from cudc_bench.artefacts.records import record_files
from cudc_bench.data.staging import unfinished
from cudc_bench.errors import RunError
from cudc_bench.files import walk
from cudc_bench.leaderboard.intake.load import load_records
from tests import ROOT

RECORDS = sorted((ROOT / "results").rglob("td3-seed1.json"))[:4]


@contextmanager
def as_somebody() -> Iterator[None]:
    """Not as the superuser, who may read everything."""
    me = os.geteuid()
    if me == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(me)


def test_a_folder_of_records_that_is_a_link_is_read(tmp_path: Path) -> None:
    for number, record in enumerate(RECORDS):
        folder = tmp_path / ("disk" if number == 3 else "results") / str(number)
        folder.mkdir(parents=True)
        shutil.copy(record, folder)
    (tmp_path / "results" / "linked").symlink_to(tmp_path / "disk")
    (tmp_path / "results" / "again").symlink_to(tmp_path / "results")
    (tmp_path / "disk" / "back").symlink_to(tmp_path / "results")
    assert len(record_files(tmp_path / "results")) == 4
    assert len(load_records([tmp_path / "results"]).records) == 4


def test_folders_that_link_to_each_other_are_entered_once(tmp_path: Path) -> None:
    for number in range(12):
        (tmp_path / str(number)).mkdir()
        for other in range(12):
            (tmp_path / str(number) / f"to{other}").symlink_to(tmp_path / str(other))
    assert len(list(walk(tmp_path))) == 13


def test_a_folder_that_cannot_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the folders above are not everybody's
    shutil.copy(RECORDS[0], tmp_path)
    (tmp_path / "closed").mkdir(0)
    tmp_path.chmod(0o755)
    with as_somebody():
        found = load_records([Path(".")])
    assert len(found.records) == 1
    assert found.problems == ("the records in closed are left out: it cannot be read: Permission denied.",)


def test_a_dataset_that_is_a_link_is_seen_as_minari_sees_it(datasets: Path, tmp_path: Path) -> None:
    for name in ("data", "other/.unfinished-v0.building"):
        (tmp_path / "disk" / name).mkdir(parents=True)
    (tmp_path / "disk" / "data" / "metadata.json").write_text("{}")
    (datasets / "walker").mkdir(parents=True)
    for name in ("random-smoke-v0", "twin-v0"):
        (datasets / "walker" / name).symlink_to(tmp_path / "disk")
    (datasets / "quadruped").symlink_to(tmp_path / "disk" / "other")
    (datasets / "walker" / "up").symlink_to(datasets)
    assert [str(one) for one in stored_ids()] == ["walker/random-smoke-v0", "walker/twin-v0"]
    assert [str(one) for one, _ in unfinished()] == ["quadruped/unfinished-v0"]


def test_a_labelled_dataset_behind_a_link_says_so(smoke: Path, tmp_path: Path) -> None:
    shutil.move(smoke / "walker" / "walk" / "cudc-smoke-v0", tmp_path / "elsewhere")
    (smoke / "walker" / "walk" / "cudc-smoke-v0").symlink_to(tmp_path / "elsewhere")
    for use in (cudc_bench.load_transitions, cudc_bench.verify):
        with pytest.raises(RunError, match=rf"lies behind a symbolic link, really in '{tmp_path}/elsewhere', from where its links"):
            use("walker/walk/cudc-smoke-v0")
    # The whole root may be one.
    shutil.move(smoke, tmp_path / "root")
    smoke.symlink_to(tmp_path / "root")
    assert cudc_bench.load_transitions("walker/run/cudc-smoke-v0").rewards.any()
