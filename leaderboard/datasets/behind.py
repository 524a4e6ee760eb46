"""The datasets behind a leaderboard: what its records say of each."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from cudc_bench.artefacts.again import base_id, collect_commands
from cudc_bench.artefacts.manifest import Manifest, exists, read_manifest
from cudc_bench.artefacts.provenance import is_own_command
from cudc_bench.artefacts.records import Record, settings_text
from cudc_bench.artefacts.tiers import TIERS
from cudc_bench.errors import CudcBenchError, UsageError
from cudc_bench.text import plain

from ..numbers.columns import column
from ..numbers.table import Table
from ..numbers.words import file_slug
from .diagnostics import Comparison, Run, compare, read_diagnostics
from .quality import Quality


@dataclass(frozen=True)
class Dataset:
    """A collection that one or several records were trained on.

    Attributes:
        id: the collected dataset's; None where the records' ids do not tell or are none.
        name: what to call it.
        method: its column in tables.
        domain, seed, steps, profile, overrides, source: as in the records.
        labelled: task, id and fingerprint of each dataset that was trained on.
        records: all that were trained on it.
        slug: a safe and unique name for files.
    """

    id: str | None
    name: str
    method: str
    domain: str
    seed: int
    steps: int
    profile: str
    overrides: Mapping[str, Any] = field(hash=False)
    source: str | None
    labelled: tuple[tuple[str, str, str], ...]
    records: tuple[Record, ...] = field(repr=False)
    slug: str

    @property
    def settings(self) -> str:
        """The profile of its collection and whatever differs from it."""
        return f"{self.profile} ({settings_text(self.overrides)})" if self.overrides else self.profile

    @property
    def commands(self) -> list[tuple[str, str]]:
        """What collects and labels it again, as label and command; nothing where no command could."""
        if self.source is not None or self.id is None:
            return []
        first = self.records[0].dataset
        what = {"collect": "Collect a part" if first.parts else "Collect it", "mix": "Mix the parts", "tiers": "Train online"}
        found = [(what[command.split()[1]], command) for command in collect_commands(first)]
        if first.method not in TIERS:
            found.append(("Label it", f"cudc-bench relabel {self.id}"))
        return [(label, command) for label, command in found if is_own_command(command)]


@dataclass(frozen=True)
class Local:
    """A dataset that is in Minari's root on this machine, with the fingerprint that the records name.

    Attributes:
        id, manifest: which.
        quality: what its states are worth, without the particle entropy; None where it has no physics states.
        diagnostics: SHA-256 of the diagnostics beside it; empty without any.
    """

    id: str
    manifest: Manifest
    quality: Quality | None
    diagnostics: str = ""

    @property
    def digest(self) -> str:
        """Tells whether anything of it has changed."""
        return hashlib.sha256("\n".join([self.manifest.model_dump_json(), repr(self.quality), self.diagnostics]).encode()).hexdigest()

    @cached_property
    def collection(self) -> Comparison | None:
        """What its collector measured of itself, by itself; None for imported data, which have no diagnostics, and for damaged ones."""
        try:
            (found,), _ = compare([Run(self.id, self.manifest, *read_diagnostics(self.id))])
        except CudcBenchError:
            return None  # That is no reason to leave the rest out.
        return found


def datasets_of(tables: Iterable[Table]) -> list[Dataset]:
    """The datasets behind some tables, by domain, profile, method and seed."""
    together: dict[tuple[str, str, str, int, str], list[Record]] = defaultdict(list)
    for table in tables:
        for record in table.records:
            one = record.dataset
            settings = f"{one.profile} {json.dumps(one.overrides, sort_keys=True)}"
            together[one.domain, settings, column(record), one.seed, base_id(record.dataset) or one.id].append(record)
    found = []
    for key in sorted(together):
        domain, settings, method, seed, name = key
        records = together[key]
        one = records[0].dataset
        labelled = sorted({(record.dataset.task, record.dataset.id, record.dataset.fingerprint) for record in records})
        slug = file_slug(
            name.replace("/", "-") if base_id(records[0].dataset) and not one.overrides and one.source is None else "\n".join(map(str, key))
        )
        # Ids that differ in where a slash stands, and profiles under one id, must not share a page.
        slug = f"{slug[:80]}-{hashlib.sha256(repr((settings, method, seed, name)).encode('utf-8', 'backslashreplace')).hexdigest()[:8]}"
        found.append(
            Dataset(base_id(records[0].dataset), plain(name), method, domain, seed, one.steps, one.profile, one.overrides, one.source,
                    tuple(labelled), tuple(records), slug)
        )  # fmt: skip
    return found


def find_base(dataset_id: str, fingerprint: str) -> tuple[str, Manifest] | None:
    """The id and manifest of what was collected, of a dataset that was trained on; None if it is not here, or is another.

    Args:
        dataset_id, fingerprint: as a record names them.

    Raises:
        RunError: what is there is damaged.
    """
    try:
        if not exists(dataset_id):
            return None
        manifest = read_manifest(dataset_id)
        if manifest.fingerprint != fingerprint:
            return None
        if manifest.base is None:
            return dataset_id, manifest
        base = read_manifest(manifest.base.id)
    except UsageError:
        return None  # no id, or somebody else's dataset
    return (manifest.base.id, base) if base.fingerprint == manifest.base.fingerprint else None
