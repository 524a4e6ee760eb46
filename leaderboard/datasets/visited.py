"""Where a dataset's states lie, in cells of its domain's behaviour descriptors, and how much of it another dataset has, too.

Two sets of states are compared as Kynkäänniemi et al. 2019, "Improved Precision and Recall Metric for Assessing Generative Models"
(NeurIPS), compare two sets of images: *precision* is the share of the one that lies where the other is, *recall* the share of the other
that lies where the one is. Departs from them in what "where" means: theirs are balls around the points of a sample, up to the third
neighbour's distance; here it is the cells in which coverage is counted. A few points far out have balls that cover what nobody visited
(Naeem et al. 2020, "Reliable Fidelity and Diversity Metrics for Generative Models", ICML), and in 24 to 78 dimensions what comes out is
decided by how many points a sample has; balls of the expert's alone, as theirs, hold next to none of anybody else's states there. Cells
are of one size for all datasets, and take all states. What they cannot see is what descriptors leave out, such as where the legs are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.data.descriptors import DescriptorCoverage, Visits
from cudc_bench.data.reader import read_episodes
from cudc_bench.envs import Domain
from cudc_bench.execution.progress import Advance

Integers = NDArray[np.int64]
_SIGNS = 6  # by which actions are told apart


@dataclass(frozen=True)
class Visited:
    """The cells that the states of a dataset lie in; resets do not count, as in its coverage.

    Attributes:
        cells: their numbers, ascending (n,).
        visits: to each of them (n,).
        pairs: how many different pairs of a state's cell and of :func:`directions` of the action that was taken there it has.
        coverage: of the cells.
    """

    cells: Integers = field(repr=False)
    visits: Integers = field(repr=False)
    pairs: int
    coverage: DescriptorCoverage


class Trail:
    """Takes a dataset's episodes one after the other, and knows what they have visited.

    Args:
        domain: one with ``descriptors``.
    """

    def __init__(self, domain: Domain) -> None:
        self._visits = Visits(domain)
        self._pairs: list[Integers] = []

    def add(self, quantities: NDArray[np.float64], actions: NDArray[np.float32]) -> None:
        """An episode's quantities (T, Q), those after each of its actions (T, A).

        Raises:
            RunError: a quantity is not finite.
        """
        cells = self._visits.add(quantities)
        # The state before an action is what the action before it led to.
        self._pairs.append(np.unique(cells[:-1] * 2**_SIGNS + directions(actions[1:])))

    @property
    def visited(self) -> Visited:
        """All that was visited so far."""
        (cells,) = np.nonzero(self._visits.counts)
        pairs = np.unique(np.concatenate(self._pairs)) if self._pairs else ()
        return Visited(cells, self._visits.counts[cells], len(pairs), self._visits.coverage)


def directions(actions: NDArray[np.float32]) -> Integers:
    """Where actions (T, A) push, as one of at most 64 numbers (T,): the signs of six sums, of which each has every sixth actuator.

    For six actuators these are their signs. Those of twelve, taken by themselves, are different ones in most steps of uniform actions.
    """
    sums = np.stack([actions[:, place::_SIGNS].sum(1, dtype=np.float64) for place in range(_SIGNS)], 1)
    return np.asarray((sums > 0) @ 2 ** np.arange(_SIGNS), np.int64)


def read_visited(dataset_id: str, manifest: Manifest, domain: Domain, advance: Advance) -> Visited:
    """What a dataset has visited, from its physics states; ``advance`` is told of those that have been read.

    Raises:
        RunError: it is damaged.
    """
    relabeler, trail = plugins.load("relabelers", domain.relabeler)(domain), Trail(domain)
    for episode in read_episodes(dataset_id, ("infos/physics", "actions")):
        trail.add(relabeler.quantities(episode["infos/physics"][1:], episode["actions"]), episode["actions"])
        advance(len(episode["actions"]))
    return trail.visited


def recall(one: Visited, experts: Sequence[Visited]) -> float:
    """The share of the experts' states, all taken together, in whose cells a dataset has been."""
    return _within(experts, [one])


def precision(one: Visited, experts: Sequence[Visited]) -> float:
    """The share of a dataset's states in whose cells one of the experts has been."""
    return _within([one], experts)


def _within(some: Sequence[Visited], others: Sequence[Visited]) -> float:
    """The share of the states of some that lie in a cell of the others."""
    there = np.unique(np.concatenate([one.cells for one in others]))
    inside = sum(int(one.visits[np.isin(one.cells, there, assume_unique=True)].sum()) for one in some)
    return inside / sum(int(one.visits.sum()) for one in some)
