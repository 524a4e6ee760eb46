"""The leaderboard from Python: records in, tables and files out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds, read_references
from cudc_bench.errors import UsageError
from cudc_bench.files import check_folder, check_path
from cudc_bench.text import plain

from .datasets.behind import datasets_of
from .datasets.diagnostics import DiagnosticsReport, compare_stored
from .datasets.quality import QualityReport, measure_stored
from .intake.chosen import only
from .intake.load import Loaded, kept_from_collector, load_records
from .numbers.missing import Missing, find_missing
from .numbers.overall import Overall, build_overall
from .numbers.published import beside_paper
from .numbers.studies import build_studies
from .numbers.study import Study
from .numbers.table import Table, build_blocks, tables_of
from .output.files import write_files
from .output.incremental import Part, build, digest, holds
from .output.measured import find_local
from .show.figures.comparisons import overall_figure_files
from .show.figures.diagnostics import diagnostic_files
from .show.figures.drawing import figure_files
from .show.figures.runs import curve_files, draw_bars, task_files
from .show.grid_files import study_files
from .show.quality_files import quality_files
from .show.render import (
    overall_to_csv,
    overall_to_latex,
    overall_to_markdown,
    paper_to_csv,
    paper_to_latex,
    paper_to_markdown,
    power_to_csv,
    scores_to_csv,
    to_csv,
    to_latex,
    to_markdown,
)
from .site.pages import site_files
from .site.parts import Run, Site, run_of

if TYPE_CHECKING:
    pass


def draw_diagnostics(
    dataset_ids: str | Sequence[str] | None = None,
    output: str | Path | None = "report",
    domain: str | None = None,
    methods: Sequence[str] | None = None,
) -> DiagnosticsReport:
    """Draw k, the losses and the representations of collectors over environment steps, from the diagnostics beside their datasets.

    For each domain and group ``<output>/<slug>/`` gets ``k``, ``losses`` and ``representation`` as ``.svg`` and ``.pdf``, without those
    that no method has values for; each file is replaced whole. The same datasets give the same bytes.

    Args:
        dataset_ids: task-agnostic datasets that were collected here; all below the dataset root unless given.
        output: the folder to write to; None writes nothing.
        domain, methods: only datasets of that domain, of these methods.

    Raises:
        UsageError: there is no such dataset, none of that domain or method, or one that was named has no diagnostics (it is labelled or
            imported); the output cannot be a folder.
        RunError: a dataset's diagnostics are damaged, or a file could not be written.
    """
    folder = None if output is None else check_folder(output, "output")
    comparisons, remarks = compare_stored(dataset_ids, domain, methods)
    files: list[Path] = []
    if folder is not None:
        for comparison in comparisons:
            files += write_files(folder / comparison.slug, diagnostic_files(comparison))
    return DiagnosticsReport(comparisons, remarks, files)


def measure_quality(
    dataset_ids: str | Sequence[str] | None = None,
    output: str | Path | None = "report",
    domain: str | None = None,
    methods: Sequence[str] | None = None,
) -> QualityReport:
    """Measure datasets without training on them: reward density for all tasks, coverage, entropy, statistics of actions.

    For each domain and group ``<output>/<slug>/`` gets ``quality.md``, ``quality.csv``, ``density.svg`` and ``density.pdf``; each file is
    replaced whole. The same datasets give the same bytes.

    Args:
        dataset_ids: task-agnostic datasets; all below the dataset root unless given.
        output: the folder to write to; None writes nothing.
        domain, methods: only datasets of that domain, of these methods.

    Raises:
        UsageError: there is no such dataset, or one that was named is labelled or holds no physics states; the output cannot be a folder.
        RunError: a dataset is damaged, or a file could not be written.
    """
    folder = None if output is None else check_folder(output, "output")
    tables, remarks = measure_stored(dataset_ids, domain, methods)
    files = [] if folder is None else [file for one in tables for file in write_files(folder / one.slug, quality_files(one))]
    return QualityReport(tables, remarks, files)


@dataclass(frozen=True)
class Report:
    """What the records say.

    Attributes:
        tables: one for each domain, algorithm and group, in that order; without methods that exist for studies only.
        overall: for each group and algorithm its methods over all tasks, with intervals.
        studies: the paper's other tables and figures, as far as there are records of them.
        problems: one line for each thing that was left out or is doubtful.
        missing: runs that would make the comparisons, and the studies that have begun, complete.
        files: what was written; empty without an output folder.
    """

    tables: list[Table]
    overall: list[Overall]
    studies: list[Study]
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

    For each table ``<output>/<slug>/`` gets ``table.md``, ``table.tex``, ``table.csv``, ``curves`` and ``bars`` as ``.svg`` and
    ``.pdf``, the curves of each task as ``task-<task>.svg``, and ``paper.md``, ``paper.tex`` and ``paper.csv`` if it has cells that the
    paper reports, too; and for each study of the same domain, algorithm and group ``<study>.md``, ``<study>.tex``, a ``.csv`` for each of
    its tables, and its figures. For each group and algorithm ``<output>/<profile>.<algorithm>/`` gets ``overall.md``, ``overall.tex``,
    ``overall.csv``, ``scores.csv``, ``power.csv``, and ``intervals``, ``profiles``, ``ranks`` and ``domains`` as ``.svg`` and ``.pdf``.
    Learners side by side are in ``<output>/<profile>.learners/``. ``<output>/index.html`` is the site over all of them (see :mod:`.site`).
    Each file is replaced whole. Where a task of a profile has a reference below the results (see ``cudc_bench.artefacts.references``),
    its floor and ceiling and the scores between them are shown, too. The same records and references, and with ``datasets`` the same
    datasets, give the same bytes. What has not changed since the last build is left alone, and what no record asks for any more is removed
    (see :mod:`.incremental`).

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
    references, faults = read_references(path for path in paths if path.is_dir())
    loaded = replace(loaded, problems=(*loaded.problems, *faults))
    records = loaded.records
    records = only(records, "record", "profile", profile, lambda record: record.profile)
    records = only(records, "record", "domain", domain, lambda record: record.dataset.domain)
    records = only(records, "record", "algo", algo, lambda record: record.algorithm)
    with kept_from_collector():
        return _make(loaded, references, paths, records, folder, datasets, whole=profile is domain is algo is None)


def _make(
    loaded: Loaded, references: Mapping[tuple[str, str, str], Bounds], paths: Sequence[Path], records: Sequence[Record],
    folder: Path | None, datasets: bool, whole: bool,
) -> Report:  # fmt: skip
    blocks, problems = build_blocks(records, references)
    tables = tables_of(blocks)
    overall = build_overall(tables)
    studies = build_studies(blocks, overall)
    missing = find_missing(tables, [one for study in studies for one in study.wanted])
    files: list[Path] = []
    if folder is not None:
        parts = [Part(table.slug, partial(_contents, table), (*loaded.inputs(table.records), *_measures(table))) for table in tables]
        for one in overall:
            compared = [table for table in tables if (table.group, table.algorithm) == (one.group, one.algorithm)]
            inputs = [text for table in compared for text in (*loaded.inputs(table.records), *_measures(table))]
            parts.append(Part(one.slug, partial(_overall_contents, one), tuple(inputs)))
        every = tuple(map(repr, sorted(references.items())))
        for study in studies:
            inputs = [*loaded.inputs(study.records), study.caption, *study.notes, *every]
            parts.append(Part(study.folder, partial(study_files, study), tuple(inputs), study.name))
        hidden = tables_of(blocks, studies=True)
        local, remarks = find_local(datasets_of([*tables, *hidden]), folder) if datasets else ({}, [])
        problems += remarks

        def site_part(there: Mapping[str, Sequence[str]]) -> Part:
            places = _places(loaded, paths)
            site = Site(tables, overall, [*loaded.problems, *problems], missing, there, places, local, studies, hidden)
            known = [loaded.inputs(records), every, site.problems, map(str, missing), map(repr, there.items()), map(repr, places.items()),
                     (f"{word} {one.digest}" for word, one in local.items())]  # fmt: skip
            return Part("", partial(site_files, site), tuple(map(digest, known)), "site" if whole else "site of some")

        # A site over all records is not replaced by one over some of them.
        files = build(folder, parts, whole, None if not whole and holds(folder, "", "site") else site_part)
    return Report(tables, overall, studies, [*loaded.problems, *problems], missing, files)


def _measures(table: Table) -> tuple[str, ...]:
    """What stands for a table's references among the inputs of its files."""
    return tuple(map(repr, table.references.items()))


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
        **figure_files("bars", lambda: draw_bars(table.runs)),
        **task_files(table.runs),
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
        **({"power.csv": power_to_csv(overall)} if overall.power else {}),
        **overall_figure_files(overall),
    }
