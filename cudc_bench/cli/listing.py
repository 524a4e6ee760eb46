"""``cudc-bench list``: what can be collected and evaluated, and what exists."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from cudc_bench.files import LeftOut


def list_command(
    results: Annotated[str, typer.Option("--output", help="Folder of the records.")] = "results",
) -> None:
    """Show methods, domains, algorithms, profiles, datasets and records."""
    from rich.console import Console

    from cudc_bench.artefacts.records import REFERENCE, record_files, visible_files
    from cudc_bench.execution.progress import warn
    from cudc_bench.files import check_folder

    broken: list[str] = []

    def left_out(error: OSError) -> None:
        broken.append(f"{error.filename} cannot be read: {error.strerror}.")

    folder = check_folder(results, "the folder of the records", writable=False)
    console = Console()
    for table in (_methods(broken), _domains(), _algorithms(broken), _profiles(), _datasets(left_out)):
        console.print(table)
    for line in _unfinished():
        console.print(line, markup=False, highlight=False)
    records, references = len(record_files(folder, left_out)), len(visible_files(folder, REFERENCE))
    console.print(f"Records in {folder}: {records}; references: {references}", markup=False)
    for line in broken:
        warn(f"left out: {line}")


def _table(title: str, *columns: str) -> Table:
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _add(table: Table, *texts: str) -> None:
    """A row, in which nothing that somebody else wrote is taken for markup or drives the terminal."""
    from rich.text import Text

    from cudc_bench.text import visible

    table.add_row(*(Text("\n".join(map(visible, text.split("\n")))) for text in texts))


def _methods(broken: list[str]) -> Table:
    from cudc_bench import plugins

    table = _table("Collectors (--method)", "name", "family", "citation")
    first: dict[object, str] = {}
    for name, kind in plugins.load_sound("collectors", lambda error: broken.append(str(error))).items():
        same = first.setdefault(kind, name)
        _add(table, name, kind.family if same == name else f"the same as {same}", kind.citation)
    return table


def _domains() -> Table:
    from cudc_bench import plugins
    from cudc_bench.envs.domains import DOMAINS, SUITE
    from cudc_bench.envs.registry import check_domain

    table = _table("Domains (--domain)", "name", "tasks", "measured", "obs, act, steps")
    for domain in map(check_domain, [*DOMAINS, *(name for name in plugins.names("domains") if name not in DOMAINS)]):
        sizes = (domain.observation_size, domain.action_size, domain.episode_length)
        _add(table, domain.name, "\n".join(domain.tasks), "\n".join(domain.quantities), ", ".join(map(str, sizes)))
    table.caption = f"and any of dm_control's suite through Shimmy, slower: {SUITE}<domain>-<task>, such as {SUITE}cheetah-run"
    table.caption_justify = "left"
    return table


def _algorithms(broken: list[str]) -> Table:
    from cudc_bench import plugins

    table = _table("Offline algorithms (--algo)", "name", "what it is", "citation")
    for name, kind in plugins.load_sound("evaluators", lambda error: broken.append(str(error))).items():
        _add(table, name, kind.summary, kind.citation)
    return table


def _profiles() -> Table:
    from cudc_bench.settings.profiles import PROFILES, resolve_profile

    table = _table(f"Profiles (--profile; auto is {resolve_profile('auto').name} here)", "name", "purpose")
    for profile in PROFILES.values():
        _add(table, profile.name, profile.purpose)
    return table


def _datasets(left_out: LeftOut) -> Table:
    from rich import box

    from cudc_bench.artefacts.ids import dataset_path, datasets_root
    from cudc_bench.artefacts.k_schedule import k_schedule
    from cudc_bench.artefacts.manifest import read_manifest, stored_ids
    from cudc_bench.errors import CudcBenchError

    root = datasets_root()
    rows = []
    for one in stored_ids(left_out=left_out):
        try:
            manifest = read_manifest(one)
        except CudcBenchError:
            continue
        size = sum(file.stat().st_size for file in dataset_path(one).rglob("*") if file.is_file())
        rows.append(
            (
                str(one),
                manifest.label,
                manifest.task or "–",
                manifest.profile,
                str(manifest.seed),
                f"{manifest.steps:,}",
                f"{size / 1e6:,.1f} MB",
                k_schedule(manifest.diagnostics).note,
            )
        )
    # Most datasets have nothing to note, and a terminal has no room for an empty column.
    columns = ("id", "method", "task", "profile", "seed", "steps", "size", *(["notes"] if any(row[-1] for row in rows) else []))
    table = _table(f"Datasets in {root}", *columns)
    # The widest table: without lines and padding an id is in two lines of a narrow terminal, not in four.
    table.box, table.collapse_padding = box.SIMPLE_HEAD, True
    for row in rows:
        _add(table, *row[: len(columns)])
    return table


def _unfinished() -> list[str]:
    from cudc_bench.data.staging import checkpoints_path, unfinished
    from cudc_bench.execution.checkpoints import progress

    lines = []
    for one, holder in unfinished():
        found = progress(checkpoints_path(one))
        there = "no checkpoint yet" if found is None else f"its last checkpoint is at step {found[0]:,}"
        state = "was interrupted" if holder is None else f"{holder} is making it"
        lines.append(f"Unfinished: {one}: {state}; {there}")
    return lines
