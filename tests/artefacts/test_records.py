"""A record is whole, finite, in order and known in every field, or it is refused in one line."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench.artefacts.records import DatasetReference, Evaluation, Record, TrainingMetrics, read_record, record_path, write_record
from cudc_bench.errors import RunError
from cudc_bench.files import write_atomically

finite = st.floats(allow_nan=False, allow_infinity=False)
name = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,63}", fullmatch=True)
scalar = st.none() | st.booleans() | st.integers() | finite | st.text(max_size=8)
overrides = st.dictionaries(st.from_regex(r"[a-z_]{1,9}", fullmatch=True), scalar | st.lists(scalar, max_size=3), max_size=3)
datasets = st.builds(
    DatasetReference, id=st.text(max_size=20), fingerprint=st.text("0123456789abcdef", min_size=64, max_size=64),
    domain=name | st.from_regex(r"dm_control/[A-Za-z0-9][A-Za-z0-9_-]{0,63}", fullmatch=True), task=name, method=name,
    seed=st.integers(0), steps=st.integers(1), profile=name, overrides=overrides,
    source=st.none() | st.from_regex(r"[A-Za-z0-9](?:[A-Za-z0-9 ._-]{0,30}[A-Za-z0-9])?", fullmatch=True),
)  # fmt: skip


@st.composite
def records(draw: st.DrawFn) -> Record:
    """Any record that the schema allows."""
    steps = draw(st.lists(st.integers(0, 10**7), min_size=1, max_size=4, unique=True).map(sorted))
    returns = st.lists(finite, min_size=1, max_size=3)
    return Record(
        dataset=draw(datasets), algorithm=draw(name), profile=draw(name), overrides=draw(overrides), seed=draw(st.integers(0)),
        hyperparameters=draw(overrides), hyperparameters_hash=draw(st.text(max_size=16)),
        milestones=draw(st.lists(st.integers(), min_size=1)),
        curve=[Evaluation(step=step, returns=draw(returns)) for step in steps],
        final=Evaluation(step=steps[-1], returns=draw(returns)),
        metrics=[TrainingMetrics(step=steps[-1], values=draw(st.dictionaries(st.text(max_size=5), finite, max_size=2)))],
        seconds=draw(st.floats(0, 1e9)), versions=draw(st.dictionaries(st.text(max_size=5), st.text(max_size=5), max_size=2)),
        commit=draw(st.none() | st.text(max_size=5)), dirty=draw(st.booleans()), machine=draw(overrides), command=draw(st.text(max_size=9)),
        created=draw(st.text(max_size=9)),
    )  # fmt: skip


VALUES = {"width": 16, "final_evaluations": 2}


def example(**changes: Any) -> dict[str, Any]:
    """A record as JSON has it."""
    return {
        "schema_version": 1,
        "dataset": {
            "id": "walker/walk/cudc-v0", "fingerprint": "a" * 64, "domain": "walker", "task": "walk", "method": "cudc", "seed": 1,
            "steps": 1000, "profile": "cpu", "overrides": {}, "reward": None, "source": None, "used": None,
        },
        "algorithm": "td3", "profile": "cpu", "overrides": {}, "seed": 1, "hyperparameters": VALUES, "hyperparameters_hash": "0",
        "milestones": [10, 20],
        "curve": [{"step": 0, "returns": [1.0, 2.0]}, {"step": 10, "returns": [3.0, 5.0]}, {"step": 20, "returns": [7.0]}],
        "final": {"step": 20, "returns": [9.0, 11.0]}, "metrics": [{"step": 20, "values": {"loss": 0.5}}], "seconds": 1.5, "versions": {},
        "commit": None, "dirty": False, "machine": {}, "command": "cudc-bench evaluate", "created": "2026-01-01T00:00:00+00:00",
    } | changes  # fmt: skip


def refused(content: str | bytes, folder: Path) -> str:
    """The one line with which reading this file is refused."""
    path = folder / "record.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RunError) as caught:
        read_record(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


@given(record=records())
def test_a_record_survives_being_written_and_read(tmp_path_factory: pytest.TempPathFactory, record: Record) -> None:
    path = tmp_path_factory.getbasetemp() / "any record" / "record.json"
    write_record(path, record)
    assert read_record(path) == record
    first = path.read_bytes()
    write_record(path, read_record(path))
    assert path.read_bytes() == first
    json.loads(first, parse_constant=lambda constant: pytest.fail(f"{constant} is not JSON"))


def test_the_example_is_valid_and_its_scores_are_means(tmp_path: Path) -> None:
    record = Record.model_validate(example())
    assert json.loads(record.model_dump_json()) == example()
    assert [record.score(step) for step in (0, 10, 20, 15)] == [1.5, 4.0, 10.0, None]
    # Those of the larger evaluations at the end count together, whatever was measured on the way there; the last alone is kept apart.
    several = example(late=[{"step": 10, "returns": [2.0, 6.0]}])
    record = Record.model_validate(several)
    assert json.loads(record.model_dump_json()) == several
    assert [record.score(step) for step in (0, 10, 20, 15)] == [1.5, 4.0, 7.0, None]
    assert (record.final.mean, record.conclusion.returns) == (10.0, [2.0, 6.0, 9.0, 11.0])


@pytest.mark.parametrize("steps", [[0], [20], [10, 20], [10, 0], [0, 5], [-1, 0, 10], [10, 10]])
def test_late_evaluations_are_the_last_of_the_curve_before_the_final_one(steps: list[int], tmp_path: Path) -> None:
    assert Record.model_validate(example(late=[{"step": step, "returns": [0.0]} for step in (0, 10)])).late[1].step == 10
    assert "'late'" in refused(json.dumps(example(late=[{"step": step, "returns": [0.0]} for step in steps])).replace("-1", "0"), tmp_path)


@pytest.mark.parametrize("where", [(), ("dataset",), ("curve", 1), ("final",), ("metrics", 0)], ids=str)
def test_an_unknown_field_is_refused_at_every_level(where: tuple[Any, ...], tmp_path: Path) -> None:
    content = example()
    place = content
    for part in where:
        place = place[part]
    place["surprise"] = 1
    assert "surprise: Extra inputs are not permitted" in refused(json.dumps(content), tmp_path)


@pytest.mark.parametrize("missing", [field for field, info in Record.model_fields.items() if info.is_required()])
def test_a_missing_field_is_refused_by_name(missing: str, tmp_path: Path) -> None:
    content = example()
    del content[missing]
    assert f"{missing}: Field required" in refused(json.dumps(content), tmp_path)


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity", '"NaN"', "1e999", "null"])
@pytest.mark.parametrize("field", ["curve", "final", "metrics", "seconds"])
def test_a_number_that_is_not_finite_is_refused(field: str, constant: str, tmp_path: Path) -> None:
    mark = 123456.5
    content = {
        "curve": example(curve=[{"step": 0, "returns": [1.0]}, {"step": 20, "returns": [2.0, mark]}]),
        "final": example(final={"step": 20, "returns": [mark]}),
        "metrics": example(metrics=[{"step": 20, "values": {"loss": mark}}]),
        "seconds": example(seconds=mark),
    }[field]
    assert f"{field}" in refused(json.dumps(content).replace(str(mark), constant), tmp_path)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_number_that_is_not_finite_cannot_even_be_recorded(value: float) -> None:
    for make in (
        lambda: Evaluation(step=0, returns=[1.0, value]),
        lambda: TrainingMetrics(step=0, values={"loss": value}),
        lambda: Record.model_validate(example(seconds=value)),
    ):
        with pytest.raises(ValueError, match=r"finite number|greater than or equal to 0"):
            make()


@given(steps=st.lists(st.integers(0, 50), min_size=2, max_size=5), final=st.integers(0, 50))
def test_a_curve_is_in_order_and_the_final_evaluation_at_its_end(steps: list[int], final: int) -> None:
    content = example(curve=[{"step": step, "returns": [0.0]} for step in steps], final={"step": final, "returns": [0.0]})
    if steps == sorted(set(steps)) and final == steps[-1]:
        assert [evaluation.step for evaluation in Record.model_validate(content).curve] == steps
    else:
        with pytest.raises(ValueError, match="'curve'"):
            Record.model_validate(content)


@pytest.mark.parametrize(
    "changes",
    [
        {"schema_version": 2}, {"schema_version": "1"}, {"curve": []}, {"milestones": []}, {"seed": -1}, {"seed": 1.5},
        {"algorithm": "../td3"}, {"algorithm": "TD3"}, {"profile": ""}, {"profile": "a" * 65}, {"seconds": -1},
        {"final": {"step": 20, "returns": []}},
        {"dataset": example()["dataset"] | {"fingerprint": "a" * 63}}, {"dataset": example()["dataset"] | {"task": None}},
        {"dataset": example()["dataset"] | {"steps": 0}}, {"dataset": example()["dataset"] | {"method": "a/b"}}, {"overrides": []},
        *({"dataset": example()["dataset"] | {"domain": domain}} for domain in ("a/b", "dm_control/", "dm_control/../a", "Walker", "a.b")),
        {"curve": [{"step": -1, "returns": [0.0]}]},
    ],
    ids=lambda changes: str(changes)[:40],
)  # fmt: skip
def test_a_value_that_does_not_fit_is_refused(changes: dict[str, Any], tmp_path: Path) -> None:
    refused(json.dumps(example(**changes)), tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"null", b"1", b"\xff\xfe", b"{}", b"[" * 100_000, b'{"a":' * 100_000, b"\0" * 10],
    ids=lambda content: ascii(content[:9]),
)
def test_a_file_that_is_no_record_is_refused(content: bytes, tmp_path: Path) -> None:
    assert "is not a run record" in refused(content, tmp_path)


@given(at=st.integers(0, 10_000), put=st.binary(max_size=3), drop=st.integers(0, 40))
def test_a_mangled_file_is_a_record_or_refused(tmp_path_factory: pytest.TempPathFactory, at: int, put: bytes, drop: int) -> None:
    content = json.dumps(example()).encode()
    at %= len(content)
    path = tmp_path_factory.getbasetemp() / "mangled.json"
    path.write_bytes(content[:at] + put + content[at + drop :])
    try:
        record = read_record(path)
    except RunError:
        return
    write_record(path, record)
    assert read_record(path) == record


def test_what_cannot_be_read_or_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "missing.json", tmp_path, tmp_path / "file" / "below.json"):
        with pytest.raises(RunError, match=f"^cannot read the record {path}: "):
            read_record(path)
    for path in (tmp_path / "file" / "below.json", tmp_path):
        with pytest.raises(RunError, match=f"^cannot write the record {path}: "):
            write_record(path, Record.model_validate(example()))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    write_atomically(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(path, "new" * 100_000 + "\udcff")
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["record.json"]


def test_a_reader_sees_the_whole_file_whenever_it_looks(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    versions = [Record.model_validate(example(seed=seed, command="x" * 100_000 * (1 + seed))) for seed in (0, 1)]
    write_record(path, versions[0])
    done = threading.Event()

    def write() -> None:
        for turn in range(60):
            write_record(path, versions[turn % 2])
        done.set()

    writer = threading.Thread(target=write)
    writer.start()
    seen = set()
    while not done.is_set():
        record = read_record(path)
        assert record == versions[record.seed]
        seen.add(record.seed)
    writer.join()
    assert seen == {0, 1}


# Chosen to look alike once written: numbers and their texts, and texts that contain what stands between two overrides.
LOOKALIKES = [
    1,
    1.0,
    True,
    "1",
    "1.0",
    "True",
    "true",
    None,
    "None",
    "null",
    "1, b=1",
    "1; evaluate: a=1",
    '1", b="1',
    [1],
    "[1]",
    [],
    "[]",
    "",
]


def test_records_share_a_group_only_if_profiles_and_overrides_are_the_same() -> None:
    one = [{"a": value} for value in LOOKALIKES]
    some = [{}, *one, *({"b": value} for value in LOOKALIKES), *({"a": v, "b": w} for v in LOOKALIKES for w in LOOKALIKES)]
    pairs = [*((c, {}) for c in some), *(({}, e) for e in some[1:]), *((c, e) for c in one for e in one)]
    runs = [(at, collected, *pair) for at in ("cpu", "paper") for collected in ("cpu", "paper") for pair in pairs]
    groups = set()
    for at, collected, collect, evaluate in runs:
        dataset = example()["dataset"] | {"profile": collected, "overrides": collect}
        groups.add(Record.model_validate(example(profile=at, dataset=dataset, overrides=evaluate)).group)
    assert len(groups) == len(runs) > 4000
    # What else differs between two records does not part them.
    assert Record.model_validate(example(seed=2, seconds=9.0, command="other")).group in groups


def test_a_group_is_the_profile_and_what_differs_from_it() -> None:
    dataset = example()["dataset"]
    assert Record.model_validate(example()).group == "cpu"
    # A record that does not say how often it was evaluated at its end is from when that could not be set, and is not taken for a later one.
    before = Record.model_validate(example(hyperparameters={"width": 16}))
    assert before.group == "cpu (evaluate: final_evaluations=1)"
    assert before.again == "cudc-bench evaluate --set final_evaluations=1"
    chosen = example(hyperparameters={"width": 16, "final_evaluations": 1}, overrides={"final_evaluations": 1})
    assert Record.model_validate(chosen).group == before.group
    assert Record.model_validate(example(dataset=dataset | {"overrides": {"steps": 100_000}})).group == "cpu (collect: steps=100000)"
    both = example(dataset=dataset | {"profile": "paper", "overrides": {"k_max": 8, "alpha": 0.1}}, overrides={"width": 64})
    assert Record.model_validate(both).group == "cpu (collected at paper; collect: alpha=0.1, k_max=8; evaluate: width=64)"


def test_paths_of_different_runs_differ(tmp_path: Path) -> None:
    runs = [
        (dataset, algorithm, seed, profile)
        for dataset in ("walker/walk/cudc-v0", "walker/walk/cudc-seed2-v0", "walker/run/cudc-v0")
        for algorithm in ("td3", "cql")
        for seed in (1, 2)
        for profile in ("cpu", "paper")
    ]
    assert len({record_path(tmp_path, *run) for run in runs}) == len(runs)
    folder = tmp_path / "cpu" / "walker" / "walk" / "cudc-v0"
    assert record_path(tmp_path, *runs[0]) == folder / "td3-seed1.json"
    # By the dataset's seed; a training with another one is told from it by both.
    assert record_path(tmp_path, *runs[0], training_seed=1) == folder / "td3-seed1.json"
    assert record_path(tmp_path, *runs[0], training_seed=2) == folder / "td3-seed1-training2.json"
    assert record_path(tmp_path, *runs[0], 500, 2) == folder / "td3-first500-seed1-training2.json"
