"""The leaderboard from Python: records and datasets in, tables and files out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from cudc_bench.artefacts.references import read_references
from cudc_bench.errors import RunError, UsageError
from cudc_bench.files import check_folder, check_path

from .datasets.diagnostics import DiagnosticsReport, compare_stored
from .datasets.pair import SUMMARY, Pair, compare_pair
from .datasets.prediction import Prediction, predict
from .datasets.quality import QualityTable, measure_stored
from .datasets.yardsticks import measure_beside
from .intake.load import Loaded, kept_from_collector, load_records
from .intake.select import only
from .output.files import write_files
from .output.film import write_film
from .output.report import Report, make_report, prediction_files, quality_files
from .show import csv, markdown
from .show.figures.diagnostics import diagnostic_files
from .show.figures.pair import pair_files

__all__ = ["QualityReport", "Report", "compare_datasets", "draw_diagnostics", "make_leaderboard", "measure_quality"]

_LONGEST = 60  # seconds of a scene


def make_leaderboard(
    results: str | Path | Sequence[str | Path] = "results",
    output: str | Path | None = "report",
    profile: str | None = None,
    domain: str | None = None,
    algo: str | None = None,
    datasets: bool = True,
    figures: bool = False,
) -> Report:
    """Make tables and a static site from run records, and with ``figures`` files of its figures.

    For each table ``<output>/<slug>/`` gets ``table.md``, ``table.tex``, ``table.csv``, and ``paper.md``, ``paper.tex`` and ``paper.csv``
    if it has cells that the paper reports, too; and for each study of the same domain, algorithm and group ``<study>.md``,
    ``<study>.tex``, and a ``.csv`` for each of its tables. For each group and algorithm ``<output>/<profile>.<algorithm>/`` gets
    ``overall.md``, ``overall.tex``, ``overall.csv``, ``scores.csv`` and ``power.csv``. Learners side by side are in
    ``<output>/<profile>.learners/``. ``<output>/index.html`` is the site over all of them, which draws its figures itself (see
    :mod:`.site`). With ``figures`` there are, beside the tables, ``curves`` and ``bars``, ``intervals``, ``profiles``, ``ranks`` and
    ``domains``, and those of studies as ``.svg`` and ``.pdf``, and the curves of each task as ``task-<task>.svg``.
    Each file is replaced whole. Where a task of a profile has a reference below the results (see ``cudc_bench.artefacts.references``),
    its floor and ceiling and the scores between them are shown, too. The same records and references, and with ``datasets`` the same
    datasets, give the same bytes. What has not changed since the last build is left alone, and what no record asks for any more is removed
    (see :mod:`.output.incremental`).

    Args:
        results: a record or a folder of records, or several.
        output: the folder to write to; None writes nothing.
        profile, domain, algo: only records of that profile, domain or algorithm.
        datasets: measure those of the records' datasets that are on this machine, for their pages; what was measured is kept in
            ``<output>/datasets/measures.json``, so that each takes its seconds once.
        figures: draw files of figures, for papers. Those of an earlier build stay as long as they are right, and are removed after that.

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
        return make_report(loaded, references, paths, records, folder, datasets, figures, whole=profile is domain is algo is None)


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


@dataclass(frozen=True)
class QualityReport:
    """What :func:`measure_quality` found.

    Attributes:
        tables: one for each domain and group, in that order.
        predictions: what goes with learners' scores, for each of the tables whose datasets have enough of them.
        remarks: one line for each thing that was left out.
        files: what was written; empty without an output folder.
    """

    tables: list[QualityTable]
    predictions: list[Prediction]
    remarks: list[str]
    files: list[Path]


def measure_quality(
    dataset_ids: str | Sequence[str] | None = None,
    output: str | Path | None = "report",
    domain: str | None = None,
    methods: Sequence[str] | None = None,
    records: str | Path | Sequence[str | Path] = (),
) -> QualityReport:
    """Measure datasets without training on them: reward density for all tasks, coverage, entropy, statistics of actions.

    Where the datasets of ``cudc-bench tiers`` are there, also what they have of the states of a task's expert, and of the state-action
    pairs of its replay; with records also where their returns lie between a task's floor and ceiling (see :mod:`.datasets.yardsticks`),
    and which of all these measures goes with learners' scores (see :mod:`.datasets.prediction`).

    For each domain and group ``<output>/<slug>/`` gets ``quality.md``, ``quality.csv``, ``density.svg`` and ``density.pdf``, and where
    datasets have scores ``prediction.md``, ``.tex``, ``.svg`` and ``.pdf``, and a ``.csv`` for each of its tables; each file is replaced
    whole. The same datasets and records give the same bytes.

    Args:
        dataset_ids: task-agnostic datasets; all below the dataset root unless given.
        output: the folder to write to; None writes nothing.
        domain, methods: only datasets of that domain, of these methods.
        records: a record, a folder of records and references, or several.

    Raises:
        UsageError: there is no such dataset, or one that was named is labelled or holds no physics states; there are no such records; the
            output cannot be a folder.
        RunError: a dataset is damaged, or a file could not be written.
    """
    folder = None if output is None else check_folder(output, "output")
    paths = [check_path(path, "the records") for path in ([records] if isinstance(records, str | Path) else records)]
    loaded = _load(paths, need=False)
    references, faults = read_references(path for path in paths if path.is_dir())
    tables, remarks = measure_stored(dataset_ids, domain, methods)
    tables, lacking = measure_beside(tables, references)
    predictions, left_out = predict(tables, loaded.records)
    files = []
    if folder is not None:
        files = [file for one in tables for file in write_files(folder / one.slug, quality_files(one))]
        files += [file for one in predictions for file in write_files(folder / one.study.folder, prediction_files(one))]
    return QualityReport(tables, predictions, [*remarks, *loaded.problems, *faults, *lacking, *left_out], files)


@dataclass(frozen=True)
class PairReport:
    """What :func:`compare_datasets` found.

    Attributes:
        pair: the numbers.
        remarks: what could not be made, and why.
        files: what was written; empty without an output folder.
    """

    pair: Pair
    remarks: list[str]
    files: list[Path]


def compare_datasets(
    first: str, second: str, output: str | Path | None = "report", quantities: Sequence[str] | None = None, seconds: float = 4.0
) -> PairReport:
    """Put two datasets of a domain side by side: their states over two quantities, rewards, spectra of actions, and a film of both.

    ``<output>/<both ids>.pair/`` gets ``quality.md`` and ``quality.csv`` as ``stats`` writes them, ``map``, ``density`` and ``spectra`` as
    ``.svg`` and ``.pdf``, and ``film.mp4`` (a GIF where there is no ffmpeg): the first, the middle and the last episode of each, the first
    dataset on the left. Where nothing can draw, a remark says so. By ``pair.json`` the next leaderboard in that folder has a page of them.

    Args:
        first, second: ids of two datasets that hold physics states.
        output: the folder to write to; None writes nothing.
        quantities: two of the domain's, for the map; the first two unless given.
        seconds: of each of the film's three scenes; 0 makes none.

    Raises:
        UsageError: as :func:`~.datasets.pair.compare_pair`, the seconds are no number of at least 0, or the output cannot be a folder.
        RunError: a dataset is damaged, or a file could not be written.
    """
    if not 0 <= seconds <= _LONGEST:
        raise UsageError(f"--seconds takes 0 to {_LONGEST}, not {seconds:g}.")
    folder = None if output is None else check_folder(output, "output")
    pair = compare_pair(first, second, quantities)
    if folder is None:
        return PairReport(pair, [], [])
    place = folder / pair.slug
    table = pair.table
    summary = pair.summary.model_dump_json(indent=1) + "\n"
    texts = {"quality.md": markdown.of_quality(table), "quality.csv": csv.of_quality(table), SUMMARY: summary}
    files = write_files(place, {**texts, **pair_files(pair)})
    remarks = []
    if seconds:
        try:
            files.append(write_film(place, pair, seconds))
        except RunError as error:
            remarks.append(f"there is no film: {error}")
    return PairReport(pair, remarks, files)


def _load(paths: Sequence[Path], need: bool = True) -> Loaded:
    way_out = "make some with: cudc-bench evaluate --algo td3"
    for path in paths:
        if not path.exists():
            raise UsageError(f"there are no results at '{path}'; {way_out}")
    loaded = load_records(paths)
    if need and not loaded.records:
        where = ", ".join(f"'{path}'" for path in paths)
        problems = loaded.problems
        why = f". Files left out: {len(problems)}, such as: {problems[0]}" if problems else ""
        raise UsageError(f"there is no usable record in {where}; {way_out}{why}")
    return loaded
