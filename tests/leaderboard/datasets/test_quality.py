"""The quality of datasets against independent routes: relabelled rewards, live coverage, distributions whose entropy is known."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import cudc_bench
from cudc_bench.data.reader import load_episodes
from cudc_bench.errors import UsageError
from cudc_bench.leaderboard.api import measure_quality
from cudc_bench.leaderboard.datasets.quality import QUANTILES, action_correlation, particle_entropies, reward_density
from cudc_bench.leaderboard.output.report import quality_files

TASKS = ("stand", "walk", "run", "flip")


def test_rewards_are_those_of_the_relabelled_datasets(smoke: Path) -> None:
    (table,) = measure_quality("walker/cudc-smoke-v0", None).tables
    (found,) = table.datasets
    assert tuple(found.rewards) == table.tasks == TASKS
    for task, density in found.rewards.items():
        episodes = [rewards.astype(np.float64) for rewards in load_episodes(f"walker/{task}/cudc-smoke-v0", ("rewards",)).split("rewards")]
        steps, means = np.concatenate(episodes), [episode.mean() for episode in episodes]
        assert density.mean == pytest.approx(np.mean(means), rel=1e-6)
        assert density.quantiles == pytest.approx(np.quantile(means, QUANTILES), rel=1e-6)
        assert density.best == pytest.approx(max(means), rel=1e-6)
        assert density.top == pytest.approx(np.sort(steps)[-30:].mean(), rel=1e-6)
        assert density.above_half == (steps > 0.5).mean()
    assert found.coverage == cudc_bench.coverage("walker/cudc-smoke-v0")
    actions = load_episodes("walker/cudc-smoke-v0", ("actions",)).arrays["actions"]
    assert found.action_std == pytest.approx(actions.std(0), rel=1e-5)
    assert found.action_saturated == (np.abs(actions) > 0.95).mean()


def test_a_density_counts_every_step_once() -> None:
    found = reward_density([np.array([0.0, 0.01, 0.5]), np.array([1.0, 1.0, 0.95, 0.39])])
    shares = np.array(found.density) / 50
    assert shares.sum() == pytest.approx(1.0)
    assert {index: round(share * 7) for index, share in enumerate(shares) if share} == {0: 2, 19: 1, 25: 1, 47: 1, 49: 2}
    assert (found.above_half, found.above_nine, found.top) == (3 / 7, 3 / 7, 1.0)
    assert found.best == pytest.approx(0.835)
    assert found.mean == pytest.approx((0.17 + 0.835) / 2)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_the_entropy_of_a_gaussian_is_found(size: int) -> None:
    points = np.random.default_rng(size).normal(3.0, 7.0, (20_000, size)).astype(np.float32)
    (found,) = particle_entropies([points])
    assert found == pytest.approx(size / 2 * math.log(2 * math.pi * math.e), abs=0.04 * size)


def test_entropies_are_compared_on_one_scale() -> None:
    """Half as wide in each of two dimensions is less by two times log 2; what never varies counts for nothing."""
    generator = np.random.default_rng(0)
    wide = np.concatenate([generator.normal(size=(6000, 2)), np.ones((6000, 1))], axis=1).astype(np.float32)
    narrow = wide * np.array([0.5, 0.5, 1.0], np.float32)
    first, second, few = particle_entropies([wide, narrow, wide[:12]])
    assert first is not None
    assert second is not None
    assert first - second == pytest.approx(2 * math.log(2), abs=1e-4)
    assert few is None
    # Equal observations have no distance; the estimate stays finite.
    (stuck,) = particle_entropies([np.repeat(wide[:100], 30, axis=0)])
    assert stuck is not None
    assert math.isfinite(stuck)
    assert stuck < first - 10


def test_consecutive_actions_correlate_within_episodes_only() -> None:
    generator = np.random.default_rng(0)
    actions = [np.zeros((2000, 2), np.float32)]
    for step in range(1, 2000):
        actions[0][step] = np.array([0.8, 0.0]) * actions[0][step - 1] + generator.normal(0, 0.1, 2)
    assert action_correlation(actions) == pytest.approx((0.8 + 0.0) / 2, abs=0.04)
    assert action_correlation([np.full((1, 2), value, np.float32) for value in (0.1, 0.9)]) is None
    assert action_correlation([np.full((10, 2), 0.3, np.float32)]) is None


def test_the_command_compares_what_may_be_compared(smoke: Path, cli: Callable, tmp_path: Path) -> None:
    cudc_bench.collect("random", profile="smoke")
    cudc_bench.collect("random", seeds=[2], profile="smoke", settings={"steps": 2000})
    done = cli("stats", "--output", "out")
    assert done.code == 0, done.err
    assert (tmp_path / "out" / "smoke.quality.walker").is_dir()
    assert len(list((tmp_path / "out").iterdir())) == 2  # other numbers of steps make another table
    names = {"quality.md", "quality.csv", "density.svg", "density.pdf"}
    assert {path.name for path in (tmp_path / "out" / "smoke.quality.walker").iterdir()} == names
    with (tmp_path / "out" / "smoke.quality.walker" / "quality.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["task"]) for row in rows] == [(method, task) for method in ("random", "cudc") for task in TASKS]
    (table, _) = measure_quality(None, None).tables
    assert float(rows[0]["mean"]) == table.datasets[0].rewards["stand"].mean
    assert quality_files(table) == quality_files(measure_quality(None, None, "walker").tables[0])


def test_what_cannot_be_measured_is_refused(smoke: Path, datasets: Path) -> None:
    with pytest.raises(UsageError, match=r"^'walker/walk/cudc-smoke-v0' is labelled for walk; name its base 'walker/cudc-smoke-v0'\.$"):
        measure_quality("walker/walk/cudc-smoke-v0", None)
    with pytest.raises(UsageError, match="no dataset has the domain 'jaco'; there are: walker"):
        measure_quality(None, None, "jaco")
    with pytest.raises(UsageError, match="no dataset was named"):
        measure_quality([], None)
    with pytest.raises(UsageError, match="there is no dataset 'walker/nothing-v0'"):
        measure_quality("walker/nothing-v0", None)
