"""Ids are checked before they become paths."""

from __future__ import annotations

import string
from collections.abc import Callable
from pathlib import Path

import minari
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from minari.dataset.minari_dataset import parse_dataset_id

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, default_id, parse_id
from cudc_bench.errors import UsageError
from cudc_bench.settings.profiles import PROFILES

LOWER = string.ascii_lowercase + string.digits
component = st.text(LOWER + "_", min_size=2, max_size=64).filter(lambda part: part != "data")
name = st.from_regex(r"[a-z0-9]([a-z0-9_-]{0,98}[a-z0-9])?", fullmatch=True)
ids = st.builds(DatasetId, st.lists(component, min_size=1, max_size=4).map("/".join), name, st.integers(0, 999_999))

HOSTILE = [
    "", " ", "/", ".", "..", "-v0", "cudc", "cudc-v0", "walker/cudc", "walker/cudc-v", "walker/cudc-v01", "walker/cudc-v-1",
    "walker/cudc-v1000000", "../x", "../walker/cudc-v0", "walker/../cudc-v0", "walker/../../etc/passwd-v0", "/walker/cudc-v0",
    "//walker/cudc-v0", "walker//cudc-v0", "walker/cudc-v0/", "./walker/cudc-v0", "walker/.cudc-v0", ".walker/cudc-v0",
    "walker/cudc.1-v0", "walker/cu dc-v0", " walker/cudc-v0", "walker/cudc-v0 ", "walker/cudc-v0\n", "walker/cudc-v0\0", "walker\\cudc-v0",
    "Walker/cudc-v0", "wälker/cudc-v0", "wаlker/cudc-v0", "walker/cudc-v０", "walker/cudc-v٣",
    "walker/cudc-v1٣", "ｗalker/cudc-v0", "walker/ﬁ-v0",
    "walker∕cudc-v0", "walker/cudc‐v0", "walker/cudc\u200b-v0", "\udcff/cudc-v0", "w/cudc-v0", "walker/-cudc-v0", "walker/cudc--v0x",
    "~/cudc-v0", "$HOME/cudc-v0", "walker/*-v0", "hf://walker/cudc-v0", "walker/cudc-v0;rm", "walker/" + "c" * 101 + "-v0",
    "w" * 65 + "/cudc-v0", "aa/bb/cc/dd/ee/cudc-v0", "walker/" * 2000 + "cudc-v0",
    # Minari takes any folder that holds one called data for a dataset, and then cannot list a single one.
    "data/cudc-v0", "walker/data/cudc-v0",
]  # fmt: skip


@given(ids)
def test_every_id_survives_being_written_and_read(one: DatasetId) -> None:
    assert parse_id(str(one)) == one


@given(ids)
def test_every_id_is_minaris_too(one: DatasetId) -> None:
    assert parse_dataset_id(str(one)) == (one.namespace, one.name, one.version)


@given(ids, st.sampled_from(["walk", "flip"]))
def test_an_id_for_a_task_is_a_valid_id_or_refused(one: DatasetId, task: str) -> None:
    if one.namespace.count("/") == 3:
        with pytest.raises(UsageError):
            one.for_task(task)
    else:
        assert parse_id(str(one.for_task(task))) == DatasetId(f"{one.namespace}/{task}", one.name, one.version)


@pytest.mark.parametrize("text", HOSTILE, ids=lambda text: ascii(text[:30]))
def test_hostile_ids_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not a dataset id; allowed: "):
        parse_id(text)
    with pytest.raises(UsageError):
        dataset_path(text)


@given(st.text(st.characters(), max_size=40) | st.text(LOWER[:2] + "v0/-._~ \n\0АаΑ０", max_size=20))
@example("aa/a-v0")
def test_any_text_is_refused_or_a_path_below_the_root(text: str) -> None:
    try:
        one = parse_id(text)
    except UsageError:
        return
    assert str(one) == text
    root = datasets_root().resolve()
    path = dataset_path(one).resolve()
    assert path.is_relative_to(root)
    assert path.relative_to(root).as_posix() == text


@given(
    st.from_regex(r"[a-z]{2,12}", fullmatch=True).filter(lambda part: part != "data"),
    name,
    st.integers(0, 10**9),
    st.sampled_from(sorted(PROFILES)),
)
def test_default_ids_differ_between_seeds(domain: str, method: str, seed: int, profile: str) -> None:
    first, second = default_id(domain, method, seed, profile), default_id(domain, method, seed + 1, profile)
    assert first != second
    # What ``auto`` takes has the plain name, and so has what was imported; what is for trying is not in their way.
    plain = {default_id(domain, method, 1, one) for one in ("paper", "cpu", "imported")}
    assert plain == {DatasetId(domain, method, 0)}
    assert len({default_id(domain, method, seed, one) for one in PROFILES}) == len(PROFILES) - 1


@pytest.mark.parametrize("one", ["walker/cudc-v0", "walker/walk/cudc-seed2-v3", "aa/bb/cc/dd/0-v999999", "__/data-v0", "walker/data_/x-v1"])
def test_minari_lists_and_loads_what_is_stored_under_accepted_ids(one: str, make_dataset: Callable, make_episodes: Callable) -> None:
    make_dataset("walker/other-v0", make_episodes([2]))
    make_dataset(one, make_episodes([3, 4]))
    assert set(minari.list_local_datasets()) == {"walker/other-v0", one}
    assert minari.load_dataset(one).total_steps == 7


def test_the_root_is_minaris_and_is_read_at_each_call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from minari.storage import get_dataset_path

    for place in (tmp_path / "a", tmp_path / "b"):
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(place))
        assert datasets_root() == Path(get_dataset_path())
        assert dataset_path("walker/cudc-v0") == Path(get_dataset_path("walker/cudc-v0"))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("MINARI_DATASETS_PATH")
    assert datasets_root() == Path(get_dataset_path())
