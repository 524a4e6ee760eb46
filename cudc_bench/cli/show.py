"""``cudc-bench show``: one method, algorithm, domain, profile or task, in the words of its own source. Nothing here needs torch."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cudc_bench.cli import completion
from cudc_bench.errors import CudcBenchError, unknown

if TYPE_CHECKING:
    from cudc_bench.envs.domains import Domain
    from cudc_bench.settings.described import Hyperparameter
    from cudc_bench.settings.profiles import Profile


@dataclass(frozen=True)
class Paragraph:
    """Some text, broken between words.

    Attributes:
        text: of any length; an empty one is an empty line.
        indent: of its lines.
        heading: whether it stands out.
    """

    text: str = ""
    indent: int = 0
    heading: bool = False


def show(
    name: Annotated[
        str,
        typer.Argument(help="Of a collector, an offline algorithm, a domain, a profile or a task.", autocompletion=completion.all_names),
    ],
) -> None:
    """Show what a method, algorithm, domain, profile or task is, with every hyperparameter and its value at each profile."""
    from rich.console import Console
    from rich.text import Text

    from cudc_bench.execution.progress import warn
    from cudc_bench.text import visible

    broken: list[str] = []
    console = Console(highlight=False)
    found = list(_found(name, broken))
    for line in broken:
        warn(f"left out: {line}")
    for index, part in enumerate(found):
        for one in (*([Paragraph()] if index else []), *part()):
            space = " " * one.indent
            lines = textwrap.wrap(
                visible(one.text), max(console.width, 20), initial_indent=space, subsequent_indent=space, break_on_hyphens=False,
                break_long_words=False,
            )  # fmt: skip
            for line in lines or [""]:
                console.print(Text(line, style="bold" if one.heading else ""), soft_wrap=True)


def _found(name: str, broken: list[str]) -> Iterator[Callable[[], Iterable[Paragraph]]]:
    """What there is of that name, in each sense that it has.

    Raises:
        UsageError: nothing is called so.
    """
    from cudc_bench import plugins
    from cudc_bench.envs.domains import DOMAINS, SUITE
    from cudc_bench.envs.registry import check_domain
    from cudc_bench.settings.profiles import PROFILES

    senses: list[Callable[[], Iterable[Paragraph]]] = []
    for stage in ("collectors", "evaluators"):
        if name in plugins.names(stage):
            senses.append(partial(_method, stage, name))
    domains: dict[str, Domain] = {}
    for one in dict.fromkeys([*DOMAINS, *plugins.names("domains"), *([name] if name.startswith(SUITE) else [])]):
        try:
            domains[one] = check_domain(one)
        except CudcBenchError as error:
            if one == name:
                raise
            broken.append(str(error))
    if name in domains:
        senses.append(partial(_domain, domains[name]))
    if name in PROFILES:
        senses.append(partial(_profile, PROFILES[name]))
    for domain in domains.values():
        if name in domain.tasks or name in domain.excluded:
            senses.append(partial(_task, domain, name))
    if not senses:
        tasks = {task for domain in domains.values() for task in domain.tasks}
        raise unknown("name", name, {*plugins.names("collectors"), *plugins.names("evaluators"), *domains, *PROFILES, *tasks})
    yield from senses


# Methods


def _method(stage: str, name: str) -> Iterator[Paragraph]:
    from cudc_bench.settings.described import at_profiles, describe, hyperparameters

    found = describe(stage, name)
    at = at_profiles(found)
    option = "collector (--method" if stage == "collectors" else "offline algorithm (--algo"
    yield Paragraph(f"{found.name}: {option} {found.name})", heading=True)
    yield from _facts(
        {
            "explores by" if stage == "collectors" else "is": found.what,
            "category": found.category,
            "from": found.citation,
            "package": found.package,
            "class": found.target,
        }
    )
    yield from _prose(found.text)
    if found.values:
        yield Paragraph()
        yield Paragraph("A variant: these values win over those of profiles and domains", heading=True)
        yield Paragraph(_settings(found.values), 2)
    if found.domain_values:
        yield Paragraph()
        yield Paragraph("Its paper's values for single domains, which win over those of profiles", heading=True)
        for domain, values in found.domain_values.items():
            yield Paragraph(f"{domain}: {_settings(values)}", 2)
    for title, config in (("Hyperparameters of the method", found.config), ("Hyperparameters of the run", found.loop)):
        yield Paragraph()
        yield Paragraph(f"{title} (--set name=value)", heading=True)
        of_config = hyperparameters(config)
        for one in of_config:
            yield from _hyperparameter(one, at[one.name])
        if not of_config:
            yield Paragraph("none", 2)


def _hyperparameter(one: Hyperparameter, values: tuple[Any, ...]) -> Iterator[Paragraph]:
    from cudc_bench.settings.described import without_marks
    from cudc_bench.settings.profiles import PROFILES

    allowed = f" ({_plain(one.allowed)})" if one.allowed else ""
    yield Paragraph(f"{one.name}: {one.kind}{allowed}, default {_value(one.default)}", 2)
    texts = list(map(_value, values))
    if len(set(texts)) > 1:
        yield Paragraph(", ".join(f"{profile} {text}" for profile, text in zip(PROFILES, texts, strict=True)), 4)
    else:
        yield Paragraph(f"{texts[0]} at every profile", 4)
    if one.meaning:
        yield Paragraph(without_marks(one.meaning), 4)


# Domains and tasks


def _domain(domain: Domain) -> Iterator[Paragraph]:
    from cudc_bench.envs.domains import domain_title
    from cudc_bench.envs.layouts import observation_layout
    from cudc_bench.envs.registry import excluded_tasks

    yield Paragraph(f"{domain.name}: domain (--domain {domain.name})", heading=True)
    yield from _facts(
        {
            "is": domain_title(domain.name),
            "tasks": ", ".join(domain.tasks) or "none",
            "cannot be labelled": excluded_tasks(domain),
            "episode": f"{domain.episode_length:,} steps, a return of {domain.max_return:g} at most",
            "physics state": f"{domain.physics_size} numbers",
        }
    )
    yield Paragraph()
    yield Paragraph(f"Observation ({domain.observation_size} numbers)", heading=True)
    first = 0
    for block in observation_layout(domain.name):
        last = first + len(block.elements) - 1
        where = str(first) if first == last else f"{first} to {last}"
        yield Paragraph(f"{where}, {block.name}: {', '.join(block.elements)}", 2)
        first = last + 1
    yield Paragraph()
    yield Paragraph(f"Action ({domain.action_size} numbers, each in [-1, 1])", heading=True)
    yield Paragraph(_actions(domain), 2)
    yield Paragraph()
    yield Paragraph("Quantities that rewards are functions of", heading=True)
    for index, quantity in enumerate(domain.quantities):
        bins = domain.descriptors[index] if domain.descriptors else None
        counted = "" if bins is None else f": coverage counts {bins.count} bins from {bins.low:g} to {bins.high:g}"
        yield Paragraph(f"{quantity}{counted}", 2)


def _actions(domain: Domain) -> str:
    from cudc_bench.envs.layouts import action_names

    try:
        return ", ".join(action_names(domain.name))
    except Exception as error:  # of a simulator that may be anybody's
        return f"their names are not known: {error}"


def _task(domain: Domain, name: str) -> Iterator[Paragraph]:
    from cudc_bench.settings import sources
    from cudc_bench.settings.described import prose

    yield Paragraph(f"{name}: task of {domain.name} (--domain {domain.name} --task {name})", heading=True)
    if name in domain.excluded:
        yield Paragraph(f"cannot be labelled: {domain.excluded[name]}", 2)
        return
    module, function = domain.rewards.split(":")
    yield from _facts(
        {
            "episode": f"{domain.episode_length:,} steps, a return of {domain.max_return:g} at most",
            "reward": f"a function of {', '.join(domain.quantities)}",
            "computed by": domain.rewards,
        }
    )
    yield from _prose(prose(sources.docstring(module, function)))


# Profiles


def _profile(profile: Profile) -> Iterator[Paragraph]:
    from cudc_bench import plugins
    from cudc_bench.settings.collect_config import CollectConfig
    from cudc_bench.settings.described import describe, profile_table
    from cudc_bench.settings.evaluate_config import EvaluateConfig
    from cudc_bench.settings.profiles import PROFILES

    yield Paragraph(f"{profile.name}: profile (--profile {profile.name})", heading=True)
    yield Paragraph(profile.purpose, 2)
    threads = "the machine's cores, shared among runs" if profile.threads is None else str(profile.threads)
    yield Paragraph(f"CPU threads of each run: {threads}", 2)
    place = list(PROFILES).index(profile.name)
    for stage, kind, loop in (("collect", "collectors", CollectConfig), ("evaluate", "evaluators", EvaluateConfig)):
        configs = [loop, *(describe(kind, name).config for name in plugins.names(kind) if plugins.is_own(kind, name))]
        yield Paragraph()
        yield Paragraph(f"Values for {stage}", heading=True)
        for name, default, values in profile_table(stage, configs):
            usual = "" if values[place] == default else f", where the default is {_plain(default)}"
            yield Paragraph(f"{name} {_plain(values[place])}{usual}", 2)
    yield Paragraph()
    yield Paragraph("All else is as each method has it: cudc-bench show METHOD", 0)


# Text


def _facts(facts: Mapping[str, str]) -> Iterator[Paragraph]:
    for name, text in facts.items():
        if text:
            yield Paragraph(f"{name}: {text}", 2)


def _prose(text: str) -> Iterator[Paragraph]:
    from cudc_bench.settings.described import without_marks

    for block in filter(str.strip, without_marks(text).split("\n\n")):
        yield Paragraph()
        yield Paragraph(block)


def _settings(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={_value(value)}" for name, value in values.items())


def _value(value: Any) -> str:
    from cudc_bench.settings.described import default_text

    return _plain(default_text(value))


def _plain(text: str) -> str:
    return text.replace("`", "")
