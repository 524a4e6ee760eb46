"""A full or read-only disk ends a command in one line and loses nothing: with room again, the same command ends as ever."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator

import pytest

from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.reader import verify_fingerprint

from .helpers import COLLECT, EVALUATE, FULL, PILOT, refused, timeless
from .smalldisk import SmallDisk


@pytest.fixture(scope="module")
def small_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SmallDisk]:
    if reason := SmallDisk.obstacle():
        pytest.skip(reason)
    found = SmallDisk(tmp_path_factory.mktemp("small"))
    yield found
    found.close()


@pytest.fixture
def disk(small_disk: SmallDisk) -> SmallDisk:
    """A fresh disk with room."""
    small_disk.mount()
    return small_disk


def fills_up(disk: SmallDisk, sizes: tuple[int, ...], *command: str) -> list[str]:
    """Run a command with so many bytes free, one number after the other, none of which are enough; return what it said."""
    said = []
    for size in sizes:
        disk.leave(size)
        done = disk.run(*command)
        refused(done, 1, FULL)
        said.append(done.line)
        assert not [name for name in disk.files() if name.endswith((".tmp", ".lock")) and "shards" not in name]
    disk.free()
    return said


def test_a_full_disk_stops_a_collection_which_then_ends_as_if_there_had_been_room(disk: SmallDisk) -> None:
    """Shards, checkpoint, HDF5 file, metadata: wherever it strikes."""
    assert disk.run(*COLLECT, "--dataset-id", "walker/undisturbed-v0").code == 0
    root = disk.seen / "datasets"
    building = root / "walker/.random-smoke-v0.building"
    lock, shards, checkpoint = fills_up(disk, (0, 50_000, 400_000), *COLLECT)
    assert "cannot write 'walker/random-smoke-v0':" in lock
    assert "cannot write 'walker/random-smoke-v0' below" in shards
    assert "cannot write a checkpoint into" in checkpoint
    # What stands in the dataset's place stops it when all is collected.
    building.mkdir()
    (building / "dataset").write_text("")
    refused(disk.run(*COLLECT), 1, "cannot write 'walker/random-smoke-v0'")
    (building / "dataset").unlink()
    assert sorted(path.name for path in building.iterdir()) == ["checkpoints", "diagnostics.jsonl", "shards"]
    kept = (building / "diagnostics.jsonl").read_bytes()
    for size in (5_000, 30_000, 120_000, 128_000, 250_000, 280_000):
        shutil.rmtree(building / "dataset", ignore_errors=True)
        assert any("below" in line for line in fills_up(disk, (size,), *COLLECT))
        assert "walker/undisturbed-v0" in disk.listed()
        assert "walker/random-smoke-v0" not in disk.listed()
    assert (building / "diagnostics.jsonl").read_bytes() == kept
    assert disk.run(*COLLECT).code == 0
    assert verify_fingerprint("walker/random-smoke-v0", root) == read_manifest("walker/undisturbed-v0", root).fingerprint
    assert "walker/random-smoke-v0" in disk.listed()


@pytest.fixture
def labelled(disk: SmallDisk) -> SmallDisk:
    """A disk with a small dataset, labelled."""
    assert disk.run(*COLLECT).code == 0
    assert disk.run("relabel", "walker/random-smoke-v0", "--task", "walk").code == 0
    return disk


def test_a_full_disk_stops_relabelling_which_goes_on_with_the_tasks_that_are_left(labelled: SmallDisk) -> None:
    disk, relabel = labelled, ("relabel", "walker/random-smoke-v0", "--tasks", "walk,run")
    for line in fills_up(disk, (0, 6_000, 12_000, 18_000), *relabel):
        assert "cannot write 'walker/run/random-smoke-v0'" in line
    assert "walker/run" not in disk.listed()
    assert not (disk.seen / "datasets/walker/run").exists()
    assert disk.run(*relabel).code == 0
    assert verify_fingerprint("walker/run/random-smoke-v0", disk.seen / "datasets")
    assert "walker/run/random-smoke-v0" in disk.listed()


def test_a_full_disk_stops_an_evaluation_and_what_is_made_of_it(labelled: SmallDisk) -> None:
    """Lock, checkpoint, policy, record; then the leaderboard, an exported policy, a video."""
    disk = labelled
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/random-smoke-v0")
    undisturbed, output = disk.place / "undisturbed", disk.place / "results"
    name = "smoke/walker/walk/random-smoke-v0/td3-seed1.json"
    assert disk.run(*evaluate, "--output", str(undisturbed)).code == 0
    said = fills_up(disk, (0, 4096, 12_288), *evaluate, "--output", str(output))
    for line, what in zip(said, (str(output / name), "the policy", "the record"), strict=True):
        assert f"cannot write {what}" in line or f"cannot write '{what}" in line
    (line,) = fills_up(disk, (40_000,), *evaluate, "--output", str(output), "--checkpoint-every", "0")
    assert "cannot write a checkpoint" in line
    assert not (disk.seen / "results" / name).exists()
    assert disk.run(*evaluate, "--output", str(output)).code == 0
    first, second = (timeless(json.loads((disk.seen / one.name / name).read_text())) for one in (undisturbed, output))
    assert first == second
    for command in (
        ("leaderboard", str(output), "--output", str(disk.place / "report")),
        ("export", str(output / name)),
        ("render", str(output / name), "--output", str(disk.place / "a.gif"), "--width", "16", "--height", "16", "--fps", "1"),
    ):
        before = disk.files()
        fills_up(disk, (0,), *command)
        assert not [one for one in disk.files() if one not in before and (disk.seen / one).is_file()]
    assert disk.run("leaderboard", str(output), "--output", str(disk.place / "report")).code == 0


def test_a_full_disk_stops_a_pilot(disk: SmallDisk) -> None:
    lock, shards, checkpoint = fills_up(disk, (0, 50_000, 400_000), *PILOT)
    assert "cannot write a pilot of cudc-vary-icm on walker:" in lock
    assert "cannot write a pilot of cudc-vary-icm on walker into" in shards
    assert "cannot write a checkpoint" in checkpoint
    assert not (disk.seen / "thresholds.json").exists()
    assert disk.run(*PILOT).code == 0
    assert json.loads((disk.seen / "thresholds.json").read_text())["thresholds"][0]["updates"] > 0
    assert disk.files() == ["thresholds.json"]


def test_a_disk_that_is_read_only_is_seen_before_any_work(labelled: SmallDisk) -> None:
    disk = labelled
    before = disk.files()
    disk.remount("ro")
    try:
        for command in (
            ("collect", "--seed", "2"),
            ("relabel", "walker/random-smoke-v0", "--task", "run"),
            (*EVALUATE, "--dataset-id", "walker/walk/random-smoke-v0", "--output", str(disk.place / "results")),
            (*EVALUATE, "--dataset-id", "walker/walk/random-smoke-v0", "--output", "elsewhere"),
            ("pilot",),
            ("leaderboard", "--output", str(disk.place / "report")),
        ):
            done = disk.run(*command)
            refused(done, 2, "cannot be written")
            assert len(done.err.splitlines()) == 1
        # What is made of it and kept elsewhere needs no more than reading.
        assert disk.run("verify", "walker/walk/random-smoke-v0").code == 0
        assert "walker/random-smoke-v0" in disk.listed()
    finally:
        disk.remount("rw")
    assert disk.files() == before
    assert not (disk.place.parent / "elsewhere").exists()
