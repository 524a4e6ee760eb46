"""The parts of the reference that are made from the code, as MyST Markdown.

A page asks for a part with a comment on a line of its own, such as ``<!-- generated: command-line -->``; ``conf.py`` calls :func:`fill`
before Sphinx reads the page. Nothing that is generated is kept, so that the pages say what the code says.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, get_args, get_type_hints

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from typer.models import ArgumentInfo, OptionInfo

import cudc_bench
from cudc_bench import plugins
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.settings import described
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.described import default_text
from cudc_bench.settings.evaluate_config import EvaluateConfig, OnlineConfig
from cudc_bench.settings.profiles import PROFILES

MARK = re.compile(r"^<!-- generated: ([a-z-]+) -->$", re.MULTILINE)
Rows = Iterable[Sequence[str]]
# What commands print with ``--json``, as the module and the name of its model.
DOCUMENTS = (
    ("list", "cudc_bench.cli.documents", "Listing"),
    ("verify", "cudc_bench.cli.documents", "VerifyDocument"),
    ("doctor", "cudc_bench.cli.documents", "DoctorDocument"),
    ("leaderboard", "cudc_bench.leaderboard.show.documents", "LeaderboardDocument"),
    ("stats", "cudc_bench.leaderboard.show.documents", "StatsDocument"),
)


def fill(source: str) -> str:
    """A page with each of its marks replaced by what it asks for.

    Raises:
        KeyError: a mark asks for something that nobody makes.
    """
    return MARK.sub(lambda found: PARTS[found[1]](), source)


# Text


def table(head: Sequence[str], rows: Rows) -> str:
    """A Markdown table; bars and line ends in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in line) + " |" for line in lines) + "\n"


def markdown(docstring: str) -> str:
    """A docstring's reStructuredText as Markdown: literals, and roles as the names that they show."""
    text = re.sub(r":[a-z]+:`~?\.*(?:[\w.]*\.)?([^`]+)`", r"`\1`", docstring)
    text = text.replace("``", "`").replace("::\n", ":\n")
    # Outside of literals an asterisk or an underscore is itself.
    return "".join(part if part.startswith("`") else re.sub(r"([*_<])", r"\\\1", part) for part in re.split(r"(`[^`]*`)", text))


def prose(kind: type) -> str:
    """A class's docstring without its sections (attributes and so on); empty where it has none of its own."""
    return markdown(described.prose(described.own_docstring(kind)))


def attributes(kind: type) -> dict[str, str]:
    """What the "Attributes:" sections of a class and of those that it inherits from say of each name."""
    return {name: markdown(meaning) for name, meaning in described.attributes(kind).items()}


# Hyperparameters


def hyperparameters(config: type, leave_out: Iterable[type] = ()) -> str:
    """The table of a configuration's fields.

    Args:
        config: a frozen dataclass.
        leave_out: configurations that stand elsewhere on the page; fields that are theirs, with the same default, are not repeated.
    """
    elsewhere = {(field.name, field.default) for one in leave_out for field in dataclasses.fields(one)}
    rows = [
        (f"`{one.name}`", one.kind, default_text(one.default), one.allowed, markdown(one.meaning))
        for one in described.hyperparameters(config)
        if (one.name, one.default) not in elsewhere
    ]
    return table(("name", "type", "default", "allowed", "meaning"), rows) if rows else ""


def configurations(kind: str) -> dict[type, list[str]]:
    """The configurations of everything registered for a kind, each with the names that use it."""
    found: dict[type, list[str]] = {}
    for name in plugins.names(kind):
        if plugins.target(kind, name)[0].startswith("cudc_bench."):
            found.setdefault(plugins.load(kind, name).config_class, []).append(name)
    return found


def _bases(config: type) -> list[type]:
    """The configurations that one inherits from and that stand on the same page, whether a method has them itself or not."""
    return [one for one in config.__mro__[1:] if dataclasses.is_dataclass(one)]


def _of_methods(kind: str) -> Iterator[str]:
    found = configurations(kind)
    shared = {base: None for config in found for base in _bases(config) if base not in found}
    for base in shared:
        users = [name for config, names in found.items() if issubclass(config, base) for name in names]
        yield f"### Shared: {base.__name__}\n\n{prose(base)}\n\nOf {_listed(users)}.\n\n{hyperparameters(base)}"
    for config, names in found.items():
        classes = {name: plugins.load(kind, name) for name in names}
        title = min(names, key=len)
        text = f"### {title}\n\n{prose(config)}\n\n"
        if len(names) > 1:
            text += f"Of {_listed(names)}.\n\n"
        if bases := _bases(config):
            text += f"Beside these it has all of {', '.join(f'`{one.__name__}`' for one in bases)}.\n\n"
        text += hyperparameters(config, bases) or "None of its own.\n"
        yield text + _values(classes)


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _values(classes: Mapping[str, Any]) -> str:
    """Where values differ from the defaults: by domain, and by name of a variant."""
    rows = []
    for name, kind in classes.items():
        for domain, values in getattr(kind, "domain_values", {}).items():
            if "domain_values" in vars(kind):
                rows.append((f"`{name}`", domain, _settings(values)))
        if kind.values:
            rows.append((f"`{name}`", "all", _settings(kind.values)))
    return "\n" + table(("name", "domain", "values that differ from the defaults"), rows) if rows else ""


def _settings(values: Mapping[str, Any]) -> str:
    return ", ".join(f"`{name}={default_text(value).strip('`')}`" for name, value in values.items())


def profiles() -> str:
    """What each profile changes, for collection and for training."""
    text = ""
    for stage, configs in (
        ("collect", [CollectConfig, *configurations("collectors")]),
        ("evaluate", [EvaluateConfig, *configurations("evaluators")]),
    ):
        rows = [(f"`{name}`", *values) for name, _, values in described.profile_table(stage, configs)]
        text += f"\n### Values for `{stage}`\n\n" + table(("hyperparameter", *(f"`{name}`" for name in PROFILES)), rows)
    return text


def departures(kind: str) -> str:
    """What each class of a kind says of itself, which includes where it departs from its paper."""
    seen: dict[Any, list[str]] = {}
    for name in plugins.names(kind):
        if plugins.target(kind, name)[0].startswith("cudc_bench."):
            seen.setdefault(plugins.load(kind, name), []).append(name)
    parts = []
    for one, names in sorted(seen.items(), key=lambda item: item[1]):
        module = inspect.getmodule(one)
        assert module is not None
        path = module.__name__.removeprefix("cudc_bench.").replace(".", "/")
        grouped = f"category {one.category}; " if kind == "collectors" else ""
        parts.append(f"### {', '.join(f'`{name}`' for name in names)}\n\n{prose(one)}\n\n{grouped}{one.citation}; `{path}.py`\n")
    return "\n".join(parts)


# Schemas


def schema(*models: type[BaseModel]) -> str:
    """A table of fields for each model."""
    return "\n".join(_fields(model) for model in models)


def _fields(model: type[BaseModel]) -> str:
    meanings, rows = attributes(model), []
    definitions = model.model_json_schema(mode="validation")
    for name, field in model.model_fields.items():
        shown, limits = _reference(definitions["properties"][name])
        meaning = meanings.get(name) or (field.description or "")
        rows.append((f"`{name}`", shown, _required(field), ". ".join(text for text in (meaning, limits) if text)))
    return f"### {model.__name__}\n\n{prose(model)}\n\n" + table(("field", "type", "if absent", "meaning"), rows)


def _required(field: FieldInfo) -> str:
    if field.is_required():
        return "refused"
    return "none" if field.default is None else f"`{field.default}`" if field.default not in ("", [], {}) else "empty"


def _reference(found: Mapping[str, Any]) -> tuple[str, str]:
    """The type of a field and what it must look like; models are named."""
    if "$ref" in found:
        return found["$ref"].rsplit("/", 1)[-1], ""
    if "anyOf" in found:
        parts = [_reference(one) for one in found["anyOf"] if one.get("type") != "null"]
        return " or ".join(kind for kind, _ in parts), "; ".join(dict.fromkeys(limits for _, limits in parts if limits))
    if found.get("type") == "array" and "items" in found:
        kind, limits = _reference(found["items"])
        return f"list of {kind}", limits
    if found.get("type") == "object":
        values = found.get("additionalProperties")
        kind = _reference(values)[0] if isinstance(values, Mapping) and values else "any"
        return f"mapping of string to {kind}", ""
    if "pattern" in found:
        return "string", f"Fits `{found['pattern']}`"
    kind, limits = described.of_schema(found)
    return kind, limits if kind == "choice" else limits and f"Allowed: {limits}"


def _models(module: str, *names: str) -> Callable[[], str]:
    def made() -> str:
        found = import_module(module)
        return schema(*(getattr(found, name) for name in names))

    return made


def _documents() -> str:
    """The documents of ``--json``, and what is in them."""
    return "\n".join(
        f"## {command}\n\n" + "\n".join(map(_printed, _with_parts(getattr(import_module(module), name))))
        for command, module, name in DOCUMENTS
    )


def _printed(model: type[BaseModel]) -> str:
    """The fields of a document or a part of one, all of which are always there."""
    meanings, rows = attributes(model), []
    for name, found in model.model_json_schema(mode="validation")["properties"].items():
        null = " or null" if any(one.get("type") == "null" for one in found.get("anyOf", ())) else ""
        rows.append((f"`{name}`", f"{_reference(found)[0]}{null}", meanings.get(name, "")))
    return f"### {model.__name__}\n\n{prose(model)}\n\n" + table(("field", "type", "meaning"), rows)


def _with_parts(model: type[BaseModel]) -> list[type[BaseModel]]:
    """A model, and then those of its fields, each once."""
    found = [model]
    for one in found:
        for field in one.model_fields.values():
            found += [part for part in _models_in(field.annotation) if part not in found]
    return found


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for one in get_args(annotation):
        yield from _models_in(one)


# The command line


def command_line() -> str:
    """Each command with its arguments and options."""
    from cudc_bench.cli.app import build_app

    app = build_app()
    root = app.registered_callback
    assert root is not None
    found = [_command("Options before a command", "cudc-bench", root.callback)]
    found += [
        _command(one.name, f"cudc-bench {one.name}", plugins.load("commands", one.name)) for one in app.registered_commands if one.name
    ]
    return "\n".join(found)


def _command(title: str, usage: str, function: Any) -> str:
    hints, arguments, options = get_type_hints(function, include_extras=True), [], []
    for parameter in inspect.signature(function).parameters.values():
        value, information = get_args(hints[parameter.name])[:2]
        kind, limits = described.described(value)
        if isinstance(information, ArgumentInfo):
            shown = str(information.metavar or parameter.name.upper())
            many, optional = kind.startswith("list"), parameter.default is not inspect.Parameter.empty
            usage += f" {f'[{shown}]' if optional else shown}{'...' if many else ''}"
            arguments.append((f"`{shown}`", str(information.help or "")))
        elif isinstance(information, OptionInfo):
            limits = ", ".join(
                f"{sign} {bound:g}" for sign, bound in (("≥", information.min), ("≤", information.max)) if bound is not None
            )  # fmt: skip
            variable = f" Or the environment variable `{information.envvar}`." if information.envvar else ""
            needed = parameter.default is inspect.Parameter.empty
            default = "needed" if needed else "" if parameter.default in (None, False) else default_text(parameter.default)
            # Inside of an annotation the first name stands where the default would.
            spelled = _listed([str(one) for one in (information.default, *(information.param_decls or ()))])
            what = "" if kind == "boolean" else f"{kind.removesuffix(' or none')}{f', {limits}' if limits else ''}"
            options.append((spelled, what, default, str(information.help or "") + variable))
    usage += f"{' [OPTIONS]' if options else ''}{' COMMAND' if usage == 'cudc-bench' else ''}"
    text = f"## {title}\n\n{markdown(inspect.cleandoc(function.__doc__ or ''))}\n\n```\n{usage}\n```\n"
    if arguments:
        text += "\n" + table(("argument", "meaning"), arguments)
    return text + ("\n" + table(("option", "value", "default", "meaning"), options) if options else "")


# Python


def python() -> str:
    """Directives of autodoc for all public names."""
    lines = []
    for name in cudc_bench.__all__:
        directive = "autoclass" if inspect.isclass(getattr(cudc_bench, name)) else "autofunction"
        members = "\n   :members:" if directive == "autoclass" else ""
        lines.append(f"## {name}\n\n```{{eval-rst}}\n.. {directive}:: cudc_bench.{name}{members}\n```\n")
    return "\n".join(lines)


# Domains


def domains() -> str:
    """The sizes of each domain, and what each number of its observations and actions is."""
    from cudc_bench.envs.layouts import action_names, observation_layout

    text = ""
    for one in DOMAINS.values():
        text += (
            f"## {one.name}\n\nTasks: {_listed(one.tasks)}. An episode has {one.episode_length:,} steps and a return of {one.max_return:g} "
            f"at most; a physics state has {one.physics_size} numbers.\n\n"
        )
        first, rows = 0, []
        for block in observation_layout(one.name):
            last = first + len(block.elements) - 1
            rows.append((str(first) if first == last else f"{first} to {last}", f"`{block.name}`", _listed(block.elements)))
            first = last + 1
        text += f"### Observation ({one.observation_size})\n\n" + table(("numbers", "part", "what each is"), rows)
        text += f"\n### Action ({one.action_size})\n\n{_listed(action_names(one.name))}, each in [-1, 1].\n\n### Quantities\n\n"
        cells = [
            (f"`{name}`", f"{bins.low:g} to {bins.high:g}", str(bins.count))
            for name, bins in zip(one.quantities, one.descriptors, strict=True)
        ]
        text += "Rewards are functions of these; coverage counts visits to the cells that their bins make.\n\n"
        text += table(("quantity", "range of the bins", "bins"), cells) + "\n"
    return text


_manifest = _models(
    "cudc_bench.artefacts.manifest", "Manifest", "Base", "Collected", "RewardFunction", "Import", "Mixture", "Part", "PartOrigin", "Pilot"
)
_tier = _models("cudc_bench.artefacts.tiers", "Tier", "LearningPoint")
PARTS: Mapping[str, Callable[[], str]] = {
    "command-line": command_line,
    "python": python,
    "domains": domains,
    "profiles": profiles,
    "collect-loop": lambda: hyperparameters(CollectConfig),
    "evaluate-loop": lambda: hyperparameters(EvaluateConfig),
    "online-loop": lambda: hyperparameters(OnlineConfig),
    "collectors": lambda: "\n".join(_of_methods("collectors")),
    "evaluators": lambda: "\n".join(_of_methods("evaluators")),
    "departures-of-collectors": lambda: departures("collectors"),
    "departures-of-evaluators": lambda: departures("evaluators"),
    "json": _documents,
    "manifest": lambda: "\n".join([_manifest(), _tier()]),
    "record": _models(
        "cudc_bench.artefacts.records",
        "Record",
        "DatasetReference",
        "Collection",
        "Evaluation",
        "TrainingMetrics",
        "Submission",
        "Reran",
        "ZeroShot",
        "LabelSource",
    ),
    "reference": _models("cudc_bench.artefacts.references", "Reference", "ReferenceRun"),
}
