"""Damaged files are noticed: a run goes on from what is whole, and what cannot be read is named in one line."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import minari
import pytest

from cudc_bench.artefacts.manifest import FieldHasher, fingerprint, metadata_path, read_manifest
from cudc_bench.cli import app as command_line
from cudc_bench.collectors.running import loop
from cudc_bench.data.reader import verify_fingerprint
from cudc_bench.data.transitions import load_transitions
from cudc_bench.errors import RunError
from cudc_bench.execution import interrupts

from .helpers import COLLECT, EVALUATE, HDF5, PILOT, refused, timeless


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
        at(2500, interrupts.request_stop, patch)
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
    damage(datasets / "walker/.icm-smoke-v0.building")
    went = []
    real = loop._Run.step
    monkeypatch.setattr(loop._Run, "step", lambda run: (went.append(run.steps), real(run))[1])
    done = main(*LONGER)
    assert (done.code, done.out) == (0, "walker/icm-smoke-v0\n"), done.err
    assert went[0] == place
    assert ("the run starts over" in done.err) == (place == 0)
    first, second = (read_manifest("walker/icm-smoke-v0", root) for root in (undisturbed, datasets))
    assert verify_fingerprint("walker/icm-smoke-v0") == first.fingerprint
    assert second.final_state == first.final_state
    inside = "walker/icm-smoke-v0/diagnostics.jsonl"
    assert (datasets / inside).read_bytes() == (undisturbed / inside).read_bytes()


def test_a_run_that_started_over_keeps_its_own_checkpoints(
    main: Callable, datasets: Path, interrupted_once: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Damaged ones of later steps are not what is kept in their stead."""
    shutil.copytree(interrupted_once, datasets)
    checkpoints = datasets / "walker/.icm-smoke-v0.building/checkpoints"
    for path in checkpoints.glob("*.pt"):
        flip(path)
    at(1200, interrupts.request_stop, monkeypatch)
    assert main(*LONGER).code == 130
    assert sorted(int(path.stem) for path in checkpoints.glob("*.pt")) == [1000, 1200]


def test_an_evaluation_goes_on_from_the_checkpoint_that_is_whole(
    main: Callable, smoke: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", "--checkpoint-every", "0")
    name = "smoke/walker/walk/cudc-smoke-v0/td3-seed1.json"
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


@pytest.mark.parametrize("what", ["cut", "flipped", "missing"])
@pytest.mark.parametrize("which", ["walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"])
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
            array = file["episode_1/infos/physics" if which == "walker/cudc-smoke-v0" else "episode_1/rewards"]
            place = array.id.get_offset() + array.id.get_storage_size() // 2
            size = path.stat().st_size
        flip(path, (place + 0.5) / size)
    output = ("--output", "results")
    if which == "walker/cudc-smoke-v0":
        refused(main("relabel", which, "--task", "walk", "--overwrite"), 1, f"'{which}'", "changed after" if what == "flipped" else HDF5)
        assert read_manifest("walker/walk/cudc-smoke-v0").task == "walk"
    if which != "walker/cudc-smoke-v0" or what != "flipped":  # an agent never sees the physics
        done = main(*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", *output)
        refused(done, 1, "walker/walk/cudc-smoke-v0'", "rewards changed" if what == "flipped" else HDF5)
        assert not list(Path("results").rglob("*.json"))
    refused(main("verify", which), 1, f"'{which}' fails the check")
    assert main("list").code == 0
    assert "walker/walk/cudc-smoke-v0" in minari.list_local_datasets()


def replaced(name: str, change: Callable[[Any], Any]) -> Callable[[Any], None]:
    """Store an array anew, as another type or with other numbers."""

    def damage(group: Any) -> None:
        values = change(group[name][()])
        del group[name]
        group[name] = values

    return damage


def with_nan(array: Any) -> Any:
    array[5] = float("nan")
    return array


BASES = {
    "an observation": (replaced("observations", lambda x: x + 1e-3), False, "observations changed after it was made"),
    "ends": (replaced("terminations", lambda x: ~x), False, "terminations changed after it was made"),
    "byte order": (replaced("actions", lambda x: x.astype(">f4")), True, "numbers in another byte order"),
    "type": (replaced("observations", lambda x: x.astype("f8")), True, "observations has rows of float64 (24,), not of float32"),
    "type of ends": (replaced("truncations", lambda x: x.astype("i8")), True, "truncations has rows of int64 (), not of bool"),
    "not finite": (replaced("infos/physics", with_nan), True, "a number of infos/physics is not finite, first in row 5"),
    "wild action": (replaced("actions", lambda x: x * 5), True, "an action is out of [-1, 1]"),
    "a word for a seed": (lambda group: group.attrs.__setitem__("seed", "one"), False, "the seed of /episode_1 is no number"),
    "seeds": (lambda group: group.attrs.__setitem__("seed", [1, 2]), False, "the seed of /episode_1 is no number"),
}


@pytest.mark.parametrize("standalone", [(), ("--standalone",)], ids=["linked", "standalone"])
@pytest.mark.parametrize("what", BASES)
def test_a_damaged_base_is_not_relabelled(what: str, standalone: tuple[str, ...], main: Callable, smoke: Path) -> None:
    """Whatever of it is damaged, what rewards are not made of included; also with hashes that fit the damage."""
    damage, forged, says = BASES[what]
    path = smoke / "walker/cudc-smoke-v0" / HDF5
    with h5py.File(path, "r+") as file:
        damage(file["episode_1"])
        hasher = FieldHasher()
        for index in range(3):
            for name in read_manifest("walker/cudc-smoke-v0").fields:
                hasher.update(name, file[f"episode_{index}/{name}"][()])
    if forged:
        metadata = metadata_path("walker/cudc-smoke-v0")
        content = json.loads(metadata.read_text())
        content["cudc_bench"] |= {"fields": hasher.digests(), "fingerprint": fingerprint(hasher.digests())}
        metadata.write_text(json.dumps(content))
    before = sorted((smoke / "walker").rglob("*"))
    refused(main("relabel", "walker/cudc-smoke-v0", "--task", "run", "--overwrite", *standalone), 1, says)
    assert sorted((smoke / "walker").rglob("*")) == before


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
    first = read_manifest("walker/random-smoke-v0")
    cut(metadata_path("walker/random-smoke-v0"))
    refused(main(*COLLECT), 2, "'walker/random-smoke-v0' exists (not a dataset of cudc-bench); use --overwrite")
    refused(main("verify", "walker/random-smoke-v0"), 1, "the metadata of 'walker/random-smoke-v0' cannot be read")
    assert main(*COLLECT, "--overwrite").code == 0
    assert verify_fingerprint("walker/random-smoke-v0") == first.fingerprint


@pytest.mark.parametrize("change", ["deleted", "replaced"])
def test_a_base_that_is_gone_or_another_is_one_line(change: str, main: Callable, smoke: Path) -> None:
    one = "walker/walk/cudc-smoke-v0"
    shutil.rmtree(smoke / "walker/cudc-smoke-v0")
    if change == "replaced":
        assert main(*COLLECT, "--dataset-id", "walker/cudc-smoke-v0").code == 0
    what = "links to 'walker/cudc-smoke-v0', which is missing" if change == "deleted" else "was made from another 'walker/cudc-smoke-v0'"
    with pytest.raises(RunError, match=what):
        load_transitions(one)
    refused(main(*EVALUATE, "--dataset-id", one, "--output", "results"), 1, what)
    refused(main("verify", one), 1, what)
    assert one in minari.list_local_datasets()
    if change == "replaced":
        refused(main(*EVALUATE, "--task", "walk", "--output", "results"), 1, what)
        assert main("relabel", "walker/cudc-smoke-v0", "--task", "walk", "--overwrite").code == 0
        assert main("verify", one).code == 0


def test_damaged_records_policies_and_thresholds_are_one_line(main: Callable, smoke: Path, tmp_path: Path) -> None:
    evaluate = (*EVALUATE, "--dataset-id", "walker/walk/cudc-smoke-v0", "--output", "results")
    assert main(*evaluate).code == 0
    record = tmp_path / "results/smoke/walker/walk/cudc-smoke-v0/td3-seed1.json"
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
