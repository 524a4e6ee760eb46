"""The card of a dataset: ``README.md`` in its folder, as people and the Hugging Face Hub read it.

It is a function of the manifest and the arrays alone. Names and values in it may come from anywhere and are escaped.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from markupsafe import Markup

from cudc_bench.artefacts.k_schedule import k_schedule, suspect_limits
from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.data.measure import CARD, NEIGHBOUR, Coverage, RewardStatistics
from cudc_bench.envs.domains import Domain, domain_title
from cudc_bench.text import escape_markdown, plain, templates

_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"), (10**8, "10M<n<100M"))


def render_card(manifest: Manifest, dataset_id: str, description: str, rewards: RewardStatistics, coverage: Coverage) -> str:
    """The card's text, with YAML front matter as the Hub expects it.

    Args:
        manifest: what the dataset is.
        dataset_id: its id, checked.
        description: one paragraph for people.
        rewards, coverage: of its arrays.
    """
    from cudc_bench.envs import check_domain

    facts = check_domain(manifest.domain)
    sizes = {
        "observation": facts.observation_size,
        "action": facts.action_size,
        "physics": facts.physics_size if "infos/physics" in manifest.fields else 0,
        "length": f"{facts.episode_length:,}",
    }
    title = f"{dataset_id}: {manifest.domain}{f' {manifest.task}' if manifest.task else ''} by {manifest.label}"
    columns = (coverage.mean, coverage.std, coverage.min, coverage.max)
    environment = templates(Path(__file__).with_name("templates"), escape_markdown)
    return environment.get_template("card.md.j2").render(
        manifest=manifest,
        dataset_id=dataset_id,
        title=title,
        # As JSON, which YAML reads, too; without a sign that could begin a tag for readers that take it for Markdown.
        quoted_title=Markup(json.dumps(plain(title)).replace("<", "\\u003c")),
        description=description,
        facts=facts_of(manifest),
        origin=_origin(manifest),
        command=plain(manifest.command),
        hyperparameters=[(name, _value(value)) for name, value in sorted(manifest.hyperparameters.items())],
        sizes=sizes,
        rewards=rewards,
        coverage=coverage,
        descriptors=_descriptors(manifest, facts),
        number=_number,
        neighbour=NEIGHBOUR,
        saturated=CARD.saturated,
        observations=[(index, [_number(value) for value in row]) for index, row in enumerate(zip(*columns, strict=True))],
        license="unknown" if manifest.holds_others_data else "mit",
        size=Markup(next((name for limit, name in _SIZES if manifest.steps < limit), "100M<n<1B")),
        versions=", ".join(f"{name} {version}" for name, version in manifest.versions.items()),
        caveats=_caveats(manifest),
    )


def facts_of(manifest: Manifest) -> list[tuple[str, str]]:
    """What a manifest says, as names and values for people; what is unknown or empty is left out."""
    rows = {
        "domain": manifest.domain,
        "task": manifest.task or "none: collected without rewards",
        "method": manifest.label,
        "seed": str(manifest.seed),
        "steps": f"{manifest.steps:,} in {manifest.episodes:,} episodes",
        "k grew": str(k_schedule(manifest.diagnostics)),
        "profile": manifest.profile,
        "settings that differ": ", ".join(f"{name}={_value(value)}" for name, value in sorted(manifest.overrides.items())),
        "threshold": _threshold(manifest),
        "mixed of": _parts(manifest),
        "of the training": _training(manifest),
        "made from": "" if manifest.base is None else f"{manifest.base.id} ({'linked' if manifest.base.linked else 'copied'})",
        "made": f"{manifest.created}, in {manifest.seconds:,.0f} seconds, on {manifest.machine.get('processor', 'an unknown processor')}",
        "commit": f"{manifest.commit or ''}{' with local changes' if manifest.dirty else ''}",
    }
    return [(name, value) for name, value in rows.items() if value]


def _descriptors(manifest: Manifest, domain: Domain) -> dict[str, Any] | None:
    """What the collection measured of the domain's behaviour descriptors, where it did."""
    cells, entropy = (manifest.diagnostics.get(name) for name in ("coverage_cells", "coverage_entropy"))
    if not domain.descriptors or not isinstance(cells, int) or not isinstance(entropy, float):
        return None
    names = domain.quantities
    every = math.prod(bins.count for bins in domain.descriptors)
    widths = [(bins.high - bins.low) / bins.count for bins in domain.descriptors]
    return {
        "names": f"{', '.join(names[:-1])} and {names[-1]}",
        "widths": ", ".join(f"{width:g}" for width in widths),
        "cells": f"{cells:,}",
        "all": f"{every:,}",
        "entropy": entropy,
    }


def _origin(manifest: Manifest) -> str:
    if manifest.imported is not None:
        made = f"Imported from {manifest.imported.files:,} episode files of {manifest.imported.source}, not collected by cudc-bench."
    elif manifest.tier is not None:
        made = f"Made by TD3, trained online on {domain_title(manifest.domain)}'s task {manifest.task} with cudc-bench."
    elif manifest.mixture is not None:
        made = f"Mixed by cudc-bench in equal parts, of whole episodes of datasets in {domain_title(manifest.domain)} without rewards."
    else:
        made = f"Collected by {manifest.method} in {domain_title(manifest.domain)}, without rewards, with cudc-bench."
    if manifest.base is None:
        return made
    return f"{made} Then {manifest.base.id} was given the rewards of {manifest.task}, computed from its physics states."


def _caveats(manifest: Manifest) -> list[str]:
    found = []
    if manifest.base is not None and manifest.base.linked:
        found.append(
            f"Everything but the rewards is linked to {manifest.base.id}, which must lie below the same dataset root. A copy that stands "
            "alone is made by cudc-bench relabel with --standalone."
        )
    if manifest.imported is not None:
        found.append(f"It is {manifest.imported.source}'s data; their terms apply.")
        found.append("The seeds of its episodes are not known: they cannot be repeated from their resets, only step by step.")
    elif manifest.mixture is not None and manifest.holds_others_data:
        sources = ", ".join(sorted({part.source for part in manifest.mixture.parts if part.source is not None}))
        found.append(f"It holds data of {sources}, whose terms apply; the seeds of these episodes are not known.")
    elif manifest.profile != "paper":
        found.append(f"It was collected at profile {manifest.profile}, which is smaller than the paper's setting.")
    schedule = k_schedule(manifest.diagnostics)
    if schedule.suspect:
        starts, ends = suspect_limits(manifest.steps)
        found.append(
            f"Its schedule of k is suspect: k grew before {starts:,} environment steps, or reached its bound within "
            f"{ends:,} steps of its first growth{f' ({schedule})' if schedule.growth else ''}. A schedule this early says "
            "more about the thresholds than about what was reachable."
        )
    if manifest.tier is not None:
        found.append("Its rewards guided whoever chose its actions: it is no data of exploration without a task.")
    one = "one draw from one seed of each of its parts" if manifest.mixture is not None else "one seed of one method"
    found += [
        f"It is {one}; differences between methods need several seeds.",
        "The numbers on coverage compare datasets of one domain, not of different ones, and say nothing about any task.",
        "Another processor or version of MuJoCo rounds differently, which a simulation amplifies: there, its episodes repeat step by step "
        "but not over their whole length.",
    ]
    return found


def _threshold(manifest: Manifest) -> str:
    pilot = manifest.pilot
    return "" if pilot is None else f"{pilot.name} = {pilot.value:.6g}, measured by a pilot: {pilot.command}"


def _training(manifest: Manifest) -> str:
    tier = manifest.tier
    if tier is None:
        return ""
    part = f"its first {tier.step:,} steps" if tier.kind.endswith("replay") else f"its policy after {tier.step:,} steps, with noise"
    return f"{part}; score {tier.score:.1f} then, {tier.expert_score:.1f} of the final policy"


def _parts(manifest: Manifest) -> str:
    if manifest.mixture is None:
        return ""
    parts = ", ".join(f"{part.id} ({part.label}, seed {part.seed})" for part in manifest.mixture.parts)
    left_out = f"; without infos/{', infos/'.join(manifest.mixture.ignored)}" if manifest.mixture.ignored else ""
    return f"{parts}: episodes of each: {len(manifest.mixture.parts[0].episodes):,}{left_out}"


def _value(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
