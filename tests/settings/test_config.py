"""Settings are checked by name, type and range, and whatever is typed ends in a value or in one clear refusal."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench import plugins
from cudc_bench.cli.options import parse_names, parse_tasks
from cudc_bench.errors import UsageError
from cudc_bench.files import check_folder
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    UnitInterval,
    as_dict,
    build,
    check_settings,
    config_hash,
    field_names,
    parse_settings,
)
from cudc_bench.settings.evaluate_config import EvaluateConfig, OnlineConfig
from cudc_bench.settings.seeds import format_seeds, parse_seeds

CONFIGS = [
    CollectConfig,
    EvaluateConfig,
    OnlineConfig,
    *(plugins.load(kind, name).config_class for kind in ("collectors", "evaluators") for name in plugins.names(kind)),
]
NAMES = sorted({name for config in CONFIGS for name in field_names(config)})
anything = st.text(st.characters())  # lone surrogates, too: that is how bytes that are not UTF-8 reach a command line


@dataclass(frozen=True)
class Example:
    """One field of each kind."""

    count: PositiveInt = 1
    index: NonNegativeInt = 0
    rate: PositiveFloat = 0.1
    weight: NonNegativeFloat = 0.0
    share: UnitInterval = 0.5
    switch: bool = False
    mode: Literal["slow", "fast"] = "slow"
    pair: tuple[PositiveInt, PositiveInt] = (1, 2)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("count", "7", 7), ("index", "0", 0), ("rate", "1e-4", 1e-4), ("weight", "0", 0.0), ("share", "1", 1.0), ("switch", "true", True),
        ("switch", "false", False), ("mode", "fast", "fast"), ("pair", "[3, 4]", (3, 4)),
    ],
)  # fmt: skip
def test_text_becomes_a_value_of_the_fields_type(name: str, text: str, value: Any) -> None:
    found = getattr(build(Example, parse_settings([f"{name}={text}"])), name)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("count", "0"), ("count", "-1"), ("count", "1.5"), ("count", "one"), ("count", ""), ("count", "[1]"), ("index", "-1"),
        ("rate", "0"), ("rate", "-0.1"), ("rate", "nan"), ("rate", "inf"), ("rate", "1e999"), ("weight", "-1e-9"),
        ("weight", "inf"), ("weight", "nan"),
        ("share", "1.01"), ("share", "-0.01"), ("share", "nan"), ("switch", "maybe"), ("switch", "2"), ("mode", "fas"), ("mode", ""),
        ("pair", "1,2"), ("pair", "[1]"), ("pair", "[1,2,3]"), ("pair", "[0,1]"), ("pair", "[1,"), ("pair", "[" * 10_000),
        ("pair", "[1,NaN]"), ("count", "9" * 5_000),
    ],
    ids=lambda text: text[:12],
)  # fmt: skip
def test_a_value_of_the_wrong_type_or_out_of_range_is_refused_by_name(name: str, text: str) -> None:
    with pytest.raises(UsageError, match=rf"^'{name}' cannot be '"):
        build(Example, parse_settings([f"{name}={text}"]))


def test_a_value_from_python_is_checked_as_well() -> None:
    assert build(Example, {"pair": [3, 4], "count": 2}) == Example(count=2, pair=(3, 4))
    for values in ({"count": 0}, {"rate": math.nan}, {"mode": "fas"}, {"pair": [1]}, {"count": None}, {"switch": []}):
        with pytest.raises(UsageError, match="cannot be"):
            build(Example, values)


def test_an_unknown_name_is_refused_with_the_nearest_and_all_allowed() -> None:
    check_settings({"count": 1, "steps": 2}, [Example, CollectConfig])
    with pytest.raises(UsageError, match=r"^nothing here is called 'cuont'\. Did you mean 'count'\? Allowed: count, index, .*, weight\.$"):
        check_settings({"cuont": 1}, [Example])
    with pytest.raises(UsageError) as caught:
        check_settings({"zzzzzzzz": 1}, [Example])
    assert "Did you mean" not in str(caught.value)


@pytest.mark.parametrize("setting", ["", "=", "=1", "count", " =1", "count:1"])
def test_a_setting_needs_a_name_and_a_value(setting: str) -> None:
    with pytest.raises(UsageError, match="--set takes name=value"):
        parse_settings([setting])


def test_settings_are_split_at_the_first_sign_and_given_once() -> None:
    assert parse_settings(["a=1", " b = x=y "]) == {"a": "1", "b": "x=y"}
    with pytest.raises(UsageError, match="gives 'a' twice"):
        parse_settings(["a=1", "a=1"])


def test_later_layers_win_and_names_of_others_are_passed_over() -> None:
    layers = ({"count": 2, "index": 2, "nothing": 0}, {"index": 3}, {"rate": "0.5"})
    assert build(Example, *layers) == Example(count=2, index=3, rate=0.5)
    assert build(Example) == Example()


def test_one_run_has_every_name_once() -> None:
    assert as_dict(Example(), CollectConfig())["pair"] == [1, 2]
    with pytest.raises(ValueError, match="have a field 'count'"):
        as_dict(Example(), Example())


@given(st.dictionaries(st.text(max_size=5), st.integers() | st.floats(allow_nan=False) | st.booleans() | st.text(max_size=5), min_size=1))
def test_the_hash_depends_on_the_values_alone(values: dict[str, Any]) -> None:
    shuffled = dict(reversed(values.items()))
    assert config_hash(values) == config_hash(shuffled) == config_hash(json.loads(json.dumps(values)))
    for name in values:
        assert config_hash({**values, name: "something else"}) != config_hash(values)
        assert config_hash({key: value for key, value in values.items() if key != name}) != config_hash(values)


numbers = st.integers().map(str) | st.floats().map(repr) | st.lists(st.integers(-1, 9)).map(json.dumps)
settings = st.builds(lambda name, value: f"{name}={value}", st.sampled_from(NAMES) | anything, numbers | anything)


@given(st.lists(settings | anything, max_size=3), st.sampled_from(CONFIGS))
def test_whatever_is_set_is_a_valid_configuration_or_refused(texts: list[str], config: type) -> None:
    try:
        values = parse_settings(texts)
        check_settings(values, [config])
        found = build(config, values)
    except UsageError:
        return
    stored = json.loads(json.dumps(as_dict(found), allow_nan=False))
    assert build(config, stored) == found
    assert values.keys() <= stored.keys()


@given(st.sampled_from([config for config in CONFIGS if field_names(config)]), st.data())
def test_any_single_field_can_be_attacked(config: type, data: st.DataObject) -> None:
    name, text = data.draw(st.sampled_from(field_names(config))), data.draw(numbers | anything)
    try:
        found = build(config, {name: text})
    except UsageError:
        return
    changed = {field.name for field in dataclasses.fields(found) if getattr(found, field.name) != getattr(config(), field.name)}
    assert changed <= {name}
    assert build(config, json.loads(json.dumps(as_dict(found), allow_nan=False))) == found


@given(st.sampled_from([config for config in CONFIGS if field_names(config)]), st.data())
def test_in_python_it_is_checked_like_on_the_command_line(config: type, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(field_names(config)))
    value = data.draw(st.integers() | st.floats() | st.text(max_size=3) | st.none() | st.booleans() | st.lists(st.integers(), max_size=4))
    refusal, expected = "", None
    try:
        expected = build(config, {name: value})
    except UsageError as error:
        refusal = str(error)
    if refusal:
        with pytest.raises(UsageError) as caught:
            config(**{name: value})
        assert str(caught.value) == refusal
    else:
        assert config(**{name: value}) == expected
        assert hash(config(**{name: value})) == hash(expected)


@pytest.mark.parametrize("config", [config for config in CONFIGS if field_names(config)])
def test_no_configuration_takes_what_is_no_value_at_all(config: type) -> None:
    for name in field_names(config):
        with pytest.raises(UsageError, match=f"'{name}' cannot be"):
            config(**{name: object()})


# ------------------------------------------------------------------------------------------------------------------------ seeds


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("1", (1,)), ("1-5", (1, 2, 3, 4, 5)), ("1,3", (1, 3)), (" 2 , 1 ", (2, 1)), ("1-3,2,7-8", (1, 2, 3, 7, 8)), ("0", (0,)),
        ("5-5", (5,)), ("007", (7,)), ("999999999", (999_999_999,)),
    ],
)  # fmt: skip
def test_seeds_are_numbers_and_ranges(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    "text", ["", " ", ",", "1,", "-1", "1-", "1--2", "5-1", "0-1000", "1.5", "a", "1 2", "١", "1-٣", "1e3", "0x1", "9" * 10, "0-999,1000"]
)
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--seeds cannot"):
        parse_seeds(text)


@given(anything | st.text("0123456789-, ", max_size=12))
def test_whatever_is_given_as_seeds_is_some_seeds_or_refused(text: str) -> None:
    try:
        seeds = parse_seeds(text)
    except UsageError:
        return
    assert 1 <= len(seeds) <= 1000
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 10**9 for seed in seeds)
    assert set(parse_seeds(format_seeds(seeds))) == set(seeds)


@given(st.lists(st.integers(0, 10**9 - 1), min_size=1, max_size=30, unique=True))
def test_seeds_survive_being_written_and_read(seeds: list[int]) -> None:
    assert parse_seeds(format_seeds(seeds)) == tuple(sorted(seeds))


def test_a_range_is_written_as_one() -> None:
    assert [format_seeds(seeds) for seeds in ([1], [1, 2], [3, 1, 2], [1, 2, 4])] == ["1", "1,2", "1-3", "1,2,4"]


def test_names_are_split_without_repeats() -> None:
    assert parse_names(" b, a,,b ") == ("b", "a")
    assert parse_names(" , ") == ()
    assert parse_tasks(" all ") is None
    assert parse_tasks("walk,run") == ("walk", "run")


def test_a_folder_that_cannot_be_made_is_refused_and_none_is_made(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for place in (file, file / "below", file / "far" / "below"):
        with pytest.raises(UsageError, match=f"the output '{place}' cannot be a folder: '{file}' is a file"):
            check_folder(place, "the output")
    assert check_folder(tmp_path / "new" / "one", "the output") == tmp_path / "new" / "one"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
