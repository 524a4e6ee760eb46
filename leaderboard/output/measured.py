"""Datasets of records that are on this machine, measured once: what was measured is kept beside the site's pages."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.data.descriptors import DescriptorCoverage
from cudc_bench.envs import check_domain
from cudc_bench.errors import CudcBenchError
from cudc_bench.execution.parallel import computed
from cudc_bench.files import MOST_LINES, read_limited
from cudc_bench.text import plain

from ..datasets.behind import Dataset, Local, find_base
from ..datasets.diagnostics import diagnostics_path
from ..datasets.quality import BINS, QUANTILES, Quality, RewardDensity, measure
from .files import write_files

FOLDER = "datasets"  # in the output, of these pages and of what they show
MEASURES = "measures.json"  # in that folder: what was measured, by fingerprint, so that it is measured once


class _Density(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    mean: float
    quantiles: Annotated[tuple[float, ...], Field(min_length=len(QUANTILES), max_length=len(QUANTILES))]
    best: float
    top: float
    above_half: float
    above_nine: float
    density: Annotated[tuple[float, ...], Field(min_length=BINS, max_length=BINS)]


class _Measures(BaseModel):
    """What is kept of a dataset."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    code: str  # the version of this project that measured
    rewards: dict[str, _Density] | None
    coverage: tuple[int, float] | None
    action_std: tuple[float, ...]
    action_saturated: float
    action_correlation: float | None


class _Kept(BaseModel):
    model_config = ConfigDict(extra="forbid")

    measures: dict[str, _Measures] = {}


def find_local(datasets: Sequence[Dataset], output: Path) -> tuple[dict[str, Local], list[str]]:
    """Those of some datasets that are on this machine, by their ``slug``, measured; and a line for each that could not be.

    What was measured is kept in ``<output>/datasets/measures.json`` by fingerprint, so that only new datasets take time (seconds each).
    """
    folder = output / FOLDER
    present, remarks = [], []
    for dataset in datasets:
        try:
            bases = (find_base(one, fingerprint) for _, one, fingerprint in dataset.labelled)
            if (found := next(filter(None, bases), None)) is not None:
                present.append((dataset, *found))
        except CudcBenchError as error:
            remarks.append(plain(str(error)))
        except OSError as error:
            remarks.append(plain(f"cannot look for the dataset {dataset.name}: {error.strerror}."))
    if not present:
        return {}, remarks
    kept = _read(folder / MEASURES)
    fresh = {one: kept[manifest.fingerprint] for _, one, manifest in present if _is_fresh(kept.get(manifest.fingerprint))}
    todo = list({one: manifest for _, one, manifest in present if one not in fresh}.items())
    measured: dict[str, Quality | None] = {}
    looks = [partial(_look, one, manifest) for one, manifest in todo]
    for (one, _), result in zip(todo, computed(looks, "measuring datasets", "datasets", few=1), strict=True):
        if isinstance(result, str):
            remarks.append(result)
        else:
            measured[one] = result
    locals_: dict[str, Local] = {}
    for dataset, one, manifest in present:
        if one in fresh:
            quality = _quality(one, manifest, fresh[one])
        elif one in measured:
            quality = measured[one]
        else:
            continue
        locals_[dataset.slug] = Local(one, manifest, quality, _digest(one))
        kept[manifest.fingerprint] = _measures(quality)
    text = _Kept(measures=dict(sorted(kept.items()))).model_dump_json(indent=1)
    write_files(folder, {MEASURES: f"{text}\n"})
    return locals_, remarks


def _look(one: str, manifest: Manifest) -> Quality | str | None:
    """A dataset's measures, None without physics states, or why it has none."""
    try:
        has_states = "infos/physics" in manifest.fields
        return measure(one, manifest, check_domain(manifest.domain), lambda states: None)[0] if has_states else None
    except CudcBenchError as error:
        return plain(str(error))


def _read(path: Path) -> dict[str, _Measures]:
    try:
        return dict(_Kept.model_validate_json(read_limited(path)).measures)
    except (OSError, ValidationError):
        return {}  # Measured again.


def _is_fresh(measures: _Measures | None) -> bool:
    return measures is not None and measures.code == version("cudc-bench")


def _digest(dataset_id: str) -> str:
    try:
        return hashlib.sha256(read_limited(diagnostics_path(dataset_id), MOST_LINES)).hexdigest()
    except OSError:
        return ""


def _measures(quality: Quality | None) -> _Measures:
    coverage = None if quality is None or quality.coverage is None else quality.coverage
    return _Measures(
        code=version("cudc-bench"),
        rewards=None if quality is None else {task: _Density(**vars(one)) for task, one in quality.rewards.items()},
        coverage=None if coverage is None else (coverage.coverage_cells, coverage.coverage_entropy),
        action_std=() if quality is None else quality.action_std,
        action_saturated=0.0 if quality is None else quality.action_saturated,
        action_correlation=None if quality is None else quality.action_correlation,
    )


def _quality(dataset_id: str, manifest: Manifest, old: _Measures) -> Quality | None:
    if old.rewards is None:
        return None
    return Quality(
        id=dataset_id,
        manifest=manifest,
        rewards={task: RewardDensity(**one.model_dump()) for task, one in old.rewards.items()},
        coverage=None if old.coverage is None else DescriptorCoverage(*old.coverage),
        particle_entropy=None,
        action_std=old.action_std,
        action_saturated=old.action_saturated,
        action_correlation=old.action_correlation,
    )
