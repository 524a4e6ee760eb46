"""Episode files of ExORL become the dataset that they were made from; whatever does not fit is refused in one line, with nothing left."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tracemalloc
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.lib import format as npy

import cudc_bench
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.records import read_record
from cudc_bench.cli.app import main
from cudc_bench.collectors.importing.exorl import LARGEST, EpisodeFile, FileFault, RawEpisode, list_files, read_episode
from cudc_bench.data.reader import load_episodes, verify_fingerprint
from cudc_bench.data.writer import Episode, EpisodeShards
from cudc_bench.envs import DOMAINS
from cudc_bench.errors import RunError, UsageError
from cudc_bench.stages import check_collected

from ..waiting import PATIENCE, wait_for

Arrays = dict[str, np.ndarray]
WALKER = DOMAINS["walker"]
BASE = "walker/cudc-smoke-v0"


def random_arrays(steps: int, seed: int = 0) -> Arrays:
    """An episode of Walker's shapes in ExORL's alignment."""
    generator = np.random.default_rng(seed)
    actions = generator.uniform(-1, 1, (steps + 1, 6)).astype(np.float32)
    actions[0] = 0
    return {
        "observation": generator.normal(size=(steps + 1, 24)).astype(np.float32),
        "action": actions,
        "reward": generator.uniform(size=(steps + 1, 1)).astype(np.float32),
        "discount": np.ones((steps + 1, 1), np.float32),
        "physics": generator.normal(size=(steps + 1, 18)),
    }


def write(folder: Path, episodes: Sequence[Arrays], name: Callable[[int, int], str] = "episode_{:06d}_{}.npz".format) -> Path:
    """One file for each episode, called after its number and length."""
    folder.mkdir(exist_ok=True)
    for index, arrays in enumerate(episodes):
        (np.savez_compressed if index % 2 else np.savez)(folder / name(index, len(next(iter(arrays.values()))) - 1), **arrays)
    return folder


def exported(dataset_id: str) -> list[Arrays]:
    """The episodes of one of our own datasets in ExORL's alignment: the action in row i led to the observation in row i."""
    data = minari.load_dataset(dataset_id)
    episodes = []
    for episode in data.iterate_episodes():
        rows = len(episode.observations)
        arrays = {
            "observation": episode.observations, "action": np.zeros((rows, 6), np.float32), "reward": np.full((rows, 1), 0.5, np.float32),
            "discount": np.ones((rows, 1), np.float32), "physics": episode.infos["physics"],
        }  # fmt: skip
        for t in range(rows - 1):
            arrays["action"][t + 1] = episode.actions[t]
            arrays["reward"][t + 1] = episode.rewards[t]
        episodes.append(arrays)
    return episodes


def everything(root: Path) -> list[str]:
    return sorted(path.relative_to(root).as_posix() for path in root.rglob("*"))


@pytest.fixture
def files(smoke: Path, tmp_path: Path) -> Path:
    """The episodes of ``walker/cudc-smoke-v0`` as ExORL would have stored them."""
    return write(tmp_path / "files", exported(BASE), "20220101T000000_{}_{}.npz".format)


# ---------------------------------------------------------------------------------------------------------------------- round trip


def test_files_made_from_a_dataset_become_that_dataset_again(files: Path) -> None:
    assert cudc_bench.import_exorl(files, "proto") == "walker/proto-v0"
    ours, theirs = read_manifest(BASE), read_manifest("walker/proto-v0")
    assert theirs.fields == ours.fields
    assert verify_fingerprint("walker/proto-v0") == ours.fingerprint
    assert (theirs.method, theirs.seed, theirs.steps, theirs.episodes, theirs.task) == ("proto", 1, ours.steps, ours.episodes, None)
    for episode, original in zip(minari.load_dataset("walker/proto-v0"), minari.load_dataset(BASE), strict=True):
        np.testing.assert_array_equal(episode.infos["physics"], original.infos["physics"])
        np.testing.assert_array_equal(episode.observations, original.observations)
        np.testing.assert_array_equal(episode.actions, original.actions)
        assert (episode.rewards == 0).all()


def test_relabelled_rewards_are_those_of_the_original(files: Path) -> None:
    cudc_bench.import_exorl(files, "proto")
    for task in cudc_bench.relabel("walker/proto-v0"):
        original = load_episodes(task.replace("proto", "cudc-smoke"), ("rewards",)).arrays["rewards"]
        np.testing.assert_array_equal(load_episodes(task, ("rewards",)).arrays["rewards"], original)
        assert read_manifest(task).imported == read_manifest("walker/proto-v0").imported


def test_a_transition_is_what_row_i_and_the_row_before_it_say(tmp_path: Path) -> None:
    episodes = [random_arrays(steps, seed=steps) for steps in (1, 7, 3)]
    cudc_bench.import_exorl(write(tmp_path / "files", episodes), "proto", task="run")
    expected: list[tuple[np.ndarray, ...]] = []
    for arrays in episodes:
        rows = len(arrays["observation"])
        expected += [
            (arrays["observation"][i - 1], arrays["action"][i], arrays["observation"][i], arrays["reward"][i]) for i in range(1, rows)
        ]
    found = cudc_bench.load_transitions("walker/run/proto-v0", verify=True)
    assert len(found) == 11
    columns = (found.observations, found.actions, found.next_observations, found.rewards[:, None])
    for column, values in zip(columns, zip(*expected, strict=True), strict=True):
        np.testing.assert_array_equal(column, np.stack(values))
    np.testing.assert_array_equal(np.flatnonzero(found.truncations), [0, 7, 10])
    assert not found.terminations.any()


def test_episodes_come_in_the_order_of_their_numbers_not_of_their_names(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    numbers = [10, 9, 100, 1]
    for number in numbers:
        arrays = random_arrays(2)
        arrays["observation"][:] = number
        # The later the episode, the earlier its timestamp.
        write(folder, [arrays], lambda _, steps, number=number: f"2022010{9 - len(str(number))}T000000_{number}_{steps}.npz")
    cudc_bench.import_exorl(folder, "proto")
    firsts = [int(episode.observations[0, 0]) for episode in minari.load_dataset("walker/proto-v0")]
    assert firsts == sorted(numbers)
    assert sorted(path.name for path in folder.iterdir())[0].endswith("_100_2.npz")


def test_without_seeds_minari_and_our_relabeler_say_nothing_of_them(files: Path) -> None:
    cudc_bench.import_exorl(files, "proto")
    cudc_bench.relabel("walker/proto-v0", ["walk"])
    for one in ("walker/proto-v0", "walker/walk/proto-v0"):
        data = minari.load_dataset(one)
        assert [metadata.get("seed") for metadata in data.storage.get_episode_metadata(range(3))] == [None] * 3
        assert read_manifest(one).episode_seed(0) is None
        environment = data.recover_environment()
        assert environment.reset(seed=1)[0].shape == (24,)
    assert read_manifest(BASE).episode_seed(0) is not None


def test_shards_keep_unknown_seeds_unknown(tmp_path: Path) -> None:
    shards = EpisodeShards(tmp_path / "shards")
    for seed in (None, 0, 2**64 - 1):
        shards.add(Episode(seed, np.zeros((2, 1), np.float32), np.zeros((1, 1), np.float32)))
    assert [episode.seed for episode in shards] == [None, 0, 2**64 - 1]


def test_the_manifest_says_that_it_was_imported_and_from_what(files: Path) -> None:
    cudc_bench.import_exorl(files, "proto", seed=2, source="A. Nother")
    manifest = read_manifest("walker/proto-seed2-v0")
    assert manifest.imported is not None
    names = sorted((path.name for path in files.iterdir()), key=lambda name: int(name.split("_")[1]))
    sums = "".join(f"{hashlib.sha256((files / name).read_bytes()).hexdigest()}  {name}\n" for name in names)
    assert manifest.imported.model_dump() == {
        "source": "A. Nother", "files": 3, "sha256": hashlib.sha256(sums.encode()).hexdigest(), "clipped": 0, "ignored": [],
    }  # fmt: skip
    assert (manifest.profile, manifest.hyperparameters, manifest.overrides) == ("imported", {}, {})
    assert manifest.describe() == "proto imported from A. Nother, seed 2, 3,000 steps"
    metadata = minari.load_dataset("walker/proto-seed2-v0").storage.metadata
    assert (metadata["algorithm_name"], metadata["author"]) == ("proto (A. Nother)", {"A. Nother"})
    assert "not collected by cudc-bench" in metadata["description"]
    assert read_manifest(BASE).imported is None


@pytest.mark.parametrize("domain", DOMAINS)
def test_every_domain_takes_files_of_its_own_sizes(domain: str, tmp_path: Path) -> None:
    facts = DOMAINS[domain]
    sizes = {"observation": facts.observation_size, "action": facts.action_size, "physics": facts.physics_size}
    arrays = random_arrays(4) | {name: np.zeros((5, size), np.float32) for name, size in sizes.items()}
    arrays["physics"] = arrays["physics"].astype(np.float64)
    one = cudc_bench.import_exorl(write(tmp_path / "files", [arrays]), "proto", domain, seed=3)
    assert one == f"{domain}/proto-seed3-v0"
    assert minari.load_dataset(one)[0].observations.shape == (5, facts.observation_size)


# ------------------------------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(("steps", "lengths"), [(1, [1]), (5, [5]), (6, [5, 1]), (13, [5, 5, 3]), (15, [5, 5, 5]), (None, [5, 5, 5])])
def test_the_first_steps_in_collection_order(steps: int | None, lengths: list[int], tmp_path: Path) -> None:
    episodes = [random_arrays(5, seed) for seed in range(3)]
    cudc_bench.import_exorl(write(tmp_path / "files", episodes), "proto", steps=steps, task="walk")
    manifest = read_manifest("walker/walk/proto-v0")
    assert (manifest.steps, manifest.episodes, manifest.imported and manifest.imported.files) == (sum(lengths), len(lengths), len(lengths))
    for found, arrays, length in zip(minari.load_dataset("walker/walk/proto-v0"), episodes[: len(lengths)], lengths, strict=True):
        np.testing.assert_array_equal(found.observations, arrays["observation"][: length + 1])
        np.testing.assert_array_equal(found.actions, arrays["action"][1 : length + 1])
        np.testing.assert_array_equal(found.rewards, arrays["reward"][1 : length + 1, 0])
        np.testing.assert_array_equal(found.infos["physics"], arrays["physics"][: length + 1])
        assert found.truncations.tolist() == [False] * (length - 1) + [True]


def test_with_a_task_the_rewards_of_the_files_are_kept(files: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for path in files.iterdir():
        path.unlink()
    write(files, exported("walker/run/cudc-smoke-v0"))
    assert cudc_bench.import_exorl(files, "proto", task="run") == "walker/run/proto-v0"
    manifest, original = read_manifest("walker/run/proto-v0"), read_manifest("walker/run/cudc-smoke-v0")
    assert (manifest.task, manifest.fingerprint, manifest.base) == ("run", original.fingerprint, None)
    with pytest.raises(UsageError, match=r"'walker/run/proto-v0' came with the rewards of run and has no base to relabel; import it"):
        cudc_bench.relabel("walker/run/proto-v0")


def test_without_physics_states_it_says_what_cannot_be_done(files: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write(files, [{name: array for name, array in arrays.items() if name != "physics"} for arrays in exported(BASE)])
    for path in files.glob("2022*"):
        path.unlink()
    cudc_bench.import_exorl(files, "proto")
    assert "the files hold no physics states: the dataset can never be labelled for a task" in capfd.readouterr().err
    assert "infos/physics" not in read_manifest("walker/proto-v0").fields
    assert "no physics states and cannot be relabelled" in minari.load_dataset("walker/proto-v0").storage.metadata["description"]
    with pytest.raises(UsageError, match=r"holds no physics states and cannot be relabelled; if the rewards in its files are a task's, "):
        cudc_bench.relabel("walker/proto-v0")
    with pytest.raises(UsageError, match="holds no physics states"):
        cudc_bench.evaluate("td3", dataset_id="walker/proto-v0", profile="smoke")


def test_arrays_with_a_row_for_each_step_are_kept_and_others_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    kept = {"skill": np.eye(6, dtype=np.float32), "option": np.arange(6), "done": np.arange(6) > 3}
    ignored = {"config": np.array("text"), "Weird\x1bName": np.arange(6), "short": np.arange(5), "pixels": np.zeros((6, 2000), np.uint8)}
    cudc_bench.import_exorl(write(tmp_path / "files", [random_arrays(5) | kept | ignored] * 2), "aps")
    for episode in minari.load_dataset("walker/aps-v0"):
        assert set(episode.infos) == {"physics", *kept}
        for name, values in kept.items():
            np.testing.assert_array_equal(episode.infos[name], values)
    manifest = read_manifest("walker/aps-v0")
    assert manifest.imported is not None
    assert manifest.imported.ignored == [r"'Weird\x1bName'", "'config'", "'pixels'", "'short'"]
    said = capfd.readouterr().err
    assert r"ignored, since not numbers with a row for each step: 'Weird\x1bName', 'config', 'pixels', 'short'" in said
    assert "\x1b" not in said


def test_rounding_beyond_the_bounds_is_clipped_and_counted(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arrays = random_arrays(3)
    arrays["action"][1:3, 0] = np.nextafter(np.float32(1), np.float32(2))
    arrays["action"][3, 1:3] = np.float32(-1.000001)
    cudc_bench.import_exorl(write(tmp_path / "files", [arrays]), "proto", steps=2)
    assert "2 of 12 numbers in actions were beyond [-1, 1] by rounding: clipped" in capfd.readouterr().err
    manifest = read_manifest("walker/proto-v0")
    assert manifest.imported is not None
    assert manifest.imported.clipped == 2
    assert np.abs(cudc_bench.load_transitions("walker/proto-v0").actions).max() == 1.0


def test_missing_episodes_are_counted(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    cudc_bench.import_exorl(write(tmp_path / "files", [random_arrays(2)] * 3, lambda index, steps: f"t_{4 * index}_{steps}.npz"), "proto")
    assert "6 episodes between 0 and 8 are missing" in capfd.readouterr().err


def test_an_existing_dataset_is_replaced_only_when_told_to(files: Path) -> None:
    there = "walker/cudc-smoke-v0"
    with pytest.raises(UsageError, match=rf"'{there}' exists \(cudc, profile smoke, seed 1, 3,000 steps\); use --overwrite"):
        cudc_bench.import_exorl(files, "cudc", dataset_id=there)
    cudc_bench.import_exorl(files, "cudc", dataset_id=there, overwrite=True)
    with pytest.raises(UsageError, match=rf"'{there}' exists \(cudc imported from ExORL, seed 1, 3,000 steps\); use --overwrite"):
        cudc_bench.collect("cudc", profile="smoke")
    assert cudc_bench.import_exorl(files, "proto", dataset_id="walker/other-v3") == "walker/other-v3"


def test_an_imported_dataset_is_found_by_its_method_at_every_profile(files: Path) -> None:
    cudc_bench.import_exorl(files, "proto")
    ids = {str(one) for profile in ("smoke", "demo", "cpu", "paper") for one in check_collected("proto", "walker", [1], profile=profile)}
    assert ids == {"walker/proto-v0"}
    # One that was collected at the profile comes first.
    assert [str(one) for one in check_collected("cudc", "walker", [1], profile="smoke")] == ["walker/cudc-smoke-v0"]


# ------------------------------------------------------------------------------------------------------------------------ refusals


def raw_npy(shape: Any, descr: str = "<f4", data: bytes = b"") -> bytes:
    """A ``.npy`` file that declares whatever it likes."""
    file = io.BytesIO()
    npy.write_array_header_1_0(file, {"shape": shape, "fortran_order": False, "descr": descr})
    return file.getvalue() + data


def with_member(content: bytes | None = None, name: str = "observation.npy", compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A file of 5 steps in which one array is replaced by other bytes, or left out."""
    file = io.BytesIO()
    arrays = random_arrays(5)
    with zipfile.ZipFile(file, "w") as archive:
        for other, array in arrays.items():
            if f"{other}.npy" != name:
                plain = io.BytesIO()
                np.save(plain, array)
                archive.writestr(f"{other}.npy", plain.getvalue())
        if content is not None:
            archive.writestr(name, content, compression)
    return file.getvalue()


def saved(**changes: Any) -> bytes:
    """A file of 5 steps with some arrays changed by a function or replaced."""
    arrays = random_arrays(5)
    for name, change in changes.items():
        arrays[name] = change(arrays[name]) if callable(change) else change
    file = io.BytesIO()
    np.savez(file, allow_pickle=True, **arrays)
    return file.getvalue()


def put(row: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Changes the first number of a row."""

    def change(array: np.ndarray) -> np.ndarray:
        array = array.copy()
        array[row, 0] = value
        return array

    return change


class Explosive:
    """Unpickling it would leave a trace."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (pytest.fail, ("a pickle was loaded",))


GIGANTIC = 10**12
LONG = np.arange(6000.0).reshape(6, 1000)
FAULTS: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "is not a whole .npz archive"),
    "text": (b"hello", "is not a whole .npz archive (BadZipFile: File is not a zip file)"),
    "npy": (raw_npy((GIGANTIC, 24)), "is not a whole .npz archive"),
    "pickle": (pickle.dumps(Explosive()), "is not a whole .npz archive"),
    "truncated": (saved()[:-200], "is not a whole .npz archive"),
    "truncated early": (saved()[:300], "is not a whole .npz archive"),
    "no array": (with_member(b"hello", "readme.txt"), "holds 'readme.txt', which is not an array"),
    "missing": (with_member(name="discount.npy"), "has no array 'discount'; it has: 'action', 'observation', 'physics', 'reward'"),
    "not an array": (with_member(b"hello"), "holds 'observation', whose header cannot be read"),
    "huge shape": (with_member(raw_npy((GIGANTIC, 24), data=b"1234")), "declares 'observation' with shape (1000000000000, 24) of float32"),
    "huge extra": (with_member(raw_npy((6, GIGANTIC)), "skill.npy"), "declares 'skill' with shape (6, 1000000000000) of float32"),
    "huge string": (with_member(raw_npy((6,), "<U99999999"), "skill.npy"), "declares 'skill' with shape (6,) of <U99999999"),
    "negative shape": (with_member(raw_npy((-6, -24), data=bytes(576))), "holds 'observation' with shape (-6, -24)"),
    "bomb": (with_member(bytes(4 * LARGEST)), "bytes uncompressed; the limit for an episode of states is"),
    "lzma": (with_member(raw_npy((6, 24), data=bytes(576)), compression=zipfile.ZIP_LZMA), "in a compression that NumPy does not write"),
    "nested header": (with_member(b"\x93NUMPY\x01\x00\x40\x1f" + b"(" * 8000), "whose header cannot be read"),
    "header 3.0": (with_member(b"\x93NUMPY\x03\x00" + raw_npy((6, 24))[8:]), "whose header cannot be read"),
    "damaged": (
        saved().replace(random_arrays(5)["observation"].tobytes(), bytes(576)),
        "holds 'observation', whose header cannot be read (BadZip",
    ),
    "damaged later": (saved(skill=LONG).replace(LONG[-1, -9:].tobytes(), bytes(72)), "holds damaged data in 'skill' (BadZipFile: Bad CRC"),
    "objects": (saved(observation=np.array([[Explosive()] * 24] * 6)), "holds 'observation' as Python objects, which are never unpickled"),
    "extra objects": (saved(skill=np.array([Explosive()] * 6)), "holds 'skill' as Python objects, which are never unpickled"),
    "structured": (saved(observation=np.zeros((6, 24), "f4,i4")), "not as float32"),
    "float64": (saved(observation=lambda array: array.astype(np.float64)), "holds 'observation' as float64, not as float32"),
    "big-endian": (saved(observation=lambda array: array.astype(">f4")), "holds 'observation' as >f4, not as float32"),
    "physics float32": (saved(physics=lambda array: array.astype(np.float32)), "holds 'physics' as float32, not as float64"),
    "wide": (saved(observation=lambda array: array[:, :23]), "'observation' with shape (6, 23); 5 steps of walker have (6, 24)."),
    "flat": (saved(observation=lambda array: array.ravel()), "holds 'observation' with shape (144,)"),
    "actions": (saved(action=lambda array: array[:, :5]), "holds 'action' with shape (6, 5); 5 steps of walker have (6, 6)"),
    "unequal": (saved(action=lambda array: array[:5]), "holds 'action' with shape (5, 6); 5 steps of walker have (6, 6)"),
    "longer": (saved(**{name: lambda array: array[:-1] for name in random_arrays(5)}), "holds 'observation' with shape (5, 24); 5 steps"),
    "flat reward": (saved(reward=lambda array: array[:, 0]), "holds 'reward' with shape (6,); 5 steps of walker have (6, 1)"),
    "state": (saved(physics=lambda array: array[:, :17]), "holds 'physics' with shape (6, 17); 5 steps of walker have (6, 18)"),
    "nan": (saved(observation=put(3, np.nan)), "holds a number that is not finite in row 3 of 'observation'"),
    "inf": (saved(physics=put(4, -np.inf)), "holds a number that is not finite in row 4 of 'physics'"),
    "action": (saved(action=put(2, 1.001)), "holds an action of size 1.001; all must be within [-1, 1]"),
    "no reset": (saved(action=put(0, 0.5)), "has an action in row 0, which must be the reset"),
    "discount": (saved(discount=put(5, 0.0)), "holds the discount 0; all must be 1"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_first_file_that_does_not_fit_is_wrong_input(fault: str, datasets: Path, tmp_path: Path) -> None:
    content, message = FAULTS[fault]
    path = tmp_path / "episode_000000_5.npz"
    path.write_bytes(content)
    with pytest.raises(UsageError) as caught:
        cudc_bench.import_exorl(tmp_path, "proto")
    assert str(caught.value).startswith(f"'{path}' ")
    assert message in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400
    assert not datasets.exists()


@pytest.mark.parametrize("fault", ["truncated", "huge shape", "bomb", "objects", "nan"])
def test_a_later_file_that_does_not_fit_ends_the_import_with_nothing_left(fault: str, datasets: Path, tmp_path: Path) -> None:
    content, message = FAULTS[fault]
    folder = write(tmp_path / "files", [random_arrays(5)] * 3)
    (folder / "episode_000001_5.npz").write_bytes(content)
    with pytest.raises(RunError, match=r"episode_000001_5\.npz' .*\. Nothing was written\.$") as caught:
        cudc_bench.import_exorl(folder, "proto")
    assert message in str(caught.value)
    assert everything(datasets) == []
    assert minari.list_local_datasets() == {}
    # What the damaged file is not asked for does not stand in the way.
    cudc_bench.import_exorl(folder, "proto", steps=5)


@pytest.mark.parametrize(("damaged", "code"), [((1, 3), 1), ((0, 2, 3), 2), ((0, *range(2, 120)), 2)])
def test_all_files_that_do_not_fit_are_named_at_once(
    damaged: Sequence[int], code: int, datasets: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "files", [random_arrays(5)] * (max(damaged) + 2))
    for index in damaged:
        (folder / f"episode_{index:06d}_5.npz").write_bytes(b"PK")
    with pytest.raises(SystemExit) as ended:
        main(["import-exorl", str(folder), "--method", "proto"])
    err = capfd.readouterr().err
    assert ended.value.code == code, err
    named = [line for line in err.splitlines() if line.startswith(f"'{folder}/episode_") and "is not a whole .npz archive" in line]
    assert len(named) == min(len(damaged), 100)
    assert f"error: {len(named)}{' or more' if len(named) == 100 else ''} of {max(damaged) + 2} files do not fit, from '" in err
    assert everything(datasets) == []


@pytest.mark.parametrize(
    "change",
    [lambda a: a.pop("physics"), lambda a: a.update(skill=np.zeros(6)), lambda a: a.update(option=np.zeros(6, np.int32)),
     lambda a: a.pop("option")],
)  # fmt: skip
def test_all_files_hold_the_same_arrays(change: Callable[[Arrays], Any], datasets: Path, tmp_path: Path) -> None:
    first, second = (random_arrays(5) | {"option": np.zeros(6, np.int64)} for _ in range(2))
    change(second)
    with pytest.raises(
        RunError, match=r"episode_000001_5\.npz' holds other optional arrays \(.*\) than 'episode_000000_5\.npz' \(physics, "
    ):
        cudc_bench.import_exorl(write(tmp_path / "files", [first, second]), "proto")
    assert everything(datasets) == []


def test_jaco_as_urlb_has_it_is_told_from_exorls(tmp_path: Path) -> None:
    jaco = replace(WALKER, name="jaco", observation_size=42, action_size=9, physics_size=18, episode_length=250)
    arrays = random_arrays(5) | {"observation": np.zeros((6, 55), np.float32), "action": np.zeros((6, 9), np.float32)}
    write(tmp_path / "files", [arrays])
    (file,) = list_files(tmp_path / "files", jaco)
    with pytest.raises(FileFault, match=r"5 steps of jaco have \(6, 42\): these are URLB's, which observe .*; ExORL's Jaco \(42\)"):
        read_episode(file, jaco)


def test_rewards_that_no_task_gives_are_refused(datasets: Path, tmp_path: Path) -> None:
    folder = write(tmp_path / "files", [random_arrays(5) | {"reward": np.full((6, 1), 300, np.float32)}])
    with pytest.raises(UsageError, match="holds rewards that sum to 1500; those of walker walk reach at most 1000"):
        cudc_bench.import_exorl(folder, "proto", task="walk")
    assert not datasets.exists()
    cudc_bench.import_exorl(folder, "proto")


@pytest.mark.parametrize("fault", ["npy", "huge shape", "huge extra", "huge string", "bomb", "nested header"])
def test_no_file_makes_the_reader_take_much_memory(fault: str, tmp_path: Path) -> None:
    path = tmp_path / "episode_0_5.npz"
    path.write_bytes(FAULTS[fault][0])
    tracemalloc.start()
    try:
        with pytest.raises(FileFault):
            read_episode(EpisodeFile(path, 0, 5), WALKER)
        assert tracemalloc.get_traced_memory()[1] < 3 * LARGEST
    finally:
        tracemalloc.stop()


def test_a_large_file_is_not_even_read(tmp_path: Path) -> None:
    path = tmp_path / "episode_0_5.npz"
    with path.open("wb") as file:
        file.truncate(100 * LARGEST)
    tracemalloc.start()
    try:
        with pytest.raises(FileFault, match="it has 1,677,721,600 bytes, where 16,777,216 are the most"):
            read_episode(EpisodeFile(path, 0, 5), WALKER)
        assert tracemalloc.get_traced_memory()[1] < 3 * LARGEST
    finally:
        tracemalloc.stop()


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """A good file with some bytes changed, left out or put in."""
    content = bytearray(draw(st.sampled_from([saved(), with_member(raw_npy((6,), "<i8", bytes(48)), "skill.npy")])))
    for _ in range(draw(st.integers(1, 4))):
        # Most of what can go wrong is in headers, of which most are near the ends.
        place = draw(st.integers(0, len(content)) | st.integers(0, 200) | st.integers(len(content) - 600, len(content)))
        place = min(max(place, 0), len(content))
        content[place : place + draw(st.integers(0, 8))] = draw(st.binary(max_size=8))
    return bytes(content)


@settings(max_examples=300)
@given(content=damaged() | st.binary(max_size=200))
def test_any_bytes_are_read_right_or_refused(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.getbasetemp() / "episode_0_5.npz"
    path.write_bytes(content)
    found: RawEpisode | FileFault
    try:
        found = read_episode(EpisodeFile(path, 0, 5), WALKER)
    except FileFault as fault:
        found = fault
    if isinstance(found, FileFault):
        assert str(found).isprintable()
        assert len(str(found)) < 400
        return
    shapes = {"observation": (6, 24), "action": (6, 6), "reward": (6, 1), "discount": (6, 1), "physics": (6, 18)}
    for name, array in found.arrays.items():
        assert array.shape == shapes.get(name, array.shape)
        assert len(array) == 6
        assert np.isfinite(array).all()
    assert shapes.keys() - found.arrays.keys() <= {"physics"}
    assert np.abs(found.arrays["action"]).max() <= 1


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=damaged() | st.binary(max_size=200), first=st.booleans())
def test_the_command_imports_a_damaged_file_whole_or_not_at_all(
    content: bytes, first: bool, datasets: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "files", [random_arrays(5)] * 2)
    (folder / f"episode_00000{0 if first else 1}_5.npz").write_bytes(content)
    capfd.readouterr()
    with pytest.raises(SystemExit) as ended:
        main(["import-exorl", str(folder), "--method", "proto"])
    out, err = capfd.readouterr()
    if ended.value.code == 0:  # what was hit means nothing, or is a number like any other
        assert list(minari.list_local_datasets()) == ["walker/proto-v0"]
        shutil.rmtree(datasets)
        return
    # A first file may be as good as any, and then it is the other one that does not fit it.
    assert ended.value.code == (2 if first and "episode_000001_5.npz'" not in err else 1), err
    assert out == ""
    assert err.splitlines()[-1].startswith("cudc-bench: error: '")
    assert len([line for line in err.splitlines() if "error" in line]) == 1
    assert "Traceback" not in err
    assert minari.list_local_datasets() == {}
    assert [path for path in datasets.rglob("*") if path.is_file()] == []


def test_reading_episodes_always_ends(datasets: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "episode_0_5.npz")
    with pytest.raises(UsageError, match=r"episode_0_5\.npz' cannot be read: it is a pipe or a device, not a file\."):
        cudc_bench.import_exorl(tmp_path, "proto")
    (tmp_path / "episode_0_5.npz").unlink()
    (tmp_path / "episode_0_5.npz").symlink_to("/dev/zero")
    with pytest.raises(UsageError, match="cannot be read: it is a pipe or a device"):
        cudc_bench.import_exorl(tmp_path, "proto")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ([], r"there are no \.npz files in '.*'; name the folder that holds the episodes of one collection\."),
        (["readme.txt", ".hidden_0_5.npz"], "there are no .npz files"),
        (["buffer/episode_0_5.npz"], r"there are no \.npz files in '.*'; did you mean '.*/buffer'\?"),
        (["episode_0_5.npz", "episode_5.npz"], r"'episode_5\.npz' in '.*' is not called <timestamp>_<episode index>_<episode length>\.npz"),
        (["a\x1b\n_0_5.npz"], r"'a\\x1b\\n_0_5\.npz' in "),
        (["e_٣_5.npz"], r"'e_\\u0663_5\.npz' in "),
        (["episode_0_1001.npz"], r"has 1,001 steps by its name; an episode of walker has 1 to 1,000\."),
        (["episode_0_0.npz"], "has 0 steps by its name"),
        (["a_1_5.npz", "b_01_5.npz"], r"'a_1_5\.npz' and 'b_01_5\.npz' in '.*' are both episode 1; keep one\."),
    ],
)
def test_names_that_do_not_fit_are_refused(names: list[str], message: str, datasets: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    (folder / "buffer").mkdir(parents=True)
    for name in names:
        (folder / name).write_bytes(b"")
    with pytest.raises(UsageError, match=message):
        cudc_bench.import_exorl(folder, "proto")
    assert not datasets.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("nowhere --method proto", "the episodes in 'nowhere' cannot be listed: No such file or directory."),
        ("files/episode_000000_5.npz --method proto", "cannot be listed: Not a directory."),
        ("files", "Missing option '--method'"),
        ("files --method proto,rnd", "--method takes one here, since all files belong to one collection; import others separately."),
        ("files --method ,", "--method takes one here"),
        ("files --method Proto!", "the method cannot be 'Proto!'; allowed: small letters, digits, '_' and '-'."),
        ("files --method proto --source (ours)", "the source cannot be '(ours)'; allowed: at most 32 letters"),
        ("files --method proto --domain wlaker", "unknown domain 'wlaker'"),
        ("files --method proto --task wlak", "unknown walker task 'wlak'"),
        ("files --method proto --task all", "unknown walker task 'all'; allowed: flip, run, stand, walk."),
        ("files --method proto --task walk,run", "--task takes at most one here"),
        ("files --method proto --seeds 1-2", "--seed takes one here"),
        ("files --method proto --steps 0", "--steps cannot be 0; there are 10 steps in 'files'."),
        ("files --method proto --steps 11", "--steps cannot be 11; there are 10 steps in 'files'."),
        ("files --method proto --dataset-id ../evil-v0", "'../evil-v0' is not a dataset id"),
        ("files --method proto --domain quadruped", "holds 'observation' with shape (6, 24); 5 steps of quadruped have (6, 78)."),
    ],
)
def test_wrong_input_is_refused_in_one_line(
    options: str, message: str, datasets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "files", [random_arrays(5)] * 2)
    with pytest.raises(SystemExit) as ended:
        main(["import-exorl", *options.split()])
    out, err = capfd.readouterr()
    assert (ended.value.code, out, len(err.splitlines())) == (2, "", 1)
    assert message in err
    assert not datasets.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_an_import_leaves_nothing_that_can_be_seen(
    number: signal.Signals, datasets: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    folder = write(tmp_path / "files", [random_arrays(1000)])
    (first,) = folder.iterdir()
    for index in range(1, 3000):
        (folder / f"episode_{index:06d}_1000.npz").symlink_to(first)
    command = [sys.executable, "-m", "cudc_bench.cli", "import-exorl", str(folder), "--method", "proto"]
    process = subprocess.Popen(command, env=environment, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        building = datasets / "walker" / ".proto-v0.building" / "data" / "main_data.hdf5"
        wait_for(building.exists, process)
        process.send_signal(number)
        _, err = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert minari.list_local_datasets() == {}
    if number == signal.SIGINT:
        assert (process.returncode, err.splitlines()[-1]) == (130, "cudc-bench: error: interrupted.")
        assert everything(datasets) == []
    else:
        assert building.exists(), "it was not killed in the middle"
        cudc_bench.import_exorl(folder, "proto", steps=1000)
        assert [path for path in everything(datasets) if "/." in path] == []


# -------------------------------------------------------------------------------------------------------------------------- chain


def test_an_imported_dataset_goes_through_the_chain_in_a_column_of_its_own(
    files: Path, cli: Callable, collected_once: Path, tmp_path: Path
) -> None:
    done = cli("import-exorl", "files", "--method", "cudc", "--dataset-id", "walker/theirs-v0")
    assert (done.code, done.out) == (0, "walker/theirs-v0\n"), done.err
    assert "import cudc on walker from files: 3 files, 3,000 steps" in done.err
    assert "next: cudc-bench relabel walker/theirs-v0, then cudc-bench evaluate --algo td3 --dataset-id walker/theirs-v0" in done.err
    manifest = read_manifest("walker/theirs-v0")
    assert manifest.command == ("cudc-bench import-exorl --domain walker --method cudc --seed 1 --dataset-id walker/theirs-v0 files")
    done = cli("relabel", "walker/theirs-v0", "--task", "walk")
    assert (done.code, done.out) == (0, "walker/walk/theirs-v0\n"), done.err
    for dataset in (["--dataset-id", "walker/theirs-v0"], ["--method", "cudc"]):
        done = cli("evaluate", "--algo", "td3", "--task", "walk", "--workers", "1", *dataset, brief=True)
        assert done.code == 0, done.err
    record = read_record(tmp_path / "results" / "smoke" / "walker" / "walk" / "theirs-v0" / "td3-seed1.json")
    assert (record.dataset.source, record.dataset.method, record.dataset.profile, record.group) == ("ExORL", "cudc", "imported", "smoke")
    assert record.command == "cudc-bench evaluate --algo td3 --profile smoke --dataset-id walker/walk/theirs-v0 --overwrite"
    done = cli("leaderboard", "results")
    assert done.code == 0, done.err
    assert "cudc (ExORL, 3K)" in done.out
    with (tmp_path / "report" / "smoke.td3.walker" / "table.csv").open() as file:
        cells = {row["method"]: row for row in csv.DictReader(file) if (row["task"], row["milestone"]) == ("walk", "40")}
    # The same data give the same numbers, each in its own column.
    assert set(cells) == {"cudc", "cudc (ExORL, 3K)"}
    assert [row["seeds"] for row in cells.values()] == ["1", "1"]
    assert cells["cudc"]["mean"] == cells["cudc (ExORL, 3K)"]["mean"]
    assert "| cudc (ExORL, 3K) |" in (tmp_path / "report" / "smoke.td3.walker" / "table.md").read_text()


def test_at_its_usual_id_it_is_found_by_its_method_at_every_profile(
    files: Path, capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    cudc_bench.import_exorl(files, "foreign")
    (path,) = cudc_bench.evaluate(
        "td3", methods=["foreign"], tasks=["walk"], profile="demo", output=tmp_path / "results", device="cpu",
        settings={"gradient_steps": 2, "evaluate_every": 1, "milestones": [1, 2], "evaluation_episodes": 1, "final_episodes": 1},
    )  # fmt: skip
    assert "walker/foreign-v0 was not collected here: foreign imported from ExORL, seed 1, 3,000 steps" in capfd.readouterr().err
    record = read_record(path)
    assert (record.profile, record.dataset.source) == ("demo", "ExORL")
    assert "--dataset-id walker/walk/foreign-v0" in record.command
    with pytest.raises(SystemExit):
        main(["list"])
    (line,) = [line for line in capfd.readouterr().out.splitlines() if "walker/foreign-v0" in line]
    assert all(words in line for words in ("foreign (ExORL)", "imported"))
    # The collector itself is not here, so that nothing can be made where nothing is.
    shutil.rmtree(Path(files).parent / "results")
    with pytest.raises(UsageError, match="unknown method 'foreign'"):
        cudc_bench.evaluate("td3", methods=["foreign"], seeds=[1, 2], tasks=["walk"], profile="smoke", output=tmp_path / "results")
