"""What datasets have beside a task's reference, expert and replay, and what is said where one of them is missing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cudc_bench.artefacts.manifest import KEY, metadata_path, read_manifest
from cudc_bench.artefacts.records import Record
from cudc_bench.artefacts.references import Bounds
from cudc_bench.artefacts.tiers import LearningPoint, Tier
from cudc_bench.data.descriptors import DescriptorCoverage
from cudc_bench.envs.domains import DOMAINS
from cudc_bench.leaderboard.datasets.quality import Quality, TaskMeasures, measure_stored, reward_density
from cudc_bench.leaderboard.datasets.visited import Visited
from cudc_bench.leaderboard.datasets.yardsticks import Yardsticks, measure_beside

BASE = "walker/cudc-smoke-v0"
BOUNDS = Bounds(floor=20.0, untrained=25.0, ceiling=220.0, seeds=3)


def visited(cells: list[int], visits: list[int], pairs: int) -> Visited:
    return Visited(np.array(cells), np.array(visits), pairs, DescriptorCoverage(len(cells), 0.0))


def quality(*episodes: float, where: Visited | None) -> Quality:
    """Of episodes with a constant reward each."""
    manifest: Any = SimpleNamespace(label="x", seed=1, tier=None)
    density = reward_density([np.full(100, reward) for reward in episodes])
    return Quality("walker/x-v0", manifest, {"walk": density}, None, None, (0.5,), 0.0, None, visited=where)


def test_measures_by_hand() -> None:
    """Of 1,000 steps: 0.06 per step are 60, a fifth of the way from 20 to 220."""
    expert, replays = visited([1, 2, 9], [5, 3, 2], 7), [visited([1], [1], 30), visited([1], [1], 50)]
    by = Yardsticks({"walk": BOUNDS}, {"walk": [expert]}, {"walk": replays})
    one = quality(0.02, 0.10, where=visited([2, 9, 11], [6, 2, 2], 10))
    assert by.measures(one, "walk", DOMAINS["walker"]) == TaskMeasures(
        trajectory_quality=pytest.approx(0.2), coverage_ratio=10 / 40, expert_recall=5 / 10, expert_precision=8 / 10
    )
    # The floor is 0, the ceiling 1, and less than random actions get is less than 0.
    found = [by.measures(quality(reward, where=None), "walk", DOMAINS["walker"]) for reward in (0.02, 0.22, 0.0)]
    assert [round(one.trajectory_quality or 0.0, 12) for one in found] == [0.0, 1.0, -0.1]
    assert (found[0].coverage_ratio, found[0].expert_recall, found[0].expert_precision) == (None, None, None)
    nothing = Yardsticks({}, {}, {})
    assert nothing.measures(one, "walk", DOMAINS["walker"]) == TaskMeasures(None, None, None, None)
    assert (nothing.has("walk"), by.has("walk"), by.has("run")) == (False, True, False)


def as_tier(datasets: Path, kind: str, task: str, seed: int = 1, **changes: Any) -> str:
    """The collected dataset under the name of a tier, as if a training had made it."""
    one = f"walker/{task}/{kind}-smoke{f'-seed{seed}' if seed > 1 else ''}-v0"
    shutil.copytree(datasets / BASE, datasets / one)
    metadata = json.loads(metadata_path(one).read_text())
    curve = [LearningPoint(step=0, score=1.0), LearningPoint(step=3000, score=9.0)]
    tier = Tier(kind=kind, algorithm="td3", step=3000, score=9.0, expert_score=9.0, curve=curve)  # type: ignore[arg-type]
    manifest = read_manifest(one).model_copy(update={"tier": tier, "method": kind, "task": task, "seed": seed, **changes})
    metadata[KEY] = manifest.model_dump(mode="json")
    metadata_path(one).write_text(json.dumps(metadata))
    return one


def test_a_dataset_is_measured_by_the_tiers_of_its_profile(smoke: Path) -> None:
    """The expert's states are the dataset's own here, so that it has all of them; what was trained with other settings is none."""
    as_tier(smoke, "expert", "walk", overrides={"data_steps": 3000})
    as_tier(smoke, "replay", "walk")
    as_tier(smoke, "expert", "run", overrides={"learning_rate": 0.5})
    as_tier(smoke, "replay", "run", profile="demo")
    as_tier(smoke, "medium", "flip")
    (table,), _ = measure_stored(BASE)
    (found,), remarks = measure_beside([table], {("smoke", "walker", "walk"): BOUNDS, ("cpu", "walker", "run"): BOUNDS})
    (one,) = found.datasets
    assert list(one.tasks) == ["walk"]
    walk = one.tasks["walk"]
    assert (walk.coverage_ratio, walk.expert_recall, walk.expert_precision) == (1.0, 1.0, 1.0)
    assert walk.trajectory_quality == pytest.approx((1000 * one.rewards["walk"].mean - 20) / 200)
    assert remarks == [
        "smoke.quality.walker: no TQ of stand, run, flip: there is no reference; make it with:"
        " cudc-bench reference --domain walker --tasks stand,run,flip --profile smoke",
        "smoke.quality.walker: no recall and precision of stand, run, flip: there is no expert's dataset; make it with:"
        " cudc-bench tiers --domain walker --tasks stand,run,flip --profile smoke",
        "smoke.quality.walker: no SACo of stand, run, flip: there is no replay; make it with:"
        " cudc-bench tiers --domain walker --tasks stand,run,flip --profile smoke",
    ]
    # Datasets that a profile says nothing of are measured by nothing.
    (other,), remarks = measure_beside([replace(table, group="smoke (collect: steps=5)")], {})
    assert not other.datasets[0].tasks
    assert len(remarks) == 1
    assert "no TQ, SACo, recall or precision" in remarks[0]


def test_the_command_says_what_is_missing(
    smoke: Path, cli: Callable, tmp_path: Path, make_record: Callable[..., Record], save: Callable[..., Path]
) -> None:
    """With the record of a learner without rewards, which is of the collected dataset itself."""
    own = {"dataset_id": BASE, "dataset_fingerprint": read_manifest(BASE).fingerprint}
    save(make_record("cudc", "walk", profile="smoke", **own))
    as_tier(smoke, "replay", "walk")
    done = cli("stats", BASE, "--output", "out")
    assert done.code == 0, done.err
    notes = [line for line in done.err.splitlines() if line.startswith("note: ")]
    assert notes[1].endswith("expert's dataset; make it with: cudc-bench tiers --domain walker --tasks stand,walk,run,flip --profile smoke")
    assert notes[2].endswith("replay; make it with: cudc-bench tiers --domain walker --tasks stand,run,flip --profile smoke")
    assert notes[3].endswith("no correlation of measures with scores of td3: it takes 5 datasets that have both on walk, not 1.")
    assert "SACo: state-action pairs, of a replay's" in done.out
    rows = (tmp_path / "out/smoke.quality.walker/quality.csv").read_text().splitlines()
    assert rows[2].split(",")[-4:] == ["", "1.0", "", ""]
    assert "| walker/cudc-smoke-v0 | walk | – | 1.000 | – | – |" in (tmp_path / "out/smoke.quality.walker/quality.md").read_text()
    refused = cli("stats", "--records", "nowhere")
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "there are no results at 'nowhere'" in refused.err
