"""What a leaderboard's files are: which belong to each table, comparison and study, and what the site is made from."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.text import plain

from ..datasets.behind import datasets_of
from ..datasets.prediction import Prediction
from ..datasets.quality import QualityTable
from ..intake.load import Loaded
from ..numbers.missing import Missing, find_missing
from ..numbers.overall import Overall, build_overall
from ..numbers.published import beside_paper
from ..numbers.studies import build_studies
from ..numbers.study import Study
from ..numbers.table import Table, build_blocks, tables_of
from ..show import csv, latex, markdown
from ..show.figures.comparisons import overall_figure_files
from ..show.figures.draw import study_figure_files
from ..show.figures.drawing import figure_files
from ..show.figures.quality import draw_correlations, draw_density
from ..show.figures.runs import curve_files, draw_bars, task_files
from ..site.pages import site_files
from ..site.parts import Run, Site, run_of
from .incremental import Contents, Target, build, digest, holds
from .measured import find_local
from .media import find_clips, find_pairs, links_to_records


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


def make_report(
    loaded: Loaded, references: Mapping[tuple[str, str, str], Bounds], paths: Sequence[Path], records: Sequence[Record],
    folder: Path | None, datasets: bool, figures: bool, whole: bool,
) -> Report:  # fmt: skip
    """What some of the loaded records say, and its files.

    Args:
        loaded: all that were found below ``paths``.
        references: by profile, domain and task.
        paths: what was asked for.
        records: those that count.
        folder: the output; None writes nothing.
        datasets: whether those that are here are measured.
        figures: whether files of figures are drawn; those of an earlier build that are still right stay in any case.
        whole: whether all loaded records count.
    """
    blocks, problems = build_blocks(records, references)
    tables = tables_of(blocks)
    overall = build_overall(tables)
    studies = build_studies(blocks, overall)
    missing = find_missing(tables, [one for study in studies for one in study.wanted])
    files: list[Path] = []
    if folder is not None:
        parts: list[Target] = []

        def add(place: str, files: Callable[[], Contents], drawn: Callable[[], Contents], inputs: Sequence[str], name: str = "") -> None:
            known = digest(inputs)
            parts.append(Target(place, files, (known,), name))
            parts.append(Target(place, drawn, (known,), f"{name} figures".strip(), figures))

        for table in tables:
            add(table.slug, partial(table_files, table), partial(table_figures, table), [*loaded.inputs(table.records), *_measures(table)])
        for one in overall:
            compared = [table for table in tables if (table.group, table.algorithm) == (one.group, one.algorithm)]
            inputs = [text for table in compared for text in (*loaded.inputs(table.records), *_measures(table))]
            add(one.slug, partial(overall_files, one), partial(overall_figure_files, one), inputs)
        every = tuple(map(repr, sorted(references.items())))
        for study in studies:
            inputs = [*loaded.inputs(study.records), study.caption, *study.notes, *every]
            add(study.folder, partial(study_files, study), partial(study_figure_files, study), inputs, study.name)
        hidden = tables_of(blocks, studies=True)
        local, remarks = find_local(datasets_of([*tables, *hidden]), folder) if datasets else ({}, [])
        problems += remarks

        def site_part(there: Mapping[str, Sequence[str]]) -> Target:
            places = _places(loaded, paths)
            links, clips, pairs = links_to_records(loaded, folder), find_clips(loaded, tables), find_pairs(folder)
            there = {**there, **{slug: names for slug, (_, names) in pairs.items()}}
            site = Site(
                tables, overall, [*loaded.problems, *problems], missing, there, places, local, studies, hidden, links, clips,
                [pair for pair, _ in pairs.values()],
            )  # fmt: skip
            known = [loaded.inputs(records), every, site.problems, map(str, missing), map(repr, there.items()), map(repr, places.items()),
                     (f"{slug} {one.digest}" for slug, one in local.items()), map(repr, links.items()), map(repr, site.pairs),
                     (f"{one.has_policy} {one.shown and one.shown.dataset.id} {one.suffix} {hashlib.sha256(one.content).hexdigest()}"
                      for one in clips.values())]  # fmt: skip
            return Target("", partial(site_files, site), tuple(map(digest, known)), "site" if whole else "site of some")

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


def table_files(table: Table) -> dict[str, str | bytes]:
    """``table`` and ``paper`` in every format."""
    files: dict[str, str | bytes] = {
        "table.md": markdown.of_table(table),
        "table.tex": latex.of_table(table),
        "table.csv": csv.of_table(table),
    }
    paper = beside_paper(table)
    if paper is not None:
        files |= {
            "paper.md": markdown.of_paper(paper),
            "paper.tex": latex.of_paper(paper, table.slug),
            "paper.csv": csv.of_paper(paper, table),
        }
    return files


def table_figures(table: Table) -> dict[str, bytes]:
    """``curves``, ``bars``, and the curves of each task."""
    return {**curve_files(table), **figure_files("bars", lambda: draw_bars(table.runs)), **task_files(table.runs)}


def overall_files(overall: Overall) -> dict[str, str | bytes]:
    """``overall`` in every format, its scores and its power."""
    return {
        "overall.md": markdown.of_overall(overall),
        "overall.tex": latex.of_overall(overall),
        "overall.csv": csv.of_overall(overall),
        "scores.csv": csv.of_scores(overall),
        **({"power.csv": csv.of_power(overall)} if overall.power else {}),
    }


def study_files(study: Study) -> dict[str, str | bytes]:
    """``<study>.md`` and ``.tex`` with all tables, and ``<study>-<table>.csv`` for each."""
    files: dict[str, str | bytes] = {f"{study.name}.md": markdown.of_study(study), f"{study.name}.tex": latex.of_study(study)}
    files |= {f"{study.name}-{grid.name}.csv": csv.of_grid(study, grid) for grid in study.tables}
    return files


def quality_files(table: QualityTable) -> dict[str, str | bytes]:
    """``quality.md``, ``quality.csv``, and ``density.svg`` and ``density.pdf`` where the domain has tasks."""
    figures = figure_files("density", lambda: draw_density(table)) if table.tasks else {}
    return {"quality.md": markdown.of_quality(table), "quality.csv": csv.of_quality(table), **figures}


def prediction_files(prediction: Prediction) -> dict[str, str | bytes]:
    """``prediction.md`` and ``.tex`` with all tables, ``prediction-<table>.csv`` for each, and ``prediction.svg`` and ``.pdf``."""
    return {**study_files(prediction.study), **figure_files("prediction", lambda: draw_correlations(prediction.figure))}
