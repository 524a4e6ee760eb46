"""Hyperparameters: frozen dataclasses, checked by name, type and range, and hashed.

A method's configuration is a :class:`Config` beside the method, whose defaults are the paper's. Ranges are written as
``Annotated[int, Field(ge=1)]``; pydantic checks them, in Python as on the command line, whose ``--set name=value`` comes through
:func:`parse_settings` and :func:`build`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

from pydantic import Field, TypeAdapter, ValidationError

from cudc_bench.errors import UsageError, nearest

ConfigT = TypeVar("ConfigT")
# Of a field that came after data had been made without it: its default is not written down, so that what was made before is still the same.
ADDED_LATER = {"later": True}
# Of a field that counts environment steps, with a default for the paper's run: smaller profiles change it in proportion to theirs.
WITH_STEPS = {"scales_with": "steps"}

# The upper bound is beyond any run, and keeps slips of the keyboard out of the arithmetic of sizes.
PositiveInt = Annotated[int, Field(ge=1, le=10**10)]
NonNegativeInt = Annotated[int, Field(ge=0, le=10**10)]
PositiveFloat = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegativeFloat = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
UnitInterval = Annotated[float, Field(ge=0, le=1)]
Precision = Literal["float32", "tf32", "bf16"]
_ADAPTERS: dict[type, dict[str, TypeAdapter[Any]]] = {}  # of configurations that were asked for: to make them takes milliseconds


class Config:
    """Base of the frozen dataclasses that hold hyperparameters: none of their values is of another type or out of range.

    Raises:
        UsageError: one is; the message names it and what is allowed.
    """

    def __post_init__(self) -> None:
        for name, adapter in _adapters(type(self)).items():
            given = getattr(self, name)
            value = _checked(name, given, adapter)
            if value != given:  # a list for a tuple, a string for what it says
                object.__setattr__(self, name, value)


def _adapters(config: type) -> dict[str, TypeAdapter[Any]]:
    if config not in _ADAPTERS:
        hints = get_type_hints(config, include_extras=True)
        _ADAPTERS[config] = {name: TypeAdapter(hints[name]) for name in field_names(config)}
    return _ADAPTERS[config]


def parse_settings(settings: Iterable[str]) -> dict[str, str]:
    """Split ``name=value`` strings.

    Raises:
        UsageError: a string without ``=``, without a name, or a name given twice.
    """
    values: dict[str, str] = {}
    for setting in settings:
        name, separator, value = setting.partition("=")
        name = name.strip()
        if not separator or not name:
            raise UsageError(f"--set takes name=value, not '{setting}'.")
        if name in values:
            raise UsageError(f"--set gives '{name}' twice; give it once.")
        values[name] = value.strip()
    return values


def field_names(config: type) -> list[str]:
    """The names of a configuration's fields, in their order."""
    return [field.name for field in dataclasses.fields(config)]


def check_settings(settings: Mapping[str, Any], configs: Iterable[type]) -> None:
    """Refuse a setting that no configuration of this run has.

    Raises:
        UsageError: names the setting, the nearest match and every allowed name.
    """
    allowed = [name for config in configs for name in field_names(config)]
    for name in settings:
        if name not in allowed:
            raise UsageError(f"nothing here is called '{name}'.{nearest(name, allowed)} Allowed: {', '.join(sorted(set(allowed)))}.")


def build(config: type[ConfigT], *layers: Mapping[str, Any]) -> ConfigT:
    """Make a configuration from its defaults and layers of values, later ones winning; names that it lacks are passed over.

    Layers are, in order: the profile, the domain's own values, the user's settings. Strings (from ``--set``) are parsed to the
    field's type.

    Args:
        config: the frozen dataclass.
        layers: mappings from field name to value.

    Raises:
        UsageError: a value is of the wrong type or out of range; the message names it and what is allowed.
    """
    adapters = _adapters(config)
    values: dict[str, Any] = {}
    for layer in layers:
        for name, value in layer.items():
            if name in adapters:
                values[name] = _checked(name, value, adapters[name])
    return config(**values)


def _checked(name: str, value: Any, adapter: TypeAdapter[Any]) -> Any:
    try:
        if isinstance(value, str):
            # A list or tuple is written as JSON on the command line, everything else as it is.
            return adapter.validate_json(value) if value[:1] == "[" else adapter.validate_strings(value)
        return adapter.validate_python(value)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"'{name}' cannot be {value!r}: {first['msg'][0].lower()}{first['msg'][1:]}.") from None


def as_dict(*configs: Any, later: bool = False) -> dict[str, Any]:
    """All values of some configurations in one JSON-ready mapping; their names must not overlap.

    Args:
        configs: frozen dataclasses.
        later: also the defaults of ``ADDED_LATER`` fields, which what is written down leaves out.
    """
    merged: dict[str, Any] = {}
    for config in configs:
        for field in dataclasses.fields(config):
            name, value = field.name, getattr(config, field.name)
            if name in merged:
                raise ValueError(f"two configurations of one run have a field '{name}'")
            if not later and field.metadata.get("later") and value == field.default:
                continue
            merged[name] = list(value) if isinstance(value, tuple) else value
    return merged


def changed(values: Mapping[str, Any], plain: Mapping[str, Any]) -> dict[str, Any]:
    """The values that differ from those of the plain profile: what a run's settings really changed."""
    return {name: value for name, value in values.items() if name not in plain or value != plain[name]}


def config_hash(values: Mapping[str, Any]) -> str:
    """The first 16 hexadecimal digits of the SHA-256 over the values in canonical JSON."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, separators=(",", ":")).encode()).hexdigest()[:16]
