"""Full disks, read-only places, damaged files, NaNs and rivals: each ends a command in one line, loses nothing, and traps nobody."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
import torch

from cudc_bench.artefacts.manifest import metadata_path, read_manifest
from cudc_bench.cli import app as command_line
from cudc_bench.collectors.running import loop
from cudc_bench.data.reader import verify_fingerprint
from cudc_bench.data.transitions import load_transitions
from cudc_bench.envs.walker import Walker
from cudc_bench.errors import RunError
from cudc_bench.execution import interrupts

from .served import briefly
from .smalldisk import ROOT, Ended, SmallDisk
from .waiting import PATIENCE

COLLECT = ("collect", "--method", "random", "--workers", "1", "--set", "steps=1000")
SHORT = ("--set", "gradient_steps=4", "--set", "evaluate_every=2", "--set", "milestones=[4]", "--set", "evaluation_episodes=1")
EVALUATE = ("evaluate", "--algo", "td3", "--workers", "1", *SHORT, "--set", "final_episodes=1")
PILOT = (
    "pilot",
    "--method",
    "cudc-vary-icm",
    "--workers",
    "1",
    "--set",
    "steps=2400",
    "--set",
    "seed_steps=500",
    "--set",
    "update_every=10",
)
FULL = "No space left on device; free some space and run the same command again."
TIMED = {"seconds", "created"}


def but(command: tuple[str, ...], **settings: Any) -> tuple[str, ...]:
    """A command with other settings."""
    words = [word for word in command if word != "--set" and word.partition("=")[0] not in settings]
    return tuple(
        part
        for word in [*words, *(f"{name}={value}" for name, value in settings.items())]
        for part in (("--set", word) if "=" in word else (word,))
    )


def refused(done: Ended, code: int, *words: str) -> None:
    """It ended with a code and one line that has some words."""
    lines = [line for line in done.err.splitlines() if "cudc-bench: error:" in line]
    assert (done.code, len(lines)) == (code, 1), done.err
    assert "Traceback" not in done.err
    assert done.line == lines[0]
    for word in words:
        assert word in lines[0], lines[0]


def timeless(value: Any) -> Any:
    """A record or thresholds without what tells the time."""
    if isinstance(value, dict):
        return {name: timeless(one) for name, one in value.items() if name not in TIMED}
    return [timeless(one) for one in value] if isinstance(value, list) else value


# ------------------------------------------------------------------------------------------------------------------------------------ disks


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
    building = root / "walker/.random-v0.building"
    lock, shards, checkpoint = fills_up(disk, (0, 50_000, 400_000), *COLLECT)
    assert "cannot write 'walker/random-v0':" in lock
    assert "cannot write 'walker/random-v0' below" in shards
    assert "cannot write a checkpoint into" in checkpoint
    # What stands in the dataset's place stops it when all is collected.
    building.mkdir()
    (building / "dataset").write_text("")
    refused(disk.run(*COLLECT), 1, "cannot write 'walker/random-v0'")
    (building / "dataset").unlink()
    assert sorted(path.name for path in building.iterdir()) == ["checkpoints", "diagnostics.jsonl", "shards"]
    kept = (building / "diagnostics.jsonl").read_bytes()
    for size in (5_000, 30_000, 120_000, 128_000, 250_000, 280_000):
        shutil.rmtree(building / "dataset", ignore_errors=True)
        assert any("below" in line for line in fills_up(disk, (size,), *COLLECT))
        assert "walker/undisturbed-v0" in disk.listed()
        assert "walker/random-v0" not in disk.listed()
    assert (building / "diagnostics.jsonl").read_bytes() == kept
    assert disk.run(*COLLECT).code == 0
    assert verify_fingerprint("walker/random-v0", root) == read_manifest("walker/undisturbed-v0", root).fingerprint
    assert "walker/random-v0" in disk.listed()


@pytest.fixture
def labelled(disk: SmallDisk) -> SmallDisk:
    """A disk with a small dataset, labelled."""
    assert disk.run(*COLLECT).code == 0
    assert disk.run("relabel", "walker/random-v0", "--task", "walk").code == 0
    return disk


def test_a_full_disk_stops_relabelling_which_goes_on_with_the_tasks_that_are_left(labelled: SmallDisk) -> None:
    disk, relabel = labelled, ("relabel", "walker/random-v0", "--tasks", "walk,run")
    for line in fills_up(disk, (0, 6_000, 12_000, 18_000), *relabel):
        assert "cannot write 'walker/run/random-v0'" in line
    assert "walker/run" not in disk.listed()
    assert not (disk.seen / "datasets/walker/run").exists()
    assert disk.run(*relabel).code == 0
    assert verify_fingerprint("walker/run/random-v0", disk.seen / "datasets")
    assert "walker/run/random-v0" in disk.listed()


def test_a_full_disk_stops_an_evaluation_and_what_is_made_of_it(labelled: SmallDisk) -> None:
    """Lock, checkpoint, policy, record; then the leaderboard, an exported policy, a video."""
    disk = labelled
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/random-v0")
    undisturbed, output = disk.place / "undisturbed", disk.place / "results"
    name = "smoke/walker/walk/random-v0/td3-seed1.json"
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
            ("relabel", "walker/random-v0", "--task", "run"),
            (*EVALUATE, "--dataset-id", "walker/walk/random-v0", "--output", str(disk.place / "results")),
            (*EVALUATE, "--dataset-id", "walker/walk/random-v0", "--output", "elsewhere"),
            ("pilot",),
            ("leaderboard", "--output", str(disk.place / "report")),
        ):
            done = disk.run(*command)
            refused(done, 2, "cannot be written")
            assert len(done.err.splitlines()) == 1
        # What is made of it and kept elsewhere needs no more than reading.
        assert disk.run("verify", "walker/walk/random-v0").code == 0
        assert "walker/random-v0" in disk.listed()
    finally:
        disk.remount("rw")
    assert disk.files() == before
    assert not (disk.place.parent / "elsewhere").exists()


# ------------------------------------------------------------------------------------------------------------------------- damaged files


@pytest.fixture
def main(datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """``cudc-bench`` within this process, in ``tmp_path``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")
    threads = torch.get_num_threads()

    def run(*command: str) -> Ended:
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            command_line.main([str(one) for one in command])
        torch.set_num_threads(threads)
        out, err = capfd.readouterr()
        return Ended(int(ended.value.code or 0), out, err)

    return run


def at(step: int, then: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Have something done, once, after so many steps of a collection."""
    real = loop._Run.step

    def stepping(run: Any) -> None:
        real(run)
        if run.steps == step:
            monkeypatch.setattr(loop._Run, "step", real)
            then()

    monkeypatch.setattr(loop._Run, "step", stepping)


def flip(path: Path, place: float = 0.5) -> None:
    """Change one bit in a file."""
    content = bytearray(path.read_bytes())
    content[int(len(content) * place)] ^= 4
    path.write_bytes(content)


def cut(path: Path) -> None:
    """Leave half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


LONGER = ("collect", "--method", "icm", "--workers", "1", "--checkpoint-every", "0", "--set", "seed_steps=1500", "--set", "measure_every=5")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a collection that was left alone."""
    root = tmp_path_factory.mktemp("undisturbed") / "datasets"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        with pytest.raises(SystemExit):
            command_line.main([*LONGER, "--profile", "smoke"])
    return root


@pytest.fixture(scope="module")
def interrupted_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of the same collection, interrupted after 2,500 of its 3,000 steps, with checkpoints of 2,000 and 2,500."""
    root = tmp_path_factory.mktemp("interrupted") / "datasets"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        at(2500, interrupts.ask, patch)
        with pytest.raises(SystemExit) as ended:
            command_line.main([*LONGER, "--profile", "smoke"])
    assert ended.value.code == 130
    return root


DAMAGE: dict[str, tuple[Callable[[Path], None], int]] = {  # what is done to the unfinished dataset, and where the run goes on then
    "nothing": (lambda _: None, 2500),
    "newest checkpoint cut": (lambda folder: cut(folder / "checkpoints/000000002500.pt"), 2000),
    "newest checkpoint flipped": (lambda folder: flip(folder / "checkpoints/000000002500.pt"), 2000),
    "newest checkpoint missing": (lambda folder: (folder / "checkpoints/000000002500.pt").unlink(), 2000),
    "both checkpoints flipped": (lambda folder: [flip(path) for path in (folder / "checkpoints").glob("*.pt")] and None, 0),
    "newest shard flipped": (lambda folder: flip(max((folder / "shards").iterdir())), 0),
    "first shard missing": (lambda folder: min((folder / "shards").iterdir()).unlink(), 0),
    "last line of diagnostics flipped": (lambda folder: flip(folder / "diagnostics.jsonl", 0.999), 2000),
    "diagnostics missing": (lambda folder: (folder / "diagnostics.jsonl").unlink(), 0),
    "run.json cut": (lambda folder: cut(folder / "checkpoints/run.json"), 2500),
    "run.json missing": (lambda folder: (folder / "checkpoints/run.json").unlink(), 2500),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_collection_goes_on_from_what_is_whole_and_ends_the_same(
    what: str, main: Callable, datasets: Path, undisturbed: Path, interrupted_once: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(interrupted_once, datasets)
    damage, place = DAMAGE[what]
    damage(datasets / "walker/.icm-v0.building")
    went = []
    real = loop._Run.step
    monkeypatch.setattr(loop._Run, "step", lambda run: (went.append(run.steps), real(run))[1])
    done = main(*LONGER)
    assert (done.code, done.out) == (0, "walker/icm-v0\n"), done.err
    assert went[0] == place
    assert ("the run starts over" in done.err) == (place == 0)
    first, second = (read_manifest("walker/icm-v0", root) for root in (undisturbed, datasets))
    assert verify_fingerprint("walker/icm-v0") == first.fingerprint
    assert second.final_state == first.final_state
    inside = "walker/icm-v0/diagnostics.jsonl"
    assert (datasets / inside).read_bytes() == (undisturbed / inside).read_bytes()


def test_a_run_that_started_over_keeps_its_own_checkpoints(
    main: Callable, datasets: Path, interrupted_once: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Damaged ones of later steps are not what is kept in their stead."""
    shutil.copytree(interrupted_once, datasets)
    checkpoints = datasets / "walker/.icm-v0.building/checkpoints"
    for path in checkpoints.glob("*.pt"):
        flip(path)
    at(1200, interrupts.ask, monkeypatch)
    assert main(*LONGER).code == 130
    assert sorted(int(path.stem) for path in checkpoints.glob("*.pt")) == [1000, 1200]


def test_an_evaluation_goes_on_from_the_checkpoint_that_is_whole(
    main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", "--checkpoint-every", "0")
    name = "smoke/walker/walk/cudc-v0/td3-seed1.json"
    assert main(*evaluate, "--output", "undisturbed").code == 0
    from cudc_bench.evaluators.running import evaluate as api

    with monkeypatch.context() as patch:
        patch.setattr(api, "write_record", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert main(*evaluate, "--output", "results").code == 130
    kept = sorted((tmp_path / "results/.checkpoints").rglob("*.pt"))
    assert [int(path.stem) for path in kept] == [3, 4]
    flip(kept[-1])
    # What is hidden in the folder of records is none.
    assert "no usable record" in main("leaderboard", "results").line
    assert "Records in results: 0" in main("list", "--output", "results").out
    assert main(*evaluate, "--output", "results").code == 0
    first, second = (timeless(json.loads((tmp_path / one / name).read_text())) for one in ("undisturbed", "results"))
    assert first == second
    assert not (tmp_path / "results/.checkpoints").exists()


HDF5 = "data/main_data.hdf5"


@pytest.mark.parametrize("what", ["cut", "flipped", "missing"])
@pytest.mark.parametrize("which", ["walker/cudc-v0", "walker/walk/cudc-v0"])
def test_a_damaged_dataset_is_one_line_wherever_it_is_read(what: str, which: str, main: Callable, smoke: Path) -> None:
    """Neither a reward nor an agent is made of what is not what was collected; nor anything from the same data as it were whole."""
    path = smoke / which / HDF5
    if what == "cut":
        cut(path)
    elif what == "missing":
        path.unlink()
    else:
        # One bit of the physics of the base, of the rewards of the labelled set.
        import h5py

        with h5py.File(path, "r") as file:
            array = file["episode_1/infos/physics" if which == "walker/cudc-v0" else "episode_1/rewards"]
            place = array.id.get_offset() + array.id.get_storage_size() // 2
            size = path.stat().st_size
        flip(path, (place + 0.5) / size)
    output = ("--output", "results")
    if which == "walker/cudc-v0":
        refused(main("relabel", which, "--task", "walk", "--overwrite"), 1, f"'{which}'", "changed after" if what == "flipped" else HDF5)
        assert read_manifest("walker/walk/cudc-v0").task == "walk"
    if which != "walker/cudc-v0" or what != "flipped":  # an agent never sees the physics
        done = main(*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", *output)
        refused(done, 1, "walker/walk/cudc-v0'", "rewards changed" if what == "flipped" else HDF5)
        assert not list(Path("results").rglob("*.json"))
    refused(main("verify", which), 1, f"'{which}' fails the check")
    assert main("list").code == 0
    assert "walker/walk/cudc-v0" in minari.list_local_datasets()


def damaged_metadata() -> dict[str, str]:
    return {
        "cut": '{"dataset_id": "walker/odd-v0", ', "a list": "[1, 2]", "empty": "",
        "foreign": json.dumps({"dataset_id": "walker/odd-v0", "total_steps": 5}),
        "our key": json.dumps({"dataset_id": "walker/odd-v0", "cudc_bench": {"schema_version": 7}}),
        "our key, no manifest": json.dumps({"dataset_id": "walker/odd-v0", "cudc_bench": None}),
    }  # fmt: skip


@pytest.mark.parametrize("what", damaged_metadata())
def test_a_strangers_dataset_is_passed_over_or_named_in_one_line(what: str, main: Callable, smoke: Path) -> None:
    odd = metadata_path("walker/odd-v0")
    odd.parent.mkdir(parents=True)
    odd.write_text(damaged_metadata()[what])
    done = main("list")
    assert (done.code, done.err) == (0, "")
    assert "walker/odd-v0" not in done.out
    assert main("diagnostics", "--output", "report").code == 0
    for command, code in (
        (("collect", "--dataset-id", "walker/odd-v0", "--method", "random"), 2),
        (("relabel", "walker/odd-v0"), None),
        ((*EVALUATE, "--dataset-id", "walker/odd-v0", "--output", "results"), None),
        (("verify", "walker/odd-v0"), None),
        (("diagnostics", "walker/odd-v0"), None),
    ):
        done = main(*command)
        refused(done, done.code if code is None else code, "'walker/odd-v0'")
        assert done.code in (1, 2)
    assert odd.read_text() == damaged_metadata()[what]
    assert sorted(path.name for path in (smoke / "walker").iterdir() if path.name.startswith(".")) == []


def test_damaged_metadata_of_an_own_dataset_can_be_written_anew(main: Callable, datasets: Path) -> None:
    assert main(*COLLECT).code == 0
    first = read_manifest("walker/random-v0")
    cut(metadata_path("walker/random-v0"))
    refused(main(*COLLECT), 2, "'walker/random-v0' exists (not a dataset of cudc-bench); use --overwrite")
    refused(main("verify", "walker/random-v0"), 1, "the metadata of 'walker/random-v0' cannot be read")
    assert main(*COLLECT, "--overwrite").code == 0
    assert verify_fingerprint("walker/random-v0") == first.fingerprint


@pytest.mark.parametrize("change", ["deleted", "replaced"])
def test_a_base_that_is_gone_or_another_is_one_line(change: str, main: Callable, smoke: Path) -> None:
    one = "walker/walk/cudc-v0"
    shutil.rmtree(smoke / "walker/cudc-v0")
    if change == "replaced":
        assert main(*COLLECT, "--dataset-id", "walker/cudc-v0").code == 0
    what = "links to 'walker/cudc-v0', which is missing" if change == "deleted" else "was made from another 'walker/cudc-v0'"
    with pytest.raises(RunError, match=what):
        load_transitions(one)
    refused(main(*EVALUATE, "--dataset-id", one, "--output", "results"), 1, what)
    refused(main("verify", one), 1, what)
    assert one in minari.list_local_datasets()
    if change == "replaced":
        refused(main(*EVALUATE, "--task", "walk", "--output", "results"), 1, what)
        assert main("relabel", "walker/cudc-v0", "--task", "walk", "--overwrite").code == 0
        assert main("verify", one).code == 0


def test_damaged_records_policies_and_thresholds_are_one_line(main: Callable, smoke: Path, tmp_path: Path) -> None:
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", "--output", "results")
    assert main(*evaluate).code == 0
    record = tmp_path / "results/smoke/walker/walk/cudc-v0/td3-seed1.json"
    policy, whole = record.with_name("td3-seed1.policy.pt"), record.read_bytes()
    flip(policy)
    refused(main("export", record), 1, "the policy", "is damaged")
    policy.unlink()
    refused(main("render", record), 1, "has no policy beside it", "train it again with: cudc-bench evaluate")
    cut(record)
    for command in (evaluate, ("export", record), ("render", record)):
        refused(main(*command), 1, "is not a run record")
    refused(main(*evaluate), 1, "use --overwrite or another --output")
    refused(main("leaderboard", "results"), 2, "no usable record", "is not a run record")
    assert main(*evaluate, "--overwrite").code == 0
    assert timeless(json.loads(record.read_bytes())) == timeless(json.loads(whole))
    thresholds = Path(os.environ["CUDC_BENCH_THRESHOLDS"])
    thresholds.write_text('{"schema_version": 1, "thresh')
    for command in (PILOT, ("collect", "--method", "cudc-vary-icm")):
        refused(main(*command), 1, f"the thresholds in {thresholds} are damaged")
    assert thresholds.read_text() == '{"schema_version": 1, "thresh'


# ------------------------------------------------------------------------------------------------------------------- numbers that are none

LEARN = (
    "collect",
    "--method",
    "icm",
    "--workers",
    "1",
    "--checkpoint-every",
    "0",
    "--set",
    "seed_steps=1200",
    "--set",
    "measure_every=500",
)


def clean(datasets: Path) -> bool:
    """Whether nothing of a dataset is left, visible or hidden."""
    return [path.name for path in datasets.rglob("*") if path.name not in ("walker", "namespace_metadata.json")] == []


def poison(name: str, step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a simulator write a NaN at a step of its second episode, into its observation or its state."""
    real, calls = getattr(Walker, name), 0

    def written(simulator: Walker, out: Any) -> None:
        nonlocal calls
        calls += 1
        real(simulator, out)
        if calls == 1001 + step:
            out[3] = np.nan

    monkeypatch.setattr(Walker, name, written)


@pytest.mark.parametrize(
    ("step", "where"), [(50, "in the episode before step 2,000"), (700, "at step 1,699")], ids=["random actions", "own actions"]
)
def test_a_nan_in_an_observation_never_reaches_a_network_or_a_dataset(
    step: int, where: str, main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison("observe", step, monkeypatch)
    # Random actions do not depend on what was observed: it is found when the episode ends.
    early = 2999 if step == 50 else 1200
    refused(
        main(*but(LEARN, seed_steps=early)),
        1,
        f"the simulation broke down {where}: what was observed is not finite; run again with another seed.",
    )
    assert clean(datasets)


def test_a_nan_in_a_state_is_not_stored(main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poison("state", 5, monkeypatch)
    refused(main(*but(COLLECT, steps=2000)), 1, "the simulation broke down in the episode before step 2,000")
    assert clean(datasets)


def test_a_collection_that_blows_up_says_so_and_does_not_stand_in_the_next_ones_way(main: Callable, datasets: Path) -> None:
    """In the actions before any metric is looked at, and in the metrics of a line."""
    huge = but(LEARN, learning_rate=1e30)
    refused(main(*huge), 1, "training broke down at step 1,2", "not finite; try a smaller learning_rate.")
    assert clean(datasets)
    refused(main(*but(huge, measure_every=1)), 1, "training broke down at step 1,2", "not finite; try a smaller learning_rate.")
    assert clean(datasets)
    assert main(*LEARN).code == 0


def test_a_run_interrupted_after_it_broke_is_given_up_when_it_is_continued(
    main: Callable, datasets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its checkpoint holds the broken networks: with the same command it fails once more, and then the next one starts."""
    from cudc_bench.collectors.icm import ICM

    real, calls = ICM.update, 0

    def update(collector: Any, batch: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 10:
            with torch.no_grad():
                next(iter(collector.actor.parameters())).fill_(float("nan"))
            interrupts.ask()
        return real(collector, batch)

    with monkeypatch.context() as patch:
        patch.setattr(ICM, "update", update)
        assert main(*LEARN).code == 130
    assert list(datasets.rglob("*.pt"))
    refused(main(*LEARN), 1, "training broke down at step", "actions not finite")
    assert clean(datasets)
    assert main(*but(LEARN, learning_rate=1e-3)).code == 0


def test_a_training_that_blows_up_is_one_line_and_leaves_no_record(main: Callable, smoke: Path, tmp_path: Path) -> None:
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", "--output", "results", "--checkpoint-every", "0")
    refused(main(*but(evaluate, learning_rate=1e30)), 1, "training broke down", "not finite; try a smaller learning_rate.")
    assert not [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    assert main(*evaluate).code == 0


def test_actions_and_returns_of_an_evaluation_are_finite(
    main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Broken networks are named before MuJoCo complains of its controls, and what it measures before it is recorded."""
    from cudc_bench.evaluators.td3 import TD3

    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", "--output", "results")
    with monkeypatch.context() as patch:
        patch.setattr(TD3, "act", lambda self, observation: torch.full((*observation.shape[:2], 6), float("nan")))
        refused(main(*evaluate), 1, "training broke down before this evaluation: actions not finite; try a smaller learning_rate.")
    with monkeypatch.context() as patch:
        patch.setattr(Walker, "quantities", lambda self, out: out.fill(np.nan))
        refused(main(*evaluate), 1, "the simulation broke down in an evaluation")
    assert not list((tmp_path / "results").rglob("*.json"))
    assert main(*evaluate).code == 0


def test_a_pilot_that_blows_up_does_not_stand_in_the_next_ones_way(main: Callable, tmp_path: Path) -> None:
    refused(main(*but(PILOT, learning_rate=1e30)), 1, "not finite", "try a smaller learning_rate.")
    # One that is too short to have learnt anything says so each time, too, and leaves nothing to continue.
    refused(main(*but(PILOT, seed_steps=1079)), 1, "learnt nothing within 1,080 steps; take a longer run or fewer seed_steps.")
    thresholds = Path(os.environ["CUDC_BENCH_THRESHOLDS"])
    assert not thresholds.exists()
    assert main(*PILOT).code == 0
    assert thresholds.exists()


def test_a_simulation_that_diverges_is_one_line_in_every_command(
    main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A speed that MuJoCo warns of and resets by itself."""
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", "--output", "results", "--checkpoint-every", "0")
    assert main(*evaluate).code == 0
    record = tmp_path / "results/smoke/walker/walk/cudc-v0/td3-seed1.json"
    real, calls = Walker.step, 0

    def step(simulator: Walker, action: Any) -> None:
        nonlocal calls
        calls += 1
        if calls % 1500 == 999:
            simulator.data.qvel[2] = 1e12
        real(simulator, action)

    monkeypatch.setattr(Walker, "step", step)
    line = "the walker simulation diverged (mjWARN_BADQ"
    before = sorted(tmp_path.rglob("*"))
    for command in (
        ("collect", "--method", "random", "--workers", "1", "--checkpoint-every", "0"),
        (*evaluate, "--overwrite"),
        ("render", record, "--output", "a.gif", "--width", "16", "--height", "16", "--fps", "1"),
    ):
        calls = 0
        refused(main(*command), 1, line, "run again with another seed.")
    assert sorted(tmp_path.rglob("*")) == before
    assert not (smoke / "walker/random-v0").exists()
    assert [path.name for path in (smoke / "walker").iterdir() if path.name.startswith(".")] == []


REWARD = """
import os
import numpy as np

calls = 0

def hop(measured):
    global calls
    calls += 1
    # In an evaluation only after a while, when there is a checkpoint.
    wrong = os.environ.get("WRONG") if len(measured["action"]) > 1 or calls > 1500 else None
    if wrong == "raises":
        raise ZeroDivisionError("division by zero")
    rewards = measured["torso_height"] * 1.0
    return {"nan": rewards * np.nan, "shape": rewards[:0]}.get(wrong, rewards)
"""


@pytest.mark.parametrize(
    ("wrong", "line"), [("nan", "numbers that are not finite"), ("shape", "shape (0,)"), ("raises", "failed: ZeroDivisionError")]
)
def test_a_reward_function_that_fails_is_one_line_and_once_mended_the_same_command_goes_on(
    wrong: str, line: str, main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"own_{wrong}.py").write_text(REWARD)
    monkeypatch.syspath_prepend(tmp_path)
    reward = ("--reward", f"own_{wrong}:hop")
    evaluate = (*EVALUATE, "--dataset-id", "walker/hop/cudc-v0", "--output", "results", "--checkpoint-every", "0", *reward)
    with monkeypatch.context() as patch:
        patch.setenv("WRONG", wrong)
        refused(main("relabel", "walker/cudc-v0", *reward), 1, f"the reward function own_{wrong}:hop", line)
    assert not (smoke / "walker/hop").exists()
    assert main("relabel", "walker/cudc-v0", *reward).code == 0
    with monkeypatch.context() as patch:
        patch.setenv("WRONG", wrong)
        refused(main(*evaluate), 1, f"the reward function own_{wrong}:hop", line)
    assert not [path for path in (tmp_path / "results").rglob("*") if path.is_file()]
    assert main(*evaluate).code == 0


# ----------------------------------------------------------------------------------------------------------------------------------- rivals


def test_of_two_that_start_at_the_same_moment_one_works_and_the_other_names_it(tmp_path: Path) -> None:
    races = {"collect": 16, "relabel": 6, "evaluate": 4}
    command = [sys.executable, "-m", "tests.racing", *(str(word) for pair in races.items() for word in pair)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"TMPDIR": str(tmp_path)}, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    for line, times in zip(done.stdout.splitlines(), races.values(), strict=True):
        found = json.loads(line)
        assert sum(found.values()) == times
        # In every second race they meet, however fast the machine is.
        assert found["refused"] >= times // 2


def a_dead_process() -> int:
    child = os.fork()
    if not child:
        os._exit(0)
    os.waitpid(child, 0)
    return child


@pytest.fixture
def three(smoke: Path) -> list[tuple[tuple[str, ...], Path, Path]]:
    """Commands, the lock of each, and the file by which what it makes is known."""
    shutil.rmtree(smoke / "walker/run")
    record = "smoke/walker/walk/cudc-v0/td3-seed1"
    return [
        (COLLECT, smoke / "walker/.random-v0.lock", smoke / "walker/random-v0" / HDF5),
        (("relabel", "walker/cudc-v0", "--task", "run"), smoke / "walker/run/.cudc-v0.lock", smoke / "walker/run/cudc-v0" / HDF5),
        (
            (*EVALUATE, "--dataset-id", "walker/walk/cudc-v0", "--output", "results"),
            Path(f"results/.checkpoints/{record}.lock"),
            Path(f"results/{record}.json"),
        ),
    ]  # fmt: skip


def test_the_lock_of_a_dead_process_is_taken_over(main: Callable, three: list) -> None:
    for command, lock, made in three:
        lock.parent.mkdir(parents=True, exist_ok=True)
        lock.write_text(f"{a_dead_process()} {platform.node()}")
        assert main(*command).code == 0
        assert made.exists()
        assert not lock.exists()


def test_who_comes_when_another_is_done_keeps_what_is_there(main: Callable, three: list, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also who looked when it was not there yet."""
    from cudc_bench.relabelers import api as relabelling
    from cudc_bench.runs import execution

    doors = [(execution, "run_jobs"), (relabelling, "say"), (execution, "run_jobs")]  # behind the first look
    for (command, lock, made), (module, door) in zip(three, doors, strict=True):
        real, before = getattr(module, door), []

        def first(
            *arguments: Any, real: Any = real, before: list = before, here: Any = (module, door, command, made), **options: Any
        ) -> Any:
            module, door, command, made = here
            monkeypatch.setattr(module, door, real)
            with pytest.raises(SystemExit) as ended:
                command_line.main(list(command))
            assert not ended.value.code
            before.append((made.stat().st_ino, made.stat().st_mtime_ns))
            return real(*arguments, **options)

        monkeypatch.setattr(module, door, first)
        for _ in range(2):  # while the other works, and after
            with briefly() if command[0] == "evaluate" else nullcontext():
                assert main(*command).code == 0
            assert before == [(made.stat().st_ino, made.stat().st_mtime_ns)]
        assert not lock.exists()
