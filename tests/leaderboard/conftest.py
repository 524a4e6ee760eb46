"""Synthetic run records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from cudc_bench.records import DatasetReference, Evaluation, Record, record_path, write_record

MakeRecord = Callable[..., Record]


def _make_record(
    method: str = "cudc",
    task: str = "walk",
    seed: int = 1,
    scores: Sequence[tuple[int, Sequence[float]]] = ((0, [0.0]), (10_000, [100.0, 200.0]), (20_000, [300.0])),
    final: Sequence[float] = (400.0, 500.0, 600.0),
    **changes: Any,
) -> Record:
    """A record whose curve is ``scores`` as (step, returns) and whose last evaluation is ``final``.

    ``dataset_<field>`` changes a field of the dataset, any other name one of the record.
    """
    of_dataset = {name.removeprefix("dataset_"): changes.pop(name) for name in list(changes) if name.startswith("dataset_")}
    domain = of_dataset.get("domain", "walker")
    dataset: dict[str, Any] = {
        "id": f"{domain}/{task}/{method}-seed{seed}-v0", "fingerprint": "a" * 64, "domain": domain, "task": task,
        "method": method, "seed": seed, "steps": 400_000, "profile": changes.get("profile", "cpu"), **of_dataset,
    }  # fmt: skip
    record: dict[str, Any] = {
        "algorithm": "td3", "profile": "cpu", "seed": 1, "hyperparameters": {"learning_rate": 1e-3},
        "hyperparameters_hash": "0" * 16, "milestones": [10_000, 20_000], "seconds": 1.0, "versions": {}, "machine": {},
        "command": f"cudc-bench evaluate --method {method} --seed {seed}", "created": "2026-11-22T10:00:00+00:00", **changes,
    }  # fmt: skip
    return Record(
        dataset=DatasetReference(**dataset),
        curve=[Evaluation(step=step, returns=list(returns)) for step, returns in scores],
        final=Evaluation(step=scores[-1][0], returns=list(final)),
        **record,
    )


@pytest.fixture
def make_record() -> MakeRecord:
    """The factory of synthetic records."""
    return _make_record


@pytest.fixture
def save(tmp_path: Path) -> Callable[..., Path]:
    """Writes records below ``tmp_path/results`` as ``evaluate`` does and returns that folder."""

    def write(*records: Record) -> Path:
        results = tmp_path / "results"
        results.mkdir(exist_ok=True)
        for r in records:
            write_record(record_path(results, r.dataset.id, r.algorithm, r.seed, r.profile), r)
        return results

    return write
