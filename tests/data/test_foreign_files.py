"""Datasets from others are data: no name in them leads out of the dataset and its base, and no damage ends in more than one line."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import cudc_bench
from cudc_bench.artefacts.ids import stored_ids
from cudc_bench.artefacts.manifest import KEY, metadata_path, read_manifest
from cudc_bench.cli.app import main
from cudc_bench.data.reader import iterate_episodes, load_episodes, read_episodes
from cudc_bench.errors import CudcBenchError, RunError

BASE, WALK = "walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"
FIELDS = ("observations", "actions", "rewards", "terminations", "truncations", "infos/physics")
Change = Callable[[h5py.Group, Path], None]
quick = settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])


def data_file(root: Path, dataset_id: str) -> Path:
    return root / dataset_id / "data" / "main_data.hdf5"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """Somebody's own HDF5 file, with arrays that would fit a dataset."""
    path = tmp_path / "secret.hdf5"
    with h5py.File(path, "w") as file:
        for index in range(3):
            file[f"episode_{index}/observations"] = np.zeros((1001, 24), np.float32)
            file[f"episode_{index}/actions"] = np.zeros((1000, 6), np.float32)
            file[f"episode_{index}/infos/physics"] = np.zeros((1001, 18))
    return path


def put(group: h5py.Group, name: str, value: Any) -> None:
    if name in group or group.get(name, getlink=True) is not None:
        del group[name]
    group[name] = value


def external_bytes(group: h5py.Group, name: str, path: Path) -> None:
    """The bytes of any file as an array."""
    shape, dtype = group[name].shape, group[name].dtype
    del group[name]
    size = int(np.prod(shape)) * dtype.itemsize
    group.create_dataset(name, shape, dtype, external=[(str(path), 0, size)])


def virtual(group: h5py.Group, name: str, path: Path) -> None:
    """An array that another file is made to hold."""
    shape, dtype = group[name].shape, group[name].dtype
    del group[name]
    layout = h5py.VirtualLayout(shape, dtype)
    layout[:] = h5py.VirtualSource(path, "episode_1/actions", shape)
    group.create_virtual_dataset(name, layout)


def claimed(group: h5py.Group, name: str) -> None:
    """More numbers than there is memory for, none of them written."""
    del group[name]
    group.create_dataset(name, (10**10, 6), np.float32, chunks=(1000, 6))


def unwritten(group: h5py.Group, name: str) -> None:
    del group[name]
    space, kind = h5py.h5s.create_simple((10**10, 6)), h5py.h5t.NATIVE_FLOAT
    h5py.h5d.create(group.id, name.encode(), kind, space)


def text(group: h5py.Group, name: str) -> None:
    put(group, name, np.array(["x"] * 1000, h5py.string_dtype()))


def linked(name: str, inside: str) -> Change:
    """A link to the same array in another file."""
    return lambda group, secret: put(group, name, h5py.ExternalLink(str(secret), inside))


def climbing(group: h5py.Group, secret: Path) -> None:
    put(group, "actions", h5py.ExternalLink("../" * 20 + str(secret)[1:], "/episode_1/actions"))


def through_a_soft_link(group: h5py.Group, secret: Path) -> None:
    group.file["infos_of_episode_1"] = h5py.ExternalLink(str(secret), "/episode_1/infos")
    put(group, "infos", h5py.SoftLink("/infos_of_episode_1"))


def group_for_array(group: h5py.Group, _: Path) -> None:
    del group["actions"]
    group.create_group("actions")


IN_THE_FILE: dict[str, Change] = {
    "absolute link": linked("actions", "/episode_1/actions"),
    "relative link": climbing,
    "linked group": linked("infos", "/episode_1/infos"),
    "linked within a group": linked("infos/physics", "/episode_1/infos/physics"),
    "linked episode": lambda group, secret: put(group.parent, "episode_1", h5py.ExternalLink(str(secret), "/episode_1")),
    "soft link": lambda group, _: put(group, "actions", h5py.SoftLink("/episode_0/actions")),
    "soft link to a link": through_a_soft_link,
    "bytes of a file": lambda group, secret: external_bytes(group, "actions", secret),
    "bytes of the system": lambda group, _: external_bytes(group, "actions", Path("/etc/passwd")),
    "virtual": lambda group, secret: virtual(group, "actions", secret),
    "claimed": lambda group, _: claimed(group, "actions"),
    "unwritten": lambda group, _: unwritten(group, "actions"),
    "text": lambda group, _: text(group, "actions"),
    "other sizes": lambda group, _: put(group, "actions", np.zeros((1000, 7), np.float32)),
    "other type": lambda group, _: put(group, "actions", np.zeros((1000, 6))),
    "array for a group": lambda group, _: put(group, "infos", np.zeros(3)),
    "group for an array": group_for_array,
}


def check_one_line(error: CudcBenchError) -> None:
    assert len(str(error).splitlines()) == 1
    assert len(str(error)) < 1000


def use_all(dataset_id: str) -> list[Callable[[], Any]]:
    """Every way in which this project opens a dataset."""
    return [
        lambda: load_episodes(dataset_id, FIELDS),
        lambda: list(read_episodes(dataset_id, FIELDS)),
        lambda: cudc_bench.verify(dataset_id, sample=1),
    ]


@pytest.mark.parametrize("change", IN_THE_FILE)
def test_no_array_comes_from_anywhere_else(change: str, smoke: Path, secret: Path, datasets: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        IN_THE_FILE[change](file["episode_1"], secret)
    # The dataset itself, and one that links to it.
    for one in (BASE, WALK):
        for use in use_all(one):
            with pytest.raises(RunError) as caught:
                use()
            check_one_line(caught.value)
    for standalone in (True, False):
        with suppress(RunError):
            cudc_bench.relabel(BASE, tasks=["run"], standalone=standalone, overwrite=True)
            # What links to something bad is no better than it.
            assert not standalone
            with pytest.raises(RunError):
                load_episodes("walker/run/cudc-smoke-v0", FIELDS)


LINKS = {
    "absolute": lambda secret, index: (str(secret), f"/episode_{index}/actions"),
    "out of the root": lambda secret, index: ("../../../../" + secret.name, f"/episode_{index}/actions"),
    "missing": lambda secret, index: ("../../../cudc-v9/data/main_data.hdf5", f"/episode_{index}/actions"),
    "another dataset": lambda secret, index: ("../../../stand/cudc-smoke-v0/data/main_data.hdf5", f"/episode_{index}/rewards"),
    "another episode": lambda secret, index: ("../../../cudc-smoke-v0/data/main_data.hdf5", "/episode_0/actions"),
    "another field": lambda secret, index: ("../../../cudc-smoke-v0/data/main_data.hdf5", f"/episode_{index}/observations"),
    "itself": lambda secret, index: (".", f"/episode_{index}/actions"),
    "a device": lambda secret, index: ("/dev/zero", f"/episode_{index}/actions"),
    "a pipe": lambda secret, index: (str(secret.with_name("pipe")), f"/episode_{index}/actions"),
    "a name of nothing": lambda secret, index: ("x" * 5000, "y" * 5000),
}


@pytest.mark.parametrize("link", LINKS)
def test_a_relabelled_dataset_links_to_its_base_alone(link: str, smoke: Path, secret: Path) -> None:
    os.mkfifo(secret.with_name("pipe"))  # who opens it waits for ever
    (smoke / secret.name).write_bytes(secret.read_bytes())
    with h5py.File(data_file(smoke, WALK), "r+") as file:
        put(file["episode_1"], "actions", h5py.ExternalLink(*LINKS[link](secret, 1)))
    for use in use_all(WALK):
        with pytest.raises(RunError) as caught:
            use()
        check_one_line(caught.value)
    # What is not asked for does no harm.
    assert len(load_episodes(WALK, ("rewards", "observations")).lengths) == 3


def test_a_base_cannot_be_linked_itself(smoke: Path) -> None:
    path = metadata_path(WALK)
    content = json.loads(path.read_text())
    content[KEY]["base"] = {"id": WALK, "fingerprint": content[KEY]["fingerprint"], "linked": True}
    path.write_text(json.dumps(content))
    with pytest.raises(RunError, match="which holds no data of its own"):
        load_episodes(WALK, ("actions",))


@pytest.mark.parametrize("base", ["../evil-v0", "/etc/passwd", "walker/cudc-smoke-v0/../../x-v0", "", "walker/\0-v0", "walker/nothing-v0"])
def test_the_name_of_a_base_is_checked_before_it_becomes_a_path(base: str, smoke: Path) -> None:
    path = metadata_path(WALK)
    content = json.loads(path.read_text())
    content[KEY]["base"]["id"] = base
    path.write_text(json.dumps(content))
    for use in use_all(WALK):
        with pytest.raises(CudcBenchError) as caught:
            use()
        check_one_line(caught.value)


def test_one_array_under_many_names_takes_no_more_than_its_file(smoke: Path) -> None:
    path = data_file(smoke, BASE)
    with h5py.File(path, "r+") as file:
        first = file["episode_0"]
        for index in range(1, 400):
            file.pop(f"episode_{index}", None)
            file[f"episode_{index}"] = first
    content = json.loads(metadata_path(BASE).read_text())
    content[KEY] |= {"episodes": 400, "steps": 400_000}
    metadata_path(BASE).write_text(json.dumps(content))
    with pytest.raises(RunError, match="claims more bytes than its file has"):
        load_episodes(BASE, ("observations",))


@pytest.mark.parametrize("steps", [0, -1, 999, 1001, 10**12, 2**63 - 1, "many", [1, 2], np.nan, 1.5])
def test_lengths_that_the_file_claims_are_checked(steps: Any, smoke: Path) -> None:
    with h5py.File(data_file(smoke, BASE), "r+") as file:
        file["episode_1"].attrs["total_steps"] = steps
    with pytest.raises(RunError) as caught:
        load_episodes(BASE, ("actions",))
    check_one_line(caught.value)


def test_statistics_do_not_follow_links_either(smoke: Path, secret: Path) -> None:
    path = data_file(smoke, BASE)
    with h5py.File(path, "r+") as file:
        put(file["episode_1"], "actions", h5py.ExternalLink(str(secret), "/episode_1/actions"))
    with pytest.raises(RunError, match=r"main_data\.hdf5 cannot be read: /episode_1/actions is a link to somewhere else"):
        list(iterate_episodes(path, ("actions",), 3))


@quick
@given(data=st.data())
def test_damaged_bytes_are_read_right_or_refused(data: st.DataObject, smoke: Path) -> None:
    path = data_file(smoke, WALK)
    whole = bytearray(path.read_bytes())
    spoilt = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, 4000) | st.integers(0, len(spoilt) - 1))
        spoilt[place : place + 8] = data.draw(st.binary(min_size=1, max_size=8))
    cut = data.draw(st.none() | st.integers(0, len(spoilt)))
    path.write_bytes(bytes(spoilt[:cut]))
    try:
        for use in use_all(WALK)[:2]:
            try:
                use()
            except CudcBenchError as error:
                check_one_line(error)
    finally:
        path.write_bytes(bytes(whole))


# -------------------------------------------------------------------------------------------------------------------------- metadata

odd_values: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
    | st.sampled_from([10**400, -1, 0, 2**63, "\x1b[31m", "\u202e", "../../x", "a" * 10_000]),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=5), inner, max_size=2),
    max_leaves=4,
)  # fmt: skip
ODD_FILES = [
    b"", b"\xff\xfe", b"\0", b"[" * 100_000, b'{"cudc_bench": ' * 50_000, b'{"a": ' + b"9" * 5_000 + b"}", b"NaN", b"{}", b"[]", b"3",
    b'{"cudc_bench": "\\ud800"}', b'{"cudc_bench": {"domain": "\\u001b[31m"}}', b'{"cudc_bench": {"\\u202e": 1}}', b"\xef\xbb\xbf{}",
]  # fmt: skip


def run(words: list[str]) -> int:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert isinstance(ended.value.code, int)
    return ended.value.code


@quick
@given(data=st.data())
def test_metadata_of_strangers_are_used_or_refused(data: st.DataObject, smoke: Path) -> None:
    path = metadata_path(WALK)
    whole = path.read_text()
    content = json.loads(whole)
    where = data.draw(st.sampled_from([content, content[KEY], content[KEY], content[KEY], content[KEY]["base"], content[KEY]["machine"]]))
    where[data.draw(st.sampled_from(sorted(where)) | st.text(max_size=5))] = data.draw(odd_values)
    path.write_text(json.dumps(content))
    try:
        for use in (lambda: read_manifest(WALK).describe(), *use_all(WALK)[:2]):
            # What else it may raise would be a traceback; that its text is one line is proved on the command line, below.
            with suppress(CudcBenchError):
                use()
    finally:
        path.write_text(whole)


@pytest.mark.parametrize("content", ODD_FILES, ids=lambda content: ascii(content[:20]))
def test_files_that_are_no_metadata_are_one_line(
    content: bytes, smoke: Path, capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDC_BENCH_PROFILE", "smoke")
    metadata_path(WALK).write_bytes(content)
    for words in (["verify", WALK], ["evaluate", "--dataset-id", WALK], ["relabel", WALK], ["diagnostics", WALK]):
        assert run(words) in {1, 2}
        out, err = capfd.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert err.startswith("cudc-bench: error: ")
        assert err[:-1].isprintable()
    # All others are still there.
    assert len(stored_ids()) == 5
    assert run(["list"]) == 0
    assert "walker/run/cudc-smoke-v0" in capfd.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_what_a_manifest_says_cannot_drive_a_terminal(
    smoke: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    path = metadata_path(BASE)
    content = json.loads(path.read_text())
    content[KEY] |= {"method": "\x1b[31mred\u202e[bold]", "profile": "a\nb\x9b2J", "task": "\x07[/]"}
    path.write_text(json.dumps(content))
    for words in (["list"], ["verify", BASE], ["diagnostics", BASE], ["collect", "--method", "cudc", "--profile", "smoke"]):
        run(words)
        said = "".join(capfd.readouterr())
        assert all(character.isprintable() or character == "\n" for character in said), ascii(said)
