"""``mix``: from several task-agnostic datasets of a domain to one of equal parts, to train on as on any of them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, default_id, parse_id
from cudc_bench.artefacts.manifest import (
    IMPORTED_PROFILE,
    MIXTURE,
    MOST_PARTS,
    Collected,
    Manifest,
    Mixture,
    Part,
    check_free,
    fingerprint,
    read_manifest,
)
from cudc_bench.artefacts.provenance import command_line, stamp
from cudc_bench.data.descriptors import Visits
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.mixing import draw_episodes, share_of, whole_episodes
from cudc_bench.data.reader import read_episodes
from cudc_bench.data.staging import publish, staging, tidy
from cudc_bench.data.writer import Episode, write_episodes
from cudc_bench.envs import Domain, check_domain, domain_title
from cudc_bench.errors import UsageError
from cudc_bench.execution import interrupts
from cudc_bench.execution.progress import Advance, bars, echo
from cudc_bench.files import check_folder
from cudc_bench.runs.existing import dataset_stands
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.profiles import PAPER_STEPS, PROFILES
from cudc_bench.settings.seeds import check_seeds


def mix(
    dataset_ids: Sequence[str], steps: int | None = None, seed: int = 1, *, dataset_id: str | None = None, overwrite: bool = False
) -> str:
    """Make one dataset of equal parts of several task-agnostic ones of a domain.

    Each part gives equally many whole episodes, drawn without replacement by the seed and the part's fingerprint alone, so that all of them
    last as long as the domain's do. They take turns: what is trained on the first transitions has equal parts, too. Infos that not all
    parts have in one form are left out. A mixture that exists and is what this would make is kept.

    Args:
        dataset_ids: of the parts, two at least.
        steps: at most so many, rounded down to equal parts of whole episodes; those of the smallest part unless given, so that a
            mixture can be compared with its parts.
        seed: of the draw, and by which the mixture is known among others of the same parts.
        dataset_id: instead of the default id, such as ``walker/mixture-v0``.
        overwrite: replace a dataset that exists.

    Returns:
        The id of the mixture.

    Raises:
        UsageError: wrong input; nothing has been written.
        RunError: a part is damaged, or the mixture cannot be written.
    """
    (seed,) = check_seeds([seed])
    check_folder(datasets_root(), "the dataset root")
    wanted = _Wanted.checked(dataset_ids, steps, seed)
    usual = default_id(wanted.domain.name, MIXTURE, seed, wanted.profile)
    one = usual if dataset_id is None else parse_id(dataset_id)
    if str(one) in wanted.sources:
        raise UsageError(f"'{one}' itself would be replaced; give another --dataset-id.")
    if not overwrite and dataset_stands(one, wanted.is_made):
        tidy(one)
        echo(f"{one} was mixed of these very parts: kept")
        return str(one)
    check_free(one, overwrite)

    domain, mixture = wanted.domain, wanted.mixture
    share = len(mixture.parts[0].episodes) * domain.episode_length
    echo(f"mix {', '.join(wanted.sources)}: {share:,} steps of each" + (f" ({wanted.short})" if wanted.short else ""))
    if mixture.ignored:
        echo(f"left out, since not all parts have them in one form: {', '.join(f'infos/{name}' for name in mixture.ignored)}")
    started = time.monotonic()
    relabeler, visits = plugins.load("relabelers", domain.relabeler)(domain), Visits(domain) if wanted.is_covered else None
    with staging(one) as building, interrupts.leaving_gracefully(saves=False):
        _check_whole(wanted)
        with bars([(f"mix {one}", len(mixture.parts) * share)], "steps") as (advance,):
            written = write_episodes(building / "data", _episodes(wanted, relabeler, visits, advance))
        values = wanted.values
        manifest = Manifest(
            domain=domain.name,
            method=MIXTURE,
            seed=seed,
            steps=written.steps,
            episodes=written.episodes,
            profile=wanted.profile,
            overrides=wanted.overrides,
            hyperparameters=values,
            hyperparameters_hash=config_hash(values),
            citation="; ".join(dict.fromkeys(part.citation for part in mixture.parts if part.citation)),
            fields=written.fields,
            fingerprint=fingerprint(written.fields),
            mixture=mixture,
            diagnostics={} if visits is None else visits.coverage.as_row(),
            command=_command(wanted, one, usual),
            **stamp(time.monotonic() - started),
        )
        write_metadata(building / "data", manifest, str(one), _description(manifest))
        publish(building, one)
    echo(f"wrote {one} to {dataset_path(one)}")
    return str(one)


@dataclass(frozen=True)
class _Wanted:
    """A mixture that somebody asks for.

    Attributes:
        sources: the manifests of its parts by their ids.
        domain: of all of them.
        steps: at most so many.
        seed: of the draw.
        profile: at which the parts were collected; imported ones go with any.
        mixture: which episodes it has.
    """

    sources: dict[str, Manifest]
    domain: Domain
    steps: int
    seed: int
    profile: str
    mixture: Mixture

    @classmethod
    def checked(cls, dataset_ids: Sequence[str], steps: int | None, seed: int) -> _Wanted:
        """The same as a user asks for it.

        Raises:
            UsageError: it cannot be.
        """
        sources = _sources([str(parse_id(one)) for one in dataset_ids])
        manifests = list(sources.values())
        domain = check_domain(manifests[0].domain)
        length, count = domain.episode_length, len(sources)
        steps = min(one.steps for one in manifests) if steps is None else steps
        if (share := share_of(steps, count, domain)) < 1:
            least = f"{count} parts of whole episodes have {count * length:,} at least"
            raise UsageError(f"{steps:,} steps are too few for a mixture of these: {least}; give --steps, or leave out some.")
        parts = []
        for one, manifest in sources.items():
            whole = whole_episodes(one, domain)
            if len(whole) < share:
                most = f"; --steps can be {len(whole) * length * count:,} at most" if whole else ""
                raise UsageError(f"'{one}' has {len(whole):,} whole episodes of {length:,} steps, and {share:,} are needed{most}.")
            parts.append(_part(one, manifest, draw_episodes(whole, share, seed, manifest.fingerprint)))
        profiles = {one.profile for one in manifests} - {IMPORTED_PROFILE}
        mixture = Mixture(parts=parts, ignored=_ignored(parts))
        return cls(sources, domain, steps, seed, next(iter(profiles), IMPORTED_PROFILE), mixture)

    @property
    def overrides(self) -> dict[str, Any]:
        """What keeps it from tables of its profile: another size, and what its parts were collected with."""
        found: dict[str, Any] = {}
        if self.profile in PROFILES and self.steps != PROFILES[self.profile].collect.get("steps", PAPER_STEPS):
            found["steps"] = self.steps
        for part in self.mixture.parts:
            found |= {f"{part.method}.{name}": value for name, value in part.overrides.items()}
        return found

    @property
    def values(self) -> dict[str, Any]:
        """All that decides it beside its parts and its seed."""
        return {"steps": self.steps} | self.overrides

    @property
    def is_covered(self) -> bool:
        """Whether the coverage of the domain's descriptors can be measured."""
        return bool(self.domain.descriptors) and all("infos/physics" in one.fields for one in self.sources.values())

    @property
    def short(self) -> str:
        """Why it has fewer steps than were asked for; empty if it has them."""
        parts, length = len(self.mixture.parts), self.domain.episode_length
        return f"{self.steps:,} are not {parts} parts of whole episodes of {length:,}" if self.steps % (parts * length) else ""

    def is_made(self, there: Manifest) -> bool:
        """Whether a dataset is what this would make."""
        found = (there.domain, there.task, there.seed, there.profile, there.hyperparameters, there.mixture)
        return found == (self.domain.name, None, self.seed, self.profile, self.values, self.mixture)


def _sources(ids: Sequence[str]) -> dict[str, Manifest]:
    """The manifests of datasets that can be mixed, by id.

    Raises:
        UsageError: they cannot.
    """
    if len(ids) < 2:
        raise UsageError("a mixture has two parts at least; name two datasets or more, such as walker/cudc-v0 walker/rnd-v0.")
    if len(ids) > MOST_PARTS:
        raise UsageError(f"a mixture has at most {MOST_PARTS} parts, not {len(ids):,}; leave out some.")
    sources: dict[str, Manifest] = {}
    for one in ids:
        manifest = read_manifest(one)
        twin = next((other for other, there in sources.items() if there.fingerprint == manifest.fingerprint), None)
        if twin is not None:
            raise UsageError(f"'{one}' was named twice; name it once." if one == twin else f"'{one}' has the same data as '{twin}'.")
        if manifest.task is not None:
            hint = "" if manifest.base is None else f"; name its base '{manifest.base.id}', and relabel the mixture"
            raise UsageError(f"'{one}' is labelled for {manifest.task}, and a mixture is of task-agnostic datasets{hint}.")
        if manifest.mixture is not None:
            raise UsageError(f"'{one}' is a mixture itself; name its parts {', '.join(part.id for part in manifest.mixture.parts)}.")
        sources[one] = manifest
    first, *others = sources.items()
    for one, manifest in others:
        if manifest.domain != first[1].domain:
            raise UsageError(f"'{first[0]}' is of {first[1].domain} and '{one}' of {manifest.domain}; a mixture is of one domain.")
        if ("infos/physics" in manifest.fields) != ("infos/physics" in first[1].fields):
            without = one if "infos/physics" in first[1].fields else first[0]
            raise UsageError(f"'{without}' holds no physics states and others do: nothing could label the mixture; leave it out.")
    profiles = {manifest.profile: one for one, manifest in sources.items() if manifest.profile != IMPORTED_PROFILE}
    if len(profiles) > 1:
        (here, one), (there, other), *_ = profiles.items()
        raise UsageError(f"'{one}' is of profile {here} and '{other}' of {there}; a mixture is of one profile.")
    return sources


def _part(one: str, manifest: Manifest, episodes: list[int]) -> Part:
    return Part(
        id=one,
        fingerprint=manifest.fingerprint,
        method=manifest.method,
        seed=manifest.seed,
        profile=manifest.profile,
        overrides=manifest.overrides,
        hyperparameters=manifest.hyperparameters,
        citation=manifest.citation,
        source=None if manifest.imported is None else manifest.imported.source,
        collected=Collected(versions=manifest.versions, machine=manifest.machine),
        episodes=episodes,
    )


def _ignored(parts: Sequence[Part]) -> list[str]:
    """The infos that not all parts have in rows of one type and shape."""
    kinds = []
    for part in parts:
        names = tuple(name for name in read_manifest(part.id).fields if name.startswith("infos/"))
        (first,) = read_episodes(part.id, (*names, "actions"), episodes=part.episodes[:1])
        kinds.append({name: (first[name].dtype, first[name].shape[1:]) for name in names})
    every = {name for kind in kinds for name in kind}
    return sorted(name.removeprefix("infos/") for name in every if len({kind.get(name) for kind in kinds}) > 1)


def _check_whole(wanted: _Wanted) -> None:
    """Hash the parts: what a mixture names is what it has.

    Raises:
        RunError: one is damaged.
    """
    labels = [(f"read {one}", manifest.episodes) for one, manifest in wanted.sources.items()]
    with bars(labels, "episodes") as advances:
        for (one, manifest), advance in zip(wanted.sources.items(), advances, strict=True):
            for _ in read_episodes(one, tuple(manifest.fields), verify=True, domain=wanted.domain):
                _leave_if_asked()
                advance(1)


def _episodes(wanted: _Wanted, relabeler: Any, visits: Visits | None, advance: Advance) -> Iterator[Episode]:
    """The episodes of all parts in turn, one of each in memory at a time."""
    mixture, manifests = wanted.mixture, list(wanted.sources.values())
    infos = [name for name in manifests[0].fields if name.startswith("infos/") and name.removeprefix("infos/") not in mixture.ignored]
    readers = [
        read_episodes(part.id, ("observations", "actions", *infos), domain=wanted.domain, episodes=part.episodes) for part in mixture.parts
    ]
    for number, together in enumerate(zip(*readers, strict=True)):
        for part, found in zip(mixture.parts, together, strict=True):
            _leave_if_asked()
            if visits is not None:
                # Row 0 of an episode is its reset.
                visits.add(relabeler.quantities(found["infos/physics"][1:], found["actions"]))
            seed = part.episode_seed(number)
            yield Episode(seed, found["observations"], found["actions"], {name.removeprefix("infos/"): found[name] for name in infos})
            advance(len(found["actions"]))


def _leave_if_asked() -> None:
    if interrupts.requested():
        raise KeyboardInterrupt


def _description(manifest: Manifest) -> str:
    assert manifest.mixture is not None
    parts = ", ".join(f"{part.id} ({part.label}, seed {part.seed})" for part in manifest.mixture.parts)
    whole = f"Equal parts of task-agnostic datasets in {domain_title(manifest.domain)}, by whole episodes: {parts}. The rewards are all 0."
    return f"{whole} Relabel it for a task with cudc-bench." if "infos/physics" in manifest.fields else whole


def _command(wanted: _Wanted, one: DatasetId, usual: DatasetId) -> str:
    options = {"--steps": str(wanted.steps), "--seed": str(wanted.seed)}
    options |= {} if one == usual else {"--dataset-id": str(one)}
    return command_line(f"mix {' '.join(wanted.sources)}", options, {})
