"""Coverage of low-dimensional behaviour descriptors: how much of what a body can do was visited, and how evenly.

In 24 to 78 dimensions nearly every observation is new, and counting them says nothing. A domain's few physical quantities
(:attr:`~cudc_bench.envs.domains.Domain.quantities`: heights, speeds, positions; functions of the state that know no task and no reward) can
be counted, in cells of fixed size that are the same for all collectors.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, parse_id
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.data.measure import shannon_entropy
from cudc_bench.data.reader import read_episodes
from cudc_bench.envs import Domain, check_domain
from cudc_bench.errors import RunError, UsageError
from cudc_bench.execution.progress import bars

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class DescriptorCoverage:
    """Of the states that actions led to; resets do not count, since no action leads to them.

    Attributes:
        coverage_cells: how many cells of the descriptors were visited at least once.
        coverage_entropy: Shannon entropy in nats of the share of visits to each cell: 0 when all are to one cell, at most the logarithm of
            ``coverage_cells``.
    """

    coverage_cells: int
    coverage_entropy: float

    def as_row(self) -> dict[str, Any]:
        """The two numbers by name, as diagnostics and manifests hold them."""
        return asdict(self)


class Visits:
    """Counts visits to the cells of a domain's descriptors.

    Numbers are counted, never added up in floating point: the result does not depend on the order or on the parts in which states come.

    Args:
        domain: one with ``descriptors``; 8 bytes are kept for each cell, 0.2 to 5 MB in the benchmark's own domains.

    Attributes:
        counts: visits to each cell (cells,), int64.
    """

    def __init__(self, domain: Domain) -> None:
        self._name = domain.name
        # The outer edges are left out: what lies beyond them goes to the border cells.
        self._edges = [np.linspace(bins.low, bins.high, bins.count + 1)[1:-1] for bins in domain.descriptors]
        self._shape = tuple(bins.count for bins in domain.descriptors)
        self.counts = np.zeros(math.prod(self._shape), np.int64)

    def add(self, quantities: Float64) -> NDArray[np.int64]:
        """Count states by their quantities (N, Q), in the order and units of the domain's.

        Returns:
            The number of each state's cell (N,).

        Raises:
            RunError: a quantity is not finite.
        """
        if not np.isfinite(quantities).all():
            raise RunError(f"physical quantities of {self._name} are not finite; the states are damaged (see cudc-bench verify).")
        bins = [np.searchsorted(edges, column, side="right") for edges, column in zip(self._edges, quantities.T, strict=True)]
        cells = np.asarray(np.ravel_multi_index(tuple(bins), self._shape), np.int64)
        visited, visits = np.unique(cells, return_counts=True)
        self.counts[visited] += visits
        return cells

    @property
    def coverage(self) -> DescriptorCoverage:
        """Of all states so far."""
        visited = self.counts[self.counts > 0]
        return DescriptorCoverage(len(visited), shannon_entropy(visited))


def coverage(dataset_id: DatasetId | str) -> DescriptorCoverage:
    """Compute the coverage of a finished dataset's descriptors from its physics states, however it was made.

    It equals the last line of the collection's diagnostics. No reward is computed.

    Args:
        dataset_id: such as ``"walker/cudc-v0"``; a relabelled one has the states, and so the coverage, of its base.

    Raises:
        UsageError: no such dataset, or it holds no physics states, or its domain has no descriptors.
        RunError: it is damaged.
    """
    checked = dataset_id if isinstance(dataset_id, DatasetId) else parse_id(dataset_id)
    manifest = read_manifest(checked)
    domain = check_domain(manifest.domain)
    if not domain.descriptors:
        raise UsageError(f"'{checked}' is of {domain.name}, which has no behaviour descriptors: its only known quantities are rewards.")
    if "infos/physics" not in manifest.fields:
        raise UsageError(f"'{checked}' holds no physics states, from which alone descriptors are computed; import files that have them.")
    relabeler, visits = plugins.load("relabelers", domain.relabeler)(domain), Visits(domain)
    with bars([(f"coverage of {checked}", manifest.steps)], "states") as (advance,):
        for episode in read_episodes(checked, ("infos/physics", "actions")):
            # Row 0 of an episode is its reset.
            visits.add(relabeler.quantities(episode["infos/physics"][1:], episode["actions"]))
            advance(len(episode["actions"]))
    return visits.coverage
