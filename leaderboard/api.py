"""The leaderboard from Python: records in, tables and files out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cudc_bench.errors import UsageError
from cudc_bench.files import check_folder, check_path
from cudc_bench.markup import plain

from .figures import curve_files, task_files
from .files import only, write_files
from .load import Loaded, load_records
from .missing import Missing, find_missing
from .overall import Overall, build_overall
from .overall_figures import overall_figure_files
from .published import beside_paper
from .render import (
    overall_to_csv,
    overall_to_latex,
    overall_to_markdown,
    paper_to_csv,
    paper_to_latex,
    paper_to_markdown,
    scores_to_csv,
    to_csv,
    to_latex,
    to_markdown,
)
from .site import site_files
from .site_datasets import datasets_of, find_local
from .site_parts import Run, Site, run_of
from .table import Table, build_tables


@dataclass(frozen=True)
class Report:
    """What the records say.

    Attributes:
        tables: one for each domain, algorithm and group, in that order.
        overall: for each group and algorithm its methods over all tasks, with intervals.
        problems: one line for each thing that was left out or is doubtful.
        missing: runs that would make the comparisons complete.
        files: what was written; empty without an output folder.
    """

    tables: list[Table]
    overall: list[Overall]
    problems: list[str]
    missing: list[Missing]
    files: list[Path]


def make_leaderboard(
    results: str | Path | Sequence[str | Path] = "results",
    output: str | Path | None = "report",
    profile: str | None = None,
    domain: str | None = None,
    algo: str | None = None,
    datasets: bool = True,
) -> Report:
    """Make tables, learning curves and a static site from run records.

    For each table ``<output>/<slug>/`` gets ``table.md``, ``table.tex``, ``table.csv``, ``curves.svg`` and ``curves.pdf``, the same
    figures for each task as ``task-<task>``, and ``paper.md``, ``paper.tex`` and ``paper.csv`` if it has cells that the paper reports,
    too. For each group and algorithm ``<output>/<profile>.<algorithm>/`` gets ``overall.md``, ``overall.tex``, ``overall.csv``,
    ``scores.csv``, and ``intervals``, ``profiles`` and ``ranks`` as ``.svg`` and ``.pdf``. ``<output>/index.html`` is the site over all
    of them (see :mod:`.site`). Each file is replaced whole. The same records, and with ``datasets`` the same datasets, give the same bytes.

    Args:
        results: a record or a folder of records, or several.
        output: the folder to write to; None writes nothing.
        profile, domain, algo: only records of that profile, domain or algorithm.
        datasets: measure those of the records' datasets that are on this machine, for their pages; what was measured is kept in
            ``<output>/datasets/measures.json``, so that each takes its seconds once.

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
    overall, missing = build_overall(tables), find_missing(tables)
    files: list[Path] = []
    if folder is not None:
        contents = {table.slug: _contents(table) for table in tables} | {one.slug: _overall_contents(one) for one in overall}
        files += [file for slug, of_slug in contents.items() for file in write_files(folder / slug, of_slug)]
        local, remarks = find_local(datasets_of(tables), folder) if datasets else ({}, [])
        problems += remarks
        site = Site(tables, overall, [*loaded.problems, *problems], missing, contents, _places(loaded, paths), local)
        files += write_files(folder, site_files(site))
    return Report(tables, overall, [*loaded.problems, *problems], missing, files)


def _places(loaded: Loaded, paths: Sequence[Path]) -> dict[Run, str]:
    """Where each record is below the folders that were asked for: the same wherever these are."""
    found = {}
    for record, file in zip(loaded.records, loaded.paths, strict=True):
        above = next((path for path in paths if path != file and file.is_relative_to(path)), file.parent)
        found[run_of(record)] = plain(file.relative_to(above).as_posix())
    return found


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
    files: dict[str, str | bytes] = {
        "table.md": to_markdown(table),
        "table.tex": to_latex(table),
        "table.csv": to_csv(table),
        **curve_files(table),
        **task_files(table),
    }
    paper = beside_paper(table)
    if paper is not None:
        files |= {"paper.md": paper_to_markdown(paper), "paper.tex": paper_to_latex(paper), "paper.csv": paper_to_csv(paper)}
    return files


def _overall_contents(overall: Overall) -> dict[str, str | bytes]:
    return {
        "overall.md": overall_to_markdown(overall),
        "overall.tex": overall_to_latex(overall),
        "overall.csv": overall_to_csv(overall),
        "scores.csv": scores_to_csv(overall),
        **overall_figure_files(overall),
    }
