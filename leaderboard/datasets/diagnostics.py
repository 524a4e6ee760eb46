"""What collectors measured of themselves while they learned: k, losses and representations, from the datasets' diagnostics.

A figure compares methods on one domain at one profile with the same settings changed; there is no way to mix them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, stdev

from cudc_bench.artefacts.k_schedule import KSchedule, k_schedule
from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.artefacts.records import settings_text
from cudc_bench.data.diagnostics import diagnostics_path as diagnostics_path
from cudc_bench.data.diagnostics import read_measures
from cudc_bench.errors import UsageError
from cudc_bench.text import plain

from ..intake.select import select
from ..methods import LOSSES, METHOD_ORDER
from ..numbers.table import differing
from ..numbers.words import ordered, slug, span

REPRESENTATION = {
    "error_over_persistence": "error over persistence", "effective_rank": "effective rank of z", "state_spread": "spread of z",
    "action_share": "actions' share of distances",
}  # fmt: skip
_NUMBERS = ("k", *LOSSES, *REPRESENTATION, "coverage_cells", "coverage_entropy")


@dataclass(frozen=True)
class Run:
    """The diagnostics of one dataset.

    Attributes:
        id: the dataset's.
        manifest: what it is.
        values: of each measure that is read here, value by environment step, ascending; a number that is missing or not finite has no
            entry, and a measure without any is absent.
        last_step: of the last line.
    """

    id: str
    manifest: Manifest
    values: dict[str, dict[int, float]]
    last_step: int

    def last(self, name: str) -> float | None:
        """The last value of a measure, or None without any."""
        found = self.values.get(name)
        return None if found is None else found[max(found)]

    @property
    def schedule(self) -> KSchedule:
        """When k grew."""
        return k_schedule(self.manifest.diagnostics)

    @property
    def k(self) -> float | None:
        """k at the end; None for a method that has none."""
        # The last line's k is that of its minibatch, from before this update's test.
        growth = self.schedule.growth
        return growth[-1].new_k if growth else self.last("k")


@dataclass(frozen=True)
class Comparison:
    """Runs that may share a figure.

    Attributes:
        group: profile and whatever differs from it, on one line, as leaderboards name it.
        domain: what was explored.
        slug: a safe and unique name for files.
        methods: in the order of leaderboards.
        runs: by method and seed, each once.
    """

    group: str
    domain: str
    slug: str
    methods: tuple[str, ...]
    runs: tuple[Run, ...] = field(repr=False)

    def of(self, method: str, name: str) -> list[Run]:
        """A method's runs that have a measure."""
        return [run for run in self.runs if run.manifest.method == method and name in run.values]

    def having(self, names: Iterable[str]) -> tuple[str, ...]:
        """The methods with at least one run that has one of some measures."""
        names = tuple(names)
        return tuple(method for method in self.methods if any(self.of(method, name) for name in names))

    def seeds(self, names: Iterable[str]) -> str:
        """How many seeds are behind a line of some measures, such as ``"1 to 3 seeds"``."""
        return span([len(runs) for name in names for method in self.methods if (runs := self.of(method, name))], "seed")


@dataclass(frozen=True)
class DiagnosticsReport:
    """What the diagnostics say.

    Attributes:
        comparisons: one for each domain and group, in that order.
        remarks: one line for each thing that was left out or is doubtful, and for each figure that there is nothing to draw in.
        files: what was written; empty without an output folder.
    """

    comparisons: list[Comparison]
    remarks: list[str]
    files: list[Path]


def read_diagnostics(dataset_id: str) -> tuple[dict[str, dict[int, float]], int]:
    """The measures of a dataset's diagnostics, as :class:`Run` has them, and the step of the last line; see ``read_measures``."""
    return read_measures(dataset_id, _NUMBERS)


def compare_stored(
    dataset_ids: str | Sequence[str] | None = None, domain: str | None = None, methods: Sequence[str] | None = None
) -> tuple[list[Comparison], list[str]]:
    """The diagnostics of datasets side by side, and one line for each thing that was left out, is doubtful or absent.

    Args:
        dataset_ids: task-agnostic datasets that were collected here; all below the dataset root unless given.
        domain, methods: only datasets of that domain, of these methods.

    Raises:
        UsageError: there is no such dataset, none of that domain or method, or one that was named has no diagnostics (it is labelled or
            imported).
        RunError: a dataset's diagnostics are damaged.
    """
    found, remarks = select(dataset_ids, domain, methods, others=_is_other, refuse=_refuse, lacks=_lacks, verb="has diagnostics")
    comparisons, doubts = compare([Run(one, manifest, *read_diagnostics(one)) for one, manifest in found])
    absent = [f"{comparison.slug}: {what}" for comparison in comparisons for what in _absent(comparison)]
    return comparisons, [*remarks, *doubts, *absent]


def compare(runs: Iterable[Run]) -> tuple[list[Comparison], list[str]]:
    """Sort runs into comparisons; runs of different domains, profiles or settings never share one.

    Of several runs of one method and seed, which would count a seed twice, the newest is kept.

    Returns:
        The comparisons, by domain and group, and one line for each thing that was left out or is doubtful.
    """
    split: dict[tuple[str, str], dict[tuple[str, int], list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        split[run.manifest.domain, group_of(run.manifest)][run.manifest.method, run.manifest.seed].append(run)
    comparisons, doubts = [], []
    for (domain, group), seeds in sorted(split.items()):
        methods = ordered({method for method, _ in seeds}, METHOD_ORDER)
        newest = {key: max(same, key=lambda run: (run.manifest.created, run.id)) for key, same in seeds.items()}
        kept = tuple(newest[key] for key in sorted(seeds, key=lambda key: (methods.index(key[0]), key[1])))
        comparison = Comparison(plain(group), plain(domain), slug(group, "diagnostics", domain), methods, kept)
        found = [
            f"{run.id} is left out: {newest[key].id} has the same method, seed and settings and is not older."
            for key, same in seeds.items()
            for run in same
            if run is not newest[key]
        ]
        doubts += [f"{comparison.slug}: {plain(doubt)}" for doubt in (*sorted(found), *_doubts(comparison))]
        comparisons.append(comparison)
    return comparisons, doubts


def series(runs: Sequence[Run], name: str) -> tuple[list[int], list[float], list[float] | None]:
    """Environment steps, means and sample standard deviations of a measure over runs that have it; None for one run.

    Only steps at which all of them have a value count, so that a mean is always over the same seeds.
    """
    steps = sorted(set.intersection(*(set(run.values[name]) for run in runs)))
    values = [[run.values[name][step] for run in runs] for step in steps]
    return steps, [fmean(row) for row in values], [stdev(row) for row in values] if len(runs) > 1 else None


def _is_other(manifest: Manifest) -> bool:
    return manifest.task is not None or not manifest.was_collected


def _refuse(one: str, manifest: Manifest) -> None:
    if manifest.imported is not None:
        raise UsageError(f"'{one}' has no diagnostics: it was imported from {manifest.imported.source}, not collected here.")
    if manifest.mixture is not None:
        parts = ", ".join(f"'{plain(part.id)}'" for part in manifest.mixture.parts)
        raise UsageError(f"'{one}' has no diagnostics: it was mixed of {parts}, which have their own.")
    if manifest.tier is not None:
        raise UsageError(f"'{one}' has no diagnostics of a collector: it is of a training on {manifest.task}; its card has the scores.")
    if manifest.task is not None:
        base = "its base" if manifest.base is None else f"its base '{plain(manifest.base.id)}'"
        raise UsageError(f"'{one}' is labelled for {plain(manifest.task)}; the diagnostics are those of {base}.")


def _lacks(one: str, _: Manifest) -> str | None:
    return None if diagnostics_path(one).exists() else f"there is no file {diagnostics_path(one)}"


def group_of(manifest: Manifest) -> str:
    """The profile of a collection and whatever differs from it, as ``Record.group`` names what was collected so."""
    return f"{manifest.profile} (collect: {settings_text(manifest.overrides)})" if manifest.overrides else manifest.profile


def _doubts(comparison: Comparison) -> Iterator[str]:
    for method in comparison.methods:
        runs = [run for run in comparison.runs if run.manifest.method == method]
        if names := differing([run.manifest.hyperparameters for run in runs]):
            yield f"the datasets of {method} were collected with different hyperparameters: {', '.join(names)}."
        for name in ("k", *LOSSES, *REPRESENTATION):
            having = comparison.of(method, name)
            if having and len(having) < len(runs):
                missing = [run.id for run in runs if run not in having]
                yield f"{method} is shown without {', '.join(missing)} where '{name}' is: it was not measured there."
            if having and not series(having, name)[0]:
                yield f"'{name}' of {method} is not shown: its seeds were never measured at the same step."


def _absent(comparison: Comparison) -> Iterator[str]:
    names = plain(", ".join(comparison.methods))
    if not comparison.having(["k"]):
        yield f"there is no figure of k, since nothing here reports one ({names})."
    if not comparison.having(LOSSES):
        yield f"there is no figure of losses, since nothing here reports {' or '.join(LOSSES.values())} losses ({names})."
