"""The generated parts of the reference say all that the code says."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Reference
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import Finite, PositiveInt, UnitInterval, build
from cudc_bench.settings.evaluate_config import EvaluateConfig, OnlineConfig

from .pages import PAGES, ROOT

_SPEC = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
assert _SPEC is not None
assert _SPEC.loader is not None
generate: Any = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(generate)


@dataclass(frozen=True)
class Shown:
    """A configuration.

    Attributes:
        first, second: share a line. third: has its own,
            in two lines.
        fourth: of ``name | other``; with a *star*.
    """

    first: PositiveInt = 200_000
    second: UnitInterval = 0.5
    third: Literal["a", "b"] = "a"
    fourth: tuple[Annotated[int, Field(gt=0)], ...] = (1, 2)
    fifth: Finite | None = None
    sixth: bool = False


def configurations() -> Iterator[type]:
    yield from (EvaluateConfig, OnlineConfig, CollectConfig)
    for kind in ("collectors", "evaluators"):
        yield from generate.configurations(kind)


def models(model: type[BaseModel], seen: set[type[BaseModel]]) -> set[type[BaseModel]]:
    """A model and all that its fields hold."""
    if model not in seen:
        seen.add(model)
        for field in model.model_fields.values():
            for part in re.findall(r"\b[A-Z]\w+", str(field.annotation)):
                for module in ("manifest", "records", "references"):
                    found = getattr(importlib.import_module(f"cudc_bench.artefacts.{module}"), part, None)
                    if isinstance(found, type) and issubclass(found, BaseModel):
                        models(found, seen)
    return seen


def test_a_configuration_is_shown_with_types_ranges_defaults_and_meanings() -> None:
    rows = [line.split(" | ") for line in generate.hyperparameters(Shown).splitlines()[2:]]
    assert [[cell.strip("| ") for cell in row] for row in rows[:3]] == [
        ["`first`", "integer", "`200_000`", "≥ 1", "share a line"],
        ["`second`", "float", "`0.5`", "≥ 0, ≤ 1", "share a line"],
        ["`third`", "choice", "`a`", "`a`, `b`", "has its own, in two lines"],
    ]
    text = generate.hyperparameters(Shown)
    assert "| `fourth` | list of: integer | `[1,2]` | > 0 | of `name \\| other`; with a \\*star\\* |" in text
    assert "| `fifth` | float or none | none |  |  |" in text
    assert "| `sixth` | boolean | `false` |  |  |" in text


def test_every_hyperparameter_has_a_meaning_and_a_default_that_set_takes() -> None:
    for config in configurations():
        meanings = generate.attributes(config)
        for field in dataclasses.fields(config):
            assert meanings.get(field.name), (config.__name__, field.name)
            if field.default is not None:
                written = generate.default_text(field.default).strip("`")
                assert getattr(build(config, {field.name: written}), field.name) == field.default, (config.__name__, field.name)


def test_every_hyperparameter_of_every_method_is_shown() -> None:
    for kind in ("collectors", "evaluators"):
        text = generate.PARTS[kind]()
        for name in plugins.names(kind):
            assert f"`{name}`" in text or f"### {name}\n" in text
        assert [f.name for one in generate.configurations(kind) for f in dataclasses.fields(one) if f"| `{f.name}` |" not in text] == []


def test_the_category_of_every_collector_is_its_class_s() -> None:
    shown = dict(re.findall(r"^\| `([a-z]+)` \| (\w+) \|", (ROOT / "docs/reference/methods.md").read_text(), re.MULTILINE))
    own = {name for name in plugins.names("collectors") if plugins.is_own("collectors", name) and "-" not in name}
    assert shown == {name: plugins.load("collectors", name).category for name in own}


def test_every_field_of_every_file_has_a_meaning() -> None:
    for model in (Manifest, Record, Reference):
        for one in models(model, set()):
            meanings = generate.attributes(one)
            assert [name for name in one.model_fields if not meanings.get(name)] == [], one.__name__
    shown = "".join(generate.PARTS[part]() for part in ("manifest", "record", "reference"))
    names = {one.__name__ for model in (Manifest, Record, Reference) for one in models(model, set())}
    assert {name for name in names if f"### {name}\n" not in shown} == set()


def test_every_command_and_option_is_shown() -> None:
    text = generate.PARTS["command-line"]()
    for name in plugins.names("commands"):
        if plugins.target("commands", name)[0].startswith("cudc_bench."):
            assert f"\n## {name}\n" in f"\n{text}"
    assert "| `--seeds`, `--seed` | string | `1` | Seeds, such as 1 or 1-5 or 1,3. |" in text
    assert "cudc-bench verify" in text


def test_all_of_python_is_shown() -> None:
    text = generate.PARTS["python"]()
    assert [name for name in cudc_bench.__all__ if f":: cudc_bench.{name}\n" not in text + "\n"] == []
    assert [name for name in cudc_bench.__all__ if not getattr(cudc_bench, name).__doc__] == []


def test_every_part_has_a_page_and_every_page_its_parts() -> None:
    asked = [mark for page in PAGES for mark in generate.MARK.findall((ROOT / page).read_text())]
    assert sorted(asked) == sorted(generate.PARTS)
    with pytest.raises(KeyError, match="nothing"):
        generate.fill("<!-- generated: nothing -->")
    assert generate.fill("before\n<!-- generated: evaluate-loop -->\nafter").count("`gradient_steps`") == 1
