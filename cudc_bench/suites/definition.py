"""What a suite is: methods, domains, seeds and algorithms, from a TOML file that comes with the package or is a user's own."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cudc_bench import plugins
from cudc_bench.artefacts.records import LABELS
from cudc_bench.envs import check_domain
from cudc_bench.errors import UsageError, nearest, unknown
from cudc_bench.files import check_path, read_limited
from cudc_bench.settings.profiles import PROFILES
from cudc_bench.settings.seeds import check_seeds, parse_seeds

from .names import FOLDER, suite_names

_LARGEST_FILE = 1_000_000
_Count = Annotated[int, Field(ge=1, strict=True)]
_Names = Annotated[list[str], Field(min_length=1)]
_Share = Annotated[float, Field(gt=0, le=1, strict=True)]
_Value = bool | int | float | str | list[int] | list[float]


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    description: str = ""
    suites: _Names | None = None
    methods: _Names | None = None
    domains: _Names | None = None
    tasks: _Names | None = None
    algos: list[str] | None = None
    dataset_shares: Annotated[list[_Share], Field(min_length=1)] | None = None
    labels: Annotated[list[_Count], Field(min_length=1)] | None = None
    stats: bool | None = None
    seeds: str | int | list[int] | None = None
    profile: str | None = None
    collect: dict[str, _Value] | None = None
    evaluate: dict[str, _Value] | None = None


_KEYS = tuple(_File.model_fields)
_OF_A_STUDY = ("methods", "domains", "tasks", "algos", "dataset_shares", "labels", "stats")


@dataclass(frozen=True)
class SuiteStudy:
    """One comparison of a suite.

    Attributes:
        methods, domains: each method explores each domain.
        tasks: each domain's own among these; None for all of them.
        algos: the offline algorithms that train; none for datasets alone.
        shares: of each dataset, from its beginning, that they train on.
        labels: transitions that those without rewards are told the rewards of, for each task once with each of these numbers.
        stats: whether to measure the datasets without training, too.
    """

    methods: tuple[str, ...]
    domains: tuple[str, ...]
    tasks: tuple[str, ...] | None = None
    algos: tuple[str, ...] = ()
    shares: tuple[float, ...] = (1.0,)
    stats: bool = False
    labels: tuple[int, ...] = (LABELS,)

    def tasks_of(self, domain: str) -> tuple[str, ...]:
        """The tasks of one of its domains."""
        return tuple(task for task in check_domain(domain).tasks if self.tasks is None or task in self.tasks)


@dataclass(frozen=True)
class Suite:
    """Studies that are made together, with the same seeds, profile and settings.

    Attributes:
        name: of the file.
        description: one line for people.
        studies: the comparisons; a run that several of them have is made once.
        seeds: of collectors; training has the same.
        profile: set of hyperparameters, or ``auto``.
        collect, evaluate: hyperparameters that differ from the profile.
    """

    name: str
    description: str
    studies: tuple[SuiteStudy, ...]
    seeds: tuple[int, ...]
    profile: str = "auto"
    collect: Mapping[str, Any] = field(default_factory=dict)
    evaluate: Mapping[str, Any] = field(default_factory=dict)


def load_suite(name: str) -> Suite:
    """A suite of the package by name, or a file by its path, which ends in ``.toml``.

    Raises:
        UsageError: there is none, or something in it is wrong; the message names the key and what is allowed.
    """
    if not name.endswith(".toml"):
        if name not in suite_names():
            raise UsageError(f"{str(unknown('suite', name, suite_names())).rstrip('.')}. A file of your own ends in .toml.")
        return _suite(name, FOLDER / f"{name}.toml")
    path = check_path(name, "the suite")
    return _suite(path.stem, path)


def narrow(
    suite: Suite, *, methods: Sequence[str] | None = None, domains: Sequence[str] | None = None, tasks: Sequence[str] | None = None,
    algos: Sequence[str] | None = None, seeds: Sequence[int] | None = None, profile: str | None = None,
) -> Suite:  # fmt: skip
    """A suite with fewer methods, domains and tasks, or with other algorithms, other seeds and another profile.

    Args:
        suite: the whole.
        methods, domains, tasks: of the suite, those to keep.
        algos: instead of its own, in the studies that train at all.
        seeds, profile: instead of its own.

    Raises:
        UsageError: the suite has no such method, domain or task; there is no such algorithm, seed or profile.
    """
    kept = _Kept(methods, domains, tasks)
    kept.check(suite)
    if algos is not None:
        if not algos:
            raise UsageError("--algos is empty; leave it out for the suite's own.")
        for name in algos:
            plugins.check_name("evaluators", name)
    if profile is not None:
        _check_profile(profile)
    studies = [part for study in suite.studies for part in kept.parts(study)]
    if algos is not None:
        studies = [replace(one, algos=tuple(algos)) if one.algos else one for one in studies]
    return replace(
        suite, studies=tuple(studies), seeds=suite.seeds if seeds is None else check_seeds(seeds), profile=profile or suite.profile
    )


@dataclass(frozen=True)
class _Kept:
    """What is kept of a suite; None keeps all."""

    methods: Sequence[str] | None
    domains: Sequence[str] | None
    tasks: Sequence[str] | None

    def check(self, suite: Suite) -> None:
        """Refuse a name that the suite does not have; of tasks, that no domain has which is kept."""
        _among(suite, "method", self.methods, [name for study in suite.studies for name in study.methods])
        _among(suite, "domain", self.domains, [name for study in suite.studies for name in study.domains])
        domains = [(study, domain) for study in suite.studies for domain in _those(study.domains, self.domains)]
        _among(suite, "task", self.tasks, [name for study, domain in domains for name in study.tasks_of(domain)])

    def parts(self, study: SuiteStudy) -> Iterator[SuiteStudy]:
        """What is kept of a study, each domain as a study of its own."""
        methods = _those(study.methods, self.methods)
        for domain in _those(study.domains, self.domains):
            tasks = _those(study.tasks_of(domain), self.tasks)
            if methods and (tasks or self.tasks is None):
                yield replace(study, methods=methods, domains=(domain,), tasks=tasks)


def _those(there: Sequence[str], kept: Sequence[str] | None) -> tuple[str, ...]:
    return tuple(name for name in there if kept is None or name in kept)


def _among(suite: Suite, kind: str, wanted: Sequence[str] | None, there: Sequence[str]) -> None:
    if wanted is None:
        return
    if not wanted:
        raise UsageError(f"--{kind}s is empty; leave it out for all of them.")
    there = list(dict.fromkeys(there))
    for name in wanted:
        if name not in there:
            raise UsageError(
                f"the suite '{suite.name}' has no {kind} '{name}'; it has: {', '.join(there)}.{nearest(name, there)} To have others, copy"
                " its file and change it."
            )


def _suite(name: str, path: Path) -> Suite:
    found = _read(path)
    where = f"the suite '{path}'" if path.parent != FOLDER else f"the suite '{name}'"
    if found.suites is not None:
        if given := [key for key in _OF_A_STUDY if getattr(found, key) is not None]:
            raise UsageError(f"{where}: 'suites' names other suites, which have their own '{given[0]}'; leave one of the two out.")
        parts = []
        for one in found.suites:
            if one not in suite_names() or _read(FOLDER / f"{one}.toml").suites is not None:
                allowed = [each for each in suite_names() if _read(FOLDER / f"{each}.toml").suites is None]
                raise UsageError(f"{where}: {unknown('suite', one, allowed)}")
            parts.append(_suite(one, FOLDER / f"{one}.toml"))
        studies, seeds = tuple(study for part in parts for study in part.studies), parts[0].seeds
    else:
        studies, seeds = (_study(found, where),), (1,)
    if found.seeds is not None:
        try:
            seeds = parse_seeds(str(found.seeds)) if isinstance(found.seeds, str | int) else check_seeds(found.seeds)
        except UsageError as error:
            raise UsageError(f"{where}: seeds: {error}") from None
    if found.profile is not None:
        _check_profile(found.profile, f"{where}: ")
    return Suite(name, found.description, studies, seeds, found.profile or "auto", found.collect or {}, found.evaluate or {})


def _study(found: _File, where: str) -> SuiteStudy:
    if found.methods is None:
        raise UsageError(f'{where} needs methods, as in methods = ["random", "cudc"]; or suites, as in suites = ["main", "cql"].')
    if found.domains is None:
        raise UsageError(f'{where} needs domains, as in domains = ["walker"].')
    study = SuiteStudy(
        tuple(dict.fromkeys(found.methods)), tuple(dict.fromkeys(found.domains)),
        None if found.tasks is None else tuple(dict.fromkeys(found.tasks)), tuple(dict.fromkeys(found.algos or ())),
        tuple(sorted(set(found.dataset_shares or (1.0,)))), bool(found.stats), tuple(sorted(set(found.labels or (LABELS,)))),
    )  # fmt: skip
    try:
        _check_names(study)
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from None
    if found.dataset_shares is not None and not study.algos:
        raise UsageError(f"{where}: 'dataset_shares' are for training; name 'algos', too, or leave it out.")
    if found.labels is not None and not study.algos:
        raise UsageError(f"{where}: 'labels' are for learners without rewards; name them in 'algos', too, or leave it out.")
    return study


def _check_names(study: SuiteStudy) -> None:
    """Refuse what is not registered, and tasks that do not fit the domains."""
    for method in study.methods:
        plugins.check_name("collectors", method)
    for algo in study.algos:
        plugins.check_name("evaluators", algo)
    there = list(dict.fromkeys(task for domain in study.domains for task in check_domain(domain).tasks))
    for task in study.tasks or ():
        if task not in there:
            raise unknown("task", task, there)
    for domain in study.domains:
        if (study.tasks is not None or study.algos) and not study.tasks_of(domain):
            raise UsageError(f"no task is one of {domain}; it has: {', '.join(check_domain(domain).tasks) or 'none'}.")


def _check_profile(name: str, where: str = "") -> None:
    if name not in PROFILES and name != "auto":
        raise UsageError(f"{where}{unknown('profile', name, [*PROFILES, 'auto'])}")


def _read(path: Path) -> _File:
    try:
        return _File.model_validate(tomllib.loads(read_limited(path, _LARGEST_FILE).decode("utf-8")))
    except FileNotFoundError:
        raise UsageError(f"there is no suite '{path}'; with the package come: {', '.join(suite_names())}.") from None
    except OSError as error:
        raise UsageError(f"the suite '{path}' cannot be read: {error.strerror or error}.") from None
    except UnicodeDecodeError:
        raise UsageError(f"the suite '{path}' is not UTF-8 text.") from None
    except RecursionError:
        raise UsageError(f"the suite '{path}' is nested too deeply to be one.") from None
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"the suite '{path}' is not TOML: {error}.") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0])
        if first["type"] == "extra_forbidden":
            raise UsageError(f"the suite '{path}' has a key '{key}'; allowed: {', '.join(_KEYS)}.{nearest(key, _KEYS)}") from None
        place = ".".join(str(part) for part in first["loc"] if not isinstance(part, str) or part == key or part.isidentifier())
        raise UsageError(f"the suite '{path}': {place} cannot be {first['input']!r}: {_ALLOWED.get(key, first['msg'])}.") from None


_ALLOWED = {
    "description": "it takes one line of text",
    "suites": "it takes a list of suites of the package",
    "methods": "it takes a list of collectors, one at least; see cudc-bench list",
    "domains": "it takes a list of domains, one at least; see cudc-bench list",
    "tasks": "it takes a list of tasks, one at least; leave it out for all",
    "algos": "it takes a list of offline algorithms; see cudc-bench list",
    "dataset_shares": "it takes a list of numbers above 0, at most 1",
    "labels": "it takes a list of whole numbers, 1 or more",
    "stats": "it takes true or false",
    "seeds": 'it takes seeds such as "1-5" or [1, 2, 3]',
    "profile": f"it takes one of {', '.join([*PROFILES, 'auto'])}",
    "collect": "it takes a table of hyperparameters, as in { steps = 100000 }",
    "evaluate": "it takes a table of hyperparameters, as in { gradient_steps = 10000 }",
}
