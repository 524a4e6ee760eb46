"""What a run of a collector is made of, from a method's name, a domain, a profile and settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cudc_bench import plugins
from cudc_bench.artefacts.manifest import Manifest, Pilot
from cudc_bench.artefacts.provenance import command_line
from cudc_bench.envs import check_domain
from cudc_bench.errors import UsageError
from cudc_bench.execution.progress import echo
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import as_dict, build, changed, check_settings, config_hash
from cudc_bench.settings.profiles import Profile, resolve_profile

from ..base import Sizes
from .thresholds import find_threshold


class NoThresholdError(UsageError):
    """A method needs a threshold that no pilot has measured yet."""


@dataclass(frozen=True)
class RunSpec:
    """One method on one domain.

    Attributes:
        method, domain, profile: their names.
        kind: the method's class.
        loop, config: all hyperparameters.
        overrides: those that the user changed.
        pilot: where the method's threshold came from, if it needs one that the user did not give.
    """

    method: str
    domain: str
    profile: str
    kind: Any
    loop: CollectConfig
    config: Any
    overrides: dict[str, Any]
    pilot: Pilot | None = None

    @property
    def values(self) -> dict[str, Any]:
        """All hyperparameters by name."""
        return as_dict(self.loop, self.config)

    @property
    def updates(self) -> int:
        """How many a whole run makes, at most."""
        return max(0, self.loop.steps - self.loop.seed_steps) // self.loop.update_every

    @property
    def sizes(self) -> Sizes:
        """The sizes that the method is built for."""
        facts = check_domain(self.domain)
        return Sizes(
            self.domain, facts.observation_size, facts.action_size, facts.episode_length, self.loop.seed_steps, self.loop.update_every,
            self.loop.steps,
        )  # fmt: skip


def resolve(method: str, domain: str, profile: Profile, settings: Mapping[str, Any] | None = None, piloting: bool = False) -> RunSpec:
    """Everything that a run needs to know, checked.

    Args:
        method: a registered collector.
        domain: a registered domain.
        profile: the set of hyperparameters to start from.
        settings: hyperparameters that differ, by name.
        piloting: put 0 in the place of the threshold that a pilot is about to measure.

    Raises:
        UsageError: wrong input, or settings that do not fit each other.
        NoThresholdError: no pilot has measured the threshold yet.
    """
    kind = plugins.load("collectors", method)
    length = check_domain(domain).episode_length
    settings = dict(settings or {})
    check_settings(settings, [CollectConfig, kind.config_class])
    loop, config = build(CollectConfig, profile.collect, settings), kind.configure(domain, profile.collect, settings)
    plain = as_dict(build(CollectConfig, profile.collect), kind.configure(domain, profile.collect))
    found, name = None, kind.measured_by_pilot(config)
    if name is not None and (piloting or getattr(config, name) is None):
        overrides = changed(as_dict(loop, config), plain)
        found = None if piloting else find_threshold(kind, method, domain, loop, config)
        if found is None and not piloting:
            options = {"--method": method, "--domain": domain, "--profile": profile.name}
            command = command_line("pilot", options, overrides)
            raise NoThresholdError(
                f"{method} needs {name}, which nobody measured for {domain} yet; run: {command}, or give --set {name}=VALUE."
            )
        value = {name: 0.0 if found is None else found.value}
        config, plain = kind.configure(domain, profile.collect, settings | value), plain | value
    setting = RunSpec(method, domain, profile.name, kind, loop, config, changed(as_dict(loop, config), plain), found)
    # Building once here finds settings that do not fit each other before any process starts.
    try:
        longest = kind(setting.sizes, config, [1], "cpu").max_horizon
    except ValueError as error:
        raise UsageError(f"{method} cannot be built: {error}.") from None
    if longest > length:
        raise UsageError(f"a horizon of {longest} steps does not fit into episodes of {length}.")
    return setting


def changed_since(manifest: Manifest) -> dict[str, tuple[Any, Any]] | None:
    """What its method, with the same profile and overrides, has other values for by now than when a dataset was collected.

    Args:
        manifest: the dataset's.

    Returns:
        For each such hyperparameter the dataset's value and today's; None stands for one that is not written down. None in all where
        today's cannot be known: the method is not installed, refuses these overrides, or waits for its pilot.
    """
    try:
        setting = resolve(manifest.method, manifest.domain, resolve_profile(manifest.profile), manifest.overrides)
    except UsageError:
        return None
    then, now = manifest.hyperparameters, setting.values
    if config_hash(now) == manifest.hyperparameters_hash:
        return {}
    pairs = {name: (then.get(name), now.get(name)) for name in then | now}
    return {name: pair for name, pair in pairs.items() if config_hash({name: pair[0]}) != config_hash({name: pair[1]})}


def echo_whose_values(setting: RunSpec) -> None:
    """Say it when a method whose paper tunes it per domain has no values for this one."""
    kind, domain = setting.kind, setting.domain
    if not kind.domain_values or domain in kind.domain_values:
        return
    plain = as_dict(kind.configure(domain))
    same = [name for name in kind.domain_values if as_dict(kind.configure(name)) == plain]
    echo(f"{setting.method} has no values of its own for {domain}; it takes {'those for ' + same[0] if same else 'its defaults'}")
