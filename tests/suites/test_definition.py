"""Suites as files: what is right is read, what is wrong is refused in one line that names the key and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cudc_bench.errors import UsageError
from cudc_bench.suites.definition import Suite, SuiteStudy, load_suite, suite_names

OWN = """
description = "mine"
methods = ["random", "cudc"]
domains = ["walker", "jaco"]
tasks = ["walk", "reach_top_left"]
algos = ["td3", "bc"]
dataset_shares = [1, 0.25]
seeds = "1-2,7"
profile = "cpu"
collect = { steps = 1000 }
evaluate = { gradient_steps = 10, milestones = [5, 10] }
"""


def refusal(path: Path, text: str | bytes) -> str:
    path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
    with pytest.raises(UsageError) as refused:
        load_suite(str(path))
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "my.suite.toml"
    path.write_text(OWN)
    study = SuiteStudy(("random", "cudc"), ("walker", "jaco"), ("walk", "reach_top_left"), ("td3", "bc"), (0.25, 1.0))
    assert (study.tasks_of("walker"), study.tasks_of("jaco")) == (("walk",), ("reach_top_left",))
    milestones = {"gradient_steps": 10, "milestones": [5, 10]}
    assert load_suite(str(path)) == Suite("my.suite", "mine", (study,), (1, 2, 7), "cpu", {"steps": 1000}, milestones)


def test_a_file_of_others(tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    path.write_text('suites = ["cql", "density"]\nseeds = [4]\n')
    found = load_suite(str(path))
    assert found.seeds == (4,)
    assert found.studies == load_suite("cql").studies + load_suite("density").studies
    assert found.profile == "auto"


def test_every_suite_of_the_package_can_be_copied(tmp_path: Path) -> None:
    import cudc_bench.suites.definition as definition

    for name in suite_names():
        copy = tmp_path / f"{name}.toml"
        copy.write_bytes((Path(definition.__file__).parent / f"{name}.toml").read_bytes())
        assert load_suite(str(copy)) == load_suite(name)
        assert load_suite(name).description
        assert load_suite(name).seeds == (1, 2, 3, 4, 5)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('methods = ["cudc"]', "needs domains, as in"),
        ('domains = ["walker"]', "needs methods, as in"),
        ("", "needs methods, as in"),
        (OWN.replace("methods", "methode"), "has a key 'methode'; allowed: description, suites, methods,"),
        (OWN.replace('"cudc"', '"cucd"'), "unknown method 'cucd'; allowed: "),
        (OWN.replace('"bc"', '"cb"'), "unknown algo 'cb'; allowed: bc, cql,"),
        (OWN.replace('"walker"', '"walk"'), "unknown domain 'walk'"),
        (OWN.replace('"walk"', '"wlak"'), "unknown task 'wlak'; allowed: flip, reach_bottom_left,"),
        (OWN.replace('"walk"', '"reach_top_right"'), "no task is one of walker; it has: stand, walk, run, flip."),
        (OWN.replace('"cpu"', '"gpu"'), "unknown profile 'gpu'; allowed: "),
        (OWN.replace('["random", "cudc"]', '"cudc"'), "methods cannot be 'cudc': it takes a list of collectors"),
        (OWN.replace('["random", "cudc"]', "[]"), "methods cannot be []: it takes a list of collectors, one at least"),
        (OWN.replace("0.25", "1.25"), "dataset_shares.1 cannot be 1.25: it takes a list of numbers above 0, at most 1"),
        (OWN.replace("0.25", "nan"), "dataset_shares.1 cannot be nan"),
        (OWN.replace('"1-2,7"', '"7-2"'), "seeds: --seeds cannot have the range '7-2'"),
        (OWN.replace('"1-2,7"', "[1, 1]"), "seeds: the seed 1 was given twice"),
        (OWN.replace('"1-2,7"', "1979-05-27"), "seeds"),
        (OWN + "stats = 1", "stats cannot be 1: it takes true or false"),
        (OWN + 'suites = ["main"]', "'suites' names other suites, which have their own 'methods'"),
        ('suites = ["min"]', "unknown suite 'min'; allowed: ablation, controls,"),
        ('suites = ["all"]', "unknown suite 'all'; allowed: "),
        ('suites = ["../main"]', "unknown suite '../main'"),
        ('methods = ["cudc"]\ndomains = ["walker"]\ndataset_shares = [0.5]', "'dataset_shares' are for training"),
        ("methods = [", "is not TOML: "),
        ("a = " + "[" * 5000, "nested too deeply"),
        (b"\xff\xfe", "is not UTF-8 text"),
        ("#" * 1_000_001, "it has 1,000,001 bytes, where 1,000,000 are the most"),
    ],
)
def test_what_is_wrong_is_named(text: str | bytes, says: str, tmp_path: Path) -> None:
    assert says in refusal(tmp_path / "my.toml", text)


def test_places_without_a_suite(tmp_path: Path) -> None:
    for name, says in (
        ("nothing", "unknown suite 'nothing'; allowed: ablation, all,"),
        ("man", "Did you mean 'main'?"),
        (str(tmp_path / "nowhere.toml"), "there is no suite"),
        (str(tmp_path), "A file of your own ends in .toml."),
    ):
        with pytest.raises(UsageError) as refused:
            load_suite(name)
        assert says in str(refused.value)
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(UsageError, match="cannot be read"):
        load_suite(str(tmp_path / "folder.toml"))


_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(codec="utf-8"), max_size=9) | st.just("cudc"),
    lambda some: st.lists(some, max_size=3) | st.dictionaries(st.text("abc-", min_size=1, max_size=3), some, max_size=3),
    max_leaves=6,
)
_keys = st.sampled_from(["methods", "domains", "tasks", "algos", "seeds", "profile", "suites", "stats", "dataset_shares", "collect", "x"])


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{name}" = {_toml(one)}' for name, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, bool) or value is None:
        return str(bool(value)).lower()
    if isinstance(value, str):
        return '"' + "".join(c if c.isalnum() and c.isascii() else f"\\U{ord(c):08X}" for c in value) + '"'
    return repr(value)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.dictionaries(_keys, _values, max_size=5))
def test_any_values_are_read_or_refused_in_one_line(tmp_path: Path, content: dict[str, Any]) -> None:
    path = tmp_path / "any.toml"
    path.write_text("\n".join(f"{name} = {_toml(value)}" for name, value in content.items()), encoding="utf-8")
    refused = ""
    try:
        assert load_suite(str(path)).studies
    except UsageError as error:
        refused = str(error)
    assert "\n" not in refused


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=40))
def test_any_bytes_are_read_or_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "any.toml"
    path.write_bytes(content)
    with pytest.raises(UsageError):
        load_suite(str(path))
