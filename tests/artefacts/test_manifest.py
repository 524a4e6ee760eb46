"""The fingerprint notices every change, and damage is reported in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import cudc_bench
from cudc_bench.artefacts.ids import parse_id
from cudc_bench.artefacts.manifest import KEY, FieldHasher, Manifest, check_free, exists, fingerprint, metadata_path, read_manifest
from cudc_bench.data.reader import verify_fingerprint
from cudc_bench.errors import RunError, UsageError

FIELDS = ("observations", "actions", "rewards", "terminations", "truncations", "infos/physics")
BASE = "walker/cudc-smoke-v0"


def hashed(episodes: list[dict[str, np.ndarray]]) -> str:
    hasher = FieldHasher()
    for episode in episodes:
        for name, array in episode.items():
            hasher.update(name, array)
    return fingerprint(hasher.digests())


def data_file(root: Path, dataset_id: str) -> Path:
    return root / dataset_id / "data" / "main_data.hdf5"


episode = st.integers(1, 5).flatmap(
    lambda steps: st.fixed_dictionaries(
        {
            "observations": hnp.arrays(np.float32, (steps + 1, 2)),
            "rewards": hnp.arrays(np.float32, (steps,)),
            "truncations": hnp.arrays(np.bool_, (steps,)),
            "infos/physics": hnp.arrays(np.float64, (steps + 1, 3)),
        }
    )
)


@given(st.lists(episode, min_size=1, max_size=4), st.data())
def test_any_flipped_bit_changes_the_fingerprint(episodes: list[dict[str, np.ndarray]], data: st.DataObject) -> None:
    before = hashed(episodes)
    assert hashed(episodes) == before
    array = data.draw(st.sampled_from(episodes))[data.draw(st.sampled_from(sorted(episodes[0])))]
    octets = array.view(np.uint8).reshape(-1)
    octets[data.draw(st.integers(0, len(octets) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    assert hashed(episodes) != before


@given(hnp.arrays(np.float32, (6, 2), elements=st.floats(-1, 1, width=32)), st.integers(1, 5))
def test_the_borders_of_episodes_count(array: np.ndarray, cut: int) -> None:
    whole = hashed([{"actions": array}])
    parts = hashed([{"actions": array[:cut]}, {"actions": array[cut:]}])
    assert parts != whole
    assert hashed([{"actions": array.reshape(12)}]) != whole
    assert hashed([{"actions": array.view(np.int32)}]) != whole
    assert hashed([{"rewards": array}]) != whole
    # Where the numbers lie in memory does not.
    assert hashed([{"actions": np.asfortranarray(array)}]) == whole


def test_the_fingerprint_does_not_depend_on_the_order_of_fields() -> None:
    arrays = {"actions": np.ones(3), "rewards": np.zeros(3)}
    assert hashed([arrays]) == hashed([dict(reversed(arrays.items()))])
    assert hashed([{"actions": arrays["rewards"], "rewards": arrays["actions"]}]) != hashed([arrays])


def test_a_collected_dataset_fits_its_fingerprint(smoke: Path) -> None:
    manifest = read_manifest(BASE)
    assert tuple(sorted(manifest.fields)) == tuple(sorted(FIELDS))
    assert verify_fingerprint(BASE) == manifest.fingerprint
    for task in ("stand", "walk", "run", "flip"):
        assert verify_fingerprint(f"walker/{task}/cudc-smoke-v0") == read_manifest(f"walker/{task}/cudc-smoke-v0").fingerprint


@pytest.mark.parametrize("field", FIELDS)
def test_one_flipped_bit_in_the_file_is_found_and_its_field_named(field: str, smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        dataset = file[f"episode_1/{field}"]
        array = dataset[()]
        array.view(np.uint8).reshape(-1)[array.nbytes // 2] ^= 1
        dataset[...] = array
    with pytest.raises(RunError, match=rf"'{BASE}' does not fit its fingerprint: {field} changed after it was made\.$"):
        verify_fingerprint(BASE)
    if field != "rewards":  # the linked set has rewards of its own
        with pytest.raises(RunError, match=f"does not fit its fingerprint: {field} changed"):
            cudc_bench.load_transitions("walker/walk/cudc-smoke-v0", verify=True)


def test_swapped_episodes_are_found(smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        for source, target in (("episode_0", "kept"), ("episode_1", "episode_0"), ("kept", "episode_1")):
            file.move(source, target)
    with pytest.raises(RunError, match="actions, infos/physics, observations changed"):
        cudc_bench.load_transitions(BASE, verify=True)


def test_an_altered_manifest_is_found(smoke: Path) -> None:
    path = metadata_path(BASE)
    metadata = json.loads(path.read_text())
    metadata[KEY]["fingerprint"] = "0" * 64
    path.write_text(json.dumps(metadata))
    with pytest.raises(RunError, match=r"the manifest changed"):
        verify_fingerprint(BASE)


@pytest.mark.parametrize("damage", ["truncate", "empty", "remove", "garbage", "no episode", "no field", "short field"])
def test_a_damaged_data_file_is_one_line(damage: str, smoke: Path) -> None:
    path = data_file(smoke, BASE)
    if damage == "truncate":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "remove":
        path.unlink()
    elif damage == "garbage":
        path.write_bytes(b"not HDF5 at all" * 100)
    else:
        with h5py.File(path, "r+") as file:
            if damage == "no episode":
                del file["episode_2"]
            else:
                actions = file["episode_1/actions"][()]
                del file["episode_1/actions"]
                if damage == "short field":
                    file["episode_1/actions"] = actions[:-1]
    with pytest.raises(RunError) as caught:
        cudc_bench.load_transitions(BASE)
    assert "\n" not in str(caught.value)
    assert BASE in str(caught.value)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("", RunError), ("{", RunError), ("\xff", RunError), ("[]", UsageError), ("null", UsageError), ("{}", UsageError),
        ('{"cudc_bench": 3}', RunError), ('{"cudc_bench": {}}', RunError), ('{"cudc_bench": {"schema_version": 2}}', RunError),
    ],
)  # fmt: skip
def test_damaged_metadata_is_one_line(content: str, error: type[Exception], smoke: Path) -> None:
    metadata_path(BASE).write_text(content, encoding="latin-1")
    with pytest.raises(error) as caught:
        read_manifest(BASE)
    assert "\n" not in str(caught.value)
    assert BASE in str(caught.value)


def test_a_missing_dataset_is_refused_with_the_root(datasets: Path) -> None:
    for one in (BASE, "walker/walk/cudc-smoke-v0", "aa/bb/cc/dd/cudc-smoke-v0"):
        with pytest.raises(UsageError) as caught:
            read_manifest(one)
        assert str(caught.value) == f"there is no dataset '{one}' in {datasets}."


def test_a_taken_id_says_by_what_and_the_way_out(smoke: Path, make_dataset: Callable, make_episodes: Callable) -> None:
    with pytest.raises(UsageError, match=r"'walker/cudc-smoke-v0' exists \(cudc, profile smoke, seed 1, 3,000 steps\); use --overwrite, "):
        check_free(parse_id(BASE), overwrite=False)
    check_free(parse_id(BASE), overwrite=True)
    check_free(parse_id("walker/cudc-v1"), overwrite=False)
    # A folder of somebody else's is not written over, either.
    (smoke / "walker" / "theirs-v0").mkdir()
    assert exists("walker/theirs-v0")
    with pytest.raises(UsageError, match="not a dataset of cudc-bench"):
        check_free(parse_id("walker/theirs-v0"), overwrite=False)


def test_the_manifest_says_everything_and_survives_json(smoke: Path) -> None:
    manifest = read_manifest(BASE)
    assert Manifest.model_validate_json(manifest.model_dump_json()) == manifest
    assert (manifest.method, manifest.domain, manifest.task, manifest.seed) == ("cudc", "walker", None, 1)
    assert (manifest.steps, manifest.episodes, manifest.profile, manifest.overrides) == (3000, 3, "smoke", {})
    assert manifest.hyperparameters["k_max"] == 6
    assert manifest.hyperparameters["steps"] == 3000
    assert manifest.base is None
    assert {"python", "torch", "mujoco", "dm-control", "minari", "cudc-bench"} <= manifest.versions.keys()
    assert "missing" not in manifest.versions.values()
    assert manifest.command == "cudc-bench collect --domain walker --method cudc --seed 1 --profile smoke"
    assert manifest.machine["threads"] == 1
