"""Files that are larger than anything of their kind has reason to be: named, left out, and never taken into memory."""

from __future__ import annotations

import json
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import cudc_bench
from cudc_bench.artefacts.manifest import metadata_path, read_manifest
from cudc_bench.artefacts.records import MOST_EVALUATIONS, MOST_SETTINGS, parse_record
from cudc_bench.collectors.running.thresholds import read_thresholds
from cudc_bench.data.diagnostics import read_measures
from cudc_bench.data.storage import open_field
from cudc_bench.errors import CudcBenchError, RunError, UsageError
from cudc_bench.evaluators.policies.stored import _read_weights
from cudc_bench.files import read_limited
from cudc_bench.leaderboard.intake.load import load_records
from cudc_bench.settings.seeds import MOST_SEEDS, check_seeds
from cudc_bench.suites.definition import load_suite
from tests import ROOT

RECORD = next((ROOT / "results").rglob("td3-seed1.json"))


def sparse(path: Path) -> Path:
    """A file of 60 GB that takes no room."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.truncate(60 * 10**9)
    return path


def test_a_pipe_a_device_or_a_file_that_has_grown_is_no_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(OSError, match="a pipe or a device"):
            read_limited(path)
    (tmp_path / "file").write_bytes(b"abc")
    assert read_limited(tmp_path / "file", 3) == b"abc"
    with pytest.raises(OSError, match="it has 3 bytes, where 2 are the most"):
        read_limited(tmp_path / "file", 2)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("walker/cudc-smoke-v0/data/metadata.json", lambda path: read_manifest("walker/cudc-smoke-v0")),
        ("walker/cudc-smoke-v0/diagnostics.jsonl", lambda path: read_measures("walker/cudc-smoke-v0", ["reward"])),
        ("thresholds.json", read_thresholds),
        ("td3-seed1.policy.pt", _read_weights),
        ("my.toml", lambda path: load_suite(str(path))),
    ],
)
def test_one_that_claims_to_be_huge_is_named(name: str, read: Callable[[Path], Any], datasets: Path) -> None:
    path = sparse(datasets / name)
    tracemalloc.start()
    try:
        with pytest.raises(CudcBenchError) as caught:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 2**26
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)


def test_a_huge_record_among_others_is_named_and_left_out(tmp_path: Path) -> None:
    (tmp_path / "good.json").write_bytes(RECORD.read_bytes())
    sparse(tmp_path / "huge.json")
    found = load_records([tmp_path])
    assert len(found.records) == 1
    (problem,) = found.problems
    assert "huge.json: it has 60,000,000,000 bytes, where 16,777,216 are the most that such a file may have" in problem


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("curve", [{"step": step, "returns": [0.0]} for step in range(MOST_EVALUATIONS + 1)]),
        ("overrides", {f"name{number}": 1 for number in range(MOST_SETTINGS + 1)}),
        ("hyperparameters", {f"name{number}": 1 for number in range(MOST_SETTINGS + 1)}),
    ],
)
def test_a_record_of_more_than_any_run_has_is_refused(field: str, value: Any) -> None:
    content = json.loads(RECORD.read_bytes()) | {field: value}
    with pytest.raises(RunError, match=rf"is not a run record: {field}: \w+ should have at most 10?,?00"):
        parse_record(json.dumps(content).encode(), Path("record.json"))


def test_as_many_seeds_as_nobody_has_are_refused() -> None:
    with pytest.raises(UsageError, match="1,001 seeds were given; at most 1,000"):
        check_seeds(range(MOST_SEEDS + 1))


def test_an_array_with_holes_is_not_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "data.hdf5", "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_layout(h5py.h5d.CONTIGUOUS)
        layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((2**33,))
        h5py.h5d.create(file.id, b"rewards", h5py.h5t.py_create(np.dtype("f4")), space, layout)
    assert (tmp_path / "data.hdf5").stat().st_blocks * 512 < 2**20
    with h5py.File(tmp_path / "data.hdf5") as file, pytest.raises(ValueError, match="claims 34,359,738,368 bytes; an array of one episode"):
        open_field(file, "rewards")


def test_a_manifest_may_claim_any_number_of_episodes(smoke: Path) -> None:
    path = metadata_path("walker/cudc-smoke-v0")
    content = json.loads(path.read_text())
    content["cudc_bench"]["episodes"] = content["total_episodes"] = 10**12
    path.write_text(json.dumps(content))
    with pytest.raises(RunError, match=r"the manifest has 1,000,000,000,000 episodes|episodes"):
        cudc_bench.verify("walker/cudc-smoke-v0")
