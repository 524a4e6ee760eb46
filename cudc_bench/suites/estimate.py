"""How long jobs take and how much room their output takes, from what was measured: here, or else in the table of the package."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from os import cpu_count
from pathlib import Path
from statistics import fmean
from typing import Any

from cudc_bench.artefacts.ids import stored_ids
from cudc_bench.artefacts.manifest import read_manifest
from cudc_bench.artefacts.provenance import processor
from cudc_bench.artefacts.records import read_record, record_files
from cudc_bench.envs import check_domain
from cudc_bench.errors import RunError, UsageError

from .jobs import Job

TABLE = Path(__file__).with_name("rates.json")
_MOST_RECORDS = 300  # that are read
# Rates of jobs that are short beside the rest: seconds for a state. Measured once; see benchmarks/README.md.
_RELABEL, _STATS = 1e-5, 1e-4
_RECORD_BYTES = 60_000  # with the policy of a small profile


@dataclass
class Rates:
    """Seconds for a unit of work (an environment or gradient step) of each kind of job.

    Attributes:
        source: where they are from, for people.
        seconds: by (kind, domain, method or algorithm); some measurements each.
    """

    source: str
    seconds: dict[tuple[str, str, str], list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, kind: str, domain: str, name: str, seconds: float, units: int) -> None:
        """Add a measurement."""
        if units > 0 and seconds >= 0:
            self.seconds[kind, domain, name].append(seconds / units)

    def of(self, kind: str, domain: str, name: str) -> float | None:
        """The mean for this very work, or else for what is nearest to it; None if nothing like it was measured."""
        asked = (kind, domain, name)
        # Collectors are alike enough for a first guess; offline algorithms differ tenfold.
        for parts in ((0, 1, 2), (0, 2), (0, 1), (0,)) if kind == "collect" else ((0, 1, 2), (0, 2)):
            found = [one for key, some in self.seconds.items() if all(key[i] == asked[i] for i in parts) for one in some]
            if found:
                return fmean(found)
        return None


@dataclass(frozen=True)
class Estimates:
    """What jobs may cost.

    Attributes:
        totals: units of work of each job.
        rates: the best first.
    """

    totals: Mapping[Job, int]
    rates: tuple[Rates, ...]

    def seconds(self, job: Job) -> float | None:
        """Of one job; None if nobody measured anything like it."""
        if job.kind in ("relabel", "stats"):
            return self.totals[job] * (_RELABEL if job.kind == "relabel" else _STATS)
        name = job.algo if job.kind == "evaluate" else job.method
        kind = "evaluate" if job.kind == "evaluate" else "collect"
        for rates in self.rates:
            if (found := rates.of(kind, job.domain, str(name))) is not None:
                return found * self.totals[job]
        return None

    def source(self, job: Job) -> str | None:
        """Where an estimate is from; None for jobs that are short, or that nobody can estimate."""
        kind = "evaluate" if job.kind == "evaluate" else "collect"
        if job.kind in ("relabel", "stats"):
            return None
        return next((rates.source for rates in self.rates if rates.of(kind, job.domain, str(job.algo or job.method)) is not None), None)

    def size(self, job: Job) -> int:
        """Bytes that a job's output takes."""
        facts, states = check_domain(job.domain), self.totals[job]
        if job.kind == "collect":
            row = 4 * facts.observation_size + 4 * facts.action_size + 8 * facts.physics_size + 4 + 2
            return states * len(job.seeds) * row
        if job.kind == "relabel":
            return 4 * states * len(job.tasks)
        return _RECORD_BYTES * len(job.seeds) * len(job.tasks) if job.kind == "evaluate" else 0


def measured_here(profile: str, device: str, output: Path) -> Rates:
    """From the datasets and records of a profile that this machine has finished."""
    rates = Rates("measured here")

    def is_here(machine: Mapping[str, Any]) -> bool:
        return (machine.get("processor"), machine.get("cores"), machine.get("device")) == (processor(), cpu_count(), device)

    for one in stored_ids():
        with suppress(UsageError, RunError):
            manifest = read_manifest(one)
            if manifest.task is None and manifest.was_collected and manifest.profile == profile and is_here(manifest.machine):
                rates.add("collect", manifest.domain, manifest.method, manifest.seconds, manifest.steps)
    for path in record_files(output / profile)[:_MOST_RECORDS]:
        with suppress(RunError):
            record = read_record(path)
            if is_here(record.machine):
                seconds = record.seconds if record.zero_shot is None else record.zero_shot.training_seconds
                rates.add("evaluate", record.dataset.domain, record.algorithm, seconds, record.final.step)
    return rates


@cache
def _table() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(TABLE.read_text(encoding="utf-8"))
    return found


def from_table(profile: str, device: str) -> Rates:
    """From the table of the package, of another machine perhaps."""
    table = _table()
    rates = Rates(f"measured on {table['machine']}, {table['date']}")
    for row in table["rates"]:
        if profile in row["profiles"] and row["device"] == device:
            for name, milliseconds in row["milliseconds"].items():
                rates.add(row["kind"], row["domain"], name, milliseconds / 1e3, 1)
    return rates
