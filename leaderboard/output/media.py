"""What lies beside records and belongs onto pages: where each is, its policy, and videos that somebody made of the best ones.

And what ``compare`` left in the output.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from pydantic import ValidationError

from cudc_bench.artefacts.records import Record
from cudc_bench.files import read_limited

from ..datasets.pair import SUMMARY, PairSummary
from ..intake.load import Loaded
from ..numbers.table import Table
from ..site.parts import Clip, Run, run_of

_VIDEOS = (".mp4", ".gif")  # as ``cudc-bench render`` names them
_COMPARED = {".md", ".csv", ".svg", ".pdf", *_VIDEOS}  # kinds of the files of ``compare`` that a page shows or offers
_LARGEST = 20_000_000  # bytes of a video on a page; of ten seconds it has a fiftieth of that


def links_to_records(loaded: Loaded, output: Path) -> dict[Run, str]:
    """Where each record is from the site's root, as an address; only of those below the folder that the output is in, too.

    Results and report lie side by side by default and may be put on a host together. Other places are nobody's business.
    """
    above = Path(os.path.abspath(output)).parent
    near: dict[Path, str | None] = {}  # of ten thousand records' folders
    found = {}
    for record, file in zip(loaded.records, loaded.paths, strict=True):
        folder = file.parent
        if folder not in near:
            place = Path(os.path.abspath(folder))
            near[folder] = place.relative_to(above).as_posix() if len(above.parts) > 1 and place.is_relative_to(above) else None
        if (place_below := near[folder]) is not None:
            found[run_of(record)] = "../" + quote(os.fsencode(f"{place_below}/{file.name}"))
    return found


def find_clips(loaded: Loaded, tables: Iterable[Table]) -> dict[tuple[str, str], Clip]:
    """For each table's slug and task its best run, whether its policy is there, and a video: its own, or the best other's that has one."""
    files: Mapping[int, Path] = {id(record): file for record, file in zip(loaded.records, loaded.paths, strict=True)}
    found = {}
    for table in tables:
        for task in table.tasks:
            runs = [record for record in table.records if record.dataset.task == task and id(record) in files]
            runs.sort(key=lambda one: (-(one.score(one.final.step) or 0.0), one.dataset.id, one.seed))
            if runs:
                found[table.slug, task] = _clip(runs, files)
    return found


def find_pairs(output: Path) -> dict[str, tuple[PairSummary, list[str]]]:
    """What ``compare`` left in an output folder: by the name of its folder there a summary, and what a page can show or offer."""
    found = {}
    for path in sorted(output.glob(f"*.pair/{SUMMARY}")):
        with suppress(OSError, ValidationError):
            pair = PairSummary.model_validate_json(read_limited(path))
            if pair.slug == path.parent.name:
                found[pair.slug] = pair, sorted(one.name for one in path.parent.iterdir() if one.suffix in _COMPARED)
    return found


def _clip(runs: Sequence[Record], files: Mapping[int, Path]) -> Clip:
    best = runs[0]
    has_policy = files[id(best)].with_suffix(".policy.pt").is_file()
    for record in runs:
        stem, _ = os.path.splitext(files[id(record)])
        for suffix in _VIDEOS:
            if os.path.isfile(stem + suffix):
                with suppress(OSError):  # such as one that is larger than a page should load
                    return Clip(best, has_policy, record, suffix, read_limited(Path(stem + suffix), _LARGEST))
    return Clip(best, has_policy)
