"""Synthetic run records, and the report of an example that has everything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from cudc_bench.artefacts.records import DatasetReference, Evaluation, Record, Submission, record_path, write_record
from cudc_bench.leaderboard.api import make_leaderboard

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
        "algorithm": "td3", "profile": "cpu", "seed": 1, "hyperparameters": {"learning_rate": 1e-3, "final_evaluations": 3},
        "hyperparameters_hash": "0" * 16, "milestones": [10_000, 20_000], "seconds": 1.0, "versions": {}, "machine": {},
        "command": f"cudc-bench evaluate --method {method} --seed {seed}", "created": "2026-11-22T10:00:00+00:00", **changes,
    }  # fmt: skip
    return Record(
        dataset=DatasetReference(**dataset),
        curve=[Evaluation(step=step, returns=list(returns)) for step, returns in scores],
        final=Evaluation(step=scores[-1][0], returns=list(final)),
        **record,
    )


@pytest.fixture(scope="session")
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


TASKS = {"walker": ("stand", "walk", "run"), "jaco": ("reach_top_left",)}
# Means of the last evaluation on walker walk, and of the milestone before.
WALK = {"random": (120.0, 60.0), "icm": (480.0, 300.0), "cudc": (900.0, 350.0), "mine": (1000.0, 90.0)}


@pytest.fixture(scope="session")
def walk() -> dict[str, tuple[float, float]]:
    """What the example's methods get on walker walk at 500K and at 100K."""
    return WALK


@pytest.fixture(scope="session")
def example_records() -> list[Record]:
    """Two groups, two domains, studies, an imported method, a submission, holes, and cells that the paper has.

    Walker walk has the means of ``walk`` and a spread of 10 over three seeds; ``mine`` has one seed, no run and no other domain.
    """
    records = []
    for domain, tasks in TASKS.items():
        scale = 1.0 if domain == "walker" else 0.25
        for task in tasks:
            for method, (last, before) in WALK.items():
                if method == "mine" and task != "walk":
                    continue
                for seed in (1,) if method == "mine" else (1, 2, 3):
                    shift = 0.0 if method == "mine" else 10.0 * (seed - 2)
                    drop = 0.0 if task == "walk" else 0.3 * last
                    mean, earlier = scale * (last + shift - drop), scale * (before + shift - drop / 5)
                    final = [mean] if mean == 1000 else [mean - 0.5, mean + 0.5]
                    records.append(_make_record(
                        method, task, seed, [(0, [1.0]), (100_000, [earlier] * 2), (500_000, [mean])], final, dataset_domain=domain,
                        profile="paper", milestones=[100_000, 500_000], versions={"cudc-bench": "0.1.0", "torch": "2.13.0"},
                        commit="c" * 40, seconds=1234.0, machine={"processor": "A processor", "device": "cuda", "threads": 2},
                    ))  # fmt: skip
    records += [_make_record(method, "walk", seed) for method in ("cudc", "icm") for seed in (1, 2)]
    records += [_make_record(method, "walk", seed) for method in ("cudc-no-pe", "cudc-kmax4") for seed in (1, 2)]
    records += [_make_record(method, "walk", 1, dataset_used=100_000) for method in ("cudc", "cudc-no-pe")]
    submission = Submission(by="ann", url="https://example.org/mine", sha256="d" * 64, submitted="2026-11-22T10:00:00+00:00")
    records.append(_make_record("cudc", seed=3, final=[700.0], submission=submission))
    records.append(_make_record("proto", final=[300.0], dataset_source="ExORL", dataset_profile="imported", dataset_steps=10_000_000))
    return records


@pytest.fixture(scope="session")
def example_report(example_records: list[Record], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that the leaderboard makes of them, never to be changed."""
    folder = tmp_path_factory.mktemp("example")
    for record in example_records:
        one = record.dataset
        write_record(record_path(folder / "results", one.id, record.algorithm, record.seed, record.profile, one.used), record)
    make_leaderboard(folder / "results", folder / "report", datasets=False)
    return folder / "report"
