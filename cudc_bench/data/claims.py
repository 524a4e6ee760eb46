"""What a dataset says of itself beside its arrays: whether that can be right, and how much of it nobody can prove."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.commands import Parsed, parse_command, settings_that_differ
from cudc_bench.artefacts.manifest import Manifest, Mixture
from cudc_bench.artefacts.provenance import is_own_command
from cudc_bench.artefacts.tiers import LearningPoint, step_of
from cudc_bench.data.mixing import share_of
from cudc_bench.envs.domains import Domain
from cudc_bench.errors import CudcBenchError, UsageError
from cudc_bench.settings.profiles import PROFILES

# What relabelling changes of a base's manifest, or makes anew; all else a relabelled dataset has from its base.
OWN = frozenset(
    {
        "task", "base", "collected", "reward", "command", "fields", "fingerprint", "versions", "commit", "dirty", "machine", "seconds",
        "created",
    }
)  # fmt: skip
# Values of a loop that a profile alone decides; a method, or its paper's values for a domain, may win over its other ones.
_OF_PROFILES = ("steps", "seed_steps", "update_every", "measure_every")


def contradictions(manifest: Manifest, domain: Domain) -> Iterator[str]:
    """What of a manifest cannot be right, as parts of sentences.

    Args:
        manifest: a dataset's.
        domain: its.
    """
    if manifest.reward is not None:
        yield from _about_reward(manifest, domain)
    for name, value in manifest.overrides.items():
        if name not in manifest.hyperparameters or manifest.hyperparameters[name] != value:
            yield f"its overrides say {name}={value!r:.60}, and its hyperparameters do not"
    if manifest.was_collected:
        for name, (then, now) in (_changed(manifest) or {}).items():
            if name in _OF_PROFILES:
                yield f"it was collected with {name}={then} where profile {manifest.profile} has {now}, and its overrides do not say so"
        if (step := manifest.diagnostics.get("step", manifest.steps)) != manifest.steps:
            yield f"its diagnostics are of step {step!r:.20}, and it has {manifest.steps:,} steps"
    yield from _about_command(manifest)


def from_base(manifest: Manifest, base: Manifest) -> Iterator[str]:
    """The names of what a relabelled dataset should have from its base, and has not."""
    own, there = manifest.model_dump(exclude=set(OWN)), base.model_dump(exclude=set(OWN))
    return (name for name in own if own[name] != there[name])


def odd_parts(manifest: Manifest, domain: Domain) -> str | None:
    """Why a mixture's parts cannot be what it says, as a part of a sentence; None if they can."""
    assert manifest.mixture is not None
    parts, length = manifest.mixture.parts, domain.episode_length
    counts, steps = [len(part.episodes) for part in parts], manifest.hyperparameters.get("steps")
    if len(set(counts)) > 1 or any(len(set(part.episodes)) < len(part.episodes) for part in parts):
        return f"its parts are not equally many different episodes, but {', '.join(map(str, counts))}"
    if sum(counts) != manifest.episodes or sum(counts) * length != manifest.steps:
        return f"its parts have {sum(counts):,} episodes of {length:,} steps, and it {manifest.episodes:,} and {manifest.steps:,} steps"
    if len({part.fingerprint for part in parts}) < len(parts):
        return "one of its parts is there twice"
    if not isinstance(steps, int) or share_of(steps, len(parts), domain) != counts[0]:
        return f"{counts[0]:,} episodes of each of its parts are not what steps={steps!r:.40} asks for"
    return None


def odd_tier(manifest: Manifest) -> str | None:
    """Why a dataset cannot be of the part of a training that it says, as a part of a sentence; None if it can."""
    assert manifest.tier is not None
    tier, steps = manifest.tier, manifest.hyperparameters.get("steps")
    wanted = {"replay": steps, "medium-replay": tier.step}.get(tier.kind, manifest.hyperparameters.get("data_steps"))
    if manifest.method != tier.kind or manifest.task is None or manifest.base is not None:
        return f"it is {tier.kind} of a training, and says method {manifest.method:.40}, task {manifest.task}"
    if manifest.steps != wanted:
        return f"it has {manifest.steps:,} steps, and {tier.kind} of its training has {wanted!r:.40}"
    right = step_of(tier.kind, tier.curve, tier.expert_score)
    if tier.curve[-1].step != steps or LearningPoint(step=right, score=tier.score) not in tier.curve or tier.step != right:
        return f"its training's curve leads to step {right:,} of {steps!r:.40}, and it says step {tier.step:,} and score {tier.score:g}"
    return None


def odd_environment(there: Any, expected: dict[str, Any]) -> tuple[str, Any, Any] | None:
    """The first entry of an environment's specification that is another than ours, with its value and ours; nothing is imported.

    Gymnasium imports and calls whatever entry points and wrappers a specification names as soon as somebody asks for the environment. The
    other entries depend on the version of Gymnasium that wrote them: those that one version lacks must be empty.

    Args:
        there: what was read.
        expected: ours, as Gymnasium writes it.
    """
    if not isinstance(there, dict):
        return "itself", there, expected
    for name in (*expected, *sorted(there.keys() - expected.keys())):
        found, wanted = there.get(name), expected.get(name)
        missing = name not in there and name not in {"id", "entry_point", "max_episode_steps", "kwargs"}
        if not (missing or found == wanted or (name not in expected and not found)):
            return name, found, wanted
    return None


def remarks(manifest: Manifest) -> Iterator[str]:
    """What is no contradiction but should be known, as parts of sentences."""
    if not manifest.was_collected:
        return
    changed = _changed(manifest)
    if changed is None:
        yield f"whether these are {manifest.method}'s hyperparameters at profile {manifest.profile} is not known here"
    elif others := [f"{name}={then} ({now} now)" for name, (then, now) in changed.items() if name not in _OF_PROFILES]:
        yield f"{manifest.method} has other hyperparameters at profile {manifest.profile} by now: {', '.join(others):.300}"
    try:
        parse_command(manifest.command)
    except UsageError as error:
        yield str(error)


def _changed(manifest: Manifest) -> dict[str, tuple[Any, Any]] | None:
    if manifest.profile not in PROFILES:
        return None
    try:
        found: dict[str, tuple[Any, Any]] | None = plugins.load("stages", "changed_since")(manifest)
    except CudcBenchError:
        return None
    return found


def _about_reward(manifest: Manifest, domain: Domain) -> Iterator[str]:
    assert manifest.reward is not None
    name = manifest.reward.reference.partition(":")[2]
    if manifest.task in domain.tasks:
        yield f"its rewards are by the function {manifest.reward.reference}, and not those of the task {manifest.task} as it says"
    elif manifest.task != name:
        yield f"its task is {manifest.task!r}, and the function {manifest.reward.reference} makes the rewards of '{name}'"


def _about_parts(mixture: Mixture, command: Parsed) -> Iterator[str]:
    if command.names("dataset_ids") != (parts := tuple(part.id for part in mixture.parts)):
        yield f"its command does not name its parts {', '.join(parts):.200} in their order"


def _about_command(manifest: Manifest) -> Iterator[str]:
    try:
        command = parse_command(manifest.command)
    except UsageError as error:
        # One of ours that this version does not know may be of another one.
        if not is_own_command(manifest.command):
            yield str(error)
        return
    task, reward = manifest.task, manifest.reward
    expected: dict[str, str | int | None]
    if manifest.base is not None:
        kind, expected = "relabel", {"dataset_ids": manifest.base.id}
        expected |= {"tasks": task} if reward is None else {"reward": reward.reference}
    elif manifest.imported is not None:
        kind, expected = "import-", {}
    elif manifest.tier is not None:
        kind, expected = "tiers", {"domain": manifest.domain, "tasks": task, "seeds": manifest.seed, "profile": manifest.profile}
        expected["steps"] = manifest.overrides.get("data_steps")
    elif manifest.mixture is not None:
        yield from _about_parts(manifest.mixture, command)
        kind, expected = "mix", {"seed": manifest.seed, "steps": manifest.hyperparameters.get("steps")}
    else:
        kind = "collect"
        expected = {"method": manifest.method, "domain": manifest.domain, "seeds": manifest.seed, "profile": manifest.profile}
    if not command.name.startswith(kind):
        yield f"its command is '{command.name}', which makes no such dataset"
        return
    yield from command.contradictions(expected)
    if kind in ("collect", "tiers"):
        try:
            everything = {"precision": "float32"} | manifest.hyperparameters
            overrides = {name: value for name, value in manifest.overrides.items() if kind == "collect" or name != "data_steps"}
            yield from settings_that_differ(command.settings, overrides, everything)
        except UsageError as error:
            yield f"its command is refused ({str(error).rstrip('.')})"
