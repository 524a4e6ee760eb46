"""Where datasets have been, against loops over states, and two sets of states whose precision and recall are known."""

from __future__ import annotations

import numpy as np
import pytest

from cudc_bench.envs.domains import DOMAINS, Domain
from cudc_bench.leaderboard.datasets.visited import Trail, Visited, precision, recall

WALKER = DOMAINS["walker"]


def states(*heights: float) -> np.ndarray:
    """Quantities of Walker (T, 4) that differ in the height of the torso alone; its cells are 10 cm."""
    found = np.zeros((len(heights), 4))
    found[:, 0] = heights
    return found


def visited(*heights: float, domain: Domain = WALKER) -> Visited:
    trail = Trail(domain)
    trail.add(states(*heights), np.zeros((len(heights), domain.action_size), np.float32))
    return trail.visited


def test_two_clusters_of_which_a_dataset_has_one() -> None:
    expert = visited(*[1.25] * 6, *[0.55] * 2)
    dataset = visited(*[1.21] * 3, 1.85)
    assert recall(dataset, [expert]) == 6 / 8
    assert precision(dataset, [expert]) == 3 / 4
    # What another seed's expert does counts for as many states as it has.
    other = visited(*[1.85] * 4)
    assert recall(dataset, [expert, other]) == 10 / 12
    assert precision(dataset, [expert, other]) == 1.0


def test_the_expert_itself_has_all_and_what_is_elsewhere_has_none() -> None:
    expert = visited(0.15, 0.15, 0.95)
    assert (recall(expert, [expert]), precision(expert, [expert])) == (1.0, 1.0)
    elsewhere = visited(0.45, 1.55)
    assert (recall(elsewhere, [expert]), precision(elsewhere, [expert])) == (0.0, 0.0)
    # A cell ends where its upper edge is: as near as that, and still elsewhere.
    assert recall(visited(0.2), [expert]) == 0.0


@pytest.mark.parametrize("name", DOMAINS)
def test_pairs_are_those_of_a_loop_over_states(name: str) -> None:
    """A state goes with the action that was taken in it, never with another episode's; an action counts by the signs of six sums."""
    domain, generator = DOMAINS[name], np.random.default_rng(0)
    trail, pairs, cells = Trail(domain), set(), []
    for length in (60, 1, 35):
        drawn = [generator.normal((one.low + one.high) / 2, (one.high - one.low) / 20, length) for one in domain.descriptors]
        quantities = np.stack(drawn, 1)
        actions = generator.choice([-0.25, 0.0, 0.5], (length, domain.action_size), p=[0.1, 0.1, 0.8]).astype(np.float32)
        trail.add(quantities, actions)
        sizes = [(one.low, (one.high - one.low) / one.count) for one in domain.descriptors]
        bins = [tuple(int((value - low) // size) for value, (low, size) in zip(row, sizes, strict=True)) for row in quantities]
        cells += bins
        for before, action in zip(bins, actions[1:].astype(float), strict=False):
            sums = [sum(action[place] for place in range(start, domain.action_size, 6)) for start in range(6)]
            pairs.add((before, tuple(one > 0 for one in sums)))
    found = trail.visited
    assert found.pairs == len(pairs) < 94
    assert found.coverage.coverage_cells == len(found.cells) == len(set(cells))
    assert sorted(found.visits) == sorted(cells.count(one) for one in set(cells))


def test_nothing_was_visited_before_the_first_episode() -> None:
    found = Trail(WALKER).visited
    assert (len(found.cells), found.pairs) == (0, 0)
