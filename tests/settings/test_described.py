"""What is read of methods without importing them is what they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest

from cudc_bench import plugins
from cudc_bench.errors import RunError
from cudc_bench.settings import sources
from cudc_bench.settings.config import as_dict
from cudc_bench.settings.described import at_profiles, default_text, describe, hyperparameters, prose, without_marks
from cudc_bench.settings.evaluate_config import plain_values
from cudc_bench.settings.profiles import PROFILES

METHODS = [(stage, name) for stage in ("collectors", "evaluators") for name in plugins.names(stage) if plugins.is_own(stage, name)]


@pytest.mark.parametrize(("stage", "name"), METHODS)
def test_a_method_that_is_read_is_the_class_that_is_imported(stage: str, name: str) -> None:
    found, kind = describe(stage, name), plugins.load(stage, name)
    assert (found.citation, found.values) == (kind.citation, kind.values)
    assert (found.what, found.category) == ((kind.family, kind.category) if stage == "collectors" else (kind.summary, ""))
    assert found.domain_values == getattr(kind, "domain_values", {})
    assert found.target == f"{kind.__module__}:{kind.__name__}"
    assert " ".join(found.text.split()) in " ".join((kind.__doc__ or "").split())
    assert found.text
    config = kind.config_class
    assert [(one.name, one.default, one.metadata) for one in dataclasses.fields(found.config)] == [
        (one.name, one.default, one.metadata) for one in dataclasses.fields(config)
    ]
    # Types, ranges and meanings, too.
    assert hyperparameters(found.config) == hyperparameters(config)


@pytest.mark.parametrize(("stage", "name"), METHODS)
def test_its_values_at_profiles_are_those_of_its_runs(stage: str, name: str) -> None:
    kind = plugins.load(stage, name)
    found = at_profiles(describe(stage, name))
    for index, profile in enumerate(PROFILES.values()):
        if stage == "collectors":
            values = as_dict(kind.configure("nowhere", profile.collect), later=True)
        else:
            values = dict(plain_values(kind, profile, profile.evaluate.get("gradient_steps", 500_000)))
        shown = {one: value[index] for one, value in found.items() if one in values}
        assert {one: list(value) if isinstance(value, tuple) else value for one, value in shown.items()} == values


def test_nothing_is_imported_to_describe_a_method(python: Callable) -> None:
    script = """
import sys
from cudc_bench.settings.described import at_profiles, describe, hyperparameters
for stage, name in (("collectors", "cudc-vary-icm"), ("evaluators", "td3-bc")):
    found = describe(stage, name)
    print(len(hyperparameters(found.config)) > 5, len(at_profiles(found)) > 5)
print(sorted({name.split(".")[0] for name in sys.modules} & {"torch", "mujoco", "gymnasium", "h5py"}))
"""
    assert python(script) == (0, "True True\nTrue True\n[]\n", "")


def test_where_there_are_no_sources_the_class_itself_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    read = describe("evaluators", "td3")
    monkeypatch.setattr(sources, "tree", lambda module: None)
    imported = describe("evaluators", "td3")
    assert (imported.what, imported.citation, imported.target) == (read.what, read.citation, read.target)
    assert at_profiles(imported) == at_profiles(read)


def test_what_needs_more_than_definitions_is_refused() -> None:
    assert sources.value("cudc_bench.collectors.ddpg", "DDPGConfig") is sources.value("cudc_bench.collectors.apt", "DDPGConfig")
    with pytest.raises(RunError, match=r"'nothing' is not defined in the source of cudc_bench\.collectors\.ddpg"):
        sources.value("cudc_bench.collectors.ddpg", "nothing")
    assert sources.attribute("cudc_bench.collectors.ddpg", "DDPG", "nothing") is None


def test_whatever_somebody_elses_configuration_holds_is_described() -> None:
    @dataclasses.dataclass(frozen=True)
    class Theirs:
        needed: int
        function: Callable[[int], int] = abs
        table: dict[str, float] = dataclasses.field(default_factory=lambda: {"a": 0.5})

    Theirs.__annotations__ = {"needed": int, "function": Callable[[int], int], "table": dict[str, float]}
    needed, function, table = hyperparameters(Theirs)
    assert (needed.kind, needed.default) == ("integer", None)
    assert (function.kind, function.allowed) == ("any", "")
    assert default_text(table.default) == "`{'a': 0.5}`"


def test_docstrings_are_shown_without_their_marks() -> None:
    text = "As ``that``, see :class:`~cudc_bench.x.Y` and :mod:`.z`::\n\n    code\n\nArgs:\n    one: is left out.\n"
    assert without_marks(prose(text)) == "As that, see Y and z:\n\n    code"
