"""``cudc-bench list``: what can be collected and evaluated, and what exists. Nothing here needs torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import JsonOption, parse_names
from cudc_bench.errors import CudcBenchError, UsageError, unknown
from cudc_bench.settings.seeds import parse_seeds

if TYPE_CHECKING:
    from pathlib import Path

    from cudc_bench.artefacts.ids import DatasetId
    from cudc_bench.artefacts.manifest import Manifest
    from cudc_bench.cli.documents import ListedDataset, ListedDomain, ListedMethod, ListedUnfinished, Listing
    from cudc_bench.cli.tables import Table
    from cudc_bench.files import LeftOut

KINDS = ("methods", "domains", "algorithms", "profiles", "datasets", "records")
AGNOSTIC = "none"  # stands for the task of a dataset that has none
Only = Callable[["Manifest"], bool]


def list_command(
    kind: Annotated[
        str | None,
        typer.Option(
            "--kind", help=f"Only these, by commas: {', '.join(KINDS)}.", autocompletion=completion.completer(lambda _: KINDS, several=True)
        ),
    ] = None,
    domain: Annotated[
        str | None, typer.Option("--domain", help="Only datasets of these domains, by commas.", autocompletion=completion.some_domains)
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", help="Only datasets of these collectors, by commas.", autocompletion=completion.some_methods)
    ] = None,
    task: Annotated[
        str | None,
        typer.Option("--task", "--tasks", help=f"Only datasets labelled for these, by commas; {AGNOSTIC} for those that are not."),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Only datasets collected at these profiles, by commas.", autocompletion=completion.some_profiles),
    ] = None,
    seeds: Annotated[str | None, typer.Option("--seed", "--seeds", help="Only datasets of these seeds, such as 1-3.")] = None,
    results: Annotated[str, typer.Option("--output", help="Folder of the records.")] = "results",
    as_json: JsonOption = False,
) -> None:
    """Show methods, domains, algorithms, profiles, datasets and records; with a filter, the datasets that fit it."""
    from cudc_bench.cli.documents import print_json
    from cudc_bench.execution.progress import warn
    from cudc_bench.files import check_folder

    filters = _Filters.parsed(domain, method, task, profile, seeds)
    kinds = _kinds(kind, filters)
    folder = check_folder(results, "the folder of the records", writable=False)
    found = gather(kinds, filters, folder)
    if as_json:
        print_json(found)
    else:
        _show(found)
    for line in found.left_out:
        warn(f"left out: {line}")


@dataclass(frozen=True)
class _Filters:
    """Which datasets are wanted; None for all. A task is None for task-agnostic ones."""

    domains: tuple[str, ...] | None = None
    methods: tuple[str, ...] | None = None
    tasks: tuple[str | None, ...] | None = None
    profiles: tuple[str, ...] | None = None
    seeds: tuple[int, ...] | None = None

    @classmethod
    def parsed(cls, domain: str | None, method: str | None, task: str | None, profile: str | None, seeds: str | None) -> _Filters:
        given = {name: _names(f"--{name}", text) for name, text in (("domain", domain), ("method", method), ("profile", profile))}
        tasks = _names("--task", task)
        return cls(
            given["domain"], given["method"], tasks and tuple(None if one == AGNOSTIC else one for one in tasks), given["profile"],
            None if seeds is None else parse_seeds(seeds, "--seed"),
        )  # fmt: skip

    @property
    def given(self) -> bool:
        """Whether anything is left out."""
        return self != _Filters()

    def fits(self, manifest: Manifest) -> bool:
        """Whether a dataset is wanted."""
        pairs = (
            (self.domains, manifest.domain), (self.methods, manifest.method), (self.tasks, manifest.task),
            (self.profiles, manifest.profile), (self.seeds, manifest.seed),
        )  # fmt: skip
        return all(wanted is None or value in wanted for wanted, value in pairs)

    def check(self, manifests: Sequence[Manifest]) -> None:
        """Refuse names that nothing here has, whether there are datasets of them or not.

        Raises:
            UsageError: names one.
        """
        from cudc_bench import plugins
        from cudc_bench.artefacts.manifest import IMPORTED_PROFILE
        from cudc_bench.envs.domains import DOMAINS, SUITE
        from cudc_bench.settings.profiles import PROFILES

        tasks = {task for one in DOMAINS.values() for task in one.tasks} | {one.task or AGNOSTIC for one in manifests}
        for kind, wanted, known in (
            ("domain", self.domains, {*DOMAINS, *plugins.names("domains"), *(one.domain for one in manifests)}),
            ("method", self.methods, {*plugins.names("collectors"), *(one.method for one in manifests)}),
            ("task", None if self.tasks is None else tuple(one or AGNOSTIC for one in self.tasks), {AGNOSTIC, *tasks}),
            ("profile", self.profiles, {*PROFILES, IMPORTED_PROFILE, *(one.profile for one in manifests)}),
        ):
            for name in wanted or ():
                # Tasks of other packages' domains are not known without importing these.
                if name not in known and not (kind == "domain" and name.startswith(SUITE)) and not (kind == "task" and self.domains):
                    raise unknown(kind, name, known)


def _names(option: str, text: str | None) -> tuple[str, ...] | None:
    names = None if text is None else parse_names(text)
    if names == ():
        raise UsageError(f"{option} is empty; leave it out for all.")
    return names


def _kinds(text: str | None, filters: _Filters) -> tuple[str, ...]:
    wanted = _names("--kind", text)
    for name in wanted or ():
        if name not in KINDS:
            raise unknown("kind", name, KINDS)
    if filters.given and wanted is not None and "datasets" not in wanted:
        raise UsageError(f"--kind {','.join(wanted)} has no datasets, which the other options choose among; leave one of them out.")
    return wanted or (("datasets",) if filters.given else KINDS)


def gather(kinds: Sequence[str], filters: _Filters, folder: Path) -> Listing:
    """What there is.

    Args:
        kinds: of :data:`KINDS`.
        filters: of datasets.
        folder: of the records.

    Raises:
        UsageError: a filter names what nothing here has.
    """
    from cudc_bench.artefacts.ids import datasets_root
    from cudc_bench.artefacts.records import REFERENCE, record_files, visible_files
    from cudc_bench.cli.documents import ListedProfile, ListedRecords, Listing
    from cudc_bench.settings.profiles import PROFILES

    broken: list[str] = []

    def left_out(error: OSError) -> None:
        broken.append(f"{error.filename} cannot be read: {error.strerror}.")

    root = datasets_root()
    datasets = _datasets(filters, left_out) if "datasets" in kinds else None
    unfinished = _unfinished() if "datasets" in kinds and not filters.given else None
    records = None
    if "records" in kinds:
        count, references = len(record_files(folder, left_out)), len(visible_files(folder, REFERENCE))
        records = ListedRecords(folder=str(folder), records=count, references=references)
    sizes = None if datasets is None else sum(one.bytes for one in (*datasets, *(unfinished or ())))
    return Listing(
        root=str(root),
        methods=_methods("collectors", broken) if "methods" in kinds else None,
        domains=_domains(broken) if "domains" in kinds else None,
        algorithms=_methods("evaluators", broken) if "algorithms" in kinds else None,
        profiles=[ListedProfile(name=one.name, purpose=one.purpose) for one in PROFILES.values()] if "profiles" in kinds else None,
        datasets=datasets,
        unfinished=unfinished,
        bytes=sizes,
        records=records,
        left_out=broken,
    )


def _methods(stage: str, broken: list[str]) -> list[ListedMethod]:
    from cudc_bench import plugins
    from cudc_bench.cli.documents import ListedMethod
    from cudc_bench.settings.described import describe

    found = []
    first: dict[str, str] = {}
    for name in plugins.names(stage):
        try:
            one = describe(stage, name)
        except CudcBenchError as error:
            broken.append(str(error))
            continue
        same = first.setdefault(one.target, name)
        found.append(
            ListedMethod(
                name=name, what=one.what, category=one.category or None, citation=one.citation, same_as=None if same == name else same,
                package=one.package,
            )
        )  # fmt: skip
    return found


def _domains(broken: list[str]) -> list[ListedDomain]:
    from cudc_bench import plugins
    from cudc_bench.cli.documents import ListedDomain
    from cudc_bench.envs.domains import DOMAINS
    from cudc_bench.envs.registry import check_domain

    found = []
    for name in [*DOMAINS, *(name for name in plugins.names("domains") if name not in DOMAINS)]:
        try:
            one = check_domain(name)
        except CudcBenchError as error:
            broken.append(str(error))
            continue
        found.append(
            ListedDomain(
                name=one.name, tasks=list(one.tasks), quantities=list(one.quantities), observation_size=one.observation_size,
                action_size=one.action_size, episode_length=one.episode_length,
            )
        )  # fmt: skip
    return found


def _datasets(filters: _Filters, left_out: LeftOut) -> list[ListedDataset]:
    from cudc_bench.artefacts.ids import dataset_path, stored_ids
    from cudc_bench.artefacts.k_schedule import k_schedule
    from cudc_bench.artefacts.manifest import read_manifest
    from cudc_bench.cli.documents import ListedDataset
    from cudc_bench.files import bytes_below

    manifests: dict[DatasetId, Manifest] = {}
    for one in stored_ids(left_out=left_out):
        try:
            manifests[one] = read_manifest(one)
        except CudcBenchError:
            continue  # somebody else's, or damaged
    filters.check(list(manifests.values()))
    return [
        ListedDataset(
            id=str(one), domain=manifest.domain, task=manifest.task, method=manifest.method,
            source=None if manifest.imported is None else manifest.imported.source, profile=manifest.profile, seed=manifest.seed,
            steps=manifest.steps, episodes=manifest.episodes, bytes=bytes_below(dataset_path(one)),
            base=None if manifest.base is None else manifest.base.id, linked=manifest.base is not None and manifest.base.linked,
            parts=[] if manifest.mixture is None else [part.id for part in manifest.mixture.parts],
            fingerprint=manifest.fingerprint, created=manifest.created, notes=k_schedule(manifest.diagnostics).note,
        )
        for one, manifest in manifests.items() if filters.fits(manifest)
    ]  # fmt: skip


def _unfinished() -> list[ListedUnfinished]:
    from cudc_bench.cli.documents import ListedUnfinished
    from cudc_bench.data.staging import building_path, checkpoints_path, unfinished
    from cudc_bench.execution.interrupted import progress
    from cudc_bench.files import bytes_below

    found = []
    for one, holder in unfinished():
        there = progress(checkpoints_path(one))
        step = None if there is None else there[0]
        found.append(ListedUnfinished(id=str(one), holder=holder, step=step, bytes=bytes_below(building_path(one))))
    return found


# For people


def _show(found: Listing) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    for index, table in enumerate(_tables(found)):
        if index:
            console.print()
        console.print(table)
    for one in found.unfinished or ():
        there = "no checkpoint yet" if one.step is None else f"its last checkpoint is at step {one.step:,}"
        state = "was interrupted" if one.holder is None else f"{one.holder} is making it"
        console.print(f"Unfinished: {one.id}: {state}; {there}", markup=False, soft_wrap=True)
    if found.records is not None:
        console.print(
            f"Records in {found.records.folder}: {found.records.records}; references: {found.records.references}", markup=False,
            soft_wrap=True,
        )  # fmt: skip


def _tables(found: Listing) -> Iterator[Table]:
    from cudc_bench.cli.tables import Column, Table, row
    from cudc_bench.envs.domains import SUITE

    def methods(title: str, what: str, listed: Sequence[ListedMethod]) -> Table:
        grouped = any(one.category for one in listed)
        rows = [
            row(
                one.name, *([one.category or ""] if grouped else []), f"the same as {one.same_as}" if one.same_as else one.what,
                one.citation,
            )
            for one in listed
        ]  # fmt: skip
        columns = (Column("name"), *([Column("category")] if grouped else []), Column(what, prose=True), Column("citation", prose=True))
        return Table(columns, tuple(rows), title, shortens=False)

    if found.methods is not None:
        yield methods("Collectors (--method)", "family", found.methods)
    if found.domains is not None:
        rows = [
            row(
                one.name,
                "\n".join(one.tasks),
                "\n".join(one.quantities),
                f"{one.observation_size}, {one.action_size}, {one.episode_length}",
            )
            for one in found.domains
        ]
        columns = (Column("name"), Column("tasks"), Column("measured"), Column("obs, act, steps"))
        caption = f"and any of dm_control's suite through Shimmy, slower: {SUITE}<domain>-<task>, such as {SUITE}cheetah-run"
        yield Table(columns, tuple(rows), "Domains (--domain)", caption, stacked=True, shortens=False)
    if found.algorithms is not None:
        yield methods("Offline algorithms (--algo)", "what it is", found.algorithms)
    if found.profiles is not None:
        rows = [row(one.name, one.purpose) for one in found.profiles]
        both = (Column("name"), Column("purpose", prose=True))
        yield Table(both, tuple(rows), "Profiles (--profile; auto is paper with CUDA, cpu without)")
    if found.datasets is not None:
        yield _table_of_datasets(found, found.datasets)


def _table_of_datasets(found: Listing, datasets: Sequence[ListedDataset]) -> Table:
    from cudc_bench.cli.tables import Column, Table, row
    from cudc_bench.text import size

    rows = [
        row(
            one.id, one.method if one.source is None else f"{one.method} ({one.source})", one.task or "–", one.profile, str(one.seed),
            f"{one.steps:,}", size(one.bytes), one.notes,
        )
        for one in datasets
    ]  # fmt: skip
    names = ("id", "method", "task", "profile", "seed", "steps", "size", "notes")
    columns = tuple(Column(name, right=name in {"seed", "steps", "size"}, prose=name == "notes") for name in names)
    if not any(one.notes for one in datasets):  # most datasets have nothing to note
        columns, rows = columns[:-1], [type(one)(one.cells[:-1]) for one in rows]
    count = f"{len(datasets):,} dataset{'' if len(datasets) == 1 else 's'}, {size(sum(one.bytes for one in datasets))} on disk"
    if found.unfinished:
        count += f"; unfinished: {len(found.unfinished):,}, {size(sum(one.bytes for one in found.unfinished))}"
    return Table(columns, tuple(rows), f"Datasets in {found.root}", count, stacked=True, shortens=False)
