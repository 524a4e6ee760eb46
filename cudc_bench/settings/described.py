"""What methods and their hyperparameters are, in their own words: the one source of ``cudc-bench list`` and ``show`` and of the reference.

A hyperparameter's type and range are its annotation's, its default the dataclass's, its meaning the class's section "Attributes:". Of this
project's methods all of that is read from the sources (:mod:`.sources`), so that nobody waits for torch; those of others are imported.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, get_type_hints

from pydantic import TypeAdapter
from pydantic.errors import PydanticInvalidForJsonSchema, PydanticSchemaGenerationError

from cudc_bench import plugins
from cudc_bench.settings import sources
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import as_dict, build
from cudc_bench.settings.evaluate_config import EvaluateConfig, profile_values
from cudc_bench.settings.profiles import PROFILES, Profile, schedules

# Of collectors, in the order of lists, and what those of each do: URLB's three (Laskin et al. 2021), and one for all others.
CATEGORIES = {
    "knowledge": "reward what their models cannot tell yet: errors, or how far several disagree",
    "data": "reward states that are spread widely: their entropy",
    "competence": "learn skills: what an agent does follows from a vector that it is given",
    "other": "do none of these, or do not say which",
}
_LARGEST = 10**10  # of a whole number: beyond any run (see ``cudc_bench.settings.config``)
_WORDS = {"integer": "integer", "number": "float", "string": "string", "boolean": "boolean"}
_SECTIONS = re.compile(r"^(?:Attributes|Class attributes|Args|Raises|Returns|Yields):$", flags=re.MULTILINE)


@dataclass(frozen=True)
class Hyperparameter:
    """A field of a configuration.

    Attributes:
        name: as after ``--set``.
        kind: of its values, such as ``"integer"``.
        allowed: the range, or the choices in backquotes; empty where everything of its kind is.
        default: of the dataclass.
        meaning: what it is, as its class says it; empty where it does not.
    """

    name: str
    kind: str
    allowed: str
    default: Any
    meaning: str


@dataclass(frozen=True)
class Method:
    """A collector or an offline algorithm.

    Attributes:
        name: as on the command line.
        stage: ``"collectors"`` or ``"evaluators"``.
        what: how it explores, or what it is in a few words.
        category: of a collector, one of :data:`CATEGORIES`; empty for an offline algorithm.
        citation: the paper.
        text: its class's docstring, without the sections on attributes and arguments.
        package: the distribution that registers it, with its version.
        target: the class that is registered, as ``module:name``; two names of one class are one method.
        config: the dataclass of its hyperparameters, which may lack its methods.
        values: what makes this variant out of the method that it is one of.
        domain_values: what the method's paper sets for single domains.
    """

    name: str
    stage: str
    what: str
    category: str
    citation: str
    text: str
    package: str
    target: str
    config: type = field(repr=False)
    values: Mapping[str, Any]
    domain_values: Mapping[str, Mapping[str, Any]]

    @property
    def loop(self) -> type:
        """The configuration of the run that it is in, beside its own."""
        return CollectConfig if self.stage == "collectors" else EvaluateConfig

    def at(self, profile: Profile) -> dict[str, Any]:
        """All hyperparameters at a profile, those of the run first; what is set for single domains is left out.

        Raises:
            RunError: its configuration cannot be made, so that nobody could run it.
        """
        try:
            return self._at(profile)
        except (TypeError, NameError, AttributeError) as error:
            raise plugins.unusable(self.stage, self.name, str(error)) from error

    def _at(self, profile: Profile) -> dict[str, Any]:
        config: Any
        if self.stage == "collectors":
            config = build(self.config, schedules(self.config, profile.collect), profile.collect, self.values)
            return as_dict(build(CollectConfig, profile.collect), config, later=True)
        loop = build(EvaluateConfig, profile.evaluate)
        config = build(self.config, profile_values(profile, loop.gradient_steps), self.values)
        return as_dict(loop, config, later=True)


def describe(stage: str, name: str) -> Method:
    """A registered method.

    Args:
        stage: ``"collectors"`` or ``"evaluators"``.
        name: that it is registered under.

    Raises:
        UsageError: there is none of that name.
        RunError: it is registered, but cannot be used.
    """
    module, target = plugins.target(stage, name)
    package = " ".join(f"{one} {version}" for one, version in plugins.package(stage, name).items())
    said = "family" if stage == "collectors" else "summary"
    wanted = (said, "category", "citation", "config_class", "values", "domain_values")
    if plugins.is_own(stage, name) and sources.tree(module) is not None:  # an installation may have no sources
        found = {one: sources.attribute(module, target, one) for one in wanted}
        text = next(filter(None, (ast.get_docstring(one.node) for one in sources.ancestry(module, target))), "")
        # A name that stands for another class is that class.
        real = next(sources.ancestry(module, target))
        module, target = real.module, real.node.name
    else:
        kind = plugins.load(stage, name)
        found, text = {one: getattr(kind, one, None) for one in wanted}, inspect.getdoc(kind) or ""
        if not (isinstance(found["config_class"], type) and dataclasses.is_dataclass(found["config_class"])):
            raise plugins.unusable(stage, name, "its config_class is no dataclass")
    category = category_of(found["category"]) if stage == "collectors" else ""
    return Method(
        name, stage, found[said], category, found["citation"], prose(text), package, f"{module}:{target}", found["config_class"],
        found["values"] or {}, found["domain_values"] or {},
    )  # fmt: skip


def category_of(value: object) -> str:
    """What a class says of its category, which may be anybody's; whatever is none is ``"other"``."""
    return value if isinstance(value, str) and value in CATEGORIES else "other"


# Hyperparameters


@cache
def hyperparameters(config: type) -> tuple[Hyperparameter, ...]:
    """The fields of a configuration, in their order."""
    hints, meanings = get_type_hints(config, include_extras=True), attributes(config)
    return tuple(
        Hyperparameter(one.name, *described(hints[one.name]), _default(one), meanings.get(one.name, ""))
        for one in dataclasses.fields(config)
    )


def _default(one: dataclasses.Field[Any]) -> Any:
    if one.default is not dataclasses.MISSING:
        return one.default
    return None if one.default_factory is dataclasses.MISSING else one.default_factory()


def at_profiles(method: Method) -> dict[str, tuple[Any, ...]]:
    """The value of each hyperparameter, of the run's and of the method's, at each profile, in the order of ``PROFILES``."""
    values = [method.at(profile) for profile in PROFILES.values()]
    return {name: tuple(one[name] for one in values) for name in values[0]}


def profile_table(stage: str, configs: Iterable[type]) -> list[tuple[str, str, tuple[str, ...]]]:
    """What profiles change, at a stage.

    Args:
        stage: ``"collect"`` or ``"evaluate"``.
        configs: of all that runs there.

    Returns:
        For each hyperparameter that any profile changes its name, its default (several with commas, where configurations differ), and its
        value at each profile, in the order of ``PROFILES``; as they are written after ``--set``.
    """
    configs = list(configs)
    given = [dict(getattr(profile, stage)) for profile in PROFILES.values()]
    values = [dict(one) for one in given]
    for one in values if stage == "collect" else ():
        one |= {name: value for config in configs for name, value in schedules(config, one).items()}
    defaults: dict[str, set[str]] = {}
    for config in configs:
        for one_field in dataclasses.fields(config):
            defaults.setdefault(one_field.name, set()).add(default_text(one_field.default))
    rows = []
    for name in dict.fromkeys(name for one in (*given, *values) for name in one):
        own = ", ".join(sorted(defaults.get(name, set())))
        rows.append((name, own, tuple(own if one.get(name) is None else default_text(one[name]) for one in values)))
    return rows


def described(hint: Any) -> tuple[str, str]:
    """The type of a value and the range that it may have, from its annotation as pydantic understands it."""
    try:
        return of_schema(TypeAdapter(hint).json_schema())
    except (PydanticSchemaGenerationError, PydanticInvalidForJsonSchema):  # of a type that JSON has no word for
        return "any", ""


def of_schema(schema: Mapping[str, Any]) -> tuple[str, str]:
    """The same from a JSON schema."""
    if "enum" in schema or "const" in schema:
        values = schema.get("enum", [schema.get("const")])
        return "choice", ", ".join(f"`{value}`" if value != "" else "empty" for value in values)
    if "anyOf" in schema:
        parts = [of_schema(one) for one in schema["anyOf"] if one.get("type") != "null"]
        optional = " or none" if len(parts) < len(schema["anyOf"]) else ""
        return " or ".join(kind for kind, _ in parts) + optional, "; ".join(dict.fromkeys(limits for _, limits in parts if limits))
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            kind, limits = of_schema(schema["prefixItems"][0])
            return f"{len(schema['prefixItems'])} of: {kind}", limits
        kind, limits = of_schema(schema.get("items", {}))
        return f"list of: {kind}", limits
    return _WORDS.get(schema.get("type", ""), schema.get("type", "any")), _limits(schema)


def _limits(schema: Mapping[str, Any]) -> str:
    found = []
    for key, sign in (("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<")):
        if key in schema and schema[key] != _LARGEST:
            found.append(f"{sign} {schema[key]:g}")
    return ", ".join(found)


def default_text(value: Any) -> str:
    """A value as one writes it after ``--set name=``, in backquotes."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple | list):
        return f"`[{','.join(str(one) for one in value)}]`"
    if isinstance(value, int):
        return f"`{value:_}`" if value >= 10_000 else f"`{value}`"
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`"


# Docstrings


def prose(docstring: str) -> str:
    """A docstring without its sections (attributes and so on)."""
    return _SECTIONS.split(inspect.cleandoc(docstring))[0].strip()


def attributes(kind: type) -> dict[str, str]:
    """What the "Attributes:" sections of a class and of those that it inherits from say of each name."""
    found: dict[str, str] = {}
    for one in reversed(kind.__mro__):
        found |= _attributes(own_docstring(one))
    return found


def own_docstring(kind: type) -> str:
    """That of a class itself; empty where it has none."""
    found = vars(kind).get("__doc__") or ""
    # What a dataclass without a docstring gets is its signature.
    return "" if found.startswith(f"{kind.__name__}(") else inspect.cleandoc(found)


def _attributes(docstring: str) -> dict[str, str]:
    section = re.search(r"^Attributes:\n((?:[ \n].*\n?)+)", docstring, re.MULTILINE)
    if section is None:
        return {}
    found: dict[str, str] = {}
    for entry in re.split(r"\n(?=    \S)", section[1].rstrip()):
        # Entries that belong together share a line: "alpha: first. beta: second."
        for part in re.split(r"[.;] (?=`{0,2}\w+`{0,2}(?:, \w+)*: )", " ".join(entry.split())):
            names, _, meaning = part.partition(": ")
            for name in names.replace("`", "").split(", "):
                found[name] = meaning.rstrip(".")
    return found


def without_marks(docstring: str) -> str:
    """A docstring's reStructuredText as plain text: literals without their marks, and roles as the names that they show."""
    text = re.sub(r":[a-z]+:`~?\.*(?:[\w.]*\.)?([^`]+)`", r"\1", docstring)
    return text.replace("`", "").replace("::\n", ":\n")
