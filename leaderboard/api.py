"""The leaderboard from Python: records in, tables and files out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cudc_bench.errors import UsageError
from cudc_bench.files import check_folder, check_path

from .figures import curve_files
from .files import only, write_files
from .load import Loaded, load_records
from .render import to_csv, to_latex, to_markdown
from .table import Table, build_tables


@dataclass(frozen=True)
class Report:
    """What the records say.

    Attributes:
        tables: one for each domain, algorithm and group, in that order.
        problems: one line for each thing that was left out or is doubtful.
        files: what was written; empty without an output folder.
    """

    tables: list[Table]
    problems: list[str]
    files: list[Path]


def make_leaderboard(
    results: str | Path | Sequence[str | Path] = "results",
    output: str | Path | None = "report",
    profile: str | None = None,
    domain: str | None = None,
    algo: str | None = None,
) -> Report:
    """Make tables and learning curves from run records.

    For each table ``<output>/<slug>/`` gets ``table.md``, ``table.tex``, ``table.csv``, ``curves.svg`` and ``curves.pdf``; each file is
    replaced whole. The same records give the same bytes.

    Args:
        results: a record or a folder of records, or several.
        output: the folder to write to; None writes nothing.
        profile, domain, algo: only records of that profile, domain or algorithm.

    Raises:
        UsageError: there is no such path, no record, or no record of that profile, domain or algorithm; the output cannot be a folder.
        RunError: a file could not be written.
    """
    paths = [check_path(path, "the results") for path in ([results] if isinstance(results, str | Path) else results)]
    folder = None if output is None else check_folder(output, "output")
    loaded = _load(paths)
    records = loaded.records
    records = only(records, "record", "profile", profile, lambda record: record.profile)
    records = only(records, "record", "domain", domain, lambda record: record.dataset.domain)
    records = only(records, "record", "algo", algo, lambda record: record.algorithm)
    tables, problems = build_tables(records)
    files = [] if folder is None else [file for table in tables for file in write_files(folder / table.slug, _contents(table))]
    return Report(tables, [*loaded.problems, *problems], files)


def _load(paths: Sequence[Path]) -> Loaded:
    way_out = "make some with: cudc-bench evaluate --algo td3"
    for path in paths:
        if not path.exists():
            raise UsageError(f"there are no results at '{path}'; {way_out}")
    loaded = load_records(paths)
    if not loaded.records:
        where = ", ".join(f"'{path}'" for path in paths)
        problems = loaded.problems
        why = f". Files left out: {len(problems)}, such as: {problems[0]}" if problems else ""
        raise UsageError(f"there is no usable record in {where}; {way_out}{why}")
    return loaded


def _contents(table: Table) -> dict[str, str | bytes]:
    return {"table.md": to_markdown(table), "table.tex": to_latex(table), "table.csv": to_csv(table), **curve_files(table)}
