"""Coverage of behaviour descriptors: counted right, live and afterwards the same, and without any effect on what is collected."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.ids import dataset_path
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.descriptors import DescriptorCoverage, Visits
from cudc_bench.data.reader import load_episodes
from cudc_bench.envs import DOMAINS, Domain, check_domain
from cudc_bench.errors import RunError, UsageError

from .test_card import card, cells

NUMBERS = ("coverage_cells", "coverage_entropy")


def lines(root: Path, dataset_id: str) -> list[dict[str, Any]]:
    text = (root / dataset_id / "diagnostics.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()]


def counted_one_by_one(domain: Domain, quantities: np.ndarray) -> tuple[int, float]:
    """Cells and entropy by a loop over the bins of each quantity of each state."""
    visits: Counter[tuple[int, ...]] = Counter()
    for state in quantities:
        cell = []
        for value, bins in zip(state, domain.descriptors, strict=True):
            edges = np.linspace(bins.low, bins.high, bins.count + 1)
            inside = [i for i in range(bins.count) if edges[i] <= value < edges[i + 1]]
            cell.append(inside[0] if inside else 0 if value < bins.low else bins.count - 1)
        visits[tuple(cell)] += 1
    shares = [count / len(quantities) for count in visits.values()]
    return len(visits), -math.fsum(share * math.log(share) for share in shares)


def check_against(found: DescriptorCoverage, expected: tuple[int, float]) -> None:
    assert found.coverage_cells == expected[0]
    assert found.coverage_entropy == pytest.approx(expected[1], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", DOMAINS)
def test_cells_and_entropy_are_those_of_a_loop_over_bins(name: str) -> None:
    domain = DOMAINS[name]
    assert len(domain.descriptors) == len(domain.quantities)
    generator = np.random.default_rng(0)
    columns = []
    for bins in domain.descriptors:
        middle, half = (bins.low + bins.high) / 2, (bins.high - bins.low) / 2
        drawn = generator.normal(middle, half / 4, 400)
        drawn[:20] = generator.choice(np.linspace(bins.low, bins.high, bins.count + 1), 20)  # on edges
        drawn[20:30] = middle + generator.choice([-1e9, -1.5 * half, 1.5 * half, 1e9], 10)  # out of range
        columns.append(drawn)
    quantities = np.stack(columns, axis=1)
    whole, parts = Visits(domain), Visits(domain)
    whole.add(quantities)
    check_against(whole.coverage, counted_one_by_one(domain, quantities))
    for part in np.array_split(generator.permutation(quantities), 7):
        parts.add(part)
    assert parts.coverage == whole.coverage


def test_one_cell_has_no_entropy_and_damaged_numbers_are_not_counted() -> None:
    visits = Visits(DOMAINS["walker"])
    assert visits.coverage == DescriptorCoverage(0, 0.0)
    visits.add(np.full((50, 4), 1e300))
    assert visits.coverage == DescriptorCoverage(1, 0.0)
    assert math.copysign(1.0, visits.coverage.coverage_entropy) == 1.0
    for damage in (np.nan, np.inf):
        with pytest.raises(RunError, match=r"^physical quantities of walker are not finite"):
            visits.add(np.full((1, 4), damage))


@pytest.mark.parametrize("name", DOMAINS)
def test_random_collection_says_how_far_it_is_at_even_steps(name: str, datasets: Path) -> None:
    """Live coverage equals that of the states so far, through the relabeler, at every line; some fall within an episode."""
    (one,) = cudc_bench.collect("random", name, profile="smoke", settings={"steps": 1_300, "measure_every": 8})
    found = lines(datasets, one)
    assert [line["step"] for line in found] == [400, 800, 1_200, 1_300]
    assert all(line["updates"] == 0 for line in found)
    domain, flat = DOMAINS[name], load_episodes(one, ("infos/physics", "actions"))
    states = np.concatenate([episode[1:] for episode in flat.split("infos/physics")])
    quantities = plugins.load("relabelers", domain.relabeler)(domain).quantities(states, flat.arrays["actions"])
    for line in found:
        check_against(DescriptorCoverage(*(line[number] for number in NUMBERS)), counted_one_by_one(domain, quantities[: line["step"]]))
    last = {number: found[-1][number] for number in NUMBERS}
    assert cudc_bench.coverage(one).as_row() == last
    assert read_manifest(one).diagnostics == found[-1]
    rows = cells(card(datasets, one))
    assert rows["visited cells of behaviour descriptors"][0].split(" of ")[0] == f"{last['coverage_cells']:,}"
    assert rows["entropy of the visits to them, in nats"] == [f"{last['coverage_entropy']:.4g}"]


def test_a_learning_method_tells_of_itself_in_the_same_lines(smoke: Path) -> None:
    found = lines(smoke, "walker/cudc-smoke-v0")
    assert [(line["step"], line["updates"]) for line in found] == [(step, max(0, step - 1000) // 50) for step in range(500, 3001, 500)]
    assert [("critic_loss" in line) for line in found] == [False, False, True, True, True, True]
    last = {number: found[-1][number] for number in NUMBERS}
    for one in ("walker/cudc-smoke-v0", "walker/walk/cudc-smoke-v0"):
        assert cudc_bench.coverage(one).as_row() == last
        assert found[-1].items() <= read_manifest(one).diagnostics.items()
        assert "visited cells of behaviour descriptors" in cells(card(smoke, one))


@pytest.mark.parametrize("method", ["random", "cudc"])
def test_it_changes_no_byte_of_the_dataset(method: str, datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prints = []
    for domain in (DOMAINS["walker"], dataclasses.replace(DOMAINS["walker"], descriptors=())):
        monkeypatch.setitem(DOMAINS, "walker", domain)
        (one,) = cudc_bench.collect(method, profile="smoke", settings={"steps": 1_500}, overwrite=True)
        prints.append(read_manifest(one).fingerprint)
        assert ("coverage_cells" in lines(datasets, one)[-1]) == bool(domain.descriptors)
    assert prints[0] == prints[1]
    with pytest.raises(UsageError, match="no behaviour descriptors"):
        cudc_bench.coverage(one)


def test_a_suite_domain_has_none_since_its_quantities_are_rewards(datasets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "dm_control/cheetah-run"
    assert check_domain(name).descriptors == ()

    def poisoned(self: Any, out: Any) -> None:
        raise AssertionError("a collector asked for the environment's reward")

    monkeypatch.setattr("cudc_bench.envs.suite.SuiteSimulator.quantities", poisoned)
    (one,) = cudc_bench.collect("random", name, profile="smoke", settings={"steps": 600})
    assert [set(line) for line in lines(datasets, one)] == [{"step", "updates"}] * 2
    assert "behaviour descriptors" not in card(datasets, one)


def test_datasets_without_states_or_with_damaged_ones_are_refused(make_dataset: Callable, make_episodes: Callable) -> None:
    episode = make_episodes([5])[0]
    make_dataset("walker/bare-v0", [dataclasses.replace(episode, infos={})])
    with pytest.raises(UsageError, match=r"'walker/bare-v0' holds no physics states"):
        cudc_bench.coverage("walker/bare-v0")
    make_dataset("walker/broken-v0", [episode])
    with h5py.File(dataset_path("walker/broken-v0") / "data/main_data.hdf5", "r+") as file:
        file["episode_0/infos/physics"][...] = np.nan
    with pytest.raises(RunError, match="not finite"):
        cudc_bench.coverage("walker/broken-v0")
    with pytest.raises(UsageError, match="there is no dataset"):
        cudc_bench.coverage("walker/nothing-v0")
