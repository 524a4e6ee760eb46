"""Two datasets side by side: what each is worth to tasks, where its states lie, how its actions change, and a few seconds of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.envs import Domain, check_domain, make_simulators
from cudc_bench.errors import UsageError, nearest
from cudc_bench.execution.progress import bars
from cudc_bench.text import plain

from .diagnostics import group_of
from .quality import Float32, Float64, Quality, QualityTable, measurable, measure, particle_entropies

SUMMARY = "pair.json"  # in the folder of a pair
_BINS = 40  # of a quantity without bins of its own, over what both datasets have of it
_WINDOW = 256  # actions of each piece whose spectrum is taken, or those of an episode where it is shorter


class SideSummary(BaseModel):
    """One of the two datasets, in a few words.

    Attributes:
        id, fingerprint, method, seed, steps: which.
        rewards: what its states are worth to each task, mean over steps.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    id: Annotated[str, Field(pattern=r"^[a-z0-9_/-]+-v[0-9]{1,6}$", max_length=500)]
    fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    method: str
    seed: Annotated[int, Field(ge=0)]
    steps: Annotated[int, Field(ge=1)]
    rewards: dict[str, float]


class PairSummary(BaseModel):
    """What is kept of a pair beside its figures, by which the site knows them.

    Attributes:
        quantities: of the map.
        shared: as in :class:`Pair`.
        sides: the first and the second.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    quantities: tuple[str, str]
    shared: float
    sides: tuple[SideSummary, SideSummary]

    @property
    def slug(self) -> str:
        """The name of their folder; other pairs have another, since no id has a full stop."""
        return ".".join([*(side.id.replace("/", ".") for side in self.sides), "pair"])

    @property
    def title(self) -> str:
        """Both by name."""
        return " beside ".join(side.id for side in self.sides)


@dataclass(frozen=True)
class Axis:
    """One of the two quantities of a map.

    Attributes:
        name: of the quantity.
        edges: of its bins (n + 1,); what lies outside is in the first or the last.
    """

    name: str
    edges: Float64 = field(repr=False)


@dataclass(frozen=True)
class Side:
    """One of the two datasets.

    Attributes:
        quality: what ``stats`` measures of it; its particle entropy is comparable with the other's.
        visits: the share of its states in each cell of the map (x, y); they sum to 1.
        spectrum: of its actions, the variance in each band of ``Pair.frequencies`` (F,), mean over actuators; None if all of its episodes
            are too short.
    """

    quality: Quality
    visits: Float64 = field(repr=False)
    spectrum: Float64 | None = field(repr=False)

    @property
    def name(self) -> str:
        """Its id."""
        return plain(self.quality.id)

    @property
    def manifest(self) -> Manifest:
        """Its own."""
        return self.quality.manifest


@dataclass(frozen=True)
class Pair:
    """What two datasets of a domain are beside each other.

    Attributes:
        domain: theirs.
        x, y: what the map is over.
        frequencies: of the spectra, Hz (F,).
        sides: the first and the second.
        shared: the sum over the map's cells of the smaller of both shares: 1 where the states are spread alike, 0 where no cell has both's.
    """

    domain: Domain
    x: Axis
    y: Axis
    frequencies: Float64 = field(repr=False)
    sides: tuple[Side, Side]

    @property
    def table(self) -> QualityTable:
        """Both as a table of ``stats`` has them, whatever profiles and settings they have."""
        groups = dict.fromkeys(group_of(side.manifest) for side in self.sides)
        methods = dict.fromkeys(side.manifest.label for side in self.sides)
        measured = tuple(side.quality for side in self.sides)
        return QualityTable(plain(" and ".join(groups)), plain(self.domain.name), self.domain.tasks, self.slug, tuple(methods), measured)

    @property
    def summary(self) -> PairSummary:
        """What is kept of it."""
        first, second = (
            SideSummary(
                id=side.quality.id, fingerprint=side.manifest.fingerprint, method=side.manifest.label, seed=side.manifest.seed,
                steps=side.manifest.steps, rewards={task: one.mean for task, one in side.quality.rewards.items()},
            )
            for side in self.sides
        )  # fmt: skip
        return PairSummary(quantities=(self.x.name, self.y.name), shared=self.shared, sides=(first, second))

    @property
    def slug(self) -> str:
        """The name of their folder."""
        return self.summary.slug

    @property
    def shared(self) -> float:
        """See above."""
        first, second = self.sides
        return float(np.minimum(first.visits, second.visits).sum())


def compare_pair(first: str, second: str, quantities: Sequence[str] | None = None) -> Pair:
    """Measure two datasets of one domain; each is read once.

    Args:
        first, second: ids of two datasets that hold physics states.
        quantities: names of two of the domain's, for the map; the first two unless given.

    Raises:
        UsageError: there is no such dataset, one is labelled from another or holds no physics states, they are of different
            domains or the same, or the domain has no such quantities.
        RunError: a dataset is damaged.
    """
    found, _ = measurable([first, second])
    if len(found) < 2:
        raise UsageError(f"'{first}' cannot be compared with itself; name two datasets.")
    domains = [manifest.domain for _, manifest in found]
    if domains[0] != domains[1]:
        raise UsageError(f"'{first}' is of {plain(domains[0])} and '{second}' of {plain(domains[1])}; name two of one domain.")
    domain = check_domain(domains[0])
    chosen = _columns(domain, quantities)
    (simulator,) = make_simulators(domain.name, 1)
    window = min(_WINDOW, domain.episode_length)
    frequencies: Float64 = np.fft.rfftfreq(window, simulator.timestep).astype(np.float64)
    measured, states, spectra = [], [], []
    with bars([(f"measure {one}", manifest.steps) for one, manifest in found], "states") as advances:
        for (one, manifest), advance in zip(found, advances, strict=True):
            seen: list[Float64] = []
            spectrum = _Spectrum(window)

            def look(quantities: Float64, actions: Float32, seen: list[Float64] = seen, spectrum: _Spectrum = spectrum) -> None:
                seen.append(quantities[:, chosen])
                spectrum.add(actions)

            measured.append(measure(one, manifest, domain, advance, look))
            states.append(np.concatenate(seen))
            spectra.append(spectrum.mean)
    x, y = (
        Axis(domain.quantities[column], _edges(domain, column, [one[:, place] for one in states])) for place, column in enumerate(chosen)
    )
    entropies = particle_entropies([points for _, points in measured])
    sides = [
        Side(replace(quality, particle_entropy=entropy), _visits(x, y, one), spectrum)
        for (quality, _), entropy, one, spectrum in zip(measured, entropies, states, spectra, strict=True)
    ]
    return Pair(domain, x, y, frequencies, (sides[0], sides[1]))


def _columns(domain: Domain, names: Sequence[str] | None) -> list[int]:
    allowed = ", ".join(domain.quantities)
    if len(domain.quantities) < 2:
        raise UsageError(f"{domain.name} has fewer than two quantities to map: {allowed or 'none'}.")
    if names is None:
        return [0, 1]
    for name in names:
        if name not in domain.quantities:
            raise UsageError(f"{domain.name} has no quantity {name!a}; allowed: {allowed}.{nearest(name, domain.quantities)}")
    if len(names) != 2 or names[0] == names[1]:
        raise UsageError(f"a map has two different quantities, not {', '.join(names) or 'none'}; allowed: {allowed}.")
    return [domain.quantities.index(name) for name in names]


def _edges(domain: Domain, column: int, values: Sequence[Float64]) -> Float64:
    if domain.descriptors:
        bins = domain.descriptors[column]
        return np.linspace(bins.low, bins.high, bins.count + 1)
    low, high = min(float(one.min()) for one in values), max(float(one.max()) for one in values)
    return np.linspace(low, high if high > low else low + 1.0, _BINS + 1)


def _visits(x: Axis, y: Axis, states: Float64) -> Float64:
    """Shares (x, y) of states (n, 2); those outside belong to the cells at the border, as in a domain's coverage."""
    first, second = (np.clip(column, axis.edges[0], axis.edges[-1]) for axis, column in zip((x, y), states.T, strict=True))
    counts: Float64 = np.histogram2d(first, second, bins=[x.edges, y.edges])[0]
    return counts / counts.sum()


class _Spectrum:
    """Adds up the spectra of episodes' actions: of pieces that overlap by half, each less its mean and under Hann's window (Welch 1967)."""

    def __init__(self, window: int) -> None:
        self._window, self._pieces = window, 0
        self._power: NDArray[np.float64] | float = 0.0

    def add(self, actions: Float32) -> None:
        """One episode's (T, A); one that is shorter than a piece does not count."""
        size = self._window
        if len(actions) < size or size < 2:
            return
        starts = range(0, len(actions) - size + 1, size // 2)
        pieces = np.stack([actions[start : start + size] for start in starts]).astype(np.float64)
        pieces -= pieces.mean(1, keepdims=True)
        taper = np.hanning(size + 1)[:-1]
        power = np.abs(np.fft.rfft(pieces * taper[:, None], axis=1)) ** 2 / (size * (taper**2).sum())
        power[:, 1 : (size + 1) // 2] *= 2.0  # each stands for its negative, too
        self._power = self._power + power.mean(2).sum(0)
        self._pieces += len(pieces)

    @property
    def mean(self) -> Float64 | None:
        """The variance in each band (F,), mean over pieces and actuators; None without any piece."""
        return np.asarray(self._power) / self._pieces if self._pieces else None
